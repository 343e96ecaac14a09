//! Resolves the tables of a scenario: reads them, creates the rig, and checks every value.
//!
//! All mistakes are reported together. A mistake must not lead to others, so that a refused value is replaced by one without
//! effect in the checks that follow.

use super::any::AnyRig;
use super::registry;
use crate::bus::Port;
use crate::config::accept::{self, Accept};
use crate::config::common::{self, MAX_TICK_HZ, length_possible, tick_possible};
use crate::config::hosts::{self, Hosts};
use crate::config::raw::Raw;
use crate::config::{
    BodyInfo, Checks, ClockKind, ConfigError, DISCONNECTED, Document, InputInfo, InputUser, Inputs, Rates,
    ScriptedFault, Settings, Shape, Variability, fault, input, observe, reference, role_names, sensor, watchdog,
};
use crate::control::{ACTUATION_DELAY_MAX, WatchBounds};
use crate::rig::Context;
use std::collections::BTreeMap;
use std::ops::{Deref, DerefMut};
use std::path::PathBuf;
use std::sync::Arc;

/// The keys of every scenario that hold one table each.
const TABLES: [&str; 7] = ["actuator", "realtime", "launch", "supervision", "watchdog", "network", "accept"];

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
    /// Resolves a document.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn resolve(mut document: Document) -> Result<Self, ConfigError> {
        // Changes are checked by resolving the scenario with their values.
        let without_changes = document.has("input").then(|| document.without("input"));
        let (mut tables, of_rig) = Tables::read(&mut document)?;
        let mut checks = Checks::new(&document);
        common::check(&tables.raw, &mut checks);
        let times = Times::new(&tables.raw);
        let context = tables.context(times);
        let (rig, rig_table) = match registry::resolve(&tables.raw.rig, &of_rig, context, &mut checks) {
            Ok(resolved) => resolved,
            Err(error) => return Err(error.and(checks.finish::<()>(None).err())),
        };
        tables.rates.check(tables.raw.actuator.command_timeout_ticks, times.last_tick, &mut checks);
        let bodies = rig.as_ref().map_or_else(Vec::new, |rig| {
            observe(tables.raw.observed.as_deref(), rig.bodies(), |index| rig.observes(index), &mut checks)
        });
        let accept = tables.accept(rig.as_deref(), &bodies, times.duration_s, &mut checks);
        let Raw { launch, .. } = &tables.raw;
        common::check_external(&tables.raw, rig.is_some().then(|| role_names(&bodies)), &mut checks);
        hosts::check_alone(&tables.hosts, &launch.processes, &launch.external, &mut checks);
        let parts = rig.as_deref().map(|rig| {
            let check = RigCheck {
                rig,
                bodies: &bodies,
                signals: rig.signals(&tables.raw.name, &bodies),
                times,
                checks: &mut checks,
            };
            check.resolve(&mut tables, without_changes)
        });
        let (files, warnings) = checks.take_remarks();
        let (rig, parts) = checks.finish(rig.zip(parts))?;
        let resolved = tables.to_toml(rig_table, &accept);
        let monitors = rig.monitors().into_iter().map(|(name, _)| name).collect();
        let Tables { raw, rates, hosts, .. } = tables;
        let settings = Settings {
            name: raw.name,
            clock: raw.clock,
            tick_hz: raw.tick_hz,
            period_ns: times.period_ns,
            last_tick: times.last_tick,
            seed: raw.seed,
            record: raw.record,
            command_timeout_ticks: raw.actuator.command_timeout_ticks,
            actuation_delay_ticks: raw.actuation_delay_ticks,
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
            faults: parts.faults,
            inputs: parts.inputs,
            reference: parts.reference,
            watch: parts.watch,
            accept,
            run: document.run(),
            bodies,
            signals: parts.signals,
            monitors,
        };
        Ok(Self { settings, rig, resolved, files, warnings })
    }
}

/// The times of a run.
#[derive(Clone, Copy)]
struct Times {
    period_ns: u64,
    /// The period, s; the shortest one if the rate is refused.
    tick_s: f64,
    /// The last tick; the largest number if rate or length is refused.
    last_tick: u64,
    /// The length, s; infinite if refused.
    duration_s: f64,
}

