//! Charts along one axis: quantile bands of the decisive metric, and the percentage of accepted cases. Also the distribution
//! of a number over all cases.
//!
//! A quantile is the value of a case, without interpolation. A line joins the values of a list or range; it is level over a
//! cell of drawn values. Must not draw a line where there are no cases.

use super::facts::{Facts, claimed_share, share};
use super::scatter;
use super::shades::{by_factors, range};
use super::spread::Cells;
use crate::campaign::Row;
use crate::report::axis::Axis;
use crate::report::chart::Picture;
use crate::report::frame::{Frame, LEFT, Line, RIGHT, TOP, WIDE, WIDTH};
use crate::report::html::escape;
use crate::telemetry::quantile;
use std::fmt::Write;

/// The largest number of cells of an axis; of an axis of drawn values, and the number of cases per cell there.
const CELLS: usize = 64;
const DRAWN: usize = 24;
const EACH: usize = 25;
/// The largest number of cases that are drawn as points over the bands.
const POINTS: usize = 300;
/// The largest number of points of a curve.
const CURVE: usize = 1000;
/// The height of a chart, and of a page-wide chart.
const TALL: f64 = 300.0;
const WIDE_TALL: f64 = 420.0;
/// The height of the heading and the key of the points above a chart.
const ABOVE: f64 = 30.0;
const QUANTILES: [f64; 5] = [0.05, 0.25, 0.5, 0.75, 0.95];

/// A cell of an axis, with its ends and its cases.
struct Stretch<'r> {
    from: f64,
    to: f64,
    rows: Vec<&'r Row>,
}

/// Distributes the cases over the cells of a numeric axis.
fn stretches<'r>(facts: &Facts<'r>, axis: usize) -> Vec<Stretch<'r>> {
    let (spread, rows) = (&facts.spreads[axis], &facts.table.rows);
    let most = if spread.is_known() { CELLS } else { (rows.len() / EACH).clamp(4, DRAWN) };
    let cells: Cells<'_> = spread.cells(most);
    let ends = (0..cells.count).filter_map(|cell| cells.ends(cell));
    let mut stretches: Vec<Stretch<'_>> = ends.map(|(from, to)| Stretch { from, to, rows: Vec::new() }).collect();
    for row in rows {
        let cell = row.parameters.get(axis).and_then(|value| cells.index_of(value));
        cell.and_then(|cell| stretches.get_mut(cell)).into_iter().for_each(|stretch| stretch.rows.push(row));
    }
    stretches
}

