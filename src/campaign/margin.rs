//! Margins: the last value of a key at which a condition holds, by bisection.
//!
//! The condition is taken to change once over the range; of several changes one is found. Must not know how a
//! case is run.

use super::axis::{self, Varied};
use super::table::{Axis, Find, Margin, MarginPoint, Parameter, Row};
use crate::analysis::{digits, to_tolerance};
use crate::config::{Checks, Document, Place};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use toml::Value;

/// Upper bound on the halvings.
const MAX_HALVINGS: u32 = 60;

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawMargin {
    pub find: Find,
    pub key: String,
    #[serde(default)]
    pub such_that: SuchThat,
    pub from: Value,
    pub to: Value,
    pub tolerance: f64,
}

/// A condition on a case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum SuchThat {
    /// Every acceptance criterion holds.
    #[default]
    Accepted,
    /// Every metric with a limit settled within it, at any time.
    Settled,
}

impl SuchThat {
    fn name(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::Settled => "settled",
        }
    }

    pub fn holds(self, row: &Row) -> bool {
        match self {
            Self::Accepted => row.accepted == Some(true),
            Self::Settled => row.settled_at_s.is_some(),
        }
    }
}

/// A margin to search.
#[derive(Debug, Clone)]
pub(super) struct Searched {
    /// The margin, without points.
    pub margin: Margin,
    pub such_that: SuchThat,
    /// The axis of its key, if the key is an axis.
    pub axis: Option<usize>,
    /// Its place in the campaign's file.
    pub place: Place,
    whole: bool,
}

impl Margin {
    /// Returns the points as a table, head and rows: for each the values of the axes, then the bracket of the margin to its
    /// tolerance. The case number is added if the values do not distinguish the points.
    pub fn rows(&self, axes: &[Axis]) -> (Vec<String>, Vec<Vec<String>>) {
        let known = |axis: &usize| self.points.iter().any(|point| point.parameter(*axis).is_some());
        let keys: Vec<usize> = (0..axes.len()).filter(|axis| axes[*axis].values.len() != 1).filter(known).collect();
        let parameter = |parameter: &Parameter| match parameter {
            Parameter::Number(number) => digits(*number),
            other => other.to_string(),
        };
        let named = |point: &MarginPoint| -> Vec<String> {
            keys.iter().map(|axis| point.parameter(*axis).map_or("-".to_owned(), parameter)).collect()
        };
        let mut rows: Vec<Vec<String>> = self.points.iter().map(named).collect();
        let alike = rows.len() > rows.iter().collect::<BTreeSet<_>>().len();
        let bound = |end: Option<f64>| end.map_or("nowhere".to_owned(), |value| to_tolerance(value, self.tolerance));
        for (row, point) in rows.iter_mut().zip(&self.points) {
            row.extend(alike.then(|| point.case.to_string()));
            row.extend(point.bracket.map(bound));
        }
        let head = keys.iter().map(|axis| axes[*axis].name()).chain(alike.then_some("case"));
        (head.chain(["holds at", "fails at"]).map(str::to_owned).collect(), rows)
    }
}

impl MarginPoint {
    /// Returns the value of an axis at this point; `None` for the moved key.
    pub fn parameter(&self, axis: usize) -> Option<&Parameter> {
        self.parameters.get(axis)?.as_ref()
    }
}

/// The result of a bisection.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Found {
    /// The last value at which the condition held.
    pub value: Option<f64>,
    /// The condition held at the first and not at the second.
    pub bracket: [Option<f64>; 2],
    /// The number of runs.
    pub runs: u64,
}

impl Searched {
    /// Checks a margin; `None` if it is refused.
    pub fn resolve(
        raw: &RawMargin,
        index: usize,
        document: &Document,
        axes: &[Varied],
        checks: &mut Checks<'_>,
    ) -> Option<Self> {
        let at = format!("margin[{index}]");
        let key = raw.key.trim().replace('[', ".").replace(']', "");
        checks.require(!key.is_empty(), &format!("{at}.key"), "empty-key", || {
            "is empty; name a key of the scenario, as --set does".to_owned()
        });
        checks.positive(&format!("{at}.tolerance"), raw.tolerance);
        let (range, whole) = axis::ends([&raw.from, &raw.to], &format!("{at}.from"), false, checks)?;
        let margin = Margin {
            find: raw.find,
            such_that: raw.such_that.name().to_owned(),
            range,
            tolerance: if whole { raw.tolerance.max(1.0) } else { raw.tolerance },
            points: Vec::new(),
            key: key.clone(),
        };
        let axis = axes.iter().position(|varied| varied.axis.key == key);
        Some(Self { margin, such_that: raw.such_that, axis, place: document.place(&format!("{at}.key")), whole })
    }