impl Times {
    fn new(raw: &Raw) -> Self {
        let period_ns = (1e9 / raw.tick_hz).round() as u64;
        let (rate_possible, length_possible) = (tick_possible(raw.tick_hz), length_possible(raw));
        Self {
            period_ns,
            tick_s: if rate_possible { period_ns as f64 / 1e9 } else { 1.0 / MAX_TICK_HZ },
            last_tick: match rate_possible && length_possible {
                true => (raw.duration_s * 1e9 / period_ns as f64).round() as u64,
                false => u64::MAX,
            },
            duration_s: if length_possible { raw.duration_s } else { f64::INFINITY },
        }
    }
}

/// The tables of a scenario as typed, without those of its rig.
struct Tables {
    raw: Raw,
    rates: Rates,
    hosts: Hosts,
    metrics: toml::Table,
    bounds: BTreeMap<String, f64>,
}

impl Tables {
    /// Returns the tables of the rig as a document of their own, and the others as typed.
    fn read(document: &mut Document) -> Result<(Self, Document), ConfigError> {
        document.refuse_lists(&[&registry::tables()[..], &TABLES].concat())?;
        let rates = Rates::split_off(document, &registry::sections());
        let of_rig = document.split_off(&registry::sections());
        let maxima: watchdog::Maxima =
            document.split_off_within("watchdog", |key| key.ends_with("_max")).read_into()?;
        let metrics = document.split_off_within("accept", |key| !accept::is_common(key));
        match (document.read_into::<Raw>(), metrics.read_into::<accept::Metrics>(), rates) {
            (Ok(raw), Ok(metrics), Ok(rates)) => {
                let rates = Rates { substeps: raw.substeps, sensor_ticks: sensor::common_ticks(&raw.sensor), ..rates };
                let hosts = Hosts { hosts: raw.host.clone(), network: raw.network.clone() };
                Ok((Self { raw, rates, hosts, metrics: metrics.accept, bounds: maxima.watchdog }, of_rig))
            }
            (raw, metrics, rates) => Err(unreadable(document, &of_rig, raw.err(), [metrics.err(), rates.err()])),
        }
    }

    fn context(&self, times: Times) -> Context {
        let Raw { duration_s, seed, actuation_delay_ticks, .. } = self.raw;
        Context {
            tick_s: times.tick_s,
            duration_s: if length_possible(&self.raw) { duration_s } else { 0.0 },
            seed,
            actuation_delay_ticks: actuation_delay_ticks.clamp(1, ACTUATION_DELAY_MAX),
            rates: self.rates,
        }
    }

    /// Checks the acceptance criteria, as far as the rig is known.
    fn accept(
        &self,
        rig: Option<&dyn AnyRig>,
        bodies: &[BodyInfo],
        duration_s: f64,
        checks: &mut Checks<'_>,
    ) -> Accept {
        let (names, roles) = (rig.map(|rig| rig.metrics()), rig.map(|_| role_names(bodies)));
        let driven: Vec<&str> = bodies.iter().filter(|body| body.driven).map(|body| &*body.name).collect();
        let setting = accept::Setting {
            duration_s,
            realtime: self.raw.clock == ClockKind::Realtime,
            metrics: names.as_deref(),
            roles: roles.as_deref(),
            driven: &driven,
        };
        accept::resolve(&self.raw.accept, &self.metrics, &setting, checks)
    }

    /// Returns all values, with the table of the rig.
    fn to_toml(&self, of_rig: toml::Table, accept: &Accept) -> toml::Table {
        let mut table = toml::Table::try_from(&self.raw).expect("a scenario of plain values is TOML");
        table.extend(of_rig);
        self.rates.write(&mut table);
        for (name, keys) in [("watchdog", self.bounds.clone()), ("accept", accept.metric_limits())] {
            if let Some(toml::Value::Table(table)) = table.get_mut(name) {
                table.extend(keys.into_iter().map(|(key, max)| (key, toml::Value::Float(max))));
            }
        }
        table
    }
}

