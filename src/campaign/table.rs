//! The results of a campaign: one row per case, and the margins.
//!
//! Plain data, the same in memory, as JSON and in the journal. Must not compute anything.

use serde::{Deserialize, Serialize};
use std::fmt;

/// The results of a campaign, complete or partial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Table {
    /// The campaign's name.
    pub name: String,
    /// The scenario that is varied: the name of a shipped one, or a file, as the campaign names it.
    pub base: String,
    /// The varied keys; a row has one parameter for each.
    pub axes: Vec<Axis>,
    /// The measured statistics; a row has one value for each.
    pub metrics: Vec<Metric>,
    /// The number of cases of the whole campaign; cases without a row have not been run here.
    pub cases: u64,
    /// One row per case that has been run, by case number.
    pub rows: Vec<Row>,
    /// One per margin.
    pub margins: Vec<Margin>,
}

/// A varied key of the scenario.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Axis {
    /// The key, as `--set` takes it: `controller.gain_per_s`, `fault.0.probability`. Its unit is its last part.
    pub key: String,
    /// The label given in the campaign.
    pub label: Option<String>,
    /// The distribution of its values.
    pub kind: AxisKind,
    /// All values in order; empty if they are drawn.
    pub values: Vec<Parameter>,
}

impl Axis {
    /// Returns the label, or else the key.
    pub fn name(&self) -> &str {
        self.label.as_deref().unwrap_or(&self.key)
    }
}

/// The distribution of an axis's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AxisKind {
    /// A list: words, flags, or numbers in the order of their author.
    Values,
    /// Evenly spaced.
    Linear,
    /// Spaced by equal factors, for a logarithmic axis.
    Log,
    /// Normally distributed about a mean.
    Normal,
}

/// One number per case: a statistic of one of the rig's metrics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Metric {
    /// The column's name: metric and statistic, as `sync_error_rad_s.peak`.
    pub name: String,
    /// The rig's metric. Its unit is its last part.
    pub metric: String,
    /// The statistic of the metric.
    pub statistic: Statistic,
}

/// A statistic of a metric over a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Statistic {
    /// The value at the last tick.
    Last,
    /// The largest value from `accept.settled_by_s` on.
    SettledMax,
    /// The largest value from `accept.peak_from_s` on.
    Peak,
    /// The integral of its square over the run: unit² s.
    Ise,
}

impl Statistic {
    /// All statistics in the order of the columns.
    pub const ALL: [Self; 4] = [Self::Last, Self::SettledMax, Self::Peak, Self::Ise];

    /// Returns the second part of a column's name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Last => "last",
            Self::SettledMax => "settled_max",
            Self::Peak => "peak",
            Self::Ise => "ise",
        }
    }
}

/// The value of a key in one case.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Parameter {
    /// True or false.
    Flag(bool),
    /// A whole number.
    Whole(i64),
    /// A number.
    Number(f64),
    /// A word; for a list or a table its TOML text, or the name that the campaign gives it.
    Word(String),
}

impl Parameter {
    /// Returns the value as a number, if it has one.
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Whole(number) => Some(*number as f64),
            Self::Number(number) => Some(*number),
            Self::Flag(_) | Self::Word(_) => None,
        }
    }
}

impl fmt::Display for Parameter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Flag(flag) => flag.fmt(f),
            Self::Whole(number) => number.fmt(f),
            Self::Number(number) => number.fmt(f),
            Self::Word(word) => word.fmt(f),
        }
    }
}

/// One case.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// The number, from 0.
    pub case: u64,
    /// The seed.
    pub seed: u64,
    /// The values of the axes, in their order.
    pub parameters: Vec<Parameter>,
    /// True if every criterion that could be judged holds; `None` if no criterion could be judged, or if the run did not finish.
    pub accepted: Option<bool>,
    /// The verdict in words, as in a run's summary.
    pub verdict: String,
    /// The end of the run.
    pub exit: End,
    /// The reason if the run did not finish.
    pub reason: Option<String>,
    /// The time from which every metric with a limit in `[accept]` stayed within it, s; `None` if one did not, or without limits.
    pub settled_at_s: Option<f64>,
    /// The statistics in the order of the table's metrics; `None` if missing or not finite, as for a lost body.
    pub metrics: Vec<Option<f64>>,
    /// Ticks executed, all roles together.
    pub executed: u64,
    /// Ticks that a role did not execute.
    pub missed: u64,
    /// Ticks at which an input that was due was absent.
    pub starved: u64,
    /// Ticks at which a body applied its safe command.
    pub safe: u64,
    /// Ticks at which some body was lost.
    pub lost: u64,
    /// Samples that scripted faults touched, and stalls.
    pub injected: u64,
    /// The state hash as 16 hexadecimal digits; empty if nothing ran.
    pub hash: String,
    /// The slowest proven rate of the loop's driven bodies, 1/s; `None` if the campaign does not ask for it, or if no rate is
    /// proven.
    pub predicted_rate_per_s: Option<f64>,
}

/// The end of a case.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum End {
    /// It ran to its last tick.
    Completed,
    /// It ran to its last tick, and a body left the range of its model.
    Lost,
    /// A role failed, and the run was ended.
    Stopped,
    /// The scenario of this case is not valid; nothing ran.
    #[default]
    Invalid,
    /// It could not be run.
    Failed,
}

impl End {
    /// Returns the name used in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Completed => "completed",
            Self::Lost => "lost",
            Self::Stopped => "stopped",
            Self::Invalid => "invalid",
            Self::Failed => "failed",
        }
    }
}

