//! The cores around a late tick: a row per core, a box for what ran there.

use super::axis::Axis;
use super::chart::Picture;
use super::frame::{BOTTOM, Frame, LEFT, RIGHT, WIDTH};
use super::html::escape;
use crate::late::{LateReport, LateTick, Slice, SliceKind, sentence, us};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// The largest number of rows.
const CORES: usize = 16;
/// The heights of the labels above the rows and of a row. The style has the height of a box.
const LABELS: f64 = 24.0;
const ROW: f64 = 32.0;
/// The width of a letter in a box on a phone, where letters are largest.
const LETTER: f64 = 7.6;
/// The width of the narrowest box. Of several boxes of one kind within half of it, one is drawn.
const NARROWEST: f64 = 0.8;
/// The room that the label at the end of the delay needs.
const END_LABEL: f64 = 90.0;

/// The appearance of a box: its layer, class and name in the legend.
type Look = (usize, &'static str, &'static str);
const LOOKS: [Look; 6] = [
    (0, "idle", "idle"),
    (1, "box o", "task"),
    (2, "box s", "another role"),
    (3, "box b", "the late role"),
    (4, "box y", "softirq"),
    (5, "box p", "interrupt"),
];

/// Draws the cores around each late tick, with a caption. All pictures have the same legend.
pub fn timelines(report: &LateReport, ticks: &[&LateTick], unit: &str) -> Vec<(Picture, String)> {
    let mut pictures: Vec<_> = ticks.iter().filter_map(|late| timeline(report, late, unit)).collect();
    let present = |class: &str| pictures.iter().any(|(picture, _)| picture.svg.contains(&format!("class=\"{class}\"")));
    let looks = LOOKS.iter().rev().filter(|(_, class, _)| present(class));
    let legend: Vec<_> = looks.map(|(_, class, name)| (*class, (*name).to_owned())).collect();
    pictures.iter_mut().for_each(|(picture, _)| picture.legend.clone_from(&legend));
    pictures
}

