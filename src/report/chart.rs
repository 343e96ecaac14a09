//! Charts as SVG: lines over axes, paths in a plane, strips of colour. Elements have classes; the page's style has the colours.
//!
//! Own code instead of a plotting library: the style alone adapts a chart to light or dark mode and to print, and every
//! value has passed through [`Columns`].

use super::axis::Axis;
use super::columns::{Column, Columns, Extremes};
use super::frame::{BOTTOM, Frame, HEIGHT, LEFT, Line, RIGHT, TOP, WIDE, WIDTH};
use super::html::escape;
use std::fmt::Write;

/// The height of a page-wide chart over time, of a row of labels above it, and the width of a letter in it.
/// Charts over time have one of two sizes, so that all charts of a size share one drawing of the marks.
const WIDE_HEIGHT: f64 = 400.0;
const ROW: f64 = 12.0;
const LETTER: f64 = 5.6;
/// The side of a plot of a plane.
const SQUARE: f64 = 420.0;
/// The largest number of changes of inputs that are marked by lines; the height of the ticks that mark more.
pub const CHANGE_LINES: usize = 40;
const CHANGE_TICK: f64 = 9.0;
/// The number of shades of a strip, from 0, the lightest.
pub const SHADES: usize = 8;

/// A chart with its legend.
#[derive(Debug, Clone)]
pub struct Picture {
    /// The SVG.
    pub svg: String,
    /// The SVG for narrow screens, if the chart is page-wide.
    pub narrow: Option<String>,
    /// The title.
    pub title: String,
    /// The class and label of every line.
    pub legend: Vec<(&'static str, String)>,
}

impl Picture {
    /// Returns the SVG with the legend below the chart. On a page the legend is in the caption.
    pub fn alone(&self) -> String {
        const KEY: f64 = 34.0;
        const LEGEND_LETTER: f64 = 6.9;
        const LEGEND_ROW: f64 = 18.0;
        let size = self.svg.split('"').nth(1).unwrap_or_default();
        let numbers: Vec<f64> = size.split(' ').filter_map(|number| number.parse().ok()).collect();
        let [_, _, width, height] = numbers[..] else { return self.svg.clone() };
        let (mut x, mut y, mut keys) = (LEFT, height + LEGEND_ROW / 2.0, String::new());
        for (class, label) in &self.legend {
            let advance = KEY + 24.0 + LEGEND_LETTER * label.chars().count() as f64;
            if x > LEFT && x + advance > width {
                (x, y) = (LEFT, y + LEGEND_ROW);
            }
            let (end, text_x, text_y, label) = (x + KEY, x + KEY + 6.0, y + 4.0, escape(label));
            let _ = write!(keys, "<path class=\"line {class}\" d=\"M{x:.1} {y}H{end:.1}\"/>");
            let _ = write!(keys, "<text x=\"{text_x:.1}\" y=\"{text_y}\">{label}</text>");
            x += advance;
        }
        let whole = if keys.is_empty() { height } else { y + LEGEND_ROW };
        let inside = self.svg.strip_suffix("</svg>").unwrap_or(&self.svg);
        format!("{}{keys}</svg>", inside.replacen(size, &format!("0 0 {width} {whole}"), 1))
    }

