//! The layout of a chart: the area of its plot, and the grid, labels and lines in it.
//!
//! Must not know the quantities of a chart.

use super::axis::Axis;
use super::columns::{Columns, Corners, Extremes};
use super::html::escape;
use std::fmt::Write;

/// The size of small charts, and the margins of all charts.
pub const WIDTH: f64 = 640.0;
pub const HEIGHT: f64 = 250.0;
pub const LEFT: f64 = 64.0;
pub const RIGHT: f64 = 22.0;
pub const TOP: f64 = 18.0;
pub const BOTTOM: f64 = 42.0;
/// The width of a page-wide chart.
pub const WIDE: f64 = 1200.0;

/// The size of a chart and the margins around its plot.
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    pub width: f64,
    pub height: f64,
    pub top: f64,
    pub left: f64,
    pub right: f64,
}

impl Frame {
    /// The frame of a small chart over time.
    pub const TIME: Self = Self::sized(WIDTH, HEIGHT, TOP);

    /// Returns a frame with the usual margins at its sides.
    pub const fn sized(width: f64, height: f64, top: f64) -> Self {
        Self { width, height, top, left: LEFT, right: RIGHT }
    }

    /// Returns the x coordinate of a value.
    pub fn x(&self, axis: &Axis, value: f64) -> f64 {
        self.left + axis.place(value) * self.plot_width()
    }

    /// Returns the y coordinate of a value.
    pub fn y(&self, axis: &Axis, value: f64) -> f64 {
        self.foot() - axis.place(value) * (self.foot() - self.top)
    }

    /// Returns the y coordinate of the lower edge of the plot.
    pub fn foot(&self) -> f64 {
        self.height - BOTTOM
    }

    /// Returns the opening tag of a chart.
    pub fn open(&self, title: &str) -> String {
        let (w, h, title) = (self.width, self.height, escape(title));
        format!("<svg viewBox=\"0 0 {w} {h}\" role=\"img\" aria-label=\"{title}\">")
    }

    /// Returns the opening tag of a chart that the page's script can zoom: it has the ends of the time axis.
    pub fn open_over_time(&self, title: &str, x: &Axis) -> String {
        let (Self { width, height, .. }, [x0, x1], title) = (self, x.ends(), escape(title));
        format!(
            "<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{title}\" class=\"time\" data-x=\"{x0} {x1}\">"
        )
    }

    /// The width between the margins.
    pub fn plot_width(&self) -> f64 {
        self.width - self.left - self.right
    }

    /// The height between the margins.
    pub fn plot_height(&self) -> f64 {
        self.foot() - self.top
    }

    /// Draws the grid, labels and frame.
    pub fn axes(&self, x: &Axis, y: &Axis, svg: &mut String) {
        self.time_axis(x, svg);
        self.time_name(x, svg);
        self.value_axis(y, svg);
    }

