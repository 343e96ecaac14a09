//! A resolved scenario: every value checked, every default filled in, its rig created; ready to run.
//!
//! | file | duty |
//! |---|---|
//! | `any` | the rig behind a table of functions: the generic code of the modules below, for code that does not know its type |
//! | `registry` | the rigs that scenarios of this program may name |
//! | `schema` | a JSON Schema of scenarios |
//!
//! Modules below know a scenario as its [`Settings`], and the rig as a type parameter. This module reads the scenario file and
//! nothing else of the machine.

mod any;
mod registry;
mod schema;

pub use any::AnyRig;
pub use registry::{RigKind, register, shipped};
pub use schema::schema;

use crate::analysis::Claim;
use crate::bus::{AnyBus, BusError};
use crate::config::accept::{self, Accept};
use crate::config::hosts::{self, Hosts};
use crate::config::raw::{Launch, Policy, Raw};
use crate::config::{
    BodyInfo, Checks, ClockKind, ConfigError, Cores, DISCONNECTED, Document, InputInfo, InputUser, Inputs, NotExternal,
    Rates, Realtime, Settings, Shape, Supervision, Variability, fault, input, nearest, observe, reference, role_names,
    sensor, watchdog,
};
use crate::control::{ACTUATION_DELAY_MAX, WatchBounds};
use crate::rig::Context;
use crate::runtime::{ReadyNode, RoleImpl};
use crate::score::Scorer;
use crate::telemetry::Ledger;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The slowest tick rate: a period must lie well within the range of a latency histogram.
const MIN_TICK_HZ: f64 = 0.1;
/// The fastest tick rate: beyond it, reading the clock alone fills the period.
const MAX_TICK_HZ: f64 = 1e5;
/// The largest number of ticks of a run: ten years at 1 kHz.
const MAX_TICKS: f64 = 3.2e11;
/// The keys of every scenario that hold one table each.
const TABLES: [&str; 7] = ["actuator", "realtime", "launch", "supervision", "watchdog", "network", "accept"];

/// The bounds of the watchdog by key; the keys depend on the rig.
#[derive(Deserialize)]
struct Maxima {
    #[serde(default)]
    watchdog: BTreeMap<String, f64>,
}

/// A scenario that can be run: its settings, its rig, and its text.
#[derive(Debug)]
pub struct Scenario {
    settings: Settings,
    /// Bodies, observer and laws.
    pub rig: Arc<dyn AnyRig>,
    /// The resolved scenario as TOML. It resolves to the same scenario.
    pub resolved: toml::Table,
    /// The files that the scenario names, with their keys.
    pub files: Vec<(String, PathBuf)>,
    /// Warnings about settings that have no effect in a run of this length, by key.
    pub warnings: Vec<String>,
}

impl Deref for Scenario {
    type Target = Settings;

    fn deref(&self) -> &Settings {
        &self.settings
    }
}

impl DerefMut for Scenario {
    fn deref_mut(&mut self) -> &mut Settings {
        &mut self.settings
    }
}

