//! The seat description: all that a foreign program needs to take a role, as one JSON object.
//!
//! Must be complete and must not contain anything untrue.

use super::error::RoleError;
use super::paths::{report_path, scenario_path};
use super::process::{WARM_UP_PAUSE_NS, WARM_UP_SAMPLES};
use crate::bus::domain::Domain;
use crate::bus::iox::{self, Qos};
use crate::bus::{Depths, Port, Reader, Signal};
use crate::config::{InputInfo, Variability};
use crate::input::Shape;
use crate::role::Rearm;
use crate::runtime::{RoleId, RoleValue, depths, ports, role_values, window_ticks};
use crate::sample::{Field, FieldKind, NO_SAMPLE, Phase, RoleState, Stamp, status};
use crate::scenario::Scenario;
use crate::system::this_program;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Layout version of the description.
const SCHEMA: &str = "corotate/seat/v1";

/// The description of a role for a foreign program.
#[derive(Debug, Serialize)]
pub struct SeatDescription {
    schema: &'static str,
    version: &'static str,
    /// The role's name, and its kind.
    role: String,
    kind: &'static str,
    /// The body of a plant; null for other roles.
    body: Option<String>,
    scenario_name: String,
    clock: &'static str,
    tick_hz: f64,
    period_ns: u64,
    /// The last tick; the first is 0.
    last_tick: u64,
    /// Number of ticks that a plant may run ahead of the credit in lockstep.
    window_ticks: u64,
    /// The role computes at every n-th tick, from tick 0 on.
    every_ticks: u64,
    /// Number of ticks from a measurement until its command acts.
    actuation_delay_ticks: u64,
    command_timeout_ticks: u64,
    rearm: &'static str,
    /// The command that starts the program of this description, as its file and first arguments; null if it is not text.
    program: Option<Vec<String>>,
    transport: Transport,
    /// The loop's signals, in the order in which the built-in role opens them.
    writes: Vec<SignalDescription>,
    reads: Vec<SignalDescription>,
    /// The role's heartbeat, and the launcher's schedule.
    health: SignalDescription,
    schedule: SignalDescription,
    /// The changes of inputs, and the inputs in the order of their numbers.
    input: SignalDescription,
    inputs: Vec<InputDescription>,
    /// The numbers of the shapes of a change.
    shapes: BTreeMap<&'static str, usize>,
    /// Length of the stamp at the start of every sample, bytes.
    stamp_size: usize,
    /// The bits of a field `valid` in outputs that are left blank.
    valid: u64,
    /// The inputs of the scenario that the role uses.
    values: Vec<ValueDescription>,
    /// The values of the schedule's `phase` and of health's `state`.
    phases: BTreeMap<&'static str, u64>,
    states: BTreeMap<&'static str, u64>,
    /// The bits of every sample's `status`.
    status: BTreeMap<&'static str, u64>,
    /// The bit of a sample's `generation` that makes it a no-sample marker.
    void_bit: u32,
    warm_up: WarmUp,
    /// The file for the role's report; null without a domain.
    report: Option<PathBuf>,
    /// The resolved scenario: parameters and initial states of all bodies.
    scenario: toml::Table,
}

/// Access to the shared memory. Without a domain only the version is known.
#[derive(Debug, Serialize)]
struct Transport {
    name: &'static str,
    /// The version that every process of a run must use.
    version: &'static str,
    /// The run's directory.
    domain: Option<PathBuf>,
    /// `global.root_path` and `global.prefix` of the transport's configuration.
    root_path: Option<PathBuf>,
    prefix: Option<String>,
}

