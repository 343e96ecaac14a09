//! A scenario as resolved: every value checked, every default filled in, ready to run.

use super::fault::{self, ScriptedFault};
use super::hosts::{self, Hosts};
use super::raw::{Launch, Policy, Raw};
use super::{
    ClockKind, ConfigError, Document, Problem, Realtime, RunId, Shape, Supervision, accept, nearest, watchdog,
};
use crate::control::{ACTUATION_DELAY_MAX, WatchBounds};
use crate::rig::{self, AnyRig, Context};
use crate::role::{Actuation, Rearm};
use serde::Deserialize;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The slowest tick: a period must lie well within what a latency histogram holds.
const MIN_TICK_HZ: f64 = 0.1;
/// The fastest tick: beyond it the clock reads alone would fill the period.
const MAX_TICK_HZ: f64 = 1e5;
/// The most ticks of one run: ten years at 1 kHz.
const MAX_TICKS: f64 = 3.2e11;
/// The keys that hold one table each, whatever the rig.
const TABLES: [&str; 7] = ["actuator", "realtime", "launch", "supervision", "watchdog", "network", "accept"];

/// The bounds of the watchdog, by their keys, which are the rig's.
#[derive(Deserialize)]
struct Maxima {
    #[serde(default)]
    watchdog: BTreeMap<String, f64>,
}

/// A scenario that can be run.
#[derive(Debug)]
pub struct Scenario {
    /// Its name: part of service names and of the run directory's.
    pub name: String,
    /// What drives the ticks.
    pub clock: ClockKind,
    /// The rate that was asked for, Hz.
    pub tick_hz: f64,
    /// The period h, ns.
    pub period_ns: u64,
    /// The last tick; the first is 0.
    pub last_tick: u64,
    /// The seed of all randomness.
    pub seed: u64,
    /// Whether every sample is to be recorded.
    pub record: bool,
    /// After how many missing commands a driven body goes to its safe command.
    pub command_timeout_ticks: u64,
    /// From so many ticks after its measurement on a command acts.
    pub actuation_delay_ticks: u64,
    /// What ends the safe command.
    pub rearm: Rearm,
    /// What a real-time run asks of the machine.
    pub realtime: Realtime,
    /// How long the roles may take until all are ready, s.
    pub startup_timeout_s: f64,
    /// For how long an external role may keep the run waiting, s; if none, for ever until the ticks run, and then 30 s.
    pub external_timeout_s: Option<f64>,
    /// The roles that share a process, where roles are processes.
    pub processes: Vec<Vec<String>>,
    /// Roles that somebody else starts: hardware, or a foreign program.
    pub external: Vec<String>,
    /// Roles that wait for a debugger before the first tick.
    pub debug: Vec<String>,
    /// What the launcher does about roles that fail.
    pub supervision: Supervision,
    /// The computers, if there are several, and what holds between them.
    pub hosts: Hosts,
    /// What is to go wrong.
    pub faults: Vec<ScriptedFault>,
    /// What the controller watches.
    pub watch: WatchBounds,
    /// What the run is judged by.
    pub accept: accept::Accept,
    /// Bodies, observer and laws.
    pub rig: AnyRig,
    /// The scenario as a file that resolves to itself.
    pub resolved: toml::Table,
    /// Files that it names: key and path.
    pub files: Vec<(String, PathBuf)>,
    /// Settings without effect in a run of this length, by key.
    pub warnings: Vec<String>,
    /// The run whose scenario this is, where there is one. Whoever starts another gives it another.
    pub run: Option<RunId>,
}