impl Scenario {
    /// Reads a scenario file, applies overrides and checks everything.
    ///
    /// # Errors
    /// [`ConfigError`], with place, reason and remedy.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        Self::changed(Document::read(path)?, overrides)
    }

    /// Does the same for a text; `origin` stands for the file in error messages.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn parse(text: &str, origin: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        Self::changed(Document::parse(text, origin)?, overrides)
    }

    fn changed(mut document: Document, overrides: &[String]) -> Result<Self, ConfigError> {
        overrides.iter().try_for_each(|argument| document.set(argument))?;
        Self::resolve(document)
    }

    /// Resolves a document.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn resolve(mut document: Document) -> Result<Self, ConfigError> {
        // Changes are checked by resolving the scenario with their values.
        let without_changes = document.has("input").then(|| document.without("input"));
        document.refuse_lists(&[&registry::tables()[..], &TABLES].concat())?;
        let rates = Rates::split_off(&mut document, &registry::sections());
        let sections = document.split_off(&registry::sections());
        let maxima: Maxima = document.split_off_within("watchdog", |key| key.ends_with("_max")).read_into()?;
        let metrics = document.split_off_within("accept", |key| !accept::is_common(key));
        let metrics = metrics.read_into::<accept::Metrics>();
        let mut checks = Checks::new(&document);
        let (raw, metrics, rates) = match (document.read_into::<Raw>(), metrics, rates) {
            (Ok(raw), Ok(metrics), Ok(rates)) => (raw, metrics.accept, rates),
            (raw, metrics, rates) => {
                // The rig's own tables are read too, to report their mistakes, but their values cannot be checked.
                let context = Context::every_tick(1.0 / MAX_TICK_HZ);
                let own = document.text("rig").map(|rig| registry::resolve(rig, &sections, context, &mut checks));
                let rig = own.as_ref().and_then(|own| own.as_ref().ok()?.0.as_deref());
                let nested = nested_keys(document.text("rig"), rig);
                checks.retain(|key| key == "rig");
                let rig_errors = checks.finish::<()>(None).err();
                let errors = [raw.err().map(|error| error.within(&nested)), metrics.err(), rates.err()];
                let errors = errors.into_iter().flatten();
                let mut errors = errors.chain(own.and_then(Result::err)).chain(rig_errors);
                let first = errors.next().expect("at least one error");
                return Err(first.and(errors));
            }
        };
        let mut raw = raw;
        let rates = Rates { substeps: raw.substeps, sensor_ticks: sensor::common_ticks(&raw.sensor), ..rates };
        check_common(&raw, &mut checks);
        let period_ns = (1e9 / raw.tick_hz).round() as u64;
        // For a refused tick rate, the rig gets the shortest tick, so that it does not report the same mistake.
        let tick_s = if tick_possible(raw.tick_hz) { period_ns as f64 / 1e9 } else { 1.0 / MAX_TICK_HZ };
        let length_s = if length_possible(&raw) { raw.duration_s } else { 0.0 };
        let actuation_delay_ticks = raw.actuation_delay_ticks.clamp(1, ACTUATION_DELAY_MAX);
        let context = Context { tick_s, duration_s: length_s, seed: raw.seed, actuation_delay_ticks, rates };
        let (rig, rig_table) = match registry::resolve(&raw.rig, &sections, context, &mut checks) {
            Ok(resolved) => resolved,
            Err(error) => return Err(error.and(checks.finish::<()>(None).err())),
        };
        let last_tick = (raw.duration_s * 1e9 / period_ns as f64).round() as u64;
        rates.check(raw.actuator.command_timeout_ticks, last_tick, &mut checks);
        // A refused length or tick rate leads to no further errors.
        let duration_s = if length_possible(&raw) { raw.duration_s } else { f64::INFINITY };
        let bodies = rig.as_ref().map_or_else(Vec::new, |rig| {
            observe(raw.observed.as_deref(), rig.bodies(), |index| rig.observes(index), &mut checks)
        });
        let accept = resolve_accept(&raw, &metrics, duration_s, rig.as_deref(), &bodies, &mut checks);
        check_external(&raw, rig.is_some().then(|| role_names(&bodies)), &mut checks);
        let hosts = Hosts { hosts: raw.host.clone(), network: raw.network.clone() };
        hosts::check_alone(&hosts, &raw.launch.processes, &raw.launch.external, &mut checks);
        let (mut faults, mut watch, mut signals) = (Vec::new(), WatchBounds::NONE, Vec::new());
        let (mut inputs, mut initial_reference) = (Inputs::default(), Vec::new());
        if let Some(rig) = &rig {
            hosts::check(&hosts, &bodies, actuation_delay_ticks, &mut checks);
            check_roles(&raw.supervision.on_failure, &role_names(&bodies), &mut checks);
            let last_tick = if tick_possible(raw.tick_hz) && length_possible(&raw) { last_tick } else { u64::MAX };
            signals = rig.signals(&raw.name, &bodies);
            let setting = fault::Setting {
                bodies: &bodies,
                signals: &signals,
                axes: rig.axes(),
                last_tick,
                seed: raw.seed,
                actuation_delay_ticks,
            };
            sensor::check(&raw.sensor, &bodies, &signals, last_tick, &mut checks);
            for body in bodies.iter().filter(|body| body.observer.is_some()) {
                sensor::check_together(&raw.sensor, &body.name, rates.observer_ticks, &mut checks);
            }
            faults = fault::resolve(&raw.fault, &setting, &mut checks);
            inputs.infos = rig.inputs();
            inputs.infos.extend(actuator_switches(&raw, rig.bodies()));
            let fields = rig.reference();
            reference::read_files(&mut raw.reference, &fields, &mut checks);
            let referred = reference::inputs(&raw.reference, &fields, (rig.bodies(), &signals), &mut checks);
            referred.iter().for_each(|info| initial_reference.extend_from_slice(&info.initial));
            inputs.infos.extend(referred);
            let probe =
                |key: &str, value| without_changes.as_ref().map_or_else(Vec::new, |base| mistakes(base, key, value));
            let setting = input::Setting { infos: &inputs.infos, tick_s, last_tick, seed: raw.seed, probe: &probe };
            let mut changes = reference::changes(&raw.reference, &setting, &mut checks);
            changes.extend(input::resolve(&raw.input, &setting, &mut checks));
            inputs.scripted = input::in_order(changes, &setting, &mut checks).into();
            watch =
                watchdog::resolve(&raw.watchdog, &maxima.watchdog, &rig.monitors(), tick_s, duration_s, &mut checks);
        }
        let (files, warnings) = checks.take_remarks();
        let rig = checks.finish(rig)?;
        let mut resolved = toml::Table::try_from(&raw).expect("a scenario of plain values is TOML");
        resolved.extend(rig_table);
        rates.write(&mut resolved);
        for (table, keys) in [("watchdog", maxima.watchdog), ("accept", accept.metric_limits())] {
            if let Some(toml::Value::Table(table)) = resolved.get_mut(table) {
                table.extend(keys.into_iter().map(|(key, max)| (key, toml::Value::Float(max))));
            }
        }
        let settings = Settings {
            name: raw.name,
            clock: raw.clock,
            tick_hz: raw.tick_hz,
            period_ns,
            last_tick,
            seed: raw.seed,
            record: raw.record,
            command_timeout_ticks: raw.actuator.command_timeout_ticks,
            actuation_delay_ticks,
            rates,
            sensors: raw.sensor,
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
            inputs,
            reference: initial_reference,
            watch,
            accept,
            run: document.run(),
            bodies,
            signals,
            monitors: rig.monitors().into_iter().map(|(name, _)| name).collect(),
        };
        Ok(Self { settings, rig, resolved, files, warnings })
    }

    /// Returns notes for readers of the results: on a rounded period, and those of the rig.
    pub fn notes(&self) -> Vec<String> {
        let real_hz = 1e9 / self.period_ns as f64;
        let part = real_hz / self.tick_hz - 1.0;
        let rounded = (part.abs() > 1e-12).then(|| {
            let period_ns = self.period_ns;
            format!("tick_hz {}: a period is a whole number of ns, {period_ns}, so the rate is {real_hz:.9} Hz ({:+.2e} of it)", self.tick_hz, part)
        });
        rounded
            .into_iter()
            .chain(self.rates.notes(self.tick_hz))
            .chain(sensor::notes(&self.sensors, self.tick_hz))
            .chain(self.rig.notes())
            .collect()
    }

    /// Returns the text of the scenario file of its run; the first line names the run.
    pub fn to_file(&self) -> String {
        self.run.map_or(String::new(), |run| format!("# {}\n", run.comment())) + &self.to_toml()
    }

    /// Returns the scenario as the text of a file.
    pub fn to_toml(&self) -> String {
        toml::to_string(&self.resolved).expect("a scenario of plain values is TOML")
    }
}

