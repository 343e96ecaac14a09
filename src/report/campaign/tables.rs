//! The tables of a campaign: what was run of what, the worst cases and how each is run again, and what could not be run.
//!
//! Must not hide how much is left out.

use super::facts::{Facts, claimed, ran, value};
use super::number::few;
use super::spread::shown;
use crate::analysis::digits;
use crate::campaign::{AxisKind, End, Row};
use crate::report::model::{Block, Section};
use crate::telemetry::{quantile, sorted};
use std::collections::BTreeMap;

/// So many of the worst cases are told.
const WORST: usize = 10;
/// So many reasons of cases that could not be run.
const REASONS: usize = 20;

fn number(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), few)
}

/// What was run, what is varied, and how to run it again.
pub fn result(facts: &Facts<'_>) -> Section {
    let (table, rows) = (facts.table, &facts.table.rows);
    let mut told = vec![("cases of the campaign", table.cases), ("cases run", rows.len() as u64)];
    let ends = [
        ("of these, a body was lost", End::Lost),
        ("of these, stopped by a role that failed", End::Stopped),
        ("of these, no valid scenario", End::Invalid),
        ("of these, not run, or without balance", End::Failed),
    ];
    for (name, verdict) in [("accepted", Some(true)), ("not accepted", Some(false)), ("not judged", None)] {
        let of: Vec<&Row> = rows.iter().filter(|row| row.accepted == verdict).collect();
        // Causes without a case are left out, but for the first four.
        told.extend((verdict.is_some() || !of.is_empty()).then_some((name, of.len() as u64)));
        let ended = ends.map(|(name, end)| (name, of.iter().filter(|row| row.exit == end).count() as u64));
        told.extend(ended.into_iter().filter(|(_, count)| *count > 0));
    }
    let rows = told.into_iter().map(|(name, count)| vec![name.to_owned(), count.to_string()]).collect();
    let mut blocks = vec![Block::table("", vec!["", "cases"], rows), axes(facts)];
    let repeats = facts.repeats();
    if repeats > 1 {
        blocks.push(Block::Text(format!("Up to {repeats} cases have the same values and differ by their seeds.")));
    }
    blocks.push(Block::table(
        "How to run it again, typed where this page was made",
        vec!["what", "command"],
        commands(facts),
    ));
    Section { id: "result", title: "Result", blocks }
}

fn commands(facts: &Facts<'_>) -> Vec<Vec<String>> {
    let mut commands = Vec::new();
    if let Some(file) = &facts.file {
        if (facts.table.rows.len() as u64) < facts.table.cases {
            let command = format!("`corotate sweep {file} --out {}`", facts.directory);
            commands.push(vec!["what is missing; of a shard, with its --shard".to_owned(), command]);
        }
        commands.push(vec!["all cases".to_owned(), format!("`corotate sweep {file}`")]);
    }
    commands.extend(
        facts
            .table
            .rows
            .first()
            .map(|row| vec!["one case, by its number".to_owned(), format!("`{}`", facts.command(row.case))]),
    );
    commands
}

fn axes(facts: &Facts<'_>) -> Block {
    let row = |(axis, spread): (&crate::campaign::Axis, &super::spread::Spread)| {
        let kind = match axis.kind {
            AxisKind::Values => "values",
            AxisKind::Linear => "even",
            AxisKind::Log => "by factors",
            AxisKind::Normal => "about a mean",
        };
        vec![spread.name.clone(), spread.key.clone(), kind.to_owned(), spread.words()]
    };
    let rows = facts.table.axes.iter().zip(&facts.spreads).map(row).collect();
    Block::table("What is varied", vec!["axis", "key", "spread", "values"], rows)
}

/// Quantiles of every metric.
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
    let head = vec!["metric", "cases", "least", "5 %", "median", "95 %", "largest"];
    Block::table("All metrics", head, facts.table.metrics.iter().enumerate().filter_map(row).collect())
}

/// The cases that fared worst, the worst first.
pub fn worst(facts: &Facts<'_>) -> Option<Section> {
    let badness = |row: &&Row| {
        let value = facts.value(row).unwrap_or(f64::NEG_INFINITY);
        (row.exit != End::Completed, row.accepted == Some(false), value)
    };
    let mut rows: Vec<&Row> = facts.table.rows.iter().filter(|row| ran(row)).collect();
    rows.sort_by(|one, other| {
        let (a, b) = (badness(one), badness(other));
        (b.0, b.1).cmp(&(a.0, a.1)).then(b.2.total_cmp(&a.2)).then(one.case.cmp(&other.case))
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
        // On one line, unless there is a reason.
        let verdict = row.verdict.replace(' ', "\u{a0}");
        cells.push(row.reason.as_ref().map_or(verdict, |reason| format!("{}: {reason}", row.verdict)));
        cells.push(row.settled_at_s.map_or("–".to_owned(), digits));
        cells.push(row.seed.to_string());
        cells
    };
    let text = format!(
        "The worst {} of {} cases that ran: those that did not end well first, then those not accepted, then by the metric.",
        rows.len().min(WORST),
        rows.len()
    );
    let table = rows.iter().take(WORST).map(row).collect();
    Some(Section { id: "worst", title: "Worst cases", blocks: vec![Block::Text(text), Block::table("", head, table)] })
}

/// What is claimed, beside what happened.
pub fn certificate(facts: &Facts<'_>) -> Option<Section> {
    if !facts.predicted {
        return None;
    }
    let count = |claim: bool, accepted: Option<bool>| {
        let of = |row: &&Row| ran(row) && claimed(row) == claim && row.accepted == accepted;
        facts.table.rows.iter().filter(of).count().to_string()
    };
    let row = |name: &str, claim: bool| {
        let mut row = vec![name.to_owned()];
        row.extend([Some(true), Some(false), None].map(|accepted| count(claim, accepted)));
        row
    };
    let rows = vec![row("a rate is claimed", true), row("none is", false)];
    let text = "The certificate says of a case, before it is run, how fast a small error of its loop falls, or that nothing is \
                claimed. [accept] asks for more than that errors fall: what is claimed may not be accepted all the same, and what is \
                not may be.";
    let rates = sorted(facts.table.rows.iter().filter_map(|row| row.predicted_rate_per_s));
    let range = rates.first().zip(rates.last()).map(|(low, high)| {
        Block::Text(format!("Rates from {} to {} 1/s, of {} cases.", digits(*low), digits(*high), rates.len()))
    });
    let head = vec!["cases", "accepted", "not accepted", "not judged"];
    let blocks = [Block::Text(text.to_owned()), Block::table("", head, rows)].into_iter().chain(range).collect();
    Some(Section { id: "certificate", title: "Claimed and observed", blocks })
}

/// Why cases could not be run, or not to their end.
pub fn reasons(facts: &Facts<'_>) -> Option<Section> {
    let mut reasons: BTreeMap<(&str, &str), (u64, u64)> = BTreeMap::new();
    for row in facts.table.rows.iter().filter(|row| !matches!(row.exit, End::Completed | End::Lost)) {
        let key = (row.exit.name(), row.reason.as_deref().unwrap_or("no reason was told"));
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
    let mut blocks = vec![Block::table("", vec!["cases", "ended", "why", "the first of them"], cells)];
    blocks.extend((left > 0).then(|| Block::Text(format!("{left} more reasons are not shown."))));
    Some(Section { id: "reasons", title: "Cases that did not run to their end", blocks })
}