/// A signal: its service, the layout of its samples, and the requirements on the service.
#[derive(Debug, Serialize)]
struct SignalDescription {
    signal: &'static str,
    service: String,
    /// The type by which the service is opened: a versioned name and the hash of the layout.
    type_name: &'static str,
    /// The hash of the layout.
    layout: &'static str,
    /// Length of a sample, bytes.
    size: usize,
    /// True if samples are slices of 8-byte words, whose type is the type name.
    slice: bool,
    fields: Vec<FieldDescription>,
    qos: Qos,
    /// Queue depth of the built-in role; only for signals that the role reads.
    #[serde(skip_serializing_if = "Option::is_none")]
    buffer_size: Option<usize>,
}

#[derive(Debug, Serialize)]
struct FieldDescription {
    name: &'static str,
    /// Offset from the start of the sample, bytes.
    offset: usize,
    kind: &'static str,
    count: usize,
}

/// An input: a scenario key that may change while the loop runs.
#[derive(Debug, Serialize)]
struct InputDescription {
    number: usize,
    /// The key; its last part ends with the unit.
    key: String,
    description: String,
    variability: Variability,
    components: usize,
    /// The values until the first change.
    initial: Vec<f64>,
    /// The least and the largest value of a component; null where it is unbounded.
    range: [Option<f64>; 2],
    /// The names of the roles that use it.
    users: Vec<String>,
}

/// An input of the scenario: its place among the numbers that a served seat receives with each tick.
#[derive(Debug, Serialize)]
struct ValueDescription {
    key: String,
    /// The index of its first number, and how many it has.
    index: usize,
    count: usize,
    /// The meaning, with the unit.
    description: String,
    /// The numbers at tick 0, if the scenario does not change them there.
    initial: Vec<f64>,
}

/// Exercise of the links before the first tick: number of samples of generation 0, and their interval.
#[derive(Debug, Serialize)]
struct WarmUp {
    samples: usize,
    pause_ns: u64,
}

/// Describes a role, in the run of a domain or in general.
pub fn describe_seat(scenario: &Scenario, role: RoleId, domain: Option<&Domain>) -> SeatDescription {
    let (ports, depths) = (ports(scenario, role), depths(scenario));
    let written = |port: &Port| SignalDescription::new(port, depths, None);
    // If several commands may arrive before one is due, the newest is not enough.
    let waits = |port: &Port| port.topic.signal == Signal::Command && scenario.actuation_delay_ticks > 1;
    let reader = |port: &Port| if waits(port) { Reader::Scorer } else { Reader::Role };
    let read = |port: &Port| SignalDescription::new(port, depths, Some(reader(port)));
    let name = role.name(scenario);
    SeatDescription {
        schema: SCHEMA,
        version: env!("CARGO_PKG_VERSION"),
        role: name.to_owned(),
        kind: role.kind(),
        body: matches!(role, RoleId::Plant(_)).then(|| name.to_owned()),
        scenario_name: scenario.name.clone(),
        clock: scenario.clock.name(),
        tick_hz: 1e9 / scenario.period_ns as f64,
        period_ns: scenario.period_ns,
        last_tick: scenario.last_tick,
        window_ticks: window_ticks(scenario),
        every_ticks: match role {
            RoleId::Controller => scenario.rates.controller_ticks,
            RoleId::Observer(_) => scenario.rates.observer_ticks,
            RoleId::Plant(_) => 1,
        },
        actuation_delay_ticks: scenario.actuation_delay_ticks,
        command_timeout_ticks: scenario.command_timeout_ticks,
        rearm: match scenario.rearm {
            Rearm::Auto => "auto",
            Rearm::Manual => "manual",
        },
        program: program_words(),
        transport: Transport::new(domain),
        writes: ports.writes.iter().map(written).collect(),
        reads: ports.reads.iter().map(read).collect(),
        health: written(&ports.health),
        schedule: read(&ports.schedule),
        input: read(&ports.input),
        inputs: inputs(scenario),
        shapes: Shape::NAMES.into_iter().zip(0..).collect(),
        stamp_size: size_of::<Stamp>(),
        valid: (1 << scenario.rig.axes()) - 1,
        values: role_values(&scenario.inputs, role).iter().map(ValueDescription::new).collect(),
        phases: Phase::NAMES.into_iter().map(|(name, phase)| (name, phase as u64)).collect(),
        states: RoleState::NAMES.into_iter().map(|(name, state)| (name, state as u64)).collect(),
        status: status::NAMES.into_iter().collect(),
        void_bit: NO_SAMPLE.trailing_zeros(),
        warm_up: WarmUp { samples: WARM_UP_SAMPLES, pause_ns: WARM_UP_PAUSE_NS },
        report: domain.map(|domain| report_path(domain.root(), name)),
        scenario: scenario.resolved.clone(),
    }
}

