//! Results of a campaign's table: the decisive metric, its limit, sorted values, and percentages of cases.
//!
//! Every number is the value of a case or a count of cases. Must not draw.

use super::spread::Spread;
use crate::campaign::{CAMPAIGN, End, Metric, Row, Statistic, Table};
use crate::rig::named;
use crate::telemetry::sorted;
use std::path::Path;

/// The keys of the acceptance limits in the file of the campaign.
const SCENARIO: &str = "scenario";
const ACCEPT: &str = "accept";

/// The results of a campaign.
pub struct Facts<'a> {
    pub table: &'a Table,
    /// The spread of each axis, in the order of the table.
    pub spreads: Vec<Spread>,
    /// The index of the decisive metric; `None` if no case has a value.
    pub metric: Option<usize>,
    /// The limit of the decisive metric, if it is the same in all cases.
    pub limit: Option<f64>,
    /// True if a case has a claimed rate.
    pub predicted: bool,
    /// The path of the campaign's file, quoted for a shell; `None` if it is missing.
    pub file: Option<String>,
    /// The path of the results, quoted for a shell.
    pub directory: String,
}

impl<'a> Facts<'a> {
    /// Reads the limits beside a table, and selects the decisive metric.
    pub fn new(table: &'a Table, directory: &Path) -> Self {
        let path = directory.join(CAMPAIGN);
        let text = std::fs::read_to_string(&path).ok();
        let accept = text.as_ref().and_then(|text| text.parse::<toml::Table>().ok());
        let accept = accept.and_then(|file| file.get(SCENARIO)?.get(ACCEPT).cloned());
        let varied = table.axes.iter().any(|axis| axis.key.split('.').next() == Some(ACCEPT));
        let limit = |metric: &Metric| accept.as_ref().filter(|_| !varied).and_then(|accept| limit(accept, metric));
        let limits: Vec<Option<f64>> = table.metrics.iter().map(limit).collect();
        let metric = decisive(table, &limits);
        Self {
            table,
            spreads: (0..table.axes.len()).map(|axis| Spread::new(table, axis)).collect(),
            metric,
            limit: metric.and_then(|metric| limits[metric]),
            predicted: table.rows.iter().any(|row| row.predicted_rate_per_s.is_some()),
            file: text.is_some().then(|| quoted(&path)),
            directory: quoted(directory),
        }
    }

    /// Returns the value of the decisive metric in a case: infinite if a body was lost, `None` if it was not measured.
    pub fn value(&self, row: &Row) -> Option<f64> {
        value(row, self.metric?)
    }

    /// Returns the name of the decisive metric and its unit; the name twice if it has no unit.
    pub fn metric_parts(&self) -> (String, String) {
        let (words, unit) =
            self.metric.map_or_else(Default::default, |metric| description(&self.table.metrics[metric]));
        if unit.is_empty() { (words.clone(), words) } else { (words, unit) }
    }

    /// Returns the name of the decisive metric with its unit.
    pub fn metric_name(&self) -> String {
        let (words, unit) = self.metric_parts();
        if words == unit { words } else { format!("{words}, {unit}") }
    }

    /// Returns the command that runs a case.
    pub fn command(&self, case: u64) -> String {
        let file = self.file.as_deref().unwrap_or("CAMPAIGN.toml");
        format!("corotate run {file} --case {case} --clock in-process")
    }

    /// Returns the values of the decisive metric in ascending order.
    pub fn sorted<'r>(&self, rows: impl IntoIterator<Item = &'r Row>) -> Vec<f64> {
        sorted(rows.into_iter().filter_map(|row| self.value(row)))
    }

    /// Returns the largest number of cases that have the same values of all axes and differ only by their seeds.
    pub fn repeats(&self) -> usize {
        let mut points = std::collections::HashMap::new();
        for row in &self.table.rows {
            let point = row.parameters.iter().map(|value| format!("{value}\n")).collect::<String>();
            *points.entry(point).or_insert(0) += 1;
        }
        points.into_values().max().unwrap_or(0)
    }
}

