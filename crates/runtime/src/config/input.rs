//! The inputs of a loop: the scenario keys that may change while it runs, and the `[[input]]` tables that change them.
//!
//! Must refuse a change that has no effect. The values themselves are checked by resolving the scenario with each of them.

use super::checks::Checks;
use super::error::nearest;
use crate::changes::{ReceivedChanges, SCRIPTED_MAX};
use crate::fault;
use crate::input::{COMPONENTS_MAX, Change, Course, Shape, Values};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::sync::{Arc, Mutex};
use toml::Value;

/// A scenario key that may change while the loop runs.
#[derive(Debug, Clone, PartialEq)]
pub struct InputInfo {
    /// The key, as in an override: `controller.gain_per_s` or `follower.0.offset_rad_s`. Its last part ends with the unit.
    pub key: String,
    /// The meaning, as a noun phrase.
    pub description: Cow<'static, str>,
    /// The kind of quantity.
    pub variability: Variability,
    /// The values in the scenario, 1 to [`COMPONENTS_MAX`].
    pub initial: Vec<f64>,
    /// The least and the largest value of a component.
    pub range: (f64, f64),
    /// The users of the input.
    pub uses: Vec<InputUse>,
    /// The quantity that shows the response to a step; `None` if no response is measured.
    pub response: Option<ResponseField>,
}

/// The quantity that shows the response to a step of an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ResponseField {
    /// The body.
    pub body: usize,
    /// The field of its truth.
    pub field: &'static str,
    /// The element of the field; `None`: that of the input's component.
    pub element: Option<usize>,
    /// True if the distance from body 0 counts.
    pub relative: bool,
    /// The field of the truth with the command that acts, if it has one.
    pub command: Option<&'static str>,
    /// True if the input disturbs the quantity, false if it is the set point of the quantity.
    pub disturbs: bool,
}

/// The kind of an input, in the words of the Functional Mock-up Interface (FMI 3.0, section 2.2.7).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variability {
    /// A parameter that is constant between changes, such as a gain.
    Tunable,
    /// A signal from outside, such as a reference or a disturbance.
    Input,
    /// A signal that is 0 or 1, `false` or `true` in the scenario.
    Switch,
}

/// A user of an input, and the number under which it knows the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InputUse {
    /// The user.
    pub user: InputUser,
    /// The number that the user's `set_input` receives.
    pub port: usize,
}

/// The port of the switch that keeps commands from a body; an actuator knows the one for the safe command as 0.
pub(crate) const DISCONNECTED: usize = 1;

/// A part of a loop that uses an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputUser {
    /// The body with this index.
    Body(usize),
    /// The actuators of the body with this index.
    Actuator(usize),
    /// The observers of all observed bodies.
    Observer,
    /// The law of the body with this index.
    Law(usize),
    /// The score of the run.
    Score,
    /// Every law and the score, as the reference; the port is the number of its first element.
    Reference,
}

impl InputInfo {
    /// Creates an input without users: a scenario key, its meaning as a noun phrase, and its values in the scenario, 1 to
    /// [`COMPONENTS_MAX`].
    pub fn new(
        key: impl Into<String>,
        variability: Variability,
        description: impl Into<Cow<'static, str>>,
        initial: &[f64],
    ) -> Self {
        let range = (f64::NEG_INFINITY, f64::INFINITY);
        let (key, description, initial) = (key.into(), description.into(), initial.to_vec());
        Self { key, description, variability, initial, range, uses: Vec::new(), response: None }
    }

    /// Sets the least and the largest value of a component.
    #[must_use]
    pub fn within(self, least: f64, largest: f64) -> Self {
        Self { range: (least, largest), ..self }
    }

    /// Adds users that know the input under the number `port`.
    #[must_use]
    pub fn used_by(mut self, users: impl IntoIterator<Item = InputUser>, port: usize) -> Self {
        self.uses.extend(users.into_iter().map(|user| InputUse { user, port }));
        self
    }

    /// Sets the quantity that shows the response to a step.
    #[must_use]
    pub fn seen_in(self, response: Option<ResponseField>) -> Self {
        Self { response, ..self }
    }