/// Returns the mistakes of tables that cannot be read. Those of the rig are read too, to report their mistakes, but their values
/// cannot be checked.
fn unreadable(
    document: &Document,
    of_rig: &Document,
    raw: Option<ConfigError>,
    further: [Option<ConfigError>; 2],
) -> ConfigError {
    let mut checks = Checks::new(document);
    let context = Context::every_tick(1.0 / MAX_TICK_HZ);
    let own = document.text("rig").map(|rig| registry::resolve(rig, of_rig, context, &mut checks));
    let rig = own.as_ref().and_then(|own| own.as_ref().ok()?.0.as_deref());
    let nested = nested_keys(document.text("rig"), rig);
    checks.retain(|key| key == "rig");
    let rig_errors = checks.finish::<()>(None).err();
    let errors = raw.map(|error| error.within(&nested)).into_iter().chain(further.into_iter().flatten());
    let mut errors = errors.chain(own.and_then(Result::err)).chain(rig_errors);
    let first = errors.next().expect("at least one error");
    first.and(errors)
}

/// The settings that depend on the rig.
struct Parts {
    signals: Vec<Port>,
    faults: Vec<ScriptedFault>,
    inputs: Inputs,
    reference: Vec<f64>,
    watch: WatchBounds,
}

/// Checks everything that depends on the rig.
struct RigCheck<'a, 'd> {
    rig: &'a dyn AnyRig,
    bodies: &'a [BodyInfo],
    signals: Vec<Port>,
    times: Times,
    checks: &'a mut Checks<'d>,
}

impl RigCheck<'_, '_> {
    fn resolve(mut self, tables: &mut Tables, without_changes: Option<Document>) -> Parts {
        let Tables { raw, rates, hosts, bounds, .. } = tables;
        let delay_ticks = raw.actuation_delay_ticks.clamp(1, ACTUATION_DELAY_MAX);
        hosts::check(hosts, self.bodies, delay_ticks, self.checks);
        common::check_roles(&raw.supervision.on_failure, &role_names(self.bodies), self.checks);
        let setting = fault::Setting {
            bodies: self.bodies,
            signals: &self.signals,
            axes: self.rig.axes(),
            last_tick: self.times.last_tick,
            seed: raw.seed,
            actuation_delay_ticks: delay_ticks,
        };
        sensor::check(&raw.sensor, self.bodies, &self.signals, self.times.last_tick, self.checks);
        for body in self.bodies.iter().filter(|body| body.observer.is_some()) {
            sensor::check_together(&raw.sensor, &body.name, rates.observer_ticks, self.checks);
        }
        let faults = fault::resolve(&raw.fault, &setting, self.checks);
        let (inputs, reference) = self.inputs(raw, without_changes);
        let Times { tick_s, duration_s, .. } = self.times;
        let watch = watchdog::resolve(&raw.watchdog, bounds, &self.rig.monitors(), tick_s, duration_s, self.checks);
        Parts { signals: self.signals, faults, inputs, reference, watch }
    }

    /// Returns the inputs with their scripted changes, and the initial values of the references.
    fn inputs(&mut self, raw: &mut Raw, without_changes: Option<Document>) -> (Inputs, Vec<f64>) {
        let mut inputs = Inputs::default();
        inputs.infos.extend(self.rig.inputs());
        inputs.infos.extend(actuator_switches(raw, self.rig.bodies()));
        let fields = self.rig.reference();
        reference::read_files(&mut raw.reference, &fields, self.checks);
        let referred = reference::inputs(&raw.reference, &fields, (self.rig.bodies(), &self.signals), self.checks);
        let initial = referred.iter().flat_map(|info| info.initial.clone()).collect();
        inputs.infos.extend(referred);
        let probe =
            |key: &str, value| without_changes.as_ref().map_or_else(Vec::new, |base| mistakes(base, key, value));
        let Times { tick_s, last_tick, .. } = self.times;
        let setting = input::Setting { infos: &inputs.infos, tick_s, last_tick, seed: raw.seed, probe: &probe };
        let mut changes = reference::changes(&raw.reference, &setting, self.checks);
        changes.extend(input::resolve(&raw.input, &setting, self.checks));
        inputs.scripted = input::in_order(changes, &setting, self.checks).into();
        (inputs, initial)
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
