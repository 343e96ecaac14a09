//! The tables of a campaign: results, axes, commands, the worst cases, and cases that did not complete.
//!
//! Must state how many rows a table omits.

use super::facts::{Facts, claimed, ran, value};
use super::number::few;
use super::spread::shown;
use crate::analysis::digits;
use crate::campaign::{AxisKind, End, Row};
use crate::report::model::{Block, Section};
use crate::telemetry::{quantile, sorted};
use std::collections::BTreeMap;

/// The number of worst cases that are shown.
const WORST: usize = 10;
/// The largest number of reasons that are shown.
const REASONS: usize = 20;

fn number(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), few)
}

/// Builds the section with counts, axes and commands.
pub fn result(facts: &Facts<'_>) -> Section {
    let (table, rows) = (facts.table, &facts.table.rows);
    let mut counts = vec![("cases of the campaign", table.cases), ("cases run", rows.len() as u64)];
    let ends = [
        ("of these, lost a body", End::Lost),
        ("of these, stopped after a role failed", End::Stopped),
        ("of these, invalid scenario", End::Invalid),
        ("of these, failed to run, or counters do not balance", End::Failed),
    ];
    for (name, verdict) in [("accepted", Some(true)), ("not accepted", Some(false)), ("not judged", None)] {
        let judged: Vec<&Row> = rows.iter().filter(|row| row.accepted == verdict).collect();
        // Counts of zero are omitted, except in the first four rows.
        counts.extend((verdict.is_some() || !judged.is_empty()).then_some((name, judged.len() as u64)));
        let ended = ends.map(|(name, end)| (name, judged.iter().filter(|row| row.exit == end).count() as u64));
        counts.extend(ended.into_iter().filter(|(_, count)| *count > 0));
    }
    let rows = counts.into_iter().map(|(name, count)| vec![name.to_owned(), count.to_string()]).collect();
    let mut blocks = vec![Block::table("", vec!["", "cases"], rows), axes(facts)];
    let repeats = facts.repeats();
    if repeats > 1 {
        blocks.push(Block::Text(format!("Up to {repeats} cases have the same values and differ by their seeds.")));
    }
    blocks.push(Block::table(
        "Commands, for the directory in which this page was made",
        vec!["run", "command"],
        commands(facts),
    ));
    Section { id: "result", title: "Result", blocks }
}

fn commands(facts: &Facts<'_>) -> Vec<Vec<String>> {
    let mut commands = Vec::new();
    if let Some(file) = &facts.file {
        if (facts.table.rows.len() as u64) < facts.table.cases {
            let command = format!("`corotate sweep {file} --out {}`", facts.directory);
            commands.push(vec!["missing cases (of a shard, add its --shard)".to_owned(), command]);
        }
        commands.push(vec!["all cases".to_owned(), format!("`corotate sweep {file}`")]);
    }
    commands.extend(
        facts.table.rows.first().map(|row| vec!["one case".to_owned(), format!("`{}`", facts.command(row.case))]),
    );
    commands
}

fn axes(facts: &Facts<'_>) -> Block {
    let row = |(axis, spread): (&crate::campaign::Axis, &super::spread::Spread)| {
        let kind = match axis.kind {
            AxisKind::Values => "values",
            AxisKind::Linear => "linear",
            AxisKind::Log => "logarithmic",
            AxisKind::Normal => "normal",
        };
        vec![spread.name.clone(), spread.key.clone(), kind.to_owned(), spread.words()]
    };
    let rows = facts.table.axes.iter().zip(&facts.spreads).map(row).collect();
    Block::table("Axes", vec!["axis", "key", "spread", "values"], rows)
}

/// Returns the table of quantiles of every metric.
pub fn metrics(facts: &Facts<'_>) -> Block {
    let row = |(place, metric): (usize, &crate::campaign::Metric)| {
        let values = sorted(facts.table.rows.iter().filter_map(|row| value(row, place)));
        if values.is_empty() {
            return None;
        }
        let mut row = vec![metric.name.clone(), values.len().to_string(), number(values.first().copied())];
        row.extend([0.05, 0.5, 0.95].map(|part| number(quantile(&values, part))));
        row.push(number(values.last().copied()));
        Some(row)
    };
    let head = vec!["metric", "cases", "smallest", "5 %", "median", "95 %", "largest"];
    Block::table("All metrics", head, facts.table.metrics.iter().enumerate().filter_map(row).collect())
}

