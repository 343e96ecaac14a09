//! Sensors that are slower than the tick: the list `sensor` of a scenario.

use super::body::BodyInfo;
use super::checks::Checks;
use super::error::nearest;
use crate::bus::{Port, Signal};
use crate::sample::Stamp;
use crate::sample::status::HELD_FIELDS;
use serde::{Deserialize, Serialize};

/// The slowest rate of a role or sensor, ticks.
pub(super) const EVERY_MAX: u64 = 100_000;
/// The words of a measurement that describe its other fields.
const NOT_SENSED: [&str; 2] = ["status", "valid"];

/// A sensor with a rate of its own. In between its field holds the last value.
///
/// It has a new value at the first tick that its body executes, and at the ticks `phase_ticks + n * every_ticks`. If the body missed
/// such a tick, the value is new at the next executed one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sensor {
    /// The body.
    pub body: String,
    /// The field of its measurement.
    pub field: String,
    /// The number of ticks between two new values.
    pub every_ticks: u64,
    /// The first tick with a new value after tick 0; below `every_ticks`.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub phase_ticks: u64,
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl Sensor {
    /// Returns the number of new values up to and including a tick, apart from the first one.
    pub fn values_until(&self, tick: u64) -> u64 {
        tick.checked_sub(self.phase_ticks).map_or(0, |ticks| ticks / self.every_ticks + 1)
    }

    /// Returns true if this sensor and something with another rate and phase are due at the same tick again and again.
    fn meets(&self, every_ticks: u64, phase_ticks: u64) -> bool {
        self.phase_ticks.abs_diff(phase_ticks).is_multiple_of(common_divisor(self.every_ticks, every_ticks))
    }
}

/// Checks the list of sensors.
pub(crate) fn check(
    sensors: &[Sensor],
    bodies: &[BodyInfo],
    signals: &[Port],
    last_tick: u64,
    checks: &mut Checks<'_>,
) {
    for (index, sensor) in sensors.iter().enumerate() {
        let key = |name: &str| format!("sensor[{index}].{name}");
        check_ticks(sensor, &key, checks);
        if sensor.every_ticks > last_tick.max(1) {
            checks.warn(&key("every_ticks"), format!("the run ends at tick {last_tick}, before a second value"));
        }
        let known: Vec<&str> = bodies.iter().map(|body| &*body.name).collect();
        let Some(body) = bodies.iter().find(|body| body.name == sensor.body) else {
            let reason = format!("there is no body `{}`; {}", sensor.body, nearest(&sensor.body, &known));
            checks.refuse(&key("body"), "unknown-body", reason);
            continue;
        };
        if body.fleet.is_some() {
            let reason =
                format!("`{}` is a fleet, whose sensors measure at every tick; name a single body", sensor.body);
            checks.refuse(&key("body"), "fleet-sensor", reason);
            continue;
        }
        let measurement = |port: &&Port| port.topic.body == sensor.body && port.topic.signal == Signal::Measurement;
        let Some(port) = signals.iter().find(measurement) else { continue };
        let fields = port.fields.iter().filter(|field| field.offset >= size_of::<Stamp>());
        let names: Vec<&str> = fields.clone().map(|field| field.name).collect();
        let sensed: Vec<&str> = names.iter().copied().filter(|name| !NOT_SENSED.contains(name)).collect();
        checks.require(sensed.contains(&&*sensor.field), &key("field"), "unknown-field", || {
            format!("its measurement has no value `{}`; {}", sensor.field, nearest(&sensor.field, &sensed))
        });
        checks.require(names.contains(&"status"), &key("field"), "no-status", || {
            "readers could not tell new values from held ones: the measurement needs a field `status: u64`".to_owned()
        });
        let place = names.iter().position(|name| *name == sensor.field);
        checks.require(place.is_none_or(|place| place < HELD_FIELDS), &key("field"), "out-of-range", || {
            format!("only the first {HELD_FIELDS} fields of a measurement can have sensors of their own rate")
        });
        let twice =
            sensors[..index].iter().any(|earlier| (&earlier.body, &earlier.field) == (&sensor.body, &sensor.field));
        checks.require(!twice, &key("field"), "given-twice", || {
            format!("`{}` of `{}` has a sensor already; remove one of them", sensor.field, sensor.body)
        });
    }
}

fn check_ticks(sensor: &Sensor, key: &dyn Fn(&str) -> String, checks: &mut Checks<'_>) {
    let Sensor { every_ticks, phase_ticks, .. } = *sensor;
    checks.require((1..=EVERY_MAX).contains(&every_ticks), &key("every_ticks"), "out-of-range", || {
        format!("{every_ticks} is out of range; give a number from 1 to {EVERY_MAX}")
    });
    checks.require(phase_ticks < every_ticks.max(1), &key("phase_ticks"), "out-of-range", || {
        format!("{phase_ticks} is not below every_ticks = {every_ticks}; give the first tick with a new value")
    });
}

/// Warns if sensors of the observed body are never new together at a tick at which the observer computes.
pub(crate) fn check_together(sensors: &[Sensor], observed: &str, observer_ticks: u64, checks: &mut Checks<'_>) {
    let valid = |sensor: &&Sensor| sensor.body == observed && sensor.every_ticks > 0;
    let own: Vec<&Sensor> = sensors.iter().filter(valid).collect();
    let apart = own.iter().enumerate().find_map(|(index, sensor)| {
        let earlier = own[..index].iter().find(|earlier| !sensor.meets(earlier.every_ticks, earlier.phase_ticks));
        let alone = || (!sensor.meets(observer_ticks.max(1), 0)).then(|| "the observer".to_owned());
        Some((sensor, earlier.map(|earlier| format!("`{}`", earlier.field)).or_else(alone)?))
    });
    if let Some((sensor, counterpart)) = apart {
        checks.warn(
            "sensor",
            format!(
                "`{}` is never new at a tick of {counterpart}: an observer that needs both at once never corrects its \
                 estimate after tick 0; change phase_ticks",
                sensor.field
            ),
        );
    }
}

/// Returns the ticks after which the pattern of all sensors repeats.
pub(crate) fn common_ticks(sensors: &[Sensor]) -> u64 {
    sensors.iter().map(|sensor| sensor.every_ticks).fold(1, common_multiple)
}

/// Returns the least common multiple, at most the largest number. 0 counts as 1.
pub(super) fn common_multiple(a: u64, b: u64) -> u64 {
    let (a, b) = (a.max(1), b.max(1));
    (a / common_divisor(a, b)).saturating_mul(b)
}

fn common_divisor(mut a: u64, mut b: u64) -> u64 {
    while b != 0 {
        (a, b) = (b, a % b);
    }
    a
}

/// Returns a sentence about each sensor that is slower than the tick.
pub(crate) fn notes(sensors: &[Sensor], tick_hz: f64) -> impl Iterator<Item = String> {
    sensors.iter().filter(|sensor| sensor.every_ticks > 1).map(move |sensor| {
        let Sensor { body, field, every_ticks, phase_ticks } = sensor;
        let phase = if *phase_ticks > 0 { format!(" from tick {phase_ticks} on") } else { String::new() };
        let rate_hz = tick_hz / *every_ticks as f64;
        format!("{field} of the {body} is measured at every {every_ticks} ticks{phase}, at {rate_hz} Hz; in between it holds")
    })
}