    /// Returns true if the chart is as wide as the page.
    pub fn is_wide(&self) -> bool {
        self.svg.starts_with(&format!("<svg viewBox=\"0 0 {WIDE} "))
    }
}

/// The marks on every time axis; times in s.
#[derive(Debug, Clone, Default)]
pub struct Marks {
    /// The start, end, number and description of every injected fault.
    pub faults: Vec<(f64, f64, usize, String)>,
    /// The time and description of every incident.
    pub incidents: Vec<(f64, String)>,
    /// The intervals in which samples are missing.
    pub missing: Vec<(f64, f64)>,
    /// The intervals in which the estimate is degraded or unobservable.
    pub unseen: Vec<(f64, f64)>,
    /// The times at which inputs change, with their descriptions.
    pub changes: Vec<(f64, String)>,
}

/// Returns the smallest and largest value of all columns; of positive values only if `positive`.
pub fn range<'a>(all: impl IntoIterator<Item = &'a Columns<Extremes>>, positive: bool) -> (f64, f64) {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for extremes in all.into_iter().flat_map(|columns| columns.iter().map(|(_, extremes)| extremes)) {
        let least = if positive && extremes.min <= 0.0 { extremes.max } else { extremes.min };
        if !extremes.is_empty() && (!positive || least > 0.0) {
            (low, high) = (low.min(least), high.max(extremes.max));
        }
    }
    (low, high)
}

/// The size of a chart over time.
#[derive(Debug, Clone, Copy)]
pub enum Size {
    /// Half as wide as the page.
    Half,
    /// As wide as the page, with the given number of rows of labels above the plot.
    Whole(usize),
}

impl Size {
    fn frame(self) -> Frame {
        match self {
            Self::Half => Frame::TIME,
            Self::Whole(rows) => {
                let top = TOP + rows as f64 * ROW;
                Frame::sized(WIDE, WIDE_HEIGHT + top, top)
            }
        }
    }

    fn name(self) -> &'static str {
        if matches!(self, Self::Half) { "half" } else { "whole" }
    }
}

/// Returns the class and label of every line with a label.
pub fn legend(lines: &[Line]) -> Vec<(&'static str, String)> {
    lines.iter().filter(|line| !line.label.is_empty()).map(|line| (line.class, line.label.clone())).collect()
}

/// Draws lines over time, with the marks.
pub fn over_time(title: &str, x: &Axis, y: &Axis, lines: &[Line]) -> Picture {
    over_time_in(Size::Half, title, x, y, lines)
}

/// Draws lines over time in a given size, with the marks.
pub fn over_time_in(size: Size, title: &str, x: &Axis, y: &Axis, lines: &[Line]) -> Picture {
    let (frame, name) = (size.frame(), size.name());
    let mut svg = frame.open_over_time(title, x);
    frame.axes(x, y, &mut svg);
    frame.window(
        y,
        |svg| {
            let _ = write!(svg, "<use href=\"#marks-{name}\"/>");
            lines.iter().for_each(|line| frame.line(line, x, y, svg));
        },
        &mut svg,
    );
    let _ = write!(svg, "<use class=\"names\" href=\"#names-{name}\"/></svg>");
    let narrow = matches!(size, Size::Whole(_)).then(|| over_time(title, x, y, lines).svg);
    Picture { svg, narrow, legend: legend(lines), title: title.to_owned() }
}

/// Draws lines over any axis, without marks.
pub fn plain(title: &str, x: &Axis, y: &Axis, lines: &[Line]) -> Picture {
    draw(&Frame::TIME, title, x, y, lines, &[])
}

/// Draws lines over the logarithm of time, as wide as the page, with the changes of inputs as the only marks.
pub fn over_log_time(title: &str, x: &Axis, y: &Axis, lines: &[Line], changes: &[(f64, String)]) -> Picture {
    // The rows of labels belong to the linear time axis only.
    let [wide, half] = [Size::Whole(0), Size::Half].map(|size| draw(&size.frame(), title, x, y, lines, changes));
    Picture { narrow: Some(half.svg), ..wide }
}

fn draw(frame: &Frame, title: &str, x: &Axis, y: &Axis, lines: &[Line], changes: &[(f64, String)]) -> Picture {
    let mut svg = frame.open(title);
    frame.axes(x, y, &mut svg);
    draw_changes(frame, x, changes, &mut svg);
    lines.iter().for_each(|line| frame.line(line, x, y, &mut svg));
    svg.push_str("</svg>");
    Picture { svg, narrow: None, legend: legend(lines), title: title.to_owned() }
}