/// Returns the switches of the actuators of all driven bodies; none if the scenario drives no body.
fn actuator_switches(raw: &Raw, bodies: &[BodyInfo]) -> Vec<InputInfo> {
    let driven = || bodies.iter().enumerate().filter(|(_, body)| body.driven);
    let switch = |(key, description, on, port): (&str, &'static str, bool, usize)| {
        let input = InputInfo::new(key, Variability::Switch, description, &[f64::from(u8::from(on))]).within(0.0, 1.0);
        input.used_by(driven().map(|(index, _)| InputUser::Actuator(index)), port)
    };
    let safe = "actuators apply the safe command; false re-arms them";
    let disconnected = "actuators ignore the controller: they hold, then apply the safe command";
    let switches = [
        ("actuator.safe", safe, raw.actuator.safe, 0),
        ("actuator.disconnected", disconnected, raw.actuator.disconnected, DISCONNECTED),
    ];
    switches.map(switch).into_iter().filter(|input| !input.uses.is_empty()).collect()
}

/// Returns the mistakes of a scenario in which a key has another value: reason and code of each.
fn mistakes(base: &Document, key: &str, value: toml::Value) -> Vec<input::Mistake> {
    let mut changed = base.clone();
    let place = changed.place(key);
    let resolved = changed.put(key, value, &place).and_then(|()| Scenario::resolve(changed));
    let Err(error) = resolved else { return Vec::new() };
    match error {
        ConfigError::Invalid { problems } => {
            problems.into_iter().map(|problem| (format!("{}: {}", problem.key, problem.reason), problem.code)).collect()
        }
        error => error.mistakes(),
    }
}

