//! Pictures as SVG: lines over axes, paths in a plane, strips of colour. Drawn with classes; the page's style has the colours.
//!
//! Own code instead of a plotting library: a picture follows the reader's light or dark and the printer's paper by style
//! alone, and every value that reaches it has gone through [`Columns`].

use super::axis::Axis;
use super::columns::{Column, Columns, Corners, Extremes};
use super::html::escape;
use std::fmt::Write;

/// All pictures over time have this size and these margins, so that one drawing of the marks serves all.
const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 250.0;
const LEFT: f64 = 64.0;
const RIGHT: f64 = 22.0;
const TOP: f64 = 18.0;
const BOTTOM: f64 = 42.0;
/// Side of a picture of a plane.
const SQUARE: f64 = 420.0;
/// The darkest shade of a strip; 0 is the lightest.
pub const SHADES: usize = 8;

/// A line of a picture.
#[derive(Debug, Clone)]
pub struct Line {
    /// Its classes: a colour and a dash pattern, see the page's style.
    pub class: &'static str,
    /// What it is, for the legend.
    pub label: String,
    /// Its parts, in the units of the axes.
    pub parts: Vec<Vec<(f64, f64)>>,
    /// Where it begins is marked by a dot.
    pub dot: bool,
}

/// A picture with what its legend says.
#[derive(Debug, Clone)]
pub struct Picture {
    /// The SVG.
    pub svg: String,
    /// Class and label of every line.
    pub legend: Vec<(&'static str, String)>,
}

/// What is marked on every time axis, by time in s.
#[derive(Debug, Clone, Default)]
pub struct Marks {
    /// From when to when a scripted fault may act, and its number.
    pub faults: Vec<(f64, f64, usize)>,
    /// When a role failed.
    pub incidents: Vec<f64>,
    /// From when to when samples are missing.
    pub missing: Vec<(f64, f64)>,
    /// From when to when an estimate lacked something.
    pub unseen: Vec<(f64, f64)>,
}

impl Line {
    /// A signal's extremes over time: within a column it goes from one to the other.
    pub fn of(class: &'static str, label: &str, columns: &Columns<Extremes>, tick_s: f64) -> Self {
        let (mut parts, mut part, mut before) = (Vec::new(), Vec::new(), f64::NAN);
        for (tick, extremes) in columns.iter() {
            if extremes.is_empty() {
                parts.extend((!part.is_empty()).then(|| std::mem::take(&mut part)));
                continue;
            }
            let time = (tick as f64 + 0.5 * (columns.stride() - 1) as f64) * tick_s;
            let mut ends = [extremes.min, extremes.max];
            // The nearer end first, so that a line is no thicker than the signal.
            if (before - extremes.max).abs() < (before - extremes.min).abs() {
                ends.reverse();
            }
            part.extend(ends.map(|value| (time, value)));
            before = ends[1];
        }
        parts.extend((!part.is_empty()).then_some(part));
        Self { class, label: label.to_owned(), parts, dot: false }
    }

    /// A path in a plane.
    pub fn path(class: &'static str, label: &str, columns: &Columns<Corners>) -> Self {
        let points = columns.iter().flat_map(|(_, corners)| corners.points()).collect();
        Self { class, label: label.to_owned(), parts: vec![points], dot: true }
    }

    /// A line through some points.
    pub fn through(class: &'static str, label: &str, points: Vec<(f64, f64)>) -> Self {
        Self { class, label: label.to_owned(), parts: vec![points], dot: false }
    }
}

/// Least and greatest of all values of some columns; only positive ones if `positive`.
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

/// Where a picture's axes lie.
struct Frame {
    width: f64,
    height: f64,
}

impl Frame {
    const TIME: Self = Self { width: WIDTH, height: HEIGHT };

    fn x(&self, axis: &Axis, value: f64) -> f64 {
        LEFT + axis.place(value) * (self.width - LEFT - RIGHT)
    }

    fn y(&self, axis: &Axis, value: f64) -> f64 {
        self.foot() - axis.place(value) * (self.foot() - TOP)
    }

    fn foot(&self) -> f64 {
        self.height - BOTTOM
    }

    fn open(&self, title: &str) -> String {
        let (w, h, title) = (self.width, self.height, escape(title));
        format!("<svg viewBox=\"0 0 {w} {h}\" role=\"img\" aria-label=\"{title}\">")
    }

