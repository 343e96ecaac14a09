//! Margins: the extreme value of a key at every searched point, as a table and along a numeric axis.
//!
//! Must not draw a margin whose bracket has only one end as a value: it lies beyond the searched range.

use super::facts::Facts;
use super::shades::{by_factors, range};
use crate::analysis::digits;
use crate::campaign::{Find, Margin, MarginPoint};
use crate::report::axis::Axis;
use crate::report::chart::Picture;
use crate::report::frame::{Frame, LEFT, Line, RIGHT, TOP, WIDTH};
use crate::report::model::{Block, Section};
use std::fmt::Write;

/// The largest number of rows of a table.
const ROWS: usize = 200;
/// The largest number of lines of a chart, one per value of a second axis.
const LINES: usize = 4;
const CLASSES: [&str; LINES] = ["b d0", "o d1", "g d3", "p d4"];
const HEIGHT: f64 = 300.0;

/// Builds the section of margins; `None` if the campaign searches for none.
pub fn section(facts: &Facts<'_>) -> Option<Section> {
    let margins = &facts.table.margins;
    let blocks: Vec<Block> = margins.iter().flat_map(|margin| blocks(facts, margin)).collect();
    (!margins.is_empty()).then_some(Section { id: "margins", title: "Margins", blocks })
}

fn blocks(facts: &Facts<'_>, margin: &Margin) -> Vec<Block> {
    let [from, to] = margin.range.map(digits);
    let extreme = if margin.find == Find::Largest { "largest" } else { "smallest" };
    let text = format!(
        "The {extreme} {} between {from} and {to} at which a case is {}, found by bisection to a tolerance of {}. If the result \
         changes more than once in the range, bisection finds one of the changes.",
        margin.key,
        margin.such_that,
        digits(margin.tolerance)
    );
    let mut blocks = vec![Block::Text(text)];
    if margin.points.is_empty() {
        blocks.push(Block::Text("No point has been searched yet.".to_owned()));
        return blocks;
    }
    blocks.extend(picture(facts, margin).map(|figure| Block::Figures(vec![figure])));
    blocks.push(table(facts, margin));
    if margin.points.len() > ROWS {
        blocks.push(Block::Text(format!("The table shows the first {ROWS} of {} points.", margin.points.len())));
    }
    blocks
}

/// Returns the axes that vary between the points of a margin.
fn axes(facts: &Facts<'_>, margin: &Margin) -> Vec<usize> {
    let known = |axis: &usize| margin.points.iter().any(|point| point.parameter(*axis).is_some());
    (0..facts.spreads.len()).filter(|axis| facts.spreads[*axis].varies()).filter(known).collect()
}

fn table(facts: &Facts<'_>, margin: &Margin) -> Block {
    let (mut head, mut rows) = margin.rows(&facts.table.axes);
    head.push("runs".to_owned());
    rows.iter_mut().zip(&margin.points).for_each(|(row, point)| row.push(point.runs.to_string()));
    rows.truncate(ROWS);
    Block::table(&margin.key, head, rows)
}

/// Draws a margin along a numeric axis, with a line for each value of a second axis.
fn picture(facts: &Facts<'_>, margin: &Margin) -> Option<(Picture, String)> {
    let axes = axes(facts, margin);
    let across = *axes.iter().find(|axis| facts.spreads[**axis].is_numeric())?;
    let second = axes.iter().copied().find(|axis| *axis != across);
    let all = margin.points.iter().flat_map(|point| point.bracket.into_iter().chain([point.value])).flatten();
    let (low, high) = range(all.clone(), false)?;
    let y = match range(all, true).filter(|_| low >= 0.0) {
        Some((low, high)) if by_factors(low, high) => {
            Axis::decades(&format!("{}, logarithmic", margin.key), (low, high))
        }
        _ => Axis::around(&margin.key, (low, high)),
    };
    let x = facts.spreads[across].number_axis();
    let frame = Frame { width: WIDTH, height: HEIGHT, top: TOP, left: LEFT, right: RIGHT };
    let title = format!("margin of {} along {}", margin.key, facts.spreads[across].name);
    let mut svg = frame.open(&title);
    frame.axes(&x, &y, &mut svg);
    let cells = second.map(|axis| facts.spreads[axis].cells(LINES));
    let (mut lines, mut open) = (Vec::new(), 0);
    for group in 0..cells.map_or(1, |cells| cells.count) {
        let in_group = |point: &&MarginPoint| match (second, cells) {
            (Some(axis), Some(cells)) => point.parameter(axis).and_then(|value| cells.index_of(value)) == Some(group),
            _ => true,
        };
        let mut points: Vec<(f64, &MarginPoint)> = margin
            .points
            .iter()
            .filter(in_group)
            .filter_map(|point| Some((point.parameter(across)?.number()?, point)))
            .collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let class = CLASSES[group % LINES];
        for (place, point) in &points {
            let [good, bad] = point.bracket;
            let place = frame.x(&x, *place);
            if let (Some(good), Some(bad)) = (good, bad) {
                let (from, to) = (frame.y(&y, good), frame.y(&y, bad));
                let _ = write!(
                    svg,
                    "<path class=\"line {class}\" d=\"M{:.1} {from:.1}h6m-3 0V{to:.1}m-3 0h6\"/>",
                    place - 3.0
                );
            } else if let Some(end) = good.or(bad) {
                let at = frame.y(&y, end);
                let up = (margin.find == Find::Largest) == good.is_some();
                let tip = if up { at - 9.0 } else { at + 9.0 };
                let _ = write!(
                    svg,
                    "<path class=\"arrow {class}\" d=\"M{:.1} {at:.1}h10L{place:.1} {tip:.1}z\"/>",
                    place - 5.0
                );
                open += 1;
            }
        }
        let name = match (second, cells) {
            (Some(axis), Some(cells)) => format!("{} = {}", facts.spreads[axis].name, cells.name(group)),
            _ => "margin".to_owned(),
        };
        // Several margins at one place, from several seeds, are drawn as points without a line.
        let distinct = points.windows(2).all(|pair| pair[0].0 < pair[1].0);
        let places = points.iter().filter_map(|(place, point)| Some((*place, point.value?)));
        let parts = if distinct { vec![places.collect()] } else { places.map(|place| vec![place]).collect() };
        lines.push(Line { class, label: name, parts, dot: false });
    }
    lines.iter().for_each(|line| frame.line(line, &x, &y, &mut svg));
    svg.push_str("</svg>");
    let mut caption = "The margin with its bracket: the condition holds at one end and fails at the other.".to_owned();
    if open > 0 {
        let _ = write!(caption, " A triangle marks a margin beyond the searched range ({open} points).");
    }
    if axes.len() > 2 {
        caption += " The lines contain the points of all values of the other axes.";
    }
    let legend = lines.iter().map(|line| (line.class, line.label.clone())).collect();
    Some((Picture { svg, narrow: None, title, legend }, caption))
}