/// Returns the line of a statistic of each cell: level over a cell of drawn values, with a gap where it is unknown.
fn line(stretches: &[Stretch<'_>], statistic: impl Fn(&[&Row]) -> Option<f64>) -> Vec<Vec<(f64, f64)>> {
    let (mut parts, mut part) = (Vec::new(), Vec::new());
    for stretch in stretches {
        match statistic(&stretch.rows) {
            Some(value) if stretch.from < stretch.to => part.extend([(stretch.from, value), (stretch.to, value)]),
            Some(value) => part.push((stretch.from, value)),
            None => parts.extend((!part.is_empty()).then(|| std::mem::take(&mut part))),
        }
    }
    parts.extend((!part.is_empty()).then_some(part));
    parts
}

/// Returns the axis of the metric over all cases; logarithmic if the values span large factors.
fn value_axis(label: &str, values: &[f64], limit: Option<f64>) -> Option<Axis> {
    let all = || values.iter().copied().chain(limit);
    let (low, high) = range(all(), false)?;
    Some(match range(all(), true).filter(|_| low >= 0.0) {
        Some((low, high)) if by_factors(low, high) => Axis::decades(&format!("{label}, logarithmic"), (low, high)),
        _ => Axis::around(label, (low, high)),
    })
}

/// Draws the metric and the percentage of accepted cases along an axis; page-wide if there is only one axis.
pub fn along(facts: &Facts<'_>, axis: usize, alone: bool) -> Vec<(Picture, String)> {
    let (name, stretches) = (&facts.spreads[axis].name, stretches(facts, axis));
    let x = facts.spreads[axis].number_axis();
    let (width, height) = if alone { (WIDE, WIDE_TALL) } else { (WIDTH, TALL) };
    let frame = Frame { width, height, top: TOP + ABOVE, left: LEFT, right: RIGHT };
    let mut figures = Vec::new();
    let all = facts.sorted(&facts.table.rows);
    let (words, unit) = facts.metric_parts();
    if let Some(y) = value_axis(&unit, &all, facts.limit) {
        let title = format!("{words} along {name}");
        let quantiles = |part: f64| line(&stretches, |rows| quantile(&facts.sorted(rows.iter().copied()), part));
        let [low, first, median, third, high] = QUANTILES.map(quantiles);
        let mut svg = frame.open(&title);
        frame.axes(&x, &y, &mut svg);
        heading(&words, &frame, &mut svg);
        for (class, (below, above)) in [("outer", (low, high)), ("inner", (first, third))] {
            let _ = write!(svg, "<path class=\"band {class}\" d=\"{}\"/>", band(&frame, &x, &y, &below, &above));
        }
        let mut lines = vec![Line { class: "b d0 wide", label: "median".to_owned(), parts: median, dot: false }];
        lines.extend(facts.limit.map(|limit| Line::through("limit o d1", "limit", ends(&x, limit))));
        let few = facts.table.rows.len() <= POINTS && facts.spreads[axis].varies();
        if few {
            scatter::key(&facts.table.rows, frame.left, TOP + ABOVE - 10.0, &mut svg);
            for row in &facts.table.rows {
                let at = row.parameters.get(axis).and_then(|value| value.number()).zip(facts.value(row));
                if let Some((from, value)) = at {
                    scatter::point(facts, row, frame.x(&x, from), frame.y(&y, value), "faint", &mut svg);
                }
            }
        }
        lines.iter().for_each(|line| frame.line(line, &x, &y, &mut svg));
        svg.push_str("</svg>");
        let legend = lines.iter().map(|line| (line.class, line.label.clone()));
        let bands =
            [("band-inner", "25 to 75 %"), ("band-outer", "5 to 95 %")].map(|(class, text)| (class, text.to_owned()));
        let mut caption = format!("{} cases with a value", all.len());
        caption += if alone { "" } else { ", over all values of the other axes" };
        caption += if few { "; a point is a case." } else { "." };
        if y.is_logarithmic() && all.first() == Some(&0.0) {
            caption += " Zeros are drawn at the bottom.";
        }
        if all.last().is_some_and(|value| value.is_infinite()) {
            caption += " The value of a case that lost a body is infinite: its band reaches the upper edge.";
        }
        figures.push((Picture { svg, narrow: None, title, legend: legend.chain(bands).collect() }, caption));
    }
    figures.extend(shares(facts, name, &stretches, &x, &frame));
    figures
}

/// Writes the heading above a chart.
fn heading(words: &str, frame: &Frame, svg: &mut String) {
    let _ = write!(svg, "<text x=\"{}\" y=\"{TOP}\">{}</text>", frame.left, escape(words));
}

/// Returns a level line over the whole axis.
fn ends(x: &Axis, value: f64) -> Vec<(f64, f64)> {
    let [low, high] = x.ends().map(|end| if x.is_logarithmic() { 10_f64.powf(end) } else { end });
    vec![(low, value), (high, value)]
}

/// Returns the path of the areas between two lines with the same parts.
fn band(frame: &Frame, x: &Axis, y: &Axis, below: &[Vec<(f64, f64)>], above: &[Vec<(f64, f64)>]) -> String {
    let mut path = String::new();
    for (below, above) in below.iter().zip(above) {
        for (place, point) in below.iter().chain(above.iter().rev()).enumerate() {
            let letter = if place == 0 { 'M' } else { 'L' };
            let _ = write!(path, "{letter}{:.1} {:.1}", frame.x(x, point.0), frame.y(y, point.1));
        }
        path.push('z');
    }
    path
}

/// Draws the percentage of accepted cases and of cases with a claimed rate along an axis; `None` if both are constant.
fn shares(
    facts: &Facts<'_>,
    name: &str,
    stretches: &[Stretch<'_>],
    x: &Axis,
    frame: &Frame,
) -> Option<(Picture, String)> {
    let all = share(&facts.table.rows).unwrap_or_default();
    if !facts.predicted && (all == 0.0 || all == 1.0) {
        return None;
    }
    let percent = |share: f64| 100.0 * share;
    let accepted = line(stretches, |rows| share(rows.iter().copied()).map(percent));
    let claimed = line(stretches, |rows| claimed_share(rows.iter().copied()).map(percent));
    let mut lines = Vec::new();
    if !accepted.is_empty() {
        lines.push(Line { class: "k d0 wide", label: "accepted".to_owned(), parts: accepted, dot: false });
    }
    if facts.predicted && !claimed.is_empty() {
        lines.push(Line { class: "b d4 wide", label: "a rate is claimed".to_owned(), parts: claimed, dot: false });
    }
    if lines.is_empty() {
        return None;
    }
    let y = Axis::linear("%", -2.0, 102.0);
    let title = format!("accepted cases along {name}");
    let mut svg = frame.open(&title);
    frame.axes(x, &y, &mut svg);
    heading("percentage of accepted cases", frame, &mut svg);
    let _ = write!(
        svg,
        "<path class=\"line grey d1\" d=\"M{} {:.1}h{}\"/>",
        frame.left,
        frame.y(&y, 50.0),
        frame.plot_width()
    );
    lines.iter().for_each(|line| frame.line(line, x, &y, &mut svg));
    svg.push_str("</svg>");
    let legend = lines.iter().map(|line| (line.class, line.label.clone())).collect();
    let caption = "Percentage of the judged cases that were accepted. The dashed line marks 50 %.";
    Some((Picture { svg, narrow: None, title, legend }, caption.to_owned()))
}

/// Draws the cumulative distribution of sorted values, as a percentage of `cases`.
pub fn distribution(title: &str, label: &str, sorted: &[f64], cases: usize, limit: Option<f64>) -> Option<Picture> {
    let x = value_axis(label, sorted, limit)?;
    let y = Axis::linear("cases, %", 0.0, 100.0);
    let frame = Frame { width: WIDTH, height: TALL, top: TOP, left: LEFT, right: RIGHT };
    let finite: Vec<f64> = sorted.iter().copied().filter(|value| value.is_finite()).collect();
    let part = |rank: usize| 100.0 * rank as f64 / cases.max(1) as f64;
    let stride = finite.len().div_ceil(CURVE).max(1);
    let ranks = (0..finite.len()).filter(|rank| rank % stride == 0 || rank + 1 == finite.len());
    let mut points = Vec::new();
    for rank in ranks {
        let before = points.last().map_or(0.0, |last: &(f64, f64)| last.1);
        points.extend([(finite[rank], before), (finite[rank], part(rank + 1))]);
    }
    let last = points.last().map_or(0.0, |last| last.1);
    points.extend(ends(&x, last).last());
    let mut lines = vec![Line::through("b d0 wide", "cases", points)];
    lines.extend(limit.map(|limit| Line::through("limit o d1", "limit", vec![(limit, 0.0), (limit, 100.0)])));
    let mut svg = frame.open(title);
    frame.axes(&x, &y, &mut svg);
    lines.iter().for_each(|line| frame.line(line, &x, &y, &mut svg));
    svg.push_str("</svg>");
    let legend = lines.iter().map(|line| (line.class, line.label.clone())).collect();
    Some(Picture { svg, narrow: None, title: title.to_owned(), legend })
}
