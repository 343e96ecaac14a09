//! How a value of an axis gets into a scenario.
//!
//! Must not know which case it belongs to.

use super::axis;
use crate::config::{ConfigError, Document};
use toml::Value;

/// How a key ends that is every number of a table.
pub(super) const EVERY: &str = ".*";
/// The quantities of a fault of which none is no fault at all.
const AMOUNTS: [&str; 5] = ["probability", "ticks", "delay_ticks", "stall_ms", "deviation"];

/// The number of the fault that an axis has switched off: one of which there is nothing.
pub(super) fn fault_that_is_off(document: &Document, key: &str) -> Option<usize> {
    let (number, amount) = key.strip_prefix("fault.")?.split_once('.')?;
    let off = AMOUNTS.contains(&amount) && axis::number(document.get(key)?)?.0 == 0.0;
    number.parse().ok().filter(|_| off)
}

/// Puts a value where an axis has it: a number for a list of numbers is each of them, a factor is one of what is there.
pub(super) fn put(
    document: &mut Document,
    key: &str,
    factor: bool,
    value: &Value,
    place: &str,
) -> Result<(), ConfigError> {
    if let (Some(table), true) = (key.strip_suffix(EVERY), factor) {
        let keys = document.get(table).and_then(Value::as_table).map(|table| table.keys().cloned().collect::<Vec<_>>());
        let numbers = keys.into_iter().flatten().map(|key| format!("{table}.{key}"));
        let numbers: Vec<String> =
            numbers.filter(|key| document.get(key).is_some_and(|there| times(there, value).is_some())).collect();
        return numbers.iter().try_for_each(|key| put(document, key, true, value, place));
    }
    let there = document.get(key);
    let put = match (there, factor) {
        (there, true) => there.and_then(|there| times(there, value)).ok_or_else(|| ConfigError::Value {
            place: place.to_owned(),
            key: key.to_owned(),
            reason: "is no number in the scenario, so nothing can be a factor of it; give values, or put it into [set]"
                .into(),
        })?,
        (Some(Value::Array(list)), false) if axis::number(value).is_some() && list.iter().all(is_number) => {
            Value::Array(vec![value.clone(); list.len()])
        }
        _ => value.clone(),
    };
    document.put(key, put, place)
}

fn is_number(value: &Value) -> bool {
    axis::number(value).is_some()
}

/// A number, or each of a list of them, times a factor; none of anything else.
fn times(there: &Value, factor: &Value) -> Option<Value> {
    if let Value::Array(list) = there {
        return list.iter().map(|there| times(there, factor)).collect::<Option<_>>().map(Value::Array);
    }
    let ((number, whole), (factor, _)) = (axis::number(there)?, axis::number(factor)?);
    Some(axis::value(number * factor, whole && (number * factor).fract() == 0.0))
}