    /// Returns the first use by a user for which `is_user` returns true.
    pub fn use_by(&self, is_user: impl Fn(InputUser) -> bool) -> Option<InputUse> {
        self.uses.iter().find(|by| is_user(by.user)).copied()
    }

    /// Returns values as those of an input; missing components are zero.
    pub fn values(components: &[f64]) -> Values {
        let mut values = [0.0; COMPONENTS_MAX];
        values.iter_mut().zip(components).for_each(|(value, component)| *value = *component);
        values
    }

    /// Returns a value as the scenario writes it.
    pub fn to_toml(&self, values: &[f64]) -> Value {
        match (self.variability, self.initial.len()) {
            (Variability::Switch, _) => Value::Boolean(values[0] != 0.0),
            (_, 1) => Value::Float(values[0]),
            (_, count) => values[..count].iter().copied().map(Value::Float).collect::<Vec<_>>().into(),
        }
    }

    /// Reads a value as the scenario writes it.
    ///
    /// # Errors
    /// The reason, with the remedy.
    pub fn from_toml(&self, value: &Value) -> Result<Values, String> {
        let number = |value: &Value| value.as_float().or_else(|| value.as_integer().map(|integer| integer as f64));
        let found = match (self.variability, value) {
            (Variability::Switch, Value::Boolean(on)) => Some(vec![f64::from(u8::from(*on))]),
            (Variability::Switch, _) => return Err("is a switch; give true or false".to_owned()),
            (_, Value::Array(list)) => list.iter().map(number).collect(),
            (_, value) => number(value).map(|number| vec![number]),
        };
        let count = self.initial.len();
        match found.filter(|found| found.len() == count && found.iter().all(|value| value.is_finite())) {
            Some(found) => Ok(Self::values(&found)),
            None if count == 1 => Err("takes one finite number".to_owned()),
            None => Err(format!("takes a list of {count} finite numbers")),
        }
    }

    /// Returns true if every component is within its range.
    pub fn allows(&self, values: &Values) -> bool {
        let (least, largest) = self.range;
        values[..self.initial.len()].iter().all(|value| (least..=largest).contains(value))
    }
}

/// The inputs of a scenario and their changes.
#[derive(Debug, Default)]
pub struct Inputs {
    /// The inputs; a [`Change`] refers to them by position.
    pub infos: Vec<InputInfo>,
    /// The changes of the scenario, in the order of their ticks.
    pub scripted: Arc<[Change]>,
    /// The changes that the present run has received.
    received: Mutex<Arc<ReceivedChanges>>,
}

impl Inputs {
    /// Returns true if the scenario changes nothing while it runs.
    pub fn is_constant(&self) -> bool {
        let on = |info: &InputInfo| info.variability == Variability::Switch && info.initial != [0.0];
        self.scripted.is_empty() && !self.infos.iter().any(on)
    }

    /// Returns the list of the changes that the present run has received.
    ///
    /// # Panics
    /// If a thread panicked while it replaced the list.
    pub fn received(&self) -> Arc<ReceivedChanges> {
        Arc::clone(&self.received.lock().expect("no thread panics while it holds the lock"))
    }

    /// Replaces the list by that of a run that begins.
    ///
    /// # Panics
    /// As [`received`](Self::received).
    pub fn receive_in(&self, list: impl Into<Arc<ReceivedChanges>>) {
        *self.received.lock().expect("no thread panics while it holds the lock") = list.into();
    }

    /// Returns the changes of the scenario and those of the present run.
    pub fn lists(&self) -> ChangeLists {
        ChangeLists { scripted: Arc::clone(&self.scripted), received: self.received() }
    }

    /// Returns true if the key is that of a parameter of the loop, not of a signal from outside.
    pub fn is_parameter(&self, key: &str) -> bool {
        self.find(key).is_ok_and(|(_, info)| info.variability == Variability::Tunable)
    }

    /// Returns the number and the description of the input with a key; list positions may be in brackets.
    ///
    /// # Errors
    /// The reason, with similar keys.
    pub fn find(&self, key: &str) -> Result<(usize, &InputInfo), String> {
        find(&self.infos, key)
    }
}

/// The changes of a scenario, and those that its present run has received.
#[derive(Debug)]
pub struct ChangeLists {
    scripted: Arc<[Change]>,
    received: Arc<ReceivedChanges>,
}

