//! What a campaign's table comes to: the metric that decides, its limit, quantiles, and what the cases of a cell have in common.
//!
//! Every number is one that some case has, or a count of cases. Must not draw.

use super::spread::Spread;
use crate::campaign::{CAMPAIGN, End, Metric, Row, Statistic, Table};
use crate::rig::named;
use crate::telemetry::sorted;
use std::path::Path;

/// The tables and keys in it that say what is accepted.
const SCENARIO: &str = "scenario";
const ACCEPT: &str = "accept";

/// A campaign as it is shown.
pub struct Facts<'a> {
    pub table: &'a Table,
    /// How each axis is spread, in the order of the table.
    pub spreads: Vec<Spread>,
    /// The column that is drawn; none if no case has a value.
    pub metric: Option<usize>,
    /// What is accepted of it, where that is the same in all cases.
    pub limit: Option<f64>,
    /// Whether some case has a rate that is claimed.
    pub predicted: bool,
    /// The campaign's file, as a command names it; none if it is not there.
    pub file: Option<String>,
    /// The results, as a command names them.
    pub directory: String,
}

impl<'a> Facts<'a> {
    pub fn of(table: &'a Table, directory: &Path) -> Self {
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
            spreads: (0..table.axes.len()).map(|axis| Spread::of(table, axis)).collect(),
            metric,
            limit: metric.and_then(|metric| limits[metric]),
            predicted: table.rows.iter().any(|row| row.predicted_rate_per_s.is_some()),
            file: text.is_some().then(|| quoted(&path)),
            directory: quoted(directory),
        }
    }

    /// The value of the drawn metric in a case: without end where a body was lost, none where nothing was measured.
    pub fn value(&self, row: &Row) -> Option<f64> {
        value(row, self.metric?)
    }

    /// What the drawn metric is, in words, and its unit; what it is once more where it has none.
    pub fn metric_parts(&self) -> (String, String) {
        let (words, unit) = self.metric.map_or_else(Default::default, |metric| told(&self.table.metrics[metric]));
        if unit.is_empty() { (words.clone(), words) } else { (words, unit) }
    }

    /// What the drawn metric is, in words, with its unit.
    pub fn metric_name(&self) -> String {
        let (words, unit) = self.metric_parts();
        if words == unit { words } else { format!("{words}, {unit}") }
    }

    /// The command that runs a case.
    pub fn command(&self, case: u64) -> String {
        let file = self.file.as_deref().unwrap_or("CAMPAIGN.toml");
        format!("corotate run {file} --case {case} --clock in-process")
    }

    /// The rows whose values are numbers, or were lost, the least first.
    pub fn sorted<'r>(&self, rows: impl IntoIterator<Item = &'r Row>) -> Vec<f64> {
        sorted(rows.into_iter().filter_map(|row| self.value(row)))
    }

    /// The most cases that have the same values of all axes: they differ by their seeds.
    pub fn repeats(&self) -> usize {
        let mut points = std::collections::HashMap::new();
        for row in &self.table.rows {
            let point = row.parameters.iter().map(|value| format!("{value}\n")).collect::<String>();
            *points.entry(point).or_insert(0) += 1;
        }
        points.into_values().max().unwrap_or(0)
    }
}

/// As [`Facts::value`], of any metric.
pub fn value(row: &Row, metric: usize) -> Option<f64> {
    let finite = row.metrics.get(metric).copied().flatten().filter(|value| value.is_finite());
    finite.or((row.exit == End::Lost).then_some(f64::INFINITY))
}

/// Whether a case was run at all.
pub fn ran(row: &Row) -> bool {
    !matches!(row.exit, End::Invalid | End::Failed)
}

/// Whether the certificate claims that the errors of a case fall.
pub fn claimed(row: &Row) -> bool {
    row.predicted_rate_per_s.is_some_and(|rate| rate > 0.0)
}

/// What a metric is, in words, and its unit.
fn told(metric: &Metric) -> (String, String) {
    let (words, unit) = named(&metric.metric);
    let (what, unit) = match metric.statistic {
        Statistic::Last => ("at the end", unit),
        Statistic::SettledMax => ("largest once settled", unit),
        Statistic::Peak => ("peak", unit),
        Statistic::Ise if unit.is_empty() => ("integral of its square", "s".to_owned()),
        Statistic::Ise => ("integral of its square", format!("({unit})² s")),
    };
    (format!("{words} ({what})"), unit)
}

/// What `[accept]` allows of a metric.
fn limit(accept: &toml::Value, metric: &Metric) -> Option<f64> {
    let suffix = match metric.statistic {
        Statistic::SettledMax => "max",
        Statistic::Peak => "peak",
        Statistic::Last | Statistic::Ise => return None,
    };
    let limit = accept.get(format!("{}_{suffix}", metric.metric))?;
    limit.as_float().or(limit.as_integer().map(|limit| limit as f64))
}

/// The metric that decides most often; where no limit is known, the first that has values, settled before peak.
fn decisive(table: &Table, limits: &[Option<f64>]) -> Option<usize> {
    let known = |metric: usize| table.rows.iter().any(|row| value(row, metric).is_some());
    let beyond = |metric: usize| {
        let limit = limits[metric]?;
        let over = table.rows.iter().filter(|row| value(row, metric).is_some_and(|value| value > limit)).count();
        // The first of those that decide as often.
        Some((over, usize::MAX - metric))
    };
    let all = 0..table.metrics.len();
    let limited = all.clone().filter(|metric| limits[*metric].is_some() && known(*metric)).max_by_key(|m| beyond(*m));
    let order = [Statistic::SettledMax, Statistic::Peak, Statistic::Last, Statistic::Ise];
    let of = |statistic| all.clone().find(|metric| table.metrics[*metric].statistic == statistic && known(*metric));
    limited.or_else(|| order.into_iter().find_map(of))
}

/// The part of the cases with a verdict that were accepted; none if none has one.
pub fn share<'r>(rows: impl IntoIterator<Item = &'r Row>) -> Option<f64> {
    part(rows.into_iter().filter_map(|row| row.accepted))
}

/// The part of the cases for which a rate is claimed: for none whose scenario is refused, as one whose loop is unstable is.
pub fn claimed_share<'r>(rows: impl IntoIterator<Item = &'r Row>) -> Option<f64> {
    part(rows.into_iter().filter(|row| row.exit != End::Failed).map(claimed))
}

fn part(flags: impl Iterator<Item = bool>) -> Option<f64> {
    let (mut held, mut all) = (0_u64, 0_u64);
    flags.for_each(|flag| (held, all) = (held + u64::from(flag), all + 1));
    (all > 0).then(|| held as f64 / all as f64)
}

/// A path as a shell takes it.
fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |letter: char| letter.is_ascii_alphanumeric() || "/._-+:@%".contains(letter);
    if !text.is_empty() && text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', r"'\''")) }
}