impl Scenario {
    /// Reads a file, applies overrides, checks everything.
    ///
    /// # Errors
    /// [`ConfigError`], with the place, the reason and the remedy.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        Self::changed(Document::read(path)?, overrides)
    }

    /// The same from a text; `origin` stands for the file in error messages.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn parse(text: &str, origin: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        Self::changed(Document::parse(text, origin)?, overrides)
    }

    fn changed(mut document: Document, overrides: &[String]) -> Result<Self, ConfigError> {
        overrides.iter().try_for_each(|argument| document.set(argument))?;
        Self::of(document)
    }

    /// The same from a document, with whatever was changed in it.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn of(mut document: Document) -> Result<Self, ConfigError> {
        document.refuse_lists(&[&rig::tables()[..], &TABLES].concat())?;
        let sections = document.split_off(&rig::sections());
        let maxima: Maxima = document.split_off_within("watchdog", |key| key.ends_with("_max")).read_into()?;
        let metrics = document.split_off_within("accept", |key| !accept::is_common(key));
        let metrics = metrics.read_into::<accept::Metrics>();
        let mut checks = Checks::new(&document);
        let (raw, metrics) = match (document.read_into::<Raw>(), metrics) {
            (Ok(raw), Ok(metrics)) => (raw, metrics.accept),
            (raw, metrics) => {
                // The rig's own sections are read all the same; of what they say nothing can be judged.
                let context = Context { tick_s: 1.0 / MAX_TICK_HZ, duration_s: 1.0, seed: 0, actuation_delay_ticks: 1 };
                let own = document.text("rig").map(|rig| rig::resolve(rig, &sections, context, &mut checks));
                let rig = own.as_ref().and_then(|own| own.as_ref().ok()?.0.as_ref());
                let nested = nested_keys(document.text("rig"), rig);
                checks.problems.retain(|problem| problem.key == "rig");
                let others = checks.finish::<()>(None).err();
                let errors = raw.err().map(|error| error.within(&nested)).into_iter().chain(metrics.err());
                let mut errors = errors.chain(own.and_then(Result::err)).chain(others);
                let first = errors.next().expect("one of them was refused");
                return Err(first.and(errors));
            }
        };
        check_common(&raw, &mut checks);
        let period_ns = (1e9 / raw.tick_hz).round() as u64;
        // A tick that is refused is not complained of by the rig too: the shortest one stands in for it.
        let tick_s = if tick_possible(raw.tick_hz) { period_ns as f64 / 1e9 } else { 1.0 / MAX_TICK_HZ };
        let length_s = if length_possible(&raw) { raw.duration_s } else { 0.0 };
        let actuation_delay_ticks = raw.actuation_delay_ticks.clamp(1, ACTUATION_DELAY_MAX);
        let context = Context { tick_s, duration_s: length_s, seed: raw.seed, actuation_delay_ticks };
        let (rig, rig_table) = match rig::resolve(&raw.rig, &sections, context, &mut checks) {
            Ok(resolved) => resolved,
            Err(error) => return Err(error.and(checks.finish::<()>(None).err())),
        };
        let last_tick = (raw.duration_s * 1e9 / period_ns as f64).round() as u64;
        // Nothing is concluded from a length or a tick that is refused.
        let duration_s = if length_possible(&raw) { raw.duration_s } else { f64::INFINITY };
        let accept = resolve_accept(&raw, &metrics, duration_s, rig.as_ref(), &mut checks);
        check_external(&raw, rig.as_ref().map(AnyRig::roles), &mut checks);
        let hosts = Hosts { hosts: raw.host.clone(), network: raw.network.clone() };
        hosts::check_alone(&hosts, &raw.launch.processes, &raw.launch.external, &mut checks);
        let (mut faults, mut watch) = (Vec::new(), WatchBounds::NONE);
        if let Some(rig) = &rig {
            let bodies: Vec<(&str, bool)> = rig.bodies().iter().map(|body| (&*body.name, body.driven)).collect();
            hosts::check(&hosts, &bodies, &rig.roles(), actuation_delay_ticks, &mut checks);
            check_roles(&raw.supervision.on_failure, rig, &mut checks);
            let last_tick = if tick_possible(raw.tick_hz) && length_possible(&raw) { last_tick } else { u64::MAX };
            let setting = fault::Setting { rig, last_tick, seed: raw.seed, actuation_delay_ticks };
            faults = fault::resolve(&raw.fault, &setting, &mut checks);
            watch = watchdog::resolve(&raw.watchdog, &maxima.watchdog, rig, tick_s, duration_s, &mut checks);
        }
        let (files, warnings) = (checks.files.take(), std::mem::take(&mut checks.warnings));
        let rig = checks.finish(rig)?;
        let mut resolved = toml::Table::try_from(&raw).expect("a scenario of plain values is TOML");
        resolved.extend(rig_table);
        for (table, keys) in [("watchdog", maxima.watchdog), ("accept", accept.metric_limits())] {
            if let Some(toml::Value::Table(table)) = resolved.get_mut(table) {
                table.extend(keys.into_iter().map(|(key, max)| (key, toml::Value::Float(max))));
            }
        }
        Ok(Self {
            name: raw.name,
            clock: raw.clock,
            tick_hz: raw.tick_hz,
            period_ns,
            last_tick,
            seed: raw.seed,
            record: raw.record,
            command_timeout_ticks: raw.actuator.command_timeout_ticks,
            actuation_delay_ticks,
            rearm: raw.actuator.rearm,
            realtime: raw.realtime,
            startup_timeout_s: raw.launch.startup_timeout_s,
            external_timeout_s: raw.launch.external_timeout_s,
            processes: raw.launch.processes,
            external: raw.launch.external,
            debug: raw.launch.debug,
            supervision: raw.supervision,
            hosts,
            faults,
            watch,
            accept,
            rig,
            resolved,
            files,
            warnings,
            run: document.run(),
        })
    }

    /// Why somebody else cannot start this role in a run of the scenario, if it is so.
    ///
    /// # Errors
    /// The reason, with what to do.
    pub fn check_external(&self, role: &str) -> Result<(), String> {
        let roles = self.rig.roles();
        if self.clock == ClockKind::InProcess {
            return Err("one process has no room for another's role; give --clock realtime or lockstep".to_owned());
        }
        if !roles.contains(&role) {
            return Err(format!("there is no such role; this scenario has: {}", roles.join(", ")));
        }
        if self.debug.iter().any(|debugged| debugged == role) {
            return Err(debugged_and_external(role));
        }
        let shared = self.processes.iter().any(|roles| roles.iter().any(|other| other == role));
        if shared { Err(shared_with_external(role)) } else { Ok(()) }
    }

    /// How many ticks after its tick a role may still wait for what crosses hosts on the way to it.
    pub fn lag_ticks(&self, role: &str) -> u64 {
        self.hosts.lag_ticks(role, self.rig.bodies().iter().map(|body| (&*body.name, body.driven)))
    }

    /// Returns notes for readers of the results: on the tick, and on the rig.
    pub fn notes(&self) -> Vec<String> {
        let real_hz = 1e9 / self.period_ns as f64;
        let part = real_hz / self.tick_hz - 1.0;
        let rounded = (part.abs() > 1e-12).then(|| {
            let period_ns = self.period_ns;
            format!("tick_hz {}: a period is a whole number of ns, {period_ns}, so the rate is {real_hz:.9} Hz ({:+.2e} of it)", self.tick_hz, part)
        });
        rounded.into_iter().chain(self.rig.notes()).collect()
    }

    /// Returns how long another host may be silent, s. One that starts is loaded, and its session may have to be replaced: it has
    /// as long as a role has to come up.
    pub fn host_silence_s(&self, running: bool) -> f64 {
        let limit_s = self.hosts.network.silence_timeout_s;
        if running { limit_s } else { limit_s.max(self.startup_timeout_s) }
    }

    /// The period h, s.
    pub fn tick_s(&self) -> f64 {
        self.period_ns as f64 / 1e9
    }

    /// The time of a tick since the first, s.
    pub fn time_s(&self, tick: u64) -> f64 {
        tick as f64 * self.tick_s()
    }

    /// How the actuators of a body treat their commands.
    pub fn actuation(&self, driven: bool) -> Actuation {
        let (delay_ticks, timeout_ticks) = (self.actuation_delay_ticks, self.command_timeout_ticks);
        Actuation { driven, delay_ticks, timeout_ticks, rearm: self.rearm }
    }

    /// The scenario as the file of its run, which the first line names.
    pub fn to_file(&self) -> String {
        self.run.map_or(String::new(), |run| format!("# {}\n", run.comment())) + &self.to_toml()
    }

    /// The scenario as the text of a file.
    pub fn to_toml(&self) -> String {
        toml::to_string(&self.resolved).expect("a scenario of plain values is TOML")
    }
}