/// Draws paths in a plane, with the same scale on both axes.
pub fn plane(title: &str, names: [&str; 2], lines: &[Line], centre: bool) -> Picture {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let centre_point = centre.then_some((0.0, 0.0));
    for (x, y) in lines.iter().flat_map(|line| line.parts.iter().flatten()).copied().chain(centre_point) {
        for (axis, value) in [x, y].into_iter().enumerate() {
            (low[axis], high[axis]) = (low[axis].min(value), high[axis].max(value));
        }
    }
    // The plot itself is square.
    let half = 0.525 * (high[0] - low[0]).max(high[1] - low[1]);
    let axis = |i: usize| {
        let middle = (low[i] + high[i]) / 2.0;
        Axis::linear(names[i], middle - half, middle + half)
    };
    let frame = Frame::sized(SQUARE + LEFT + RIGHT, SQUARE + TOP + BOTTOM, TOP);
    let (x, y) = (axis(0), axis(1));
    let mut picture = draw(&frame, title, &x, &y, lines, &[]);
    if centre {
        let (at_x, at_y) = (frame.x(&x, 0.0), frame.y(&y, 0.0));
        let cross =
            format!("<path class=\"line k\" d=\"M{:.1} {at_y:.1}h12M{at_x:.1} {:.1}v12\"/>", at_x - 6.0, at_y - 6.0);
        picture.svg.insert_str(picture.svg.len() - "</svg>".len(), &cross);
    }
    picture
}

/// Draws the marks of all charts over time once per size, and returns the page-wide size with the rows that the labels need.
pub fn marks(x: &Axis, marks: &Marks) -> (String, Size) {
    let (rows, names) = names(x, marks);
    let whole = Size::Whole(rows);
    let mut svg = String::from("<svg class=\"defs\" width=\"0\" height=\"0\"><defs>");
    marks_in(Size::Half, x, marks, &mut svg);
    numbers(x, marks, &mut svg);
    marks_in(whole, x, marks, &mut svg);
    let _ = write!(svg, "<g id=\"names-whole\">{names}</g></defs></svg>");
    (svg, whole)
}

fn marks_in(size: Size, x: &Axis, marks: &Marks, svg: &mut String) {
    let (frame, name) = (size.frame(), size.name());
    let (top, foot, height) = (frame.top, frame.foot(), frame.plot_height());
    let _ = write!(svg, "<g id=\"marks-{name}\">");
    let faults = marks.faults.iter().map(|(from, to, ..)| ("fault", from, to));
    let bands = marks.unseen.iter().map(|(from, to)| ("unseen", from, to)).chain(faults);
    for (class, from, to) in bands {
        let (from, to) = (frame.x(x, *from), frame.x(x, *to));
        let width = (to - from).max(1.5);
        let _ = write!(
            svg,
            "<rect class=\"{class}\" x=\"{from:.1}\" y=\"{top}\" width=\"{width:.1}\" height=\"{height}\"/>"
        );
    }
    draw_changes(&frame, x, &marks.changes, svg);
    for (time, _) in &marks.incidents {
        let at = frame.x(x, *time);
        let _ = write!(svg, "<path class=\"incident\" d=\"M{at:.1} {top}V{foot}\"/>");
    }
    let mut rug = String::new();
    for (from, to) in &marks.missing {
        let (from, to) = (frame.x(x, *from), frame.x(x, *to));
        let _ = write!(rug, "M{from:.1} {:.1}h{:.1}", foot - 3.0, (to - from).max(1.0));
    }
    let _ = write!(svg, "<path class=\"missing\" d=\"{rug}\"/></g>");
}