/// Returns the claims about every driven body's loop.
pub fn claims(scenario: &Scenario) -> Vec<Claim> {
    scenario.rig.claims(scenario)
}

/// Opens a role's links and builds its node. Its counters are in the ledger, which may hold those of a predecessor.
///
/// # Errors
/// [`BusError::Open`].
pub fn build<'a>(
    scenario: &Scenario,
    role_impl: impl Into<RoleImpl>,
    bus: impl Into<AnyBus<'a>>,
    ledger: &Ledger,
) -> Result<ReadyNode, BusError> {
    scenario.rig.node(scenario, role_impl.into(), bus.into(), ledger)
}

/// Opens a scorer on the run's bus.
///
/// # Errors
/// [`BusError::Open`].
pub fn scorer<'a>(scenario: &Scenario, bus: impl Into<AnyBus<'a>>) -> Result<Box<dyn Scorer>, BusError> {
    scenario.rig.scorer(scenario, bus.into())
}

/// Checks the acceptance criteria, as far as the rig is known.
fn resolve_accept(
    raw: &Raw,
    metrics: &toml::Table,
    duration_s: f64,
    rig: Option<&dyn AnyRig>,
    bodies: &[BodyInfo],
    checks: &mut Checks<'_>,
) -> Accept {
    let (names, roles) = (rig.map(|rig| rig.metrics()), rig.map(|_| role_names(bodies)));
    let driven: Vec<&str> = bodies.iter().filter(|body| body.driven).map(|body| &*body.name).collect();
    let setting = accept::Setting {
        duration_s,
        realtime: raw.clock == ClockKind::Realtime,
        metrics: names.as_deref(),
        roles: roles.as_deref(),
        driven: &driven,
    };
    accept::resolve(&raw.accept, metrics, &setting, checks)
}