/// Draws the cores around a late tick, without legend; `None` if the report does not have them.
fn timeline(report: &LateReport, late: &LateTick, unit: &str) -> Option<(Picture, String)> {
    let mut slices: Vec<&Slice> = late.slices.iter().filter(|slice| slice.to_us > slice.from_us).collect();
    let (rows, hidden) = rows(&slices);
    slices.retain(|slice| rows.contains_key(&slice.core));
    slices.sort_by(|a, b| {
        (look(a, late).0, a.core).cmp(&(look(b, late).0, b.core)).then(a.from_us.total_cmp(&b.from_us))
    });
    if slices.is_empty() {
        return None;
    }
    let ends = |(from, to): (f64, f64), slice: &&Slice| (from.min(slice.from_us), to.max(slice.to_us));
    let (from, to) = slices.iter().fold((0.0, late.late_us), ends);
    let x = Axis::linear("time after the due time, µs", from, to);
    let frame = Frame::sized(WIDTH, LABELS + ROW * rows.len() as f64 + BOTTOM, LABELS);
    let title = format!("cores around tick {} of {}", late.tick, late.role);
    let mut svg = frame.open(&title);
    frame.time_axis(&x, &mut svg);
    for (core, row) in &rows {
        let (beside, below) = (LEFT - 6.0, middle(*row) + 4.0);
        let _ = write!(svg, "<text class=\"row\" x=\"{beside}\" y=\"{below}\" text-anchor=\"end\">core {core}</text>");
    }
    boxes(&slices, &rows, late, (&frame, &x), &mut svg);
    delay(late, &frame, &x, &mut svg);
    let (across, below, label) = ((LEFT + WIDTH - RIGHT) / 2.0, frame.height - 8.0, escape(&x.label));
    let _ = write!(svg, "<text class=\"name\" x=\"{across}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
    frame.frame(&mut svg);
    svg.push_str("</svg>");
    let more = if hidden > 0 { format!(" {hidden} more cores are not drawn.") } else { String::new() };
    Some((Picture { svg, narrow: None, title, legend: Vec::new() }, sentence(report, late, unit) + &more))
}

/// Returns the row of each drawn core, and the number of cores without a row. Cores of roles are drawn first.
fn rows(slices: &[&Slice]) -> (BTreeMap<usize, usize>, usize) {
    let has_role: BTreeSet<usize> =
        slices.iter().filter(|slice| slice.kind == SliceKind::Role).map(|slice| slice.core).collect();
    let cores: BTreeSet<(bool, usize)> =
        slices.iter().map(|slice| (!has_role.contains(&slice.core), slice.core)).collect();
    let drawn: BTreeSet<usize> = cores.iter().take(CORES).map(|(_, core)| *core).collect();
    let hidden = cores.len() - drawn.len();
    (drawn.into_iter().enumerate().map(|(row, core)| (core, row)).collect(), hidden)
}

/// Draws a box for each slice, with its name if it fits.
fn boxes(
    slices: &[&Slice],
    rows: &BTreeMap<usize, usize>,
    late: &LateTick,
    (frame, x): (&Frame, &Axis),
    svg: &mut String,
) {
    let (mut before, mut drawn_to) = (None, f64::NEG_INFINITY);
    for slice in slices {
        let (layer, class, _) = look(slice, late);
        let y = middle(rows[&slice.core]);
        let (from, to) = (frame.x(x, slice.from_us), frame.x(x, slice.to_us));
        let same_row = before.replace((layer, slice.core)) == Some((layer, slice.core));
        if same_row && to < drawn_to + NARROWEST / 2.0 {
            continue;
        }
        let to = to.max(from + NARROWEST);
        drawn_to = to;
        let name = escape(&slice.name);
        let about = format!("{name}, core {}, {} to {} µs", slice.core, us(slice.from_us), us(slice.to_us));
        let _ = write!(svg, "<path class=\"{class}\" d=\"M{from:.1} {y}H{to:.1}\"><title>{about}</title></path>");
        let width = LETTER * slice.name.chars().count() as f64;
        if slice.kind != SliceKind::Idle && width < to - from {
            let (at, below) = ((from + to) / 2.0, y + 4.0);
            let _ =
                write!(svg, "<text class=\"inbox\" x=\"{at:.1}\" y=\"{below}\" text-anchor=\"middle\">{name}</text>");
        }
    }
}

/// Marks the due time and the end of the delay.
fn delay(late: &LateTick, frame: &Frame, x: &Axis, svg: &mut String) {
    let (due, end) = (frame.x(x, 0.0), frame.x(x, late.late_us));
    let (foot, above) = (frame.foot(), LABELS - 7.0);
    let _ = write!(svg, "<path class=\"due\" d=\"M{due:.1} {}V{foot}\"/>", LABELS - 5.0);
    let _ = write!(svg, "<path class=\"incident\" d=\"M{end:.1} {}V{foot}\"/>", LABELS - 5.0);
    let _ = write!(svg, "<text x=\"{:.1}\" y=\"{above}\" text-anchor=\"end\">due</text>", due - 3.0);
    let (at, anchor) =
        if end + END_LABEL > frame.width { (frame.width - 2.0, "end") } else { (end.max(due + 4.0), "start") };
    let _ =
        write!(svg, "<text x=\"{at:.1}\" y=\"{above}\" text-anchor=\"{anchor}\">+{} µs</text>", rounded(late.late_us));
}

/// Formats a delay in whole µs, unless it is short or absurd.
fn rounded(value: f64) -> String {
    if (100.0..1e7).contains(&value) { format!("{value:.0}") } else { us(value) }
}

/// Returns the appearance of a slice.
fn look(slice: &Slice, late: &LateTick) -> Look {
    match slice.kind {
        SliceKind::Idle => LOOKS[0],
        SliceKind::Task => LOOKS[1],
        SliceKind::Role if slice.name != late.role => LOOKS[2],
        SliceKind::Role => LOOKS[3],
        SliceKind::Softirq => LOOKS[4],
        SliceKind::Interrupt => LOOKS[5],
    }
}

/// Returns the y coordinate of the middle of a row.
fn middle(row: usize) -> f64 {
    LABELS + ROW * (row as f64 + 0.5)
}