/// A margin: the range of a key at every point of the other axes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Margin {
    /// The key that is moved.
    pub key: String,
    /// The end to find.
    pub find: Find,
    /// The condition, for example `accepted`.
    pub such_that: String,
    /// Both ends of the search.
    pub range: [f64; 2],
    /// The largest width of the bracket, in the key's unit.
    pub tolerance: f64,
    /// One per searched point, by case number.
    pub points: Vec<MarginPoint>,
}

/// The end of a range to find.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Find {
    /// The largest value at which the condition holds.
    Largest,
    /// The smallest value at which the condition holds.
    Smallest,
}

/// A margin at one point of the other axes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MarginPoint {
    /// The case with the same parameters and seed, except the moved key.
    pub case: u64,
    /// The values of the axes in their order; `None` for the moved key, if it is an axis.
    pub parameters: Vec<Option<Parameter>>,
    /// The last value at which the condition held; `None` if it does not hold where the search begins.
    pub value: Option<f64>,
    /// The bracket of the margin: the condition held at the first value and not at the second. `None` for an end beyond the
    /// range.
    pub bracket: [Option<f64>; 2],
    /// The number of runs.
    pub runs: u64,
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::journal;
    use super::*;

    /// A table with an example of every part.
    pub fn table() -> Table {
        let metric = |statistic: Statistic| Metric {
            name: format!("sync_error_rad_s.{}", statistic.name()),
            metric: "sync_error_rad_s".to_owned(),
            statistic,
        };
        Table {
            name: "map".to_owned(),
            base: "rigid-pair".to_owned(),
            axes: vec![Axis {
                key: "controller.gain_per_s".to_owned(),
                label: None,
                kind: AxisKind::Log,
                values: vec![Parameter::Number(1.0), Parameter::Whole(2), Parameter::Word("a".into())],
            }],
            metrics: Statistic::ALL.map(metric).to_vec(),
            cases: 4,
            rows: vec![Row {
                case: 3,
                seed: u64::MAX,
                parameters: vec![Parameter::Number(0.1 + 0.2)],
                accepted: Some(true),
                verdict: "accepted".to_owned(),
                exit: End::Completed,
                settled_at_s: Some(1.0 / 3.0),
                metrics: vec![Some(1e-300), None, Some(5.0), None],
                executed: 4,
                hash: "00ff00ff00ff00ff".to_owned(),
                ..Row::default()
            }],
            margins: vec![Margin {
                key: "fault.0.ticks".to_owned(),
                find: Find::Largest,
                such_that: "accepted".to_owned(),
                range: [1.0, 100.0],
                tolerance: 1.0,
                points: vec![MarginPoint {
                    case: 3,
                    parameters: vec![Some(Parameter::Flag(true)), None],
                    value: Some(41.0),
                    bracket: [Some(41.0), Some(42.0)],
                    runs: 9,
                }],
            }],
        }
    }

    #[test]
    fn a_table_is_the_same_after_json() {
        let table = table();
        let text = serde_json::to_string(&table).unwrap();
        assert_eq!(serde_json::from_str::<Table>(&text).unwrap(), table, "{text}");
    }

    #[test]
    fn a_table_is_read_from_its_directory() {
        let directory = tempfile::tempdir().unwrap();
        let table = table();
        let head = journal::Head::new("0123".to_owned(), None, &table);
        let mut text = journal::line(&head);
        // Out of order, and one of them twice.
        let repeated = Row { case: 1, ..table.rows[0].clone() };
        for row in [&table.rows[0], &repeated, &repeated] {
            text += &journal::line(&journal::Entry::Row(row.clone()));
        }
        text += &journal::line(&journal::Entry::Margin { margin: 0, point: table.margins[0].points[0].clone() });
        std::fs::write(directory.path().join(journal::FILE), format!("{text}0123456789abcdef {{\"row\"")).unwrap();
        let read = Table::read(directory.path()).unwrap();
        assert_eq!(read, Table { rows: vec![repeated, table.rows[0].clone()], ..table });
    }
}

/// Columns before the parameters, between them and the metrics, and after these.
const FIRST: [&str; 2] = ["case", "seed"];

const VERDICT: [&str; 5] = ["accepted", "verdict", "exit", "reason", "settled_at_s"];

const LAST: [&str; 8] = ["executed", "missed", "starved", "safe", "lost", "injected", "hash", "predicted_rate_per_s"];

/// Returns the names of all columns, in the order of both tables.
pub(super) fn columns(table: &Table) -> Vec<String> {
    let owned = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
    let axes = table.axes.iter().map(|axis| axis.key.clone()).collect();
    let metrics = table.metrics.iter().map(|metric| metric.name.clone()).collect();
    [owned(&FIRST), axes, owned(&VERDICT), metrics, owned(&LAST)].concat()
}

/// The common type of an axis's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Flag,
    Whole,
    Number,
    Word,
}

impl Kind {
    pub fn from_parameter(parameter: &Parameter) -> Self {
        match parameter {
            Parameter::Flag(_) => Self::Flag,
            Parameter::Whole(_) => Self::Whole,
            Parameter::Number(_) => Self::Number,
            Parameter::Word(_) => Self::Word,
        }
    }

    pub fn with(self, kind: Option<Self>) -> Self {
        match (self, kind) {
            (own, None) => own,
            (own, Some(kind)) if own == kind => own,
            (Self::Whole | Self::Number, Some(Self::Whole | Self::Number)) => Self::Number,
            _ => Self::Word,
        }
    }
}
