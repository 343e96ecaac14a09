//! The page of a campaign: maps, points, bands, margins, and the worst cases with the commands that run them again.
//!
//! | file | duty |
//! |---|---|
//! | `facts` | results computed from the rows |
//! | `spread` | the values of an axis, and its cells |
//! | `shades` | classes of values, and their scale |
//! | `map`, `scatter`, `bands` | charts over two axes, of cases as points, and along one axis |
//! | `number` | numbers in few digits |
//! | `margins`, `tables` | margins; tables |
//!
//! Must not judge a case: the verdict is in its row. Must not show numbers other than those of rows and counts of rows.

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
use crate::campaign::{Row, Table};
use crate::telemetry::sorted;
use facts::{Facts, ran};
use map::{Map, Paint, panels};
use shades::Shades;
use std::path::Path;

/// The largest number of pairs of axes, and of axes, that are drawn.
const PAIRS: usize = 6;
const AXES: usize = 12;
/// The largest number of cells in each direction, of a map and of each of several maps.
const CELLS: usize = 40;
const PANEL_CELLS: usize = 20;
/// The largest number of values of a third axis.
const PANELS: usize = 6;
/// The number of cells in each direction of a map of drawn values.
const BINS: usize = 24;

/// Builds the page of a campaign with its results in a directory.
pub fn model(table: &Table, directory: &Path) -> Model {
    let facts = Facts::new(table, directory);
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
            "{missing} of {} cases are missing: they have not been run, or belong to another shard",
            table.cases
        ));
    }
    if facts.file.is_none() {
        remarks.push(
            "campaign.toml is missing from the results: limits are unknown, and the commands name CAMPAIGN.toml"
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

/// Builds the section of charts over two axes.
fn pairs(facts: &Facts<'_>) -> Option<Section> {
    let varied: Vec<usize> = (0..facts.spreads.len()).filter(|axis| facts.spreads[*axis].varies()).collect();
    let pairs: Vec<[usize; 2]> =
        varied.iter().enumerate().flat_map(|(place, x)| varied[place + 1..].iter().map(|y| [*x, *y])).collect();
    if pairs.is_empty() || facts.table.rows.is_empty() {
        return None;
    }
    let values = facts.sorted(&facts.table.rows);
    let shades = Shades::for_values(&values);
    let names =
        |axes: &[usize]| axes.iter().map(|axis| facts.spreads[*axis].name.as_str()).collect::<Vec<_>>().join(", ");
    let (mut blocks, mut figures) = (Vec::new(), Vec::new());
    for (place, pair) in pairs.iter().take(PAIRS).enumerate() {
        // Words have more room on the y axis.
        let [x, y] = *pair;
        let axes = if facts.spreads[y].is_numeric() && !facts.spreads[x].is_numeric() { [y, x] } else { [x, y] };
        let rest: Vec<usize> = varied.iter().copied().filter(|axis| !pair.contains(axis)).collect();
        let over = match rest.len() {
            0 => String::new(),
            1 | 2 => format!(" over all values of {}", names(&rest)),
            more => format!(" over all values of {more} other axes"),
        };
        let known = axes.iter().all(|axis| facts.spreads[*axis].is_known());
        if !known && facts.table.rows.len() <= scatter::POINTS {
            let caption = format!("A point is a case; its shade is the metric{over}.");
            figures.push((scatter::scatter(facts, axes, shades.as_ref()), caption));
            continue;
        }
        let map = Map::new(facts, axes, if known { CELLS } else { BINS }, &facts.table.rows);
        figures.extend(maps(facts, &map, &over));
        if let (0, Some(third)) = (place, rest.first()) {
            blocks.extend(separate_maps(facts, axes, *third, &rest[1..], &names));
        }
    }
    blocks.insert(0, Block::Figures(figures));
    if pairs.len() > PAIRS {
        let left: Vec<String> = pairs[PAIRS..].iter().map(|pair| names(pair)).take(PAIRS).collect();
        let more = if pairs.len() > 2 * PAIRS { ", and others" } else { "" };
        blocks.push(Block::Text(format!(
            "{} of {} pairs of axes are drawn, in the order of the campaign. Not drawn: {}{more}.",
            PAIRS,
            pairs.len(),
            left.join("; ")
        )));
    }
    Some(Section { id: "maps", title: "Maps", blocks })
}

/// Draws the map of the metric, and the map of accepted cases if a cell has several cases.
fn maps(facts: &Facts<'_>, map: &Map<'_>, over: &str) -> Vec<(super::chart::Picture, String)> {
    let mut figures = Vec::new();
    let cases = if map.most() > 1 { format!(" A cell has up to {} cases{over}.", map.most()) } else { String::new() };
    let limit = facts
        .limit
        .map_or(String::new(), |limit| format!(" The bar across the scale marks the limit, {}.", number::few(limit)));
    let values: Vec<f64> = map.values().collect();
    let shares = Shades::for_fractions();
    // Without a finite value the map still shows lost bodies.
    let shades = Shades::for_values(&values).or_else(|| Shades::for_values(&[0.0]));
    if let Some(shades) = shades.filter(|_| facts.metric.is_some()) {
        let border = "The border of acceptance surrounds the cells in which at least half of the cases are accepted.";
        figures.push((map.picture(Paint::Metric(&shades)), format!("{border}{cases}{limit}")));
    }
    if map.most() > 1 || facts.metric.is_none() {
        let caption = format!("Percentage of accepted cases.{cases}");
        figures.push((map.picture(Paint::Share(&shares)), caption));
    }
    figures
}

/// Draws a map for each value of a third axis.
fn separate_maps(
    facts: &Facts<'_>,
    axes: [usize; 2],
    third: usize,
    rest: &[usize],
    names: &dyn Fn(&[usize]) -> String,
) -> Option<Block> {
    let spread = &facts.spreads[third];
    let cells = spread.cells(if spread.is_known() { usize::MAX } else { PANELS });
    let shown = cells.some(PANELS);
    let map = |cell: &usize| {
        let in_cell = |row: &&Row| row.parameters.get(third).and_then(|value| cells.index_of(value)) == Some(*cell);
        let rows = facts.table.rows.iter().filter(in_cell);
        (format!("{} = {}", spread.name, cells.name(*cell)), Map::new(facts, axes, PANEL_CELLS, rows))
    };
    let maps: Vec<(String, Map<'_>)> = shown.iter().map(map).filter(|(_, map)| !map.is_empty()).collect();
    let values: Vec<f64> = maps.iter().flat_map(|(_, map)| map.values()).collect();
    let picture = panels(&maps, &Shades::for_values(&values)?)?;
    let mut caption = format!("A map for each of {} of the {} values of {}", maps.len(), cells.count, spread.name);
    if !rest.is_empty() {
        caption += &format!(", over all values of {}", names(rest));
    }
    Some(Block::Figures(vec![(picture, caption + "; all with the same scale.")]))
}

/// Builds the section of charts along each axis.
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

/// Builds the section of distributions over all cases.
fn distribution(facts: &Facts<'_>) -> Option<Section> {
    let ran = facts.table.rows.iter().filter(|row| ran(row)).count();
    let (values, mut figures) = (facts.sorted(&facts.table.rows), Vec::new());
    let label = facts.metric_name();
    let lost = values.iter().filter(|value| value.is_infinite()).count();
    let picture = bands::distribution("distribution of the metric", &label, &values, ran, facts.limit);
    let mut caption =
        format!("Percentage of {ran} cases with at most the given value; {} have a value", values.len() - lost);
    if lost > 0 {
        caption += &format!(", {lost} lost a body");
    }
    figures.extend(picture.map(|picture| (picture, caption + ".")));
    let settled = sorted(facts.table.rows.iter().filter_map(|row| row.settled_at_s));
    let title = "distribution of the time to settle";
    let picture = bands::distribution(title, "within all limits from, s", &settled, ran, None);
    let caption =
        format!("Time from which all metrics with a limit stay within it: {} of {ran} cases settled.", settled.len());
    figures.extend(picture.map(|picture| (picture, caption)));
    let blocks = vec![Block::Figures(figures), tables::metrics(facts)];
    (ran > 0 && facts.metric.is_some()).then_some(Section { id: "distribution", title: "Distribution", blocks })
}