    /// Draws the name of the x axis.
    pub fn time_name(&self, x: &Axis, svg: &mut String) {
        let (middle, below, label) = (self.left + self.plot_width() / 2.0, self.height - 8.0, escape(&x.label));
        let _ = write!(svg, "<text class=\"name\" x=\"{middle}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
    }

    /// Draws the grid, labels and name of the y axis, and the frame.
    pub fn value_axis(&self, y: &Axis, svg: &mut String) {
        let (left, top, right, foot) = (self.left, self.top, self.width - self.right, self.foot());
        for (value, label) in &y.ticks {
            let at = self.y(y, *value);
            let _ = write!(svg, "<path class=\"grid\" d=\"M{left} {at:.1}H{right}\"/>");
            let (beside, below, label) = (left - 6.0, at + 4.0, escape(label));
            let _ = write!(svg, "<text x=\"{beside}\" y=\"{below:.1}\" text-anchor=\"end\">{label}</text>");
        }
        let (middle, label) = ((top + foot) / 2.0, escape(&y.label));
        let turn = format!("rotate(-90 14 {middle})");
        let _ = write!(
            svg,
            "<text class=\"name\" x=\"14\" y=\"{middle}\" text-anchor=\"middle\" transform=\"{turn}\">{label}</text>"
        );
        self.frame(svg);
    }

    /// Draws the grid of the x axis, with its labels.
    pub fn time_axis(&self, x: &Axis, svg: &mut String) {
        let (top, foot) = (self.top, self.foot());
        svg.push_str("<g class=\"ticks\">");
        for (value, label) in &x.ticks {
            let at = self.x(x, *value);
            let _ = write!(svg, "<path class=\"grid\" d=\"M{at:.1} {top}V{foot}\"/>");
            let (below, label) = (foot + 15.0, escape(label));
            let _ = write!(svg, "<text x=\"{at:.1}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
        }
        svg.push_str("</g>");
    }

    /// Draws the grid of the x axis without labels.
    pub fn time_grid(&self, x: &Axis, svg: &mut String) {
        svg.push_str("<g class=\"ticks\">");
        for (value, _) in &x.ticks {
            let (at, top, foot) = (self.x(x, *value), self.top, self.foot());
            let _ = write!(svg, "<path class=\"grid\" d=\"M{at:.1} {top}V{foot}\"/>");
        }
        svg.push_str("</g>");
    }

    /// Draws the edge of the plot.
    pub fn frame(&self, svg: &mut String) {
        let (left, top, width, height) = (self.left, self.top, self.plot_width(), self.plot_height());
        let _ = write!(svg, "<rect class=\"frame\" x=\"{left}\" y=\"{top}\" width=\"{width}\" height=\"{height}\"/>");
    }

    /// Draws lines and marks in a nested SVG, which clips them at the axes. It has the ends of the y axis for the page's script.
    pub fn window(&self, y: &Axis, draw: impl FnOnce(&mut String), svg: &mut String) {
        let (left, top, width, height) = (self.left, self.top, self.plot_width(), self.plot_height());
        let ([y0, y1], scale) = (y.ends(), if y.is_logarithmic() { "log" } else { "linear" });
        let _ = write!(
            svg,
            "<svg class=\"plot\" x=\"{left}\" y=\"{top}\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"{left} {top} {width} {height}\" preserveAspectRatio=\"none\" data-y=\"{y0} {y1}\" \
             data-scale=\"{scale}\">"
        );
        draw(svg);
        svg.push_str("</svg>");
    }

    /// Draws a line.
    pub fn line(&self, line: &Line, x: &Axis, y: &Axis, svg: &mut String) {
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
                // A single point becomes a dot.
                path.push_str("h.1");
            }
        }
        let (class, label) = (line.class, escape(&line.label));
        let _ = write!(svg, "<path class=\"line {class}\" data-label=\"{label}\" d=\"{path}\"/>");
        if let (true, Some(first)) = (line.dot, line.parts.first().and_then(|part| part.first())) {
            let (at_x, at_y, class) = (self.x(x, first.0), self.y(y, first.1), line.class);
            let _ = write!(svg, "<circle class=\"dot {class}\" cx=\"{at_x:.1}\" cy=\"{at_y:.1}\" r=\"4\"/>");
        }
    }
}

/// A line of a chart.
#[derive(Debug, Clone)]
pub struct Line {
    /// The classes of colour and dash pattern in the page's style.
    pub class: &'static str,
    /// The label in the legend.
    pub label: String,
    /// The parts, in the units of the axes; there is a gap between two parts.
    pub parts: Vec<Vec<(f64, f64)>>,
    /// True if a dot marks the first point.
    pub dot: bool,
}

impl Line {
    /// Returns a line of a signal's extremes over time. Within a column it connects the smallest and largest value.
    pub fn over_time(class: &'static str, label: &str, columns: &Columns<Extremes>, tick_s: f64) -> Self {
        let (mut parts, mut part, mut before) = (Vec::new(), Vec::new(), f64::NAN);
        for (tick, extremes) in columns.iter() {
            if extremes.is_empty() {
                parts.extend((!part.is_empty()).then(|| std::mem::take(&mut part)));
                continue;
            }
            let time = (tick as f64 + 0.5 * (columns.stride() - 1) as f64) * tick_s;
            let mut ends = [extremes.min, extremes.max];
            // The nearer extreme comes first, so that the line is not thicker than the signal.
            if (before - extremes.max).abs() < (before - extremes.min).abs() {
                ends.reverse();
            }
            part.extend(ends.map(|value| (time, value)));
            before = ends[1];
        }
        parts.extend((!part.is_empty()).then_some(part));
        Self { class, label: label.to_owned(), parts, dot: false }
    }

    /// Returns a path in a plane.
    pub fn path(class: &'static str, label: &str, columns: &Columns<Corners>) -> Self {
        let points = columns.iter().flat_map(|(_, corners)| corners.points()).collect();
        Self { class, label: label.to_owned(), parts: vec![points], dot: true }
    }

    /// Returns a line through the given points.
    pub fn through(class: &'static str, label: &str, points: Vec<(f64, f64)>) -> Self {
        Self { class, label: label.to_owned(), parts: vec![points], dot: false }
    }
}