impl ChangeLists {
    /// Returns all changes with their origin, true for a received one, in the order of their ticks: of one tick the scripted ones
    /// first.
    pub fn all(&self) -> Vec<(Change, bool)> {
        let received = (0..self.received.count()).filter_map(|number| self.received.get(number));
        let scripted = self.scripted.iter().map(|change| (*change, false));
        let mut all: Vec<(Change, bool)> = scripted.chain(received.map(|change| (change, true))).collect();
        // Stable: changes of one tick keep their order.
        all.sort_by_key(|(change, _)| change.tick);
        all
    }

    /// Returns the changes that act from a tick on.
    pub fn at(&self, tick: u64) -> Vec<Change> {
        let first = self.scripted.partition_point(|change| change.tick < tick);
        let scripted = self.scripted[first..].iter().take_while(|change| change.tick == tick).copied();
        let received = (0..self.received.count()).filter_map(|number| self.received.get(number));
        scripted.chain(received.filter(|change| change.tick == tick)).collect()
    }

    /// Returns the values of the inputs at a tick.
    pub fn values_at(&self, infos: &[InputInfo], tick: u64) -> Vec<Values> {
        self.courses_at(infos, tick).iter().map(|course| course.at(tick)).collect()
    }

    /// Returns the courses of the inputs with all changes up to a tick. They hold until the next change.
    pub fn courses_at(&self, infos: &[InputInfo], tick: u64) -> Vec<Course> {
        let mut courses: Vec<Course> = infos.iter().map(|info| Course::new(InputInfo::values(&info.initial))).collect();
        for (change, _) in self.all().iter().filter(|(change, _)| change.tick <= tick) {
            if let Some(course) = courses.get_mut(change.input) {
                course.enter(change);
            }
        }
        courses
    }
}

/// Returns the number of the input that is the set point of the quantity which shows the response to `input`.
pub fn set_point_of(infos: &[InputInfo], input: &InputInfo) -> Option<usize> {
    let place = |field: ResponseField| (field.body, field.field);
    infos.iter().position(|info| {
        info.response.map(place) == input.response.map(place) && info.response.is_some_and(|field| !field.disturbs)
    })
}

fn find<'a>(infos: &'a [InputInfo], key: &str) -> Result<(usize, &'a InputInfo), String> {
    let plain = key.trim().replace('[', ".").replace(']', "");
    let found = infos.iter().enumerate().find(|(_, info)| info.key == plain);
    found.ok_or_else(|| {
        let keys: Vec<&str> = infos.iter().map(|info| &*info.key).collect();
        match keys.is_empty() {
            true => "nothing in this scenario can change while it runs".to_owned(),
            false => format!("{plain} cannot change while the loop runs; {}", nearest(&plain, &keys)),
        }
    })
}

/// An `[[input]]` table as typed.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawInput {
    pub at_s: f64,
    pub key: String,
    pub value: RawValue,
    #[serde(default)]
    pub shape: ShapeName,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub duration_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frequency_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub end_frequency_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hold_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
}

/// The value of a change as typed.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(untagged, expecting = "unknown value; give a number, a list of numbers, or true or false")]
pub(crate) enum RawValue {
    Switch(bool),
    Number(f64),
    List(Vec<f64>),
}

impl RawValue {
    pub fn to_toml(&self) -> Value {
        match self {
            Self::Switch(on) => Value::Boolean(*on),
            Self::Number(number) => Value::Float(*number),
            Self::List(list) => list.iter().copied().map(Value::Float).collect::<Vec<_>>().into(),
        }
    }
}

/// The names of the shapes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum ShapeName {
    #[default]
    Step,
    Ramp,
    Pulse,
    Sine,
    Chirp,
    Prbs,
}

/// The reason and the code of a mistake.
pub(crate) type Mistake = (String, &'static str);

/// The settings against which changes are checked.
pub(crate) struct Setting<'a> {
    pub infos: &'a [InputInfo],
    pub tick_s: f64,
    pub last_tick: u64,
    pub seed: u64,
    /// Returns the mistakes of the scenario if the key has this value.
    pub probe: &'a dyn Fn(&str, Value) -> Vec<Mistake>,
}

