//! A campaign as one page: maps, points, bands, margins, and the worst cases with the commands that run them again.
//!
//! | file | duty |
//! |---|---|
//! | `facts` | what the rows come to |
//! | `spread` | how the values of an axis lie, and its cells |
//! | `shades` | classes of values, and their scale |
//! | `map`, `scatter`, `bands` | two axes, cases as points, one axis |
//! | `number` | numbers in few digits |
//! | `margins`, `tables` | margins; everything in rows |
//!
//! Must not judge a case: verdicts are those of its row. Must not show a number that no row has, but for counts of rows.

mod bands;
mod facts;
mod map;
mod margins;
mod number;
mod scatter;
mod shades;
mod spread;
mod tables;
#[cfg(test)]
mod tests;

use super::model::{Block, Model, Section};
use crate::campaign::Table;
use crate::telemetry::sorted;
use facts::{Facts, ran};
use map::{Map, Paint, panels};
use shades::Shades;
use std::path::Path;

/// Pictures of at most so many pairs of axes, and of so many axes.
const PAIRS: usize = 6;
const AXES: usize = 12;
/// Cells of a map in each direction, and of each of several.
const CELLS: usize = 40;
const PANEL_CELLS: usize = 20;
/// Of a third axis so many values.
const PANELS: usize = 6;
/// Cells of a map of cases that are too many to be points.
const BINS: usize = 24;

/// Draws up the page of a campaign whose results are in a directory.
pub fn model(table: &Table, directory: &Path) -> Model {
    let facts = Facts::of(table, directory);
    let rows = &table.rows;
    let accepted = rows.iter().filter(|row| row.accepted == Some(true)).count();
    let judged = rows.iter().filter(|row| row.accepted.is_some()).count();
    let whole = rows.len() as u64 >= table.cases;
    let verdict = match (rows.len(), judged) {
        (0, _) => ("no case has been run".to_owned(), None),
        (_, 0) => ("no case was judged".to_owned(), None),
        (all, _) if accepted == all && whole => (format!("all {all} cases accepted"), Some(true)),
        (all, _) if accepted == 0 && judged == all => (format!("none of {all} cases accepted"), Some(false)),
        (all, _) => (format!("{accepted} of {all} cases accepted"), None),
    };
    let mut remarks = Vec::new();
    if !whole {
        let missing = table.cases - rows.len() as u64;
        remarks.push(format!(
            "{missing} of {} cases have not been run, or not here: the page shows those that have been",
            table.cases
        ));
    }
    if facts.file.is_none() {
        remarks.push(
            "there is no campaign.toml beside the results: commands name CAMPAIGN.toml, and limits are not known"
                .to_owned(),
        );
    }
    let mut sections = vec![tables::result(&facts)];
    sections.extend(pairs(&facts));
    sections.extend(along(&facts));
    sections.extend(distribution(&facts));
    sections.extend(margins::section(&facts));
    sections
        .extend([tables::certificate(&facts), tables::worst(&facts), tables::reasons(&facts)].into_iter().flatten());
    Model {
        title: table.name.clone(),
        run: None,
        subtitle: format!("campaign of {}: {} of {} cases", table.base, rows.len(), table.cases),
        verdict,
        remarks,
        marks: String::new(),
        sections,
    }
}

/// Two axes at a time.
fn pairs(facts: &Facts<'_>) -> Option<Section> {
    let varied: Vec<usize> = (0..facts.spreads.len()).filter(|axis| facts.spreads[*axis].varies()).collect();
    let pairs: Vec<[usize; 2]> = varied
        .iter()
        .enumerate()
        .flat_map(|(place, one)| varied[place + 1..].iter().map(|other| [*one, *other]))
        .collect();
    if pairs.is_empty() || facts.table.rows.is_empty() {
        return None;
    }
    let values = facts.sorted(&facts.table.rows);
    let shades = Shades::of(&values);
    let names =
        |axes: &[usize]| axes.iter().map(|axis| facts.spreads[*axis].name.as_str()).collect::<Vec<_>>().join(", ");
    let (mut blocks, mut figures) = (Vec::new(), Vec::new());
    for (place, pair) in pairs.iter().take(PAIRS).enumerate() {
        // Words find more room at the side.
        let [x, y] = *pair;
        let axes = if facts.spreads[y].is_numeric() && !facts.spreads[x].is_numeric() { [y, x] } else { [x, y] };
        let others: Vec<usize> = varied.iter().copied().filter(|axis| !pair.contains(axis)).collect();
        let over = match others.len() {
            0 => String::new(),
            1 | 2 => format!(" over all values of {}", names(&others)),
            more => format!(" over all values of {more} other axes"),
        };
        let known = axes.iter().all(|axis| facts.spreads[*axis].is_known());
        if !known && facts.table.rows.len() <= scatter::POINTS {
            let others = if others.is_empty() { "" } else { "; other axes are varied too" };
            let caption = format!("A point is a case, its shade the metric{others}.");
            figures.push((scatter::scatter(facts, axes, shades.as_ref()), caption));
            continue;
        }
        let map = Map::of(facts, axes, if known { CELLS } else { BINS }, &facts.table.rows);
        figures.extend(maps(facts, &map, &over));
        if let (0, Some(third)) = (place, others.first()) {
            blocks.extend(apart(facts, axes, *third, &others[1..], &names));
        }
    }
    blocks.insert(0, Block::Figures(figures));
    if pairs.len() > PAIRS {
        let left: Vec<String> = pairs[PAIRS..].iter().map(|pair| names(pair)).take(PAIRS).collect();
        let more = if pairs.len() > 2 * PAIRS { ", and others" } else { "" };
        blocks.push(Block::Text(format!(
            "{} of {} pairs of axes are drawn, in the order of the campaign; not {}{more}.",
            PAIRS,
            pairs.len(),
            left.join("; ")
        )));
    }
    Some(Section { id: "maps", title: "Maps", blocks })
}