/// Returns the keys within tables, as `accept.settled_by_s`, including those that the rig defines.
fn nested_keys(name: Option<&str>, rig: Option<&dyn AnyRig>) -> Vec<String> {
    let mut nested = Vec::new();
    let shapes = registry::shapes();
    let own = shapes.iter().filter(|(rig, _)| name == Some(*rig)).flat_map(|(_, keys)| keys);
    let Shape::Table { keys: common, .. } = Shape::read_by::<Raw>() else { unreachable!("a scenario is a table") };
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

/// Returns true if the number of ticks is within the limits, or unknown because the tick rate is refused.
fn length_possible(raw: &Raw) -> bool {
    !tick_possible(raw.tick_hz) || (1.0..=MAX_TICKS).contains(&(raw.duration_s * raw.tick_hz))
}

fn check_common(raw: &Raw, checks: &mut Checks<'_>) {
    let named = !raw.name.is_empty()
        && raw.name.len() <= 32
        && raw.name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    checks.require(named, "name", "bad-name", || {
        format!("`{}` cannot name services and files; use 1 to 32 of a-z, 0-9 and -", raw.name)
    });
    checks.require(tick_possible(raw.tick_hz), "tick_hz", "out-of-range", || {
        format!(
            "{} Hz is outside the range of tick rates; give a rate from {MIN_TICK_HZ} to {MAX_TICK_HZ} Hz",
            raw.tick_hz
        )
    });
    checks.require(length_possible(raw), "duration_s", "out-of-range", || {
        let ticks = raw.duration_s * raw.tick_hz;
        format!("{} s is {ticks} ticks; give a length of 1 to {MAX_TICKS:e} ticks", raw.duration_s)
    });
    checks.require(
        (1..=ACTUATION_DELAY_MAX).contains(&raw.actuation_delay_ticks),
        "actuation_delay_ticks",
        "out-of-range",
        || {
            format!(
                "a command cannot act {} ticks after its measurement; give 1 (the next tick) to {ACTUATION_DELAY_MAX}",
                raw.actuation_delay_ticks
            )
        },
    );
    checks.require(raw.actuator.command_timeout_ticks >= 1, "actuator.command_timeout_ticks", "out-of-range", || {
        "0 would apply the safe command at every tick; give at least 1".to_owned()
    });
    check_realtime(&raw.realtime, checks);
    check_supervision(&raw.supervision, checks);
    checks.require(
        (0.1..=3600.0).contains(&raw.launch.startup_timeout_s),
        "launch.startup_timeout_s",
        "out-of-range",
        || format!("{} s is out of range; give 0.1 to 3600", raw.launch.startup_timeout_s),
    );
    if let Some(timeout_s) = raw.launch.external_timeout_s {
        checks.require((0.1..=604_800.0).contains(&timeout_s), "launch.external_timeout_s", "out-of-range", || {
            format!("{timeout_s} s is out of range; give 0.1 to 604800, or remove it")
        });
    }
}

fn check_supervision(supervision: &Supervision, checks: &mut Checks<'_>) {
    let (heartbeat_s, interval_s) = (supervision.heartbeat_timeout_s, supervision.restart_interval_s);
    checks.require((0.1..=3600.0).contains(&heartbeat_s), "supervision.heartbeat_timeout_s", "out-of-range", || {
        format!("{heartbeat_s} s is out of range (heartbeats are due every 0.02 s); give 0.1 to 3600")
    });
    checks.require((0.0..=3600.0).contains(&interval_s), "supervision.restart_interval_s", "out-of-range", || {
        format!("{interval_s} s is out of range; give 0 to 3600")
    });
    checks.require(supervision.restarts_max <= 1000, "supervision.restarts_max", "out-of-range", || {
        format!("{} restarts of one role are too many; give 0 to 1000", supervision.restarts_max)
    });
}

/// Checks external and debugged roles. Without a rig, the roles are unknown and not checked.
fn check_external(raw: &Raw, roles: Option<Vec<&str>>, checks: &mut Checks<'_>) {
    let Launch { external, debug, .. } = &raw.launch;
    checks.require(external.is_empty() || raw.clock != ClockKind::InProcess, "launch.external", "one-process", || {
        "an in-process run has no external roles; give clock = \"realtime\" or \"lockstep\", or leave it empty"
            .to_owned()
    });
    checks.require(debug.is_empty() || raw.clock != ClockKind::InProcess, "launch.debug", "one-process", || {
        "all roles share one process: start it in a debugger, as `gdb --args corotate run …`, or give clock = \"lockstep\"".to_owned()
    });
    for (index, role) in debug.iter().enumerate().filter(|(_, role)| external.contains(role)) {
        let refused = Err(NotExternal::DebuggedAndExternal { role: role.clone() });
        checks.accept::<(), _>(&format!("launch.debug[{index}]"), refused);
    }
    let Some(roles) = roles else { return };
    check_processes(&raw.launch, &roles, checks);
    for (key, names) in [("external", external), ("debug", debug)] {
        for (index, role) in names.iter().enumerate().filter(|(_, role)| !roles.contains(&role.as_str())) {
            let known = roles.join(", ");
            checks.refuse(
                &format!("launch.{key}[{index}]"),
                "unknown-role",
                format!("there is no role `{role}`; this scenario has: {known}"),
            );
        }
    }
}

/// Checks that every listed role exists, is listed once, and is not external.
fn check_processes(launch: &Launch, roles: &[&str], checks: &mut Checks<'_>) {
    let mut taken = Vec::new();
    for (process, names) in launch.processes.iter().enumerate() {
        let key = format!("launch.processes[{process}]");
        checks.require(names.len() > 1, &key, "role-alone", || {
            "a single role always has a process of its own; name two roles or more, or remove the entry".to_owned()
        });
        for (index, name) in names.iter().enumerate() {
            let key = format!("{key}[{index}]");
            if !roles.contains(&name.as_str()) {
                let known = roles.join(", ");
                checks.refuse(&key, "unknown-role", format!("there is no role `{name}`; this scenario has: {known}"));
            } else if taken.contains(&name) {
                checks.refuse(&key, "role-twice", format!("the {name} is listed twice; list it once"));
            } else if launch.external.contains(name) {
                checks.accept::<(), _>(&key, Err(NotExternal::SharedAndExternal { role: name.clone() }));
            }
            taken.push(name);
        }
    }
}

/// Checks that the roles named by a policy exist.
fn check_roles(policy: &Policy, known: &[&str], checks: &mut Checks<'_>) {
    let Policy::ByRole(roles) = policy else { return };
    for role in roles.keys().filter(|role| !known.contains(&role.as_str())) {
        checks.refuse(
            &format!("supervision.on_failure.{role}"),
            "unknown-role",
            format!("there is no such role; {}", nearest(role, known)),
        );
    }
}

fn check_realtime(realtime: &Realtime, checks: &mut Checks<'_>) {
    let priority = realtime.priority;
    checks.require(priority == 0 || (1..=99).contains(&priority), "realtime.priority", "out-of-range", || {
        format!("{priority} is not a SCHED_FIFO priority; give 1 to 99, or 0 to run without")
    });
    let late_us = realtime.late_us.unwrap_or_default();
    for (key, value) in [
        ("realtime.wake_lead_us", realtime.wake_lead_us),
        ("realtime.spin_us", realtime.spin_us),
        ("realtime.late_us", late_us),
    ] {
        checks.require((0.0..=100_000.0).contains(&value), key, "out-of-range", || {
            format!("{value} us is out of range; give 0 to 100000")
        });
    }
    checks.require(realtime.cutoff > 0.0 && realtime.cutoff <= 1.0, "realtime.cutoff", "out-of-range", || {
        format!("{} is not a part of the period; give a number above 0, up to 1", realtime.cutoff)
    });
    if let Cores::List(cores) = &realtime.cores {
        checks.require(
            !cores.is_empty() && cores.iter().all(|core| *core < 1024),
            "realtime.cores",
            "bad-cores",
            || {
                "the list is empty or names a core beyond 1023; name cores of this machine, \"auto\" or \"any\""
                    .to_owned()
            },
        );
    }
}
