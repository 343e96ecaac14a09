//! The axes of a campaign: as typed, with their checks, and the value of each at a point.
//!
//! Must not know which case a point belongs to.

use super::draw;
use super::table::{Axis, AxisKind, Parameter};
use crate::config::{Checks, Document, Place};
use serde::{Deserialize, Serialize};
use toml::Value;

/// Upper bound on the values of one axis.
const MAX_POINTS: u64 = 1_000_000;

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawAxis {
    pub key: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label: Option<String>,
    #[serde(default, skip_serializing_if = "is_false")]
    pub factor: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub values: Option<Vec<Value>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub names: Option<Vec<String>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range: Option<RawRange>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub random: Option<RawRandom>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawRange {
    pub from: Value,
    pub to: Value,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points: Option<u64>,
    #[serde(default, skip_serializing_if = "is_false")]
    pub log: bool,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawRandom {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub uniform: Option<[Value; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_uniform: Option<[Value; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub normal: Option<[Value; 2]>,
}

fn is_false(flag: &bool) -> bool {
    !flag
}

/// A checked axis.
#[derive(Debug, Clone)]
pub(super) struct Varied {
    pub axis: Axis,
    /// True if its values are factors of the scenario's value.
    pub factor: bool,
    /// Its place in the campaign's file.
    pub place: Place,
    spread: Spread,
}

/// The distribution of the values.
#[derive(Debug, Clone)]
enum Spread {
    Values(Vec<Value>),
    /// Without points, values are drawn from the range.
    Range {
        ends: [f64; 2],
        points: Option<u64>,
        log: bool,
        whole: bool,
    },
    Normal {
        mean: f64,
        deviation: f64,
        whole: bool,
    },
}

/// Returns a number, and true if it is an integer.
pub(super) fn number(value: &Value) -> Option<(f64, bool)> {
    match value {
        Value::Integer(number) => Some((*number as f64, true)),
        Value::Float(number) => Some((*number, false)),
        _ => None,
    }
}

impl Varied {
    /// Checks an axis; `None` if it is refused.
    pub fn resolve(raw: &RawAxis, index: usize, document: &Document, checks: &mut Checks<'_>) -> Option<Self> {
        let at = format!("axis[{index}]");
        let given = [raw.values.is_some(), raw.range.is_some(), raw.random.is_some()];
        let single = given.iter().filter(|given| **given).count() == 1;
        checks.require(single, &at, "conflicting-keys", || {
            "needs exactly one of values, range and random; give one of them".to_owned()
        });
        checks.require(!raw.key.trim().is_empty(), &format!("{at}.key"), "empty-key", || {
            "is empty; name a key of the scenario, as --set does".to_owned()
        });
        let spread = match (&raw.values, &raw.range, &raw.random) {
            _ if !single => return None,
            (Some(values), ..) => Spread::values(values, raw.names.as_deref(), &at, checks)?,
            (_, Some(range), _) => Spread::range(range, &format!("{at}.range"), checks)?,
            (.., random) => Spread::random(random.as_ref()?, &format!("{at}.random"), checks)?,
        };
        checks.require(raw.names.is_none() || raw.values.is_some(), &format!("{at}.names"), "unused-key", || {
            "have no effect without a list of values; remove them".to_owned()
        });
        let mut varied = Self {
            axis: Axis {
                key: raw.key.trim().replace('[', ".").replace(']', ""),
                label: raw.label.clone(),
                kind: spread.kind(),
                values: Vec::new(),
            },
            factor: raw.factor,
            place: document.place(&format!("{at}.key")),
            spread,
        };
        let numbers = (0..varied.points().unwrap_or(0)).all(|point| number(&varied.at(point)).is_some());
        checks.require(!raw.factor || numbers, &format!("{at}.factor"), "not-a-number", || {
            "needs numbers, and some value is not one; give numbers, or remove it".to_owned()
        });
        let named = |point: u64| match raw.names.as_ref().and_then(|names| names.get(point as usize)) {
            Some(name) => Parameter::Word(name.clone()),
            None => parameter(&varied.at(point)),
        };
        varied.axis.values = (0..varied.points().unwrap_or(0)).map(named).collect();
        Some(varied)
    }

    /// Returns the number of values; `None` if they are drawn.
    pub fn points(&self) -> Option<u64> {
        match &self.spread {
            Spread::Values(values) => Some(values.len() as u64),
            Spread::Range { points, .. } => *points,
            Spread::Normal { .. } => None,
        }
    }

    /// Returns the value of this index, if values are not drawn.
    pub fn at(&self, point: u64) -> Value {
        match &self.spread {
            Spread::Values(values) => values[point as usize].clone(),
            Spread::Range { points, .. } => {
                let last = points.unwrap_or(1).saturating_sub(1);
                self.between(if last == 0 { 0.0 } else { point as f64 / last as f64 })
            }
            Spread::Normal { mean, whole, .. } => value(*mean, *whole),
        }
    }

    /// Returns the value for a number in (0, 1), and its index if it has one.
    pub fn drawn(&self, unit: f64) -> (Value, Option<u64>) {
        if let Some(points) = self.points() {
            let point = ((unit * points as f64) as u64).min(points - 1);
            return (self.at(point), Some(point));
        }
        let drawn = match &self.spread {
            Spread::Normal { mean, deviation, whole } => value(mean + deviation * draw::normal(unit), *whole),
            // Whole numbers are as likely at the ends as in between.
            Spread::Range { ends: [from, to], log: false, whole: true, .. } => {
                value((from + unit * (to - from + 1.0)).floor().min(*to), true)
            }
            _ => self.between(unit),
        };
        (drawn, None)
    }

    /// Returns the parameter that tables show for a value.
    pub fn shown(&self, value: &Value, point: Option<u64>) -> Parameter {
        let known = point.and_then(|point| self.axis.values.get(point as usize));
        known.cloned().unwrap_or_else(|| parameter(value))
    }

    /// Returns the value at a fraction of the range; 0 and 1 give its ends exactly.
    fn between(&self, part: f64) -> Value {
        let Spread::Range { ends: [from, to], log, whole, .. } = &self.spread else { return Value::Boolean(false) };
        let number = match part {
            0.0 => *from,
            1.0 => *to,
            _ if *log => libm::exp(libm::log(*from) + part * (libm::log(*to) - libm::log(*from))),
            _ => from + part * (to - from),
        };
        value(number, *whole)
    }
}

impl Spread {
    fn kind(&self) -> AxisKind {
        match self {
            Self::Values(_) => AxisKind::Values,
            Self::Range { log: true, .. } => AxisKind::Log,
            Self::Range { .. } => AxisKind::Linear,
            Self::Normal { .. } => AxisKind::Normal,
        }
    }

    fn values(values: &[Value], names: Option<&[String]>, at: &str, checks: &mut Checks<'_>) -> Option<Self> {
        let enough = (1..=MAX_POINTS as usize).contains(&values.len());
        checks.require(enough, &format!("{at}.values"), "out-of-range", || {
            format!("has {} values; give 1 to {MAX_POINTS}", values.len())
        });
        checks.require(
            names.is_none_or(|names| names.len() == values.len()),
            &format!("{at}.names"),
            "wrong-length",
            || {
                format!(
                    "has {} names for {} values; give one for each value",
                    names.map_or(0, <[_]>::len),
                    values.len()
                )
            },
        );
        enough.then(|| Self::Values(values.to_vec()))
    }

    fn range(raw: &RawRange, at: &str, checks: &mut Checks<'_>) -> Option<Self> {
        let (ends, whole) = ends([&raw.from, &raw.to], at, raw.log, checks)?;
        let points = raw.points;
        checks.require(
            points.is_none_or(|points| (2..=MAX_POINTS).contains(&points)),
            &format!("{at}.points"),
            "out-of-range",
            || format!("{} points do not reach from one end to the other; give 2 to {MAX_POINTS}", points.unwrap_or(0)),
        );
        let steps = points.unwrap_or(2).saturating_sub(1).max(1) as f64;
        let even = !whole || raw.log || points.is_none() || ((ends[1] - ends[0]) / steps).fract() == 0.0;
        checks.require(even, &format!("{at}.points"), "uneven-steps", || {
            "does not divide the range into integer steps; give another number of points, or ends such as 1.0"
                .to_owned()
        });
        Some(Self::Range { ends, points: points.map(|points| points.clamp(2, MAX_POINTS)), log: raw.log, whole })
    }

    fn random(raw: &RawRandom, at: &str, checks: &mut Checks<'_>) -> Option<Self> {
        match (&raw.uniform, &raw.log_uniform, &raw.normal) {
            (Some([from, to]), None, None) => {
                let (ends, whole) = ends([from, to], &format!("{at}.uniform"), false, checks)?;
                Some(Self::Range { ends, points: None, log: false, whole })
            }
            (None, Some([from, to]), None) => {
                let (ends, whole) = ends([from, to], &format!("{at}.log_uniform"), true, checks)?;
                Some(Self::Range { ends, points: None, log: true, whole })
            }
            (None, None, Some(normal)) => {
                let at = format!("{at}.normal");
                let [Some((mean, whole)), Some((deviation, also))] = [number(&normal[0]), number(&normal[1])] else {
                    checks.refuse(&at, "wrong-length", "takes two numbers; give mean and standard deviation");
                    return None;
                };
                checks.positive(&at, deviation);
                Some(Self::Normal { mean, deviation, whole: whole && also })
            }
            _ => {
                checks.refuse(
                    at,
                    "conflicting-keys",
                    "needs exactly one of uniform, log_uniform and normal; give one of them",
                );
                None
            }
        }
    }
}

/// Returns the ends of a range, and true if both are integers.
pub(super) fn ends(given: [&Value; 2], at: &str, log: bool, checks: &mut Checks<'_>) -> Option<([f64; 2], bool)> {
    let [Some((from, whole)), Some((to, also))] = given.map(number) else {
        checks.refuse(at, "wrong-length", "needs a number at each end; give two numbers");
        return None;
    };
    checks.require(from < to, at, "wrong-order", || format!("{from} is not below {to}; give the lower end first"));
    checks.require(!log || from > 0.0, at, "not-positive", || {
        format!("starts at {from}, and a logarithmic range needs positive ends; give ends above zero")
    });
    Some(([from, to], whole && also)).filter(|_| from < to && (!log || from > 0.0))
}

/// Returns a number as a scenario's value.
pub(super) fn value(number: f64, whole: bool) -> Value {
    if whole { Value::Integer(number.round() as i64) } else { Value::Float(number) }
}

/// Returns a value as tables show it.
pub(super) fn parameter(value: &Value) -> Parameter {
    match value {
        Value::Boolean(flag) => Parameter::Flag(*flag),
        Value::Integer(number) => Parameter::Whole(*number),
        Value::Float(number) => Parameter::Number(*number),
        Value::String(word) => Parameter::Word(word.clone()),
        other => Parameter::Word(other.to_string()),
    }
}