/// Returns the value of any metric in a case, as [`Facts::value`] does.
pub fn value(row: &Row, metric: usize) -> Option<f64> {
    let finite = row.metrics.get(metric).copied().flatten().filter(|value| value.is_finite());
    finite.or((row.exit == End::Lost).then_some(f64::INFINITY))
}

/// Returns true if the case was run.
pub fn ran(row: &Row) -> bool {
    !matches!(row.exit, End::Invalid | End::Failed)
}

/// Returns true if the certificate claims a positive decay rate for a case.
pub fn claimed(row: &Row) -> bool {
    row.predicted_rate_per_s.is_some_and(|rate| rate > 0.0)
}

/// Returns the name of a metric with its statistic, and the unit.
fn description(metric: &Metric) -> (String, String) {
    let (words, unit) = named(&metric.metric);
    let (statistic, unit) = match metric.statistic {
        Statistic::Last => ("at the end", unit),
        Statistic::SettledMax => ("largest once settled", unit),
        Statistic::Peak => ("peak", unit),
        Statistic::Ise if unit.is_empty() => ("integral of its square", "s".to_owned()),
        Statistic::Ise => ("integral of its square", format!("({unit})² s")),
    };
    (format!("{words} ({statistic})"), unit)
}

/// Returns the limit of a metric in `[accept]`.
fn limit(accept: &toml::Value, metric: &Metric) -> Option<f64> {
    let suffix = match metric.statistic {
        Statistic::SettledMax => "max",
        Statistic::Peak => "peak",
        Statistic::Last | Statistic::Ise => return None,
    };
    let limit = accept.get(format!("{}_{suffix}", metric.metric))?;
    limit.as_float().or(limit.as_integer().map(|limit| limit as f64))
}

/// Returns the metric that exceeds its limit in most cases. Without limits it is the first metric with values, in the
/// order settled, peak, last, integral.
fn decisive(table: &Table, limits: &[Option<f64>]) -> Option<usize> {
    let known = |metric: usize| table.rows.iter().any(|row| value(row, metric).is_some());
    let beyond = |metric: usize| {
        let limit = limits[metric]?;
        let over = table.rows.iter().filter(|row| value(row, metric).is_some_and(|value| value > limit)).count();
        // Of equal counts the first metric wins.
        Some((over, usize::MAX - metric))
    };
    let all = 0..table.metrics.len();
    let limited = all.clone().filter(|metric| limits[*metric].is_some() && known(*metric)).max_by_key(|m| beyond(*m));
    let order = [Statistic::SettledMax, Statistic::Peak, Statistic::Last, Statistic::Ise];
    let with = |statistic| all.clone().find(|metric| table.metrics[*metric].statistic == statistic && known(*metric));
    limited.or_else(|| order.into_iter().find_map(with))
}

/// Returns the fraction of the judged cases that were accepted; `None` if no case was judged.
pub fn share<'r>(rows: impl IntoIterator<Item = &'r Row>) -> Option<f64> {
    part(rows.into_iter().filter_map(|row| row.accepted))
}

/// Returns the fraction of the cases with a claimed rate. An invalid case, such as one with an unstable loop, has none.
pub fn claimed_share<'r>(rows: impl IntoIterator<Item = &'r Row>) -> Option<f64> {
    part(rows.into_iter().filter(|row| row.exit != End::Failed).map(claimed))
}

fn part(flags: impl Iterator<Item = bool>) -> Option<f64> {
    let (mut held, mut all) = (0_u64, 0_u64);
    flags.for_each(|flag| (held, all) = (held + u64::from(flag), all + 1));
    (all > 0).then(|| held as f64 / all as f64)
}

/// Quotes a path for a shell.
fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |letter: char| letter.is_ascii_alphanumeric() || "/._-+:@%".contains(letter);
    if !text.is_empty() && text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', r"'\''")) }
}
