//! Charts of two plots, one above the other, over one axis of time.

use super::axis::Axis;
use super::chart::{Picture, legend};
use super::frame::{BOTTOM, Frame, Line, TOP, WIDTH};
use std::fmt::Write;

/// The heights of the plots, and the distance between them.
const UPPER: f64 = 190.0;
const LOWER: f64 = 90.0;
const BETWEEN: f64 = 16.0;
/// The room for labels such as −0.04, also in the letters of a phone.
const LEFT: f64 = 80.0;

/// A plot: its y axis and its lines.
#[derive(Debug)]
pub struct Plot {
    pub y: Axis,
    pub lines: Vec<Line>,
}

/// Draws one plot, or two with the lower one less high. A line marks the time 0. The marks of the time in the run are not drawn.
pub fn panels(title: &str, x: &Axis, upper: &Plot, lower: Option<&Plot>) -> Picture {
    let frame = |top: f64, height: f64| Frame { left: LEFT, ..Frame::sized(WIDTH, top + height + BOTTOM, top) };
    let above = frame(TOP, UPPER);
    let below = frame(above.foot() + BETWEEN, LOWER);
    let last = if lower.is_some() { below } else { above };
    let mut svg = last.open_over_time(title, x);
    if lower.is_some() {
        above.time_grid(x, &mut svg);
        above.value_axis(&upper.y, &mut svg);
        last.time_axis(x, &mut svg);
    } else {
        last.time_axis(x, &mut svg);
        above.value_axis(&upper.y, &mut svg);
    }
    lower.iter().for_each(|lower| below.value_axis(&lower.y, &mut svg));
    last.time_name(x, &mut svg);
    for (frame, plot) in [(above, upper)].into_iter().chain(lower.map(|lower| (below, lower))) {
        frame.window(&plot.y, |svg| draw(&frame, x, plot, svg), &mut svg);
    }
    svg.push_str("</svg>");
    let legend = [Some(upper), lower].into_iter().flatten().flat_map(|plot| legend(&plot.lines)).collect();
    Picture { svg, narrow: None, legend, title: title.to_owned() }
}

fn draw(frame: &Frame, x: &Axis, plot: &Plot, svg: &mut String) {
    let (at, top, foot) = (frame.x(x, 0.0), frame.top, frame.foot());
    let _ = write!(svg, "<path class=\"change\" d=\"M{at:.1} {top}V{foot}\"/>");
    plot.lines.iter().for_each(|line| frame.line(line, x, &plot.y, svg));
}