/// Marks the changes of inputs: a line for each, or ticks at the axis if there are many.
fn draw_changes(frame: &Frame, x: &Axis, changes: &[(f64, String)], svg: &mut String) {
    let (top, foot) = (frame.top, frame.foot());
    let at = |(time, _): &(f64, String)| format!("{:.1}", frame.x(x, *time));
    if changes.len() > CHANGE_LINES {
        let mut places: Vec<String> = changes.iter().map(at).collect();
        places.dedup();
        let ticks: String = places.iter().map(|at| format!("M{at} {foot}v-{CHANGE_TICK}")).collect();
        let _ = write!(svg, "<path class=\"changes\" d=\"{ticks}\"/>");
        return;
    }
    for change in changes {
        let (at, about) = (at(change), escape(&change.1));
        let _ = write!(svg, "<path class=\"change\" d=\"M{at} {top}V{foot}\"><title>{about}</title></path>");
    }
}

/// Draws the numbers of faults above a small chart, as far as they fit, and a flag for every incident.
fn numbers(x: &Axis, marks: &Marks, svg: &mut String) {
    let frame = Frame::TIME;
    svg.push_str("<g id=\"names-half\">");
    let mut labelled = f64::NEG_INFINITY;
    for (from, to, number, _) in &marks.faults {
        let (from, to) = (frame.x(x, *from), frame.x(x, *to));
        if from > labelled + 15.0 {
            let (at, above) = ((from + to) / 2.0, TOP - 5.0);
            let _ = write!(
                svg,
                "<text class=\"number\" x=\"{at:.1}\" y=\"{above}\" text-anchor=\"middle\">{number}</text>"
            );
            labelled = from;
        }
    }
    for (time, _) in &marks.incidents {
        let _ = write!(svg, "<path class=\"flag\" d=\"M{:.1} {TOP}l-5 -9h10z\"/>", frame.x(x, *time));
    }
    svg.push_str("</g>");
}

/// Draws a label for every fault and incident above a large chart, each in the lowest free row; returns the number of rows.
fn names(x: &Axis, marks: &Marks) -> (usize, String) {
    let frame = Frame::sized(WIDE, WIDE_HEIGHT, TOP);
    let faults = marks.faults.iter().map(|(from, _, number, what)| (*from, "number", format!("{number} {what}")));
    let incidents = marks.incidents.iter().map(|(time, what)| (*time, "number bad", format!("▾ {what}")));
    let mut all: Vec<(f64, &str, String)> = faults.chain(incidents).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut ends: Vec<f64> = Vec::new();
    let placed: Vec<(f64, usize)> = all
        .iter()
        .map(|(time, _, text)| {
            let length = text.chars().count() as f64 * LETTER;
            let at = frame.x(x, *time).min(WIDE - length);
            let row = ends.iter().position(|end| *end < at).unwrap_or(ends.len());
            ends.resize(ends.len().max(row + 1), 0.0);
            ends[row] = at + length;
            (at, row)
        })
        .collect();
    let (rows, mut svg) = (ends.len(), String::new());
    let foot = TOP + rows as f64 * ROW - 5.0;
    for ((_, class, text), (at, row)) in all.iter().zip(placed) {
        let (above, text) = (foot - row as f64 * ROW, escape(text));
        let _ = write!(svg, "<text class=\"{class}\" x=\"{at:.1}\" y=\"{above}\">{text}</text>");
    }
    (rows, svg)
}

