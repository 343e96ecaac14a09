//! Puts the value of an axis into a scenario.
//!
//! Must not know which case it belongs to.

use super::axis;
use crate::config::{ConfigError, Document, Place};
use toml::Value;

/// The end of a key that stands for every number of a table.
pub(super) const EVERY: &str = ".*";
/// The quantities of a fault that switch it off at zero.
const AMOUNTS: [&str; 7] =
    ["probability", "ticks", "delay_ticks", "jitter_ticks", "stall_ms", "deviation", "weakly_hard.misses"];
/// A fault delays while one of these two is above zero.
const LATENESS: [&str; 2] = ["delay_ticks", "jitter_ticks"];

/// Returns the number of the fault that the value of an axis has switched off.
pub(super) fn fault_that_is_off(document: &Document, key: &str) -> Option<usize> {
    let (number, amount) = key.strip_prefix("fault.")?.split_once('.')?;
    let none =
        |name: &str| axis::number(document.get(&format!("fault.{number}.{name}"))?).map(|(value, _)| value == 0.0);
    let late = LATENESS.contains(&amount) && LATENESS.iter().any(|name| none(name) == Some(false));
    let off = AMOUNTS.contains(&amount) && none(amount)? && !late;
    number.parse().ok().filter(|_| off)
}

/// Puts a value at the key of an axis. A number replaces each number of a list; a factor multiplies the existing value.
pub(super) fn put(
    document: &mut Document,
    key: &str,
    factor: bool,
    value: &Value,
    place: &Place,
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
        (there, true) => there.and_then(|there| times(there, value)).ok_or_else(|| {
            let reason =
                "is not a number in the scenario and cannot be multiplied; give values, or put the key into [set]";
            ConfigError::invalid(place.clone(), key, "not-a-factor", reason)
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

/// Multiplies a number, or each number of a list, by a factor; `None` for any other value.
fn times(there: &Value, factor: &Value) -> Option<Value> {
    if let Value::Array(list) = there {
        return list.iter().map(|there| times(there, factor)).collect::<Option<_>>().map(Value::Array);
    }
    let ((number, whole), (factor, _)) = (axis::number(there)?, axis::number(factor)?);
    Some(axis::value(number * factor, whole && (number * factor).fract() == 0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_is_off_only_when_all_its_amounts_are_zero() {
        let off = |fault: &str, key: &str| {
            let document = Document::parse(&format!("[[fault]]\nkind = \"delay\"\n{fault}\n"), "x").unwrap();
            fault_that_is_off(&document, &format!("fault.0.{key}")).is_some()
        };
        assert!(off("delay_ticks = 0", "delay_ticks") && off("probability = 0.0", "probability"));
        assert!(!off("delay_ticks = 1", "delay_ticks") && !off("from_tick = 0", "from_tick") && !off("", "ticks"));
        assert!(off("weakly_hard = { misses = 0 }", "weakly_hard.misses"));
        assert!(!off("delay_ticks = 0\njitter_ticks = 2", "delay_ticks"), "jitter is left");
        assert!(!off("delay_ticks = 2\njitter_ticks = 0", "jitter_ticks"), "the constant part is left");
        assert!(off("delay_ticks = 0\njitter_ticks = 0", "jitter_ticks"));
    }
}