    /// Halves the range down to the tolerance; `None` once `holds` returns `None`.
    pub fn search(&self, mut holds: impl FnMut(Value) -> Option<bool>) -> Option<Found> {
        let [from, to] = self.margin.range;
        let (mut good, mut bad) = if self.margin.find == Find::Largest { (from, to) } else { (to, from) };
        let mut runs = 0;
        let mut tried = |value: f64| {
            runs += 1;
            holds(axis::value(value, self.whole)).map(|holds| (holds, runs))
        };
        let (holds_at_best, runs) = tried(good)?;
        if !holds_at_best {
            return Some(Found { value: None, bracket: [None, Some(good)], runs });
        }
        let (holds_at_worst, mut runs) = tried(bad)?;
        if holds_at_worst {
            return Some(Found { value: Some(bad), bracket: [Some(bad), None], runs });
        }
        for _ in 0..MAX_HALVINGS {
            let middle = 0.5 * (good + bad);
            let middle = if self.whole { middle.floor() } else { middle };
            if (good - bad).abs() <= self.margin.tolerance || middle == good || middle == bad {
                break;
            }
            let holds;
            (holds, runs) = tried(middle)?;
            *(if holds { &mut good } else { &mut bad }) = middle;
        }
        Some(Found { value: Some(good), bracket: [Some(good), Some(bad)], runs })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn searched(find: Find, range: [f64; 2], tolerance: f64, whole: bool) -> Searched {
        let margin =
            Margin { key: "k".into(), find, such_that: "accepted".into(), range, tolerance, points: Vec::new() };
        Searched { margin, such_that: SuchThat::Accepted, axis: None, place: "".into(), whole }
    }

    proptest! {
        #[test]
        fn a_known_margin_is_found_to_the_tolerance(limit in 0.0..100.0_f64, tolerance in 1e-9..10.0_f64, down: bool) {
            let find = if down { Find::Smallest } else { Find::Largest };
            let holds = |value: f64| if down { value >= limit } else { value <= limit };
            let mut asked = 0;
            let found = searched(find, [0.0, 100.0], tolerance, false)
                .search(|value| {
                    asked += 1;
                    Some(holds(value.as_float().unwrap()))
                })
                .unwrap();
            let [good, bad] = found.bracket.map(Option::unwrap);
            prop_assert!(holds(good) && !holds(bad) && (good - bad).abs() <= tolerance);
            prop_assert_eq!((found.value, found.runs), (Some(good), asked));
            prop_assert!(asked <= 2 + 38);
        }

        #[test]
        fn whole_numbers_are_found_exactly(limit in 1..1000_i64) {
            let found = searched(Find::Largest, [1.0, 1000.0], 1.0, true)
                .search(|value| Some(value.as_integer().unwrap() <= limit))
                .unwrap();
            let beyond = (limit < 1000).then_some(limit as f64 + 1.0);
            prop_assert_eq!(found.bracket, [Some(limit as f64), beyond]);
        }
    }

    #[test]
    fn a_condition_that_never_changes_leaves_an_open_bracket() {
        let searched = searched(Find::Smallest, [1.0, 2.0], 0.1, false);
        let nowhere = searched.search(|_| Some(false)).unwrap();
        assert_eq!(nowhere, Found { value: None, bracket: [None, Some(2.0)], runs: 1 });
        let everywhere = searched.search(|_| Some(true)).unwrap();
        assert_eq!(everywhere, Found { value: Some(1.0), bracket: [Some(1.0), None], runs: 2 });
        assert_eq!(searched.search(|_| None), None, "interrupted");
    }
}