/// Builds the section of the worst cases, the worst first.
pub fn worst(facts: &Facts<'_>) -> Option<Section> {
    let badness = |row: &&Row| {
        let value = facts.value(row).unwrap_or(f64::NEG_INFINITY);
        (row.exit != End::Completed, row.accepted == Some(false), value)
    };
    let mut rows: Vec<&Row> = facts.table.rows.iter().filter(|row| ran(row)).collect();
    rows.sort_by(|left, right| {
        let (a, b) = (badness(left), badness(right));
        (b.0, b.1).cmp(&(a.0, a.1)).then(b.2.total_cmp(&a.2)).then(left.case.cmp(&right.case))
    });
    if rows.is_empty() {
        return None;
    }
    let names = facts.spreads.iter().map(|spread| spread.name.clone());
    let metric = facts.metric.map(|_| facts.metric_name());
    let first = ["case", "command"].map(str::to_owned);
    let last = ["verdict", "within limits from, s", "seed"].map(str::to_owned);
    let head: Vec<String> = first.into_iter().chain(metric.clone()).chain(names).chain(last).collect();
    let row = |row: &&Row| {
        let mut cells = vec![row.case.to_string(), format!("`{}`", facts.command(row.case))];
        cells.extend(metric.as_ref().map(|_| number(facts.value(row))));
        cells.extend(row.parameters.iter().map(shown));
        // A verdict without a reason stays on one line.
        let verdict = row.verdict.replace(' ', "\u{a0}");
        cells.push(row.reason.as_ref().map_or(verdict, |reason| format!("{}: {reason}", row.verdict)));
        cells.push(row.settled_at_s.map_or("–".to_owned(), digits));
        cells.push(row.seed.to_string());
        cells
    };
    let text = format!(
        "The worst {} of {} cases that ran: first those that did not complete, then those not accepted, then by the metric.",
        rows.len().min(WORST),
        rows.len()
    );
    let table = rows.iter().take(WORST).map(row).collect();
    Some(Section { id: "worst", title: "Worst cases", blocks: vec![Block::Text(text), Block::table("", head, table)] })
}

/// Builds the section that compares claims with results.
pub fn certificate(facts: &Facts<'_>) -> Option<Section> {
    if !facts.predicted {
        return None;
    }
    let count = |claim: bool, accepted: Option<bool>| {
        let counted = |row: &&Row| ran(row) && claimed(row) == claim && row.accepted == accepted;
        facts.table.rows.iter().filter(counted).count().to_string()
    };
    let row = |name: &str, claim: bool| {
        let mut row = vec![name.to_owned()];
        row.extend([Some(true), Some(false), None].map(|accepted| count(claim, accepted)));
        row
    };
    let rows = vec![row("a rate is claimed", true), row("no rate is claimed", false)];
    let text = "Before a case runs, the certificate claims a decay rate of small errors, or no rate. The criteria in [accept] are \
                different: a case with a claimed rate may be refused, and one without may be accepted.";
    let rates = sorted(facts.table.rows.iter().filter_map(|row| row.predicted_rate_per_s));
    let range = rates.first().zip(rates.last()).map(|(low, high)| {
        Block::Text(format!("Claimed rates of {} cases: {} to {} 1/s.", rates.len(), digits(*low), digits(*high)))
    });
    let head = vec!["cases", "accepted", "not accepted", "not judged"];
    let blocks = [Block::Text(text.to_owned()), Block::table("", head, rows)].into_iter().chain(range).collect();
    Some(Section { id: "certificate", title: "Claims and results", blocks })
}

/// Builds the section with the reasons of cases that did not complete.
pub fn reasons(facts: &Facts<'_>) -> Option<Section> {
    let mut reasons: BTreeMap<(&str, &str), (u64, u64)> = BTreeMap::new();
    for row in facts.table.rows.iter().filter(|row| !matches!(row.exit, End::Completed | End::Lost)) {
        let key = (row.exit.name(), row.reason.as_deref().unwrap_or("no reason given"));
        reasons.entry(key).or_insert((0, row.case)).0 += 1;
    }
    let mut rows: Vec<_> = reasons.into_iter().collect();
    rows.sort_by_key(|(_, (count, case))| (std::cmp::Reverse(*count), *case));
    let left = rows.len().saturating_sub(REASONS);
    let row = |((end, reason), (count, case)): ((&str, &str), (u64, u64))| {
        vec![count.to_string(), end.to_owned(), reason.to_owned(), format!("`{}`", facts.command(case))]
    };
    let cells: Vec<_> = rows.into_iter().take(REASONS).map(row).collect();
    if cells.is_empty() {
        return None;
    }
    let mut blocks = vec![Block::table("", vec!["cases", "end", "reason", "first case"], cells)];
    blocks.extend((left > 0).then(|| Block::Text(format!("{left} more reasons are not shown."))));
    Some(Section { id: "reasons", title: "Incomplete cases", blocks })
}