/// Checks all `[[input]]` tables and returns their changes. Refused ones are recorded and left out.
pub(crate) fn resolve(raw: &[RawInput], setting: &Setting<'_>, checks: &mut Checks<'_>) -> Vec<Change> {
    checks.require(raw.len() <= SCRIPTED_MAX, "input", "too-many", || {
        format!("{} are more than a run takes; give at most {SCRIPTED_MAX}", raw.len())
    });
    let each = raw.iter().enumerate();
    each.filter_map(|(number, raw)| change_of(raw, format!("input[{number}]"), number, setting, checks)).collect()
}

/// Checks one change, which stands in the scenario at `place`. `number` seeds its random numbers.
pub(crate) fn change_of(
    raw: &RawInput,
    place: String,
    number: usize,
    setting: &Setting<'_>,
    checks: &mut Checks<'_>,
) -> Option<Change> {
    InputCheck { raw, place, number, setting, checks }.resolve()
}

/// Returns changes in the order of their ticks, and checks that they do not end one another.
pub(crate) fn in_order(mut changes: Vec<Change>, setting: &Setting<'_>, checks: &mut Checks<'_>) -> Vec<Change> {
    // Stable: changes of one tick keep their order.
    changes.sort_by_key(|change| change.tick);
    check_overlaps(&changes, setting, checks);
    changes
}

/// Checks that no excitation begins while another one of the same input lasts: it would end that.
fn check_overlaps(changes: &[Change], setting: &Setting<'_>, checks: &mut Checks<'_>) {
    for (index, change) in changes.iter().enumerate().filter(|(_, change)| !change.shape.sets_level()) {
        let before = changes[..index].iter().rev();
        let mut before = before.filter(|before| before.input == change.input && !before.shape.sets_level());
        let ends = before.next().map(|before| before.tick + before.shape.ticks());
        if ends.is_some_and(|ends| ends > change.tick) {
            let key = &setting.infos[change.input].key;
            checks.refuse(
                "input",
                "overlap",
                format!(
                    "two excitations of {key} overlap at {} s; end the first one before, or combine them in one",
                    change.tick as f64 * setting.tick_s
                ),
            );
        }
    }
}

/// The check of one change.
struct InputCheck<'a, 'c, 'd> {
    raw: &'a RawInput,
    /// The key of the table, such as `input[0]`.
    place: String,
    number: usize,
    setting: &'a Setting<'a>,
    checks: &'c mut Checks<'d>,
}