/// Collects findings, so that all of them are told at once.
pub struct Checks<'a> {
    document: &'a Document,
    problems: Vec<Problem>,
    warnings: Vec<String>,
    files: RefCell<Vec<(String, PathBuf)>>,
}

impl<'a> Checks<'a> {
    pub(crate) fn new(document: &'a Document) -> Self {
        Self { document, problems: Vec::new(), warnings: Vec::new(), files: RefCell::default() }
    }

    /// Notes that the value at `key` makes no sense.
    pub fn refuse(&mut self, key: &str, reason: impl Into<String>) {
        let place = self.document.place(key);
        self.problems.push(Problem { place, key: key.to_owned(), reason: reason.into() });
    }

    /// Notes that the value at `key` has no effect: the scenario is valid all the same.
    pub fn warn(&mut self, key: &str, reason: impl std::fmt::Display) {
        self.warnings.push(format!("{key}: {reason}"));
    }

    /// The file that the value at `key` names: beside the scenario, or where the program was started if it was named there.
    pub fn file(&self, key: &str, name: &str) -> PathBuf {
        let here = self.document.place(key).starts_with("--set");
        let path = if here { name.into() } else { self.document.directory().join(name) };
        self.files.borrow_mut().push((key.to_owned(), path.clone()));
        path
    }