/// Draws rows of shades over time; `shade` returns 0 to 1 for a column, `None` for a column without values.
pub fn strip<C: Column>(
    title: &str,
    x: &Axis,
    rows: &[(String, &Columns<C>)],
    tick_s: f64,
    shade: impl Fn(&C) -> Option<f64>,
) -> Picture {
    let frame = Frame::TIME;
    let mut svg = frame.open(title);
    let mut shades = vec![String::new(); SHADES];
    let height = (frame.foot() - TOP) / rows.len().max(1) as f64;
    let thick = 0.86 * height;
    for (row, (name, columns)) in rows.iter().enumerate() {
        let middle = TOP + (row as f64 + 0.5) * height;
        let (beside, below, name) = (LEFT - 6.0, middle + 4.0, escape(name));
        let _ = write!(svg, "<text class=\"row\" x=\"{beside}\" y=\"{below:.1}\" text-anchor=\"end\">{name}</text>");
        for (tick, column) in columns.iter() {
            let Some(part) = shade(column) else { continue };
            let (from, to) = (tick as f64 * tick_s, (tick + columns.stride()) as f64 * tick_s);
            let (from, to) = (frame.x(x, from), frame.x(x, to));
            let index = ((part * SHADES as f64) as usize).min(SHADES - 1);
            let top = middle - thick / 2.0;
            let _ = write!(shades[index], "M{from:.1} {top:.1}h{:.1}v{thick:.1}H{from:.1}z", (to - from).max(0.6));
        }
    }
    for (index, path) in shades.iter().enumerate().filter(|(_, path)| !path.is_empty()) {
        let _ = write!(svg, "<path class=\"shade{index}\" d=\"{path}\"/>");
    }
    frame.time_axis(x, &mut svg);
    let (middle, below, label) = ((LEFT + WIDTH - RIGHT) / 2.0, HEIGHT - 8.0, escape(&x.label));
    let _ = write!(svg, "<text class=\"name\" x=\"{middle}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
    frame.frame(&mut svg);
    svg.push_str("<use href=\"#marks-half\"/><use href=\"#names-half\"/></svg>");
    Picture { svg, narrow: None, legend: Vec::new(), title: title.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn charts_are_well_formed_for_any_label() {
        let mut columns = Columns::<Extremes>::default();
        [1.0, -2.0, f64::NAN, 3.0].iter().enumerate().for_each(|(tick, value)| columns.at(tick as u64).take(*value));
        let line = Line::over_time("k", "<&\">", &columns, 1e-3);
        assert_eq!(line.parts.iter().map(Vec::len).collect::<Vec<_>>(), [4, 2], "the gap divides the line");
        let (x, y) = (Axis::linear("t <s>", 0.0, 1.0), Axis::around("\"&\"", range([&columns], false)));
        for picture in [over_time("a<b", &x, &y, std::slice::from_ref(&line)), plane("p", ["<", ">"], &[line], true)] {
            let document = roxmltree::Document::parse(&picture.svg).unwrap();
            assert!(document.descendants().any(|node| node.has_tag_name("path")));
            assert!(!picture.svg.contains("NaN") && !picture.svg.contains("inf"), "{}", picture.svg);
        }
    }

    #[test]
    fn changes_are_lines_or_ticks_and_take_little_room() {
        let x = Axis::time(10.0);
        let drawn = |count: u32| {
            let change = |n: u32| (10.0 * f64::from(n) / f64::from(count), "<a>&".to_owned());
            let (svg, _) = marks(&x, &Marks { changes: (0..count).map(change).collect(), ..Marks::default() });
            roxmltree::Document::parse(&svg).unwrap();
            let of_class = |class: &str| svg.matches(&format!("class=\"{class}\"")).count();
            (of_class("change"), of_class("changes"), svg.matches("<title>").count(), svg.len())
        };
        let most = CHANGE_LINES;
        assert_eq!((drawn(most as u32).0, drawn(most as u32).2), (2 * most, 2 * most), "in charts of two sizes");
        let (lines, ticks, titles, length) = drawn(4096);
        assert!((lines, ticks, titles) == (0, 2, 0) && length < 200_000, "{length}");
    }

    #[test]
    fn the_range_of_positive_values_excludes_zero() {
        let mut columns = Columns::<Extremes>::default();
        [0.0, 1e-9, 2.0].iter().enumerate().for_each(|(tick, value)| columns.at(tick as u64).take(*value));
        assert_eq!(range([&columns], true), (1e-9, 2.0));
        assert_eq!(range([&columns], false), (0.0, 2.0));
    }
}