/// Describes the inputs of a scenario.
fn inputs(scenario: &Scenario) -> Vec<InputDescription> {
    let describe = |(number, info): (usize, &InputInfo)| {
        let roles = info.uses.iter().flat_map(|by| RoleId::using(scenario, by.user));
        let mut users: Vec<String> = roles.map(|role| role.name(scenario).to_owned()).collect();
        users.dedup();
        let (least, largest) = info.range;
        InputDescription {
            number,
            key: info.key.clone(),
            description: info.description.clone().into_owned(),
            variability: info.variability,
            components: info.initial.len(),
            initial: info.initial.clone(),
            range: [least, largest].map(|bound| Some(bound).filter(|bound| bound.is_finite())),
            users,
        }
    };
    scenario.inputs.infos.iter().enumerate().map(describe).collect()
}

impl SeatDescription {
    /// Returns the description as indented JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a description of plain values is JSON") + "\n"
    }
}

/// Joins the domain in a directory, whose run must use this scenario: the description depends on both.
///
/// # Errors
/// [`RoleError::Domain`], [`RoleError::Config`], [`RoleError::OtherScenario`].
pub fn join_run(scenario: &Scenario, root: &Path) -> Result<Domain, RoleError> {
    let domain = Domain::join(root)?;
    let path = scenario_path(&domain);
    if Scenario::load(&path, &[])?.resolved != scenario.resolved {
        return Err(RoleError::OtherScenario { domain: root.to_owned(), scenario: path });
    }
    Ok(domain)
}

/// Returns the file in a domain's directory that describes an external role.
pub fn seat_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.seat.json"))
}

impl Transport {
    fn new(domain: Option<&Domain>) -> Self {
        let root = domain.map(|domain| domain.root().to_owned());
        Self {
            name: "iceoryx2",
            version: iox::VERSION,
            domain: root.clone(),
            root_path: root,
            prefix: domain.map(Domain::prefix),
        }
    }
}

impl SignalDescription {
    fn new(port: &Port, depths: Depths, reader: Option<Reader>) -> Self {
        let signal = port.topic.signal;
        Self {
            signal: signal.name(),
            service: port.topic.to_string(),
            type_name: port.layout,
            layout: port.layout.split_once('#').map_or("", |(_, hash)| hash),
            size: port.size,
            fields: Stamp::FIELDS.iter().chain(&port.fields).map(FieldDescription::new).collect(),
            slice: port.fleet,
            qos: port.qos(depths),
            buffer_size: reader.map(|reader| iox::buffer_size(signal, reader, depths)),
        }
    }
}

impl ValueDescription {
    fn new(value: &RoleValue<'_>) -> Self {
        let (info, index) = (value.info, value.index);
        let (count, initial) = (info.initial.len(), info.initial.clone());
        Self { key: info.key.clone(), index, count, description: info.description.clone().into_owned(), initial }
    }
}

/// Returns the command that starts this program; `None` if a word of it is not UTF-8.
fn program_words() -> Option<Vec<String>> {
    let command = this_program().ok()?;
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(|word| word.to_str().map(str::to_owned)).collect()
}