    /// Grid, labels and frame.
    fn axes(&self, x: &Axis, y: &Axis, svg: &mut String) {
        let (right, foot) = (self.width - RIGHT, self.foot());
        for (value, label) in &x.ticks {
            let at = self.x(x, *value);
            let _ = write!(svg, "<path class=\"grid\" d=\"M{at:.1} {TOP}V{foot}\"/>");
            let (below, label) = (foot + 15.0, escape(label));
            let _ = write!(svg, "<text x=\"{at:.1}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
        }
        for (value, label) in &y.ticks {
            let at = self.y(y, *value);
            let _ = write!(svg, "<path class=\"grid\" d=\"M{LEFT} {at:.1}H{right}\"/>");
            let (beside, below, label) = (LEFT - 6.0, at + 4.0, escape(label));
            let _ = write!(svg, "<text x=\"{beside}\" y=\"{below:.1}\" text-anchor=\"end\">{label}</text>");
        }
        let (middle, below, label) = ((LEFT + right) / 2.0, self.height - 8.0, escape(&x.label));
        let _ = write!(svg, "<text class=\"name\" x=\"{middle}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
        self.name(&y.label, svg);
        self.frame(svg);
    }

    /// The name of the upright axis.
    fn name(&self, label: &str, svg: &mut String) {
        let (middle, label) = ((TOP + self.foot()) / 2.0, escape(label));
        let turn = format!("rotate(-90 14 {middle})");
        let _ = write!(
            svg,
            "<text class=\"name\" x=\"14\" y=\"{middle}\" text-anchor=\"middle\" transform=\"{turn}\">{label}</text>"
        );
    }

    fn frame(&self, svg: &mut String) {
        let (width, height) = (self.width - LEFT - RIGHT, self.foot() - TOP);
        let _ = write!(svg, "<rect class=\"frame\" x=\"{LEFT}\" y=\"{TOP}\" width=\"{width}\" height=\"{height}\"/>");
    }

    fn line(&self, line: &Line, x: &Axis, y: &Axis, svg: &mut String) {
        let mut path = String::new();
        for part in &line.parts {
            let (mut last, mut count) = (String::new(), 0);
            for point in part {
                let at = format!("{:.1} {:.1}", self.x(x, point.0), self.y(y, point.1));
                if at != last {
                    path.push(if count == 0 { 'M' } else { 'L' });
                    path.push_str(&at);
                    (last, count) = (at, count + 1);
                }
            }
            if count == 1 {
                // A single point is seen as a dot.
                path.push_str("h.1");
            }
        }
        let _ = write!(svg, "<path class=\"line {}\" d=\"{path}\"/>", line.class);
        if let (true, Some(first)) = (line.dot, line.parts.first().and_then(|part| part.first())) {
            let (at_x, at_y, class) = (self.x(x, first.0), self.y(y, first.1), line.class);
            let _ = write!(svg, "<circle class=\"dot {class}\" cx=\"{at_x:.1}\" cy=\"{at_y:.1}\" r=\"4\"/>");
        }
    }
}

fn legend(lines: &[Line]) -> Vec<(&'static str, String)> {
    lines.iter().filter(|line| !line.label.is_empty()).map(|line| (line.class, line.label.clone())).collect()
}

/// Lines over time, with the marks.
pub fn over_time(title: &str, x: &Axis, y: &Axis, lines: &[Line]) -> Picture {
    let mut picture = plain(title, x, y, lines);
    picture.svg.insert_str(picture.svg.len() - "</svg>".len(), "<use href=\"#marks\"/>");
    picture
}

/// Lines over any axis.
pub fn plain(title: &str, x: &Axis, y: &Axis, lines: &[Line]) -> Picture {
    draw(&Frame::TIME, title, x, y, lines)
}

fn draw(frame: &Frame, title: &str, x: &Axis, y: &Axis, lines: &[Line]) -> Picture {
    let mut svg = frame.open(title);
    frame.axes(x, y, &mut svg);
    lines.iter().for_each(|line| frame.line(line, x, y, &mut svg));
    svg.push_str("</svg>");
    Picture { svg, legend: legend(lines) }
}

/// Paths in a plane, both axes of one scale.
pub fn plane(title: &str, names: [&str; 2], lines: &[Line], centre: bool) -> Picture {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let centre_point = centre.then_some((0.0, 0.0));
    for (x, y) in lines.iter().flat_map(|line| line.parts.iter().flatten()).copied().chain(centre_point) {
        for (axis, value) in [x, y].into_iter().enumerate() {
            (low[axis], high[axis]) = (low[axis].min(value), high[axis].max(value));
        }
    }
    // A picture is wider than high by its margins alone.
    let half = 0.525 * (high[0] - low[0]).max(high[1] - low[1]);
    let axis = |i: usize| {
        let middle = (low[i] + high[i]) / 2.0;
        Axis::linear(names[i], middle - half, middle + half)
    };
    let frame = Frame { width: SQUARE + LEFT + RIGHT, height: SQUARE + TOP + BOTTOM };
    let (x, y) = (axis(0), axis(1));
    let mut picture = draw(&frame, title, &x, &y, lines);
    if centre {
        let (at_x, at_y) = (frame.x(&x, 0.0), frame.y(&y, 0.0));
        let cross =
            format!("<path class=\"line k\" d=\"M{:.1} {at_y:.1}h12M{at_x:.1} {:.1}v12\"/>", at_x - 6.0, at_y - 6.0);
        picture.svg.insert_str(picture.svg.len() - "</svg>".len(), &cross);
    }
    picture
}

/// The marks of all pictures over time, to be drawn once and used by each.
pub fn marks(x: &Axis, marks: &Marks) -> String {
    let frame = Frame::TIME;
    let (foot, mut svg) =
        (frame.foot(), String::from("<svg class=\"defs\" width=\"0\" height=\"0\"><defs><g id=\"marks\">"));
    for (from, to) in &marks.unseen {
        let (from, to) = (frame.x(x, *from), frame.x(x, *to));
        let (width, height) = ((to - from).max(1.5), foot - TOP);
        let _ = write!(
            svg,
            "<rect class=\"unseen\" x=\"{from:.1}\" y=\"{TOP}\" width=\"{width:.1}\" height=\"{height}\"/>"
        );
    }
    let mut labelled = f64::NEG_INFINITY;
    for (from, to, number) in &marks.faults {
        let (from, to) = (frame.x(x, *from), frame.x(x, *to));
        let (width, height) = ((to - from).max(1.5), foot - TOP);
        let _ =
            write!(svg, "<rect class=\"fault\" x=\"{from:.1}\" y=\"{TOP}\" width=\"{width:.1}\" height=\"{height}\"/>");
        if from > labelled + 15.0 {
            let (at, above) = (from + width / 2.0, TOP - 5.0);
            let _ = write!(
                svg,
                "<text class=\"number\" x=\"{at:.1}\" y=\"{above}\" text-anchor=\"middle\">{number}</text>"
            );
            labelled = from;
        }
    }
    for time in &marks.incidents {
        let at = frame.x(x, *time);
        let _ = write!(svg, "<path class=\"incident\" d=\"M{at:.1} {TOP}V{foot}\"/>");
        let _ = write!(svg, "<path class=\"flag\" d=\"M{at:.1} {TOP}l-5 -9h10z\"/>");
    }
    let mut rug = String::new();
    for (from, to) in &marks.missing {
        let (from, to) = (frame.x(x, *from), frame.x(x, *to));
        let _ = write!(rug, "M{from:.1} {:.1}h{:.1}", foot - 3.0, (to - from).max(1.0));
    }
    let _ = write!(svg, "<path class=\"missing\" d=\"{rug}\"/></g></defs></svg>");
    svg
}

/// Rows of shades over time; `shade` gives 0 to 1 for a column, none where there is nothing.
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
    for (value, label) in &x.ticks {
        let (at, below, label) = (frame.x(x, *value), frame.foot() + 15.0, escape(label));
        let _ = write!(svg, "<text x=\"{at:.1}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
    }
    let (middle, below, label) = ((LEFT + WIDTH - RIGHT) / 2.0, HEIGHT - 8.0, escape(&x.label));
    let _ = write!(svg, "<text class=\"name\" x=\"{middle}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
    frame.frame(&mut svg);
    svg.push_str("<use href=\"#marks\"/></svg>");
    Picture { svg, legend: Vec::new() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_well_formed_whatever_its_names_are() {
        let mut columns = Columns::<Extremes>::default();
        [1.0, -2.0, f64::NAN, 3.0].iter().enumerate().for_each(|(tick, value)| columns.at(tick as u64).take(*value));
        let line = Line::of("k", "<&\">", &columns, 1e-3);
        assert_eq!(line.parts.iter().map(Vec::len).collect::<Vec<_>>(), [4, 2], "the gap is one");
        let (x, y) = (Axis::linear("t <s>", 0.0, 1.0), Axis::around("\"&\"", range([&columns], false)));
        for picture in [over_time("a<b", &x, &y, std::slice::from_ref(&line)), plane("p", ["<", ">"], &[line], true)] {
            let document = roxmltree::Document::parse(&picture.svg).unwrap();
            assert!(document.descendants().any(|node| node.has_tag_name("path")));
            assert!(!picture.svg.contains("NaN") && !picture.svg.contains("inf"), "{}", picture.svg);
        }
    }

    #[test]
    fn the_range_of_positive_values_leaves_out_zero() {
        let mut columns = Columns::<Extremes>::default();
        [0.0, 1e-9, 2.0].iter().enumerate().for_each(|(tick, value)| columns.at(tick as u64).take(*value));
        assert_eq!(range([&columns], true), (1e-9, 2.0));
        assert_eq!(range([&columns], false), (0.0, 2.0));
    }
}
