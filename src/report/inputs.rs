//! The changes of inputs: their table, and their marks on all time axes.

use super::chart::CHANGE_LINES;
use super::model::Block;
use super::source::Source;
use super::traces::Traces;
use crate::analysis::digits;
use crate::inputs::AppliedChange;

/// The largest number of rows of a table.
pub const ROWS: usize = 50;

/// A run on a page; without a name if it is the only one.
#[derive(Clone, Copy)]
pub struct RunView<'a> {
    pub name: &'static str,
    pub source: &'a Source,
    pub traces: Option<&'a Traces>,
}

/// Returns the times at which inputs of the runs change, up to `last_s`, with descriptions.
pub fn marks<'a>(runs: impl IntoIterator<Item = (&'static str, &'a Source)>, last_s: f64) -> Vec<(f64, String)> {
    let lists: Vec<(&str, Vec<AppliedChange>)> =
        runs.into_iter().map(|(name, source)| (name, source.changes())).collect();
    let mut marks: Vec<(f64, String)> = Vec::new();
    for (names, change) in merged(&lists).into_iter().filter(|(_, change)| change.time_s <= last_s) {
        let run = if names.is_empty() { String::new() } else { format!("{names}: ") };
        let about = format!("{run}{} = {}{}", change.key, change.value, course(change));
        match marks.last_mut().filter(|(time_s, _)| *time_s == change.time_s) {
            Some((_, text)) => *text = format!("{text}; {about}"),
            None => marks.push((change.time_s, format!("at {} s: {about}", digits(change.time_s)))),
        }
    }
    marks
}

/// Returns the course of a change in words, if it is not a step.
fn course(change: &AppliedChange) -> String {
    match change.shape.as_str() {
        "step" => String::new(),
        shape => format!(" ({shape} over {} s)", digits(change.duration_s)),
    }
}

/// Returns the changes of all runs in the order of time, each with the names of the runs that have it.
fn merged<'a>(lists: &'a [(&str, Vec<AppliedChange>)]) -> Vec<(String, &'a AppliedChange)> {
    let mut all: Vec<(String, &AppliedChange)> = Vec::new();
    for (name, changes) in lists {
        // Equal changes of the earlier runs, each of which is merged once.
        let earlier = all.len();
        let mut next = 0;
        for change in changes {
            // Both lists are in the order of ticks.
            let rest = all[next..earlier].iter().take_while(|(_, first)| first.time_s <= change.time_s);
            match rest.enumerate().filter(|(_, (_, first))| same(first, change)).map(|(place, _)| next + place).next() {
                Some(place) => {
                    all[place].0 = format!("{}, {name}", all[place].0);
                    next = place + 1;
                }
                None => all.push(((*name).to_owned(), change)),
            }
        }
    }
    all.sort_by(|(_, a), (_, b)| a.time_s.total_cmp(&b.time_s));
    all
}

fn same(a: &AppliedChange, b: &AppliedChange) -> bool {
    let AppliedChange { tick: _, time_s, key, value, shape, duration_s, received } = a;
    (time_s, key, value, shape, duration_s, received)
        == (&b.time_s, &b.key, &b.value, &b.shape, &b.duration_s, &b.received)
}

/// Returns the text about the marks and the table of changes.
pub fn blocks(runs: &[RunView<'_>]) -> Vec<Block> {
    let lists: Vec<(&str, Vec<AppliedChange>)> = runs.iter().map(|run| (run.name, run.source.changes())).collect();
    let changes = merged(&lists);
    let mut blocks = Vec::new();
    if !changes.is_empty() && runs.iter().any(|run| run.traces.is_some()) {
        let times = marks(runs.iter().map(|run| (run.name, run.source)), f64::INFINITY).len();
        let mark = if times > CHANGE_LINES { "a tick at the bottom" } else { "a dotted line" };
        blocks.push(Block::Text(format!("Each change is {mark} in charts over time.")));
    }
    blocks.extend(table(&changes, runs.len() > 1));
    blocks
}

/// Returns the table of changes, with the names of the runs if there are several.
fn table(changes: &[(String, &AppliedChange)], several: bool) -> Vec<Block> {
    let row = |(names, change): &(String, &AppliedChange)| {
        let over = if change.duration_s > 0.0 { format!(", {} s", digits(change.duration_s)) } else { String::new() };
        let origin = if change.received { "received" } else { "scenario" };
        let mut row = vec![digits(change.time_s), change.key.clone(), change.value.to_string()];
        row.extend([format!("{}{over}", change.shape), origin.to_owned()]);
        row.extend(several.then(|| names.clone()));
        row
    };
    let head = ["at, s", "key", "value", "shape", "origin"].into_iter().chain(several.then_some("run"));
    let table = Block::table("", head.collect(), changes.iter().take(ROWS).map(row).collect());
    shortened(table, changes.len(), "changes")
}

/// Returns a table, and a text that names the number of its rows if some are left out.
pub fn shortened(table: Block, count: usize, what: &str) -> Vec<Block> {
    let text = || Block::Text(format!("The table has the first {ROWS} of {count} {what}; summary.json has all."));
    match count {
        0 => Vec::new(),
        count => std::iter::once(table).chain((count > ROWS).then(text)).collect(),
    }
}