impl FieldDescription {
    fn new(field: &Field) -> Self {
        let kind = match field.kind {
            FieldKind::U64 => "u64",
            FieldKind::F64 => "f64",
        };
        Self { name: field.name, offset: field.offset, kind, count: field.count }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::config::SHIPPED;
    use serde_json::Value;

    fn described(text: &str, role: &str, domain: Option<&Domain>) -> Value {
        let scenario = Scenario::parse(text, "test", &["clock=lockstep".to_owned()]).unwrap();
        let role = RoleId::named(&scenario, role).unwrap();
        serde_json::from_str(&describe_seat(&scenario, role, domain).to_json()).unwrap()
    }

    /// The fields of every signal of every shipped scenario fill its sample without gaps.
    #[test]
    fn the_fields_of_every_signal_fill_its_size() {
        let mut signals = 0;
        for (name, text) in SHIPPED {
            let scenario = Scenario::parse(text, name, &[]).unwrap();
            for role in RoleId::all(&scenario) {
                let seat = describe_seat(&scenario, role, None);
                for signal in seat.writes.iter().chain(&seat.reads).chain([&seat.health, &seat.schedule, &seat.input]) {
                    let end = signal.fields.iter().fold(0, |end, field| {
                        assert_eq!(field.offset, end, "{}: {}", signal.service, field.name);
                        end + 8 * field.count
                    });
                    assert_eq!(end, signal.size, "{}", signal.service);
                    signals += 1;
                }
            }
        }
        assert!(signals > 100, "{signals}");
    }

    #[test]
    fn a_follower_s_seat_describes_its_domain_and_signals() {
        let domain = OwnedDomain::create(0).unwrap();
        let seat = described(SHIPPED[0].1, "follower", Some(domain.domain()));
        assert_eq!(seat["kind"], "plant");
        assert_eq!(seat["reads"][0]["service"], "corotate/rigid-pair/follower/command");
        assert_eq!(seat["reads"][0]["buffer_size"], 128);
        assert_eq!(seat["writes"][0]["signal"], "measurement");
        assert_eq!(seat["writes"][0]["fields"][0]["name"], "tick");
        assert_eq!(seat["writes"][0]["qos"]["subscriber_max_buffer_size"], 128);
        assert_eq!(seat["schedule"]["buffer_size"], 1);
        assert_eq!(seat["transport"]["prefix"], domain.domain().prefix());
        let place = |key| seat["inputs"].as_array().unwrap().iter().position(|input| input["key"] == key).unwrap();
        let number = place("follower.0.disturbance_rad_s2");
        let disturbance = &seat["inputs"][number];
        assert_eq!((&disturbance["number"], &disturbance["components"]), (&number.into(), &3.into()));
        assert_eq!(disturbance["users"], serde_json::json!(["follower"]));
        assert_eq!(disturbance["range"][0].as_f64().unwrap(), -disturbance["range"][1].as_f64().unwrap());
        assert_eq!(seat["inputs"][place("observer.decay_rate_per_s")]["range"], serde_json::json!([0.0, null]));
        assert_eq!(
            (&seat["input"]["service"], &seat["shapes"]["ramp"]),
            (&"corotate/rigid-pair/run/input".into(), &1.into())
        );
        assert!(seat["input"]["buffer_size"].as_u64() >= seat["input"]["qos"]["history_size"].as_u64());
        assert_eq!(seat["phases"]["warm_up"], 1);
        assert_eq!(seat["states"]["done"], 4);
        assert_eq!(seat["status"]["fault"], 512);
        assert_eq!(1 << seat["void_bit"].as_u64().unwrap(), NO_SAMPLE);
        assert_eq!(seat["scenario"]["leader"]["inertia_kg_m2"][2], 2.5);
        assert_eq!(seat["scenario"]["follower"][0]["inertia_factor"][0], 1.0);
    }

    #[test]
    fn fields_that_need_a_domain_are_null_without_one() {
        let seat = described(SHIPPED[0].1, "controller", None);
        assert!(seat["transport"]["prefix"].is_null() && seat["report"].is_null() && seat["body"].is_null());
    }
}