/// The map of the metric, and that of the part accepted where verdicts differ within a cell.
fn maps(facts: &Facts<'_>, map: &Map<'_>, over: &str) -> Vec<(super::chart::Picture, String)> {
    let mut figures = Vec::new();
    let cases = if map.most() > 1 { format!("; a cell has up to {} cases{over}", map.most()) } else { String::new() };
    let limit = facts
        .limit
        .map_or(String::new(), |limit| format!("; the bar across the scale is the limit, {}", number::few(limit)));
    let values: Vec<f64> = map.values().collect();
    let shares = Shades::of_shares();
    // Without a finite value there is still what was lost.
    let shades = Shades::of(&values).or_else(|| Shades::of(&[0.0]));
    if let Some(shades) = shades.filter(|_| facts.metric.is_some()) {
        let border =
            "The border of acceptance is between cells of which at least half of the cases are accepted and others";
        figures.push((map.picture(Paint::Metric(&shades)), format!("{border}{cases}{limit}.")));
    }
    if map.most() > 1 || facts.metric.is_none() {
        let caption = format!("Which part of the cases of a cell was accepted{cases}.");
        figures.push((map.picture(Paint::Share(&shares)), caption));
    }
    figures
}

/// The same for values of a third axis, each by itself.
fn apart(
    facts: &Facts<'_>,
    axes: [usize; 2],
    third: usize,
    rest: &[usize],
    names: &dyn Fn(&[usize]) -> String,
) -> Option<Block> {
    let spread = &facts.spreads[third];
    let cells = spread.cells(if spread.is_known() { usize::MAX } else { PANELS });
    let shown = cells.some(PANELS);
    let of = |cell: &usize| {
        let rows =
            facts.table.rows.iter().filter(|row| row.parameters.get(third).and_then(|v| cells.of(v)) == Some(*cell));
        (format!("{} = {}", spread.name, cells.name(*cell)), Map::of(facts, axes, PANEL_CELLS, rows))
    };
    let maps: Vec<(String, Map<'_>)> = shown.iter().map(of).filter(|(_, map)| !map.is_empty()).collect();
    let values: Vec<f64> = maps.iter().flat_map(|(_, map)| map.values()).collect();
    let picture = panels(&maps, &Shades::of(&values)?)?;
    let mut caption = format!("The same for {} of {} values of {}", maps.len(), cells.count, spread.name);
    if !rest.is_empty() {
        caption += &format!(", over all values of {}", names(rest));
    }
    Some(Block::Figures(vec![(picture, caption + "; all with one scale.")]))
}

/// One axis at a time.
fn along(facts: &Facts<'_>) -> Option<Section> {
    let numeric = |axis: &usize| facts.spreads[*axis].is_numeric() && facts.spreads[*axis].varies();
    let axes: Vec<usize> = (0..facts.spreads.len()).filter(numeric).collect();
    let varied = facts.spreads.iter().filter(|spread| spread.varies()).count();
    let alone = axes.len() == 1 && varied == 1;
    let figures: Vec<_> = axes.iter().take(AXES).flat_map(|axis| bands::along(facts, *axis, alone)).collect();
    let mut blocks = vec![Block::Figures(figures)];
    if axes.len() > AXES {
        blocks.push(Block::Text(format!("{} more axes are not drawn.", axes.len() - AXES)));
    }
    (!axes.is_empty() && !facts.table.rows.is_empty()).then_some(Section {
        id: "axes",
        title: "Along each axis",
        blocks,
    })
}

/// How the numbers are distributed over all cases.
fn distribution(facts: &Facts<'_>) -> Option<Section> {
    let ran = facts.table.rows.iter().filter(|row| ran(row)).count();
    let (values, mut figures) = (facts.sorted(&facts.table.rows), Vec::new());
    let label = facts.metric_name();
    let lost = values.iter().filter(|value| value.is_infinite()).count();
    let picture = bands::distribution("distribution of the metric", &label, &values, ran, facts.limit);
    let mut caption = format!("Which part of {ran} cases has no larger value; {} have one", values.len() - lost);
    if lost > 0 {
        caption += &format!(", in {lost} a body was lost");
    }
    figures.extend(picture.map(|picture| (picture, caption + ".")));
    let settled = sorted(facts.table.rows.iter().filter_map(|row| row.settled_at_s));
    let title = "distribution of the time to settle";
    let picture = bands::distribution(title, "within all limits from, s", &settled, ran, None);
    let caption = format!(
        "From when on every limited metric stayed within its limit: {} of {ran} cases came there.",
        settled.len()
    );
    figures.extend(picture.map(|picture| (picture, caption)));
    let blocks = vec![Block::Figures(figures), tables::metrics(facts)];
    (ran > 0 && facts.metric.is_some()).then_some(Section { id: "distribution", title: "Distribution", blocks })
}