impl InputCheck<'_, '_, '_> {
    fn refuse(&mut self, name: &str, code: &'static str, reason: impl Into<String>) {
        self.checks.refuse(&format!("{}.{name}", self.place), code, reason);
    }

    fn resolve(mut self) -> Option<Change> {
        self.check_keys();
        let (number, info) = match find(self.setting.infos, &self.raw.key) {
            Ok(found) => found,
            Err(reason) => {
                self.refuse("key", "not-tunable", reason);
                return None;
            }
        };
        let values = match info.from_toml(&self.raw.value.to_toml()) {
            Ok(values) => values,
            Err(reason) => {
                self.refuse("value", "wrong-type", format!("{} {reason}", info.key));
                return None;
            }
        };
        let tick = self.ticks("at_s", self.raw.at_s)?;
        let shape = self.shape(info)?;
        self.check_values(info, &values, shape);
        if tick > self.setting.last_tick {
            let key = format!("{}.at_s", self.place);
            self.checks.warn(&key, format!("{} s is after the last tick: the change does not act", self.raw.at_s));
        }
        Some(Change { tick, input: number, shape, values })
    }

    /// Refuses keys without a meaning for the shape, and missing keys that it needs.
    fn check_keys(&mut self) {
        use ShapeName::{Chirp, Prbs, Sine, Step};
        let raw = self.raw;
        let is = |shapes: &[ShapeName]| shapes.contains(&raw.shape);
        for (name, given, wanted, needed) in [
            ("duration_s", raw.duration_s.is_some(), !is(&[Step]), !is(&[Step])),
            ("frequency_hz", raw.frequency_hz.is_some(), is(&[Sine, Chirp]), is(&[Sine, Chirp])),
            ("end_frequency_hz", raw.end_frequency_hz.is_some(), is(&[Chirp]), is(&[Chirp])),
            ("hold_s", raw.hold_s.is_some(), is(&[Prbs]), false),
            ("seed", raw.seed.is_some(), is(&[Prbs]), false),
        ] {
            if given && !wanted {
                self.refuse(name, "unused-key", "has no meaning for this shape; remove it");
            }
            if needed && !given {
                self.refuse(name, "missing-key", "is missing for this shape; add it");
            }
        }
    }

    /// Returns a time in ticks.
    fn ticks(&mut self, name: &str, time_s: f64) -> Option<u64> {
        let ticks = (time_s / self.setting.tick_s).round();
        if (0.0..1e15).contains(&ticks) {
            return Some(ticks as u64);
        }
        self.refuse(name, "out-of-range", format!("{time_s} s is out of range; give 0 or more"));
        None
    }

    fn length(&mut self, name: &str, time_s: Option<f64>) -> Option<u64> {
        let ticks = self.ticks(name, time_s?)?;
        if ticks == 0 {
            self.refuse(name, "out-of-range", format!("is shorter than a tick of {} s; raise it", self.setting.tick_s));
            return None;
        }
        Some(ticks)
    }

    /// Returns a frequency in cycles per tick.
    fn frequency(&mut self, name: &str, frequency_hz: Option<f64>) -> Option<f64> {
        let cycles = frequency_hz? * self.setting.tick_s;
        if cycles > 0.0 && cycles < 0.5 {
            return Some(cycles);
        }
        let limit_hz = 0.5 / self.setting.tick_s;
        self.refuse(
            name,
            "out-of-range",
            format!("give a frequency above 0 and below half the tick rate, {limit_hz} Hz"),
        );
        None
    }

    fn shape(&mut self, info: &InputInfo) -> Option<Shape> {
        let raw = self.raw;
        if info.variability == Variability::Switch && !matches!(raw.shape, ShapeName::Step | ShapeName::Pulse) {
            self.refuse("shape", "wrong-shape", "a switch has no such course; give \"step\" or \"pulse\"");
            return None;
        }
        if raw.shape == ShapeName::Step {
            return Some(Shape::Step);
        }
        let ticks = self.length("duration_s", raw.duration_s)?;
        Some(match raw.shape {
            ShapeName::Step => Shape::Step,
            ShapeName::Ramp => Shape::Ramp { ticks },
            ShapeName::Pulse => Shape::Pulse { ticks },
            ShapeName::Sine => Shape::Sine { ticks, frequency: self.frequency("frequency_hz", raw.frequency_hz)? },
            ShapeName::Chirp => Shape::Chirp {
                ticks,
                frequency: self.frequency("frequency_hz", raw.frequency_hz)?,
                end_frequency: self.frequency("end_frequency_hz", raw.end_frequency_hz)?,
            },
            ShapeName::Prbs => Shape::Prbs {
                ticks,
                hold_ticks: match raw.hold_s {
                    Some(hold_s) => self.length("hold_s", Some(hold_s))?,
                    None => 1,
                },
                seed: raw.seed.unwrap_or_else(|| fault::seed(self.setting.seed, self.number as u64)),
            },
        })
    }

    /// Checks the new level, or the extremes around the initial one.
    fn check_values(&mut self, info: &InputInfo, values: &Values, shape: Shape) {
        let initial = InputInfo::values(&info.initial);
        let extremes = match (shape.sets_level(), info.variability) {
            (true, _) => vec![*values],
            (false, Variability::Switch) => {
                if info.initial[0] + values[0] > 1.0 {
                    self.refuse("value", "no-effect", "the switch is on already");
                }
                vec![]
            }
            (false, _) => [1.0, -1.0].map(|sign| std::array::from_fn(|i| initial[i] + sign * values[i])).to_vec(),
        };
        for extreme in extremes {
            if !info.allows(&extreme) {
                let (least, largest) = info.range;
                self.refuse(
                    "value",
                    "out-of-range",
                    format!("{} is out of range; give {least} to {largest}", info.key),
                );
                continue;
            }
            let mistakes = (self.setting.probe)(&info.key, info.to_toml(&extreme));
            for (reason, code) in mistakes {
                self.refuse("value", code, reason);
            }
        }
    }
}