    /// Notes it unless `holds`.
    pub fn require(&mut self, holds: bool, key: &str, reason: impl FnOnce() -> String) {
        if !holds {
            self.refuse(key, reason());
        }
    }

    /// Notes a number that is not positive. Non-finite numbers never get so far.
    pub fn positive(&mut self, key: &str, value: f64) {
        self.require(value > 0.0, key, || format!("{value} is not above zero; give a positive number"));
    }

    /// Takes the value, or notes why there is none.
    pub fn accept<T>(&mut self, key: &str, value: Result<T, impl std::fmt::Display>) -> Option<T> {
        value.map_err(|error| self.refuse(key, error.to_string())).ok()
    }

    pub(crate) fn finish<T>(self, value: Option<T>) -> Result<T, ConfigError> {
        match value {
            Some(value) if self.problems.is_empty() => Ok(value),
            _ => Err(ConfigError::Invalid { problems: self.problems }),
        }
    }
}

/// Checks the criteria against what is known of the rig.
fn resolve_accept(
    raw: &Raw,
    metrics: &toml::Table,
    duration_s: f64,
    rig: Option<&AnyRig>,
    checks: &mut Checks<'_>,
) -> accept::Accept {
    let (names, roles) = (rig.map(AnyRig::metrics), rig.map(AnyRig::roles));
    let bodies = rig.map_or(&[][..], AnyRig::bodies);
    let driven: Vec<&str> = bodies.iter().filter(|body| body.driven).map(|body| &*body.name).collect();
    let setting = accept::Setting { duration_s, metrics: names.as_deref(), roles: roles.as_deref(), driven: &driven };
    accept::resolve(&raw.accept, metrics, &setting, checks)
}

/// The keys of tables, as `accept.settled_by_s`, with those that the rig of this name gives names to.
fn nested_keys(name: Option<&str>, rig: Option<&AnyRig>) -> Vec<String> {
    let mut nested = Vec::new();
    let shapes = rig::shapes();
    let own = shapes.iter().filter(|(rig, _)| name == Some(*rig)).flat_map(|(_, keys)| keys);
    let Shape::Table { keys: common, .. } = Shape::of::<Raw>() else { unreachable!("a scenario is a table") };
    for key in own.chain(&common) {
        if let Shape::Table { keys, .. } = &key.shape {
            nested.extend(keys.iter().map(|inner| format!("{}.{}", key.name, inner.name)));
        }
    }
    let rig_keys = rig.into_iter().flat_map(|rig| {
        let metrics = rig.metrics().into_iter();
        let criteria = metrics.flat_map(|metric| [format!("accept.{metric}_max"), format!("accept.{metric}_peak")]);
        criteria.chain(rig.monitors().into_iter().map(|(name, _)| format!("watchdog.{name}_max"))).collect::<Vec<_>>()
    });
    nested.extend(rig_keys);
    nested
}

fn tick_possible(tick_hz: f64) -> bool {
    (MIN_TICK_HZ..=MAX_TICK_HZ).contains(&tick_hz)
}

/// Whether a run can have so many ticks. Where the tick is refused, no number of ticks is known.
fn length_possible(raw: &Raw) -> bool {
    !tick_possible(raw.tick_hz) || (1.0..=MAX_TICKS).contains(&(raw.duration_s * raw.tick_hz))
}

fn check_common(raw: &Raw, checks: &mut Checks<'_>) {
    let named = !raw.name.is_empty()
        && raw.name.len() <= 32
        && raw.name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    checks.require(named, "name", || {
        format!("`{}` cannot name services and files; use 1 to 32 of a-z, 0-9 and -", raw.name)
    });
    checks.require(tick_possible(raw.tick_hz), "tick_hz", || {
        format!(
            "{} Hz is outside the range of tick rates; give a rate from {MIN_TICK_HZ} to {MAX_TICK_HZ} Hz",
            raw.tick_hz
        )
    });
    checks.require(length_possible(raw), "duration_s", || {
        let ticks = raw.duration_s * raw.tick_hz;
        format!("{} s is {ticks} ticks; give a length of 1 to {MAX_TICKS:e} ticks", raw.duration_s)
    });
    checks.require((1..=ACTUATION_DELAY_MAX).contains(&raw.actuation_delay_ticks), "actuation_delay_ticks", || {
        format!(
            "no command acts {} ticks after its measurement; give 1 (the next tick) to {ACTUATION_DELAY_MAX}",
            raw.actuation_delay_ticks
        )
    });
    checks.require(raw.actuator.command_timeout_ticks >= 1, "actuator.command_timeout_ticks", || {
        "0 would make every tick unsafe; give at least 1".to_owned()
    });
    check_realtime(&raw.realtime, checks);
    check_supervision(&raw.supervision, checks);
    checks.require((0.1..=3600.0).contains(&raw.launch.startup_timeout_s), "launch.startup_timeout_s", || {
        format!("{} s is no time to wait for roles; give 0.1 to 3600", raw.launch.startup_timeout_s)
    });
    if let Some(timeout_s) = raw.launch.external_timeout_s {
        checks.require((0.1..=604_800.0).contains(&timeout_s), "launch.external_timeout_s", || {
            format!("{timeout_s} s is no time to wait for an external role; give 0.1 to 604800, or leave it out")
        });
    }
}

fn check_supervision(supervision: &Supervision, checks: &mut Checks<'_>) {
    let (heartbeat_s, interval_s) = (supervision.heartbeat_timeout_s, supervision.restart_interval_s);
    checks.require((0.1..=3600.0).contains(&heartbeat_s), "supervision.heartbeat_timeout_s", || {
        format!("{heartbeat_s} s is no time to wait for a word that is due every 0.02 s; give 0.1 to 3600")
    });
    checks.require((0.0..=3600.0).contains(&interval_s), "supervision.restart_interval_s", || {
        format!("{interval_s} s is no time between two starts; give 0 to 3600")
    });
    checks.require(supervision.restarts_max <= 1000, "supervision.restarts_max", || {
        format!("{} starts of one role will not mend it; give 0 to 1000", supervision.restarts_max)
    });
}

/// Without a rig, its roles are not known and nothing is said of them.
fn check_external(raw: &Raw, roles: Option<Vec<&str>>, checks: &mut Checks<'_>) {
    let Launch { external, debug, .. } = &raw.launch;
    checks.require(external.is_empty() || raw.clock != ClockKind::InProcess, "launch.external", || {
        "one process has no room for another's role; give clock = \"realtime\" or \"lockstep\", or leave it empty"
            .to_owned()
    });
    checks.require(debug.is_empty() || raw.clock != ClockKind::InProcess, "launch.debug", || {
        "one process has all roles: debug it, as `gdb --args corotate run …`, or give clock = \"lockstep\"".to_owned()
    });
    for (index, role) in debug.iter().enumerate().filter(|(_, role)| external.contains(role)) {
        checks.refuse(&format!("launch.debug[{index}]"), debugged_and_external(role));
    }
    let Some(roles) = roles else { return };
    check_processes(&raw.launch, &roles, checks);
    for (key, names) in [("external", external), ("debug", debug)] {
        for (index, role) in names.iter().enumerate().filter(|(_, role)| !roles.contains(&role.as_str())) {
            let known = roles.join(", ");
            checks.refuse(
                &format!("launch.{key}[{index}]"),
                format!("there is no role `{role}`; this scenario has: {known}"),
            );
        }
    }
}

/// A process can only have roles that there are, each once, and none that is somebody else's program.
fn check_processes(launch: &Launch, roles: &[&str], checks: &mut Checks<'_>) {
    let mut taken = Vec::new();
    for (process, names) in launch.processes.iter().enumerate() {
        let key = format!("launch.processes[{process}]");
        checks.require(names.len() > 1, &key, || {
            "a role alone has a process in any case; name two roles or more, or leave it out".to_owned()
        });
        for (index, name) in names.iter().enumerate() {
            let key = format!("{key}[{index}]");
            if !roles.contains(&name.as_str()) {
                let known = roles.join(", ");
                checks.refuse(&key, format!("there is no role `{name}`; this scenario has: {known}"));
            } else if taken.contains(&name) {
                checks.refuse(&key, format!("the {name} cannot be in two places; name it once"));
            } else if launch.external.contains(name) {
                checks.refuse(&key, shared_with_external(name));
            }
            taken.push(name);
        }
    }
}

/// Why a run cannot wait for a debugger of a role that another program takes.
fn debugged_and_external(role: &str) -> String {
    format!(
        "another program takes the {role}: start that in a debugger, as `gdb --args …`, and take it out of launch.debug"
    )
}

/// Why a role that shares a process of ours cannot be somebody else's.
fn shared_with_external(role: &str) -> String {
    format!("launch.processes has the {role} in a process of ours, so nobody else can be it; take it out there")
}

/// Roles that a policy names must exist.
fn check_roles(policy: &Policy, rig: &AnyRig, checks: &mut Checks<'_>) {
    let Policy::ByRole(roles) = policy else { return };
    let known = rig.roles();
    for role in roles.keys().filter(|role| !known.contains(&role.as_str())) {
        checks.refuse(
            &format!("supervision.on_failure.{role}"),
            format!("there is no such role; {}", nearest(role, &known)),
        );
    }
}

fn check_realtime(realtime: &Realtime, checks: &mut Checks<'_>) {
    let priority = realtime.priority;
    checks.require(priority == 0 || (1..=99).contains(&priority), "realtime.priority", || {
        format!("{priority} is no SCHED_FIFO priority; give 1 to 99, or 0 not to ask for it")
    });
    for (key, value) in [("realtime.wake_lead_us", realtime.wake_lead_us), ("realtime.spin_us", realtime.spin_us)] {
        checks.require((0.0..=100_000.0).contains(&value), key, || {
            format!("{value} us is no time to spin, which is for the last moments before a sample; give 0 to 100000")
        });
    }
    checks.require(realtime.cutoff > 0.0 && realtime.cutoff <= 1.0, "realtime.cutoff", || {
        format!("{} is no part of the period; give a number above 0, up to 1", realtime.cutoff)
    });
    if let super::Cores::List(cores) = &realtime.cores {
        checks.require(!cores.is_empty() && cores.iter().all(|core| *core < 1024), "realtime.cores", || {
            "the list is empty or names a core beyond 1023; name cores of this machine, \"auto\" or \"any\"".to_owned()
        });
    }
}
