//! The page of a log's hidden component: estimate and measurement, their difference, and unobservable intervals.
//!
//! Keeps a bounded number of segments, and of points per segment. Must not omit any without a note.

use super::axis::Axis;
use super::chart::{Picture, plain};
use super::frame::Line;
use super::model::{Block, Model, Section};
use super::page::page;
use crate::estimate::SegmentScore;
use crate::telemetry::sorted;
use std::mem::take;

/// The largest number of points of a segment. When it is reached, every other point is dropped.
const POINTS: usize = 4096;
/// The largest number of segments that are kept.
const SEGMENTS: usize = 128;
/// The largest number of segments that are drawn.
const DRAWN: usize = 6;

/// One point of a segment.
#[derive(Debug, Clone, Copy)]
struct Point {
    time_s: f64,
    estimate: f64,
    measured: f64,
    observed: bool,
}

/// The points of a segment.
#[derive(Debug, Clone, Default)]
struct Trace {
    points: Vec<Point>,
    /// Rows per point.
    stride: usize,
    rows: usize,
}

/// A builder of the page; takes the rows of a log in their order.
#[derive(Debug, Clone, Default)]
pub struct HiddenPage {
    traces: Vec<Trace>,
    segments: usize,
}

/// The content of the page besides its charts.
#[derive(Debug, Clone)]
pub struct HiddenFacts<'a> {
    /// The log's name.
    pub title: String,
    /// The letter of the hidden axis.
    pub axis: &'a str,
    /// Paragraphs about the method.
    pub paragraphs: Vec<String>,
    /// The name and score of every segment, in their order.
    pub segments: &'a [(String, SegmentScore)],
}

impl HiddenPage {
    /// Adds a row: `begins` is true for the first row of a segment, the time is in s, `estimate` and `measured` are rates in
    /// rad/s (NaN if unknown), and `observed` is true if the step to this row was observable.
    pub fn push(&mut self, begins: bool, time_s: f64, estimate: f64, measured: f64, observed: bool) {
        if begins {
            self.segments += 1;
            if self.segments <= SEGMENTS {
                self.traces.push(Trace { stride: 1, ..Trace::default() });
            }
        }
        let Some(trace) = self.traces.last_mut().filter(|_| self.segments <= SEGMENTS) else { return };
        if trace.rows.is_multiple_of(trace.stride) {
            trace.points.push(Point { time_s, estimate, measured, observed });
        } else if let (false, Some(last)) = (observed, trace.points.last_mut()) {
            // A dropped row still marks its point as unobservable.
            last.observed = false;
        }
        trace.rows += 1;
        if trace.points.len() >= POINTS {
            let mut kept = false;
            trace.points.retain(|_| {
                kept = !kept;
                kept
            });
            trace.stride *= 2;
        }
    }

    /// Returns the page as HTML.
    pub fn html(&self, facts: &HiddenFacts<'_>) -> String {
        let scored = |index: &usize| facts.segments[*index].1.error_rad_s;
        let known = self.traces.len().min(facts.segments.len());
        let mut order: Vec<usize> = (0..known).collect();
        // Segments without a score come last.
        order.sort_by(|a, b| scored(a).total_cmp(&scored(b)));
        let shown = spread(&order);
        let mut sections = vec![Section { id: "result", title: "Result", blocks: result(facts) }];
        sections.push(Section {
            id: "segments",
            title: "Reconstructed and measured",
            blocks: self.figures(facts, &shown),
        });
        let model = Model {
            title: facts.title.clone(),
            run: None,
            subtitle: format!(
                "the rate about {} from the other two; corotate {}",
                facts.axis,
                env!("CARGO_PKG_VERSION")
            ),
            verdict: (String::new(), None),
            remarks: Vec::new(),
            marks: String::new(),
            sections,
        };
        page(&model)
    }

    fn figures(&self, facts: &HiddenFacts<'_>, shown: &[usize]) -> Vec<Block> {
        let mut figures = Vec::new();
        for &index in shown {
            let ((name, score), trace) = (&facts.segments[index], &self.traces[index]);
            let every = if trace.stride > 1 { format!(", every {}th row", trace.stride) } else { String::new() };
            let error = match score.scored {
                0 => "not measured".to_owned(),
                _ => format!("rms error over the second half {:.4} rad/s", score.error_rad_s),
            };
            let (motion, rest) = trace.pictures(name, facts.axis);
            figures.push((motion, format!("segment {name}: {error}{every}")));
            figures.extend(rest.map(|rest| (rest, format!("segment {name}: estimate − measured{every}"))));
        }
        let text = match facts.segments.len() {
            0 | 1 => String::new(),
            count if count > self.traces.len() => format!(
                "{} of the first {} of {count} segments, from the smallest to the largest error.",
                shown.len(),
                self.traces.len()
            ),
            count => format!("{} of {count} segments, from the smallest to the largest error.", shown.len()),
        };
        let text = (!text.is_empty()).then_some(Block::Text(text));
        text.into_iter().chain([Block::Figures(figures)]).collect()
    }
}

/// Selects elements from the first to the last in equal steps.
fn spread(order: &[usize]) -> Vec<usize> {
    if order.len() <= DRAWN {
        return order.to_vec();
    }
    (0..DRAWN).map(|n| order[n * (order.len() - 1) / (DRAWN - 1)]).collect()
}

fn result(facts: &HiddenFacts<'_>) -> Vec<Block> {
    let mut blocks: Vec<Block> = facts.paragraphs.iter().cloned().map(Block::Text).collect();
    let errors = facts.segments.iter().map(|(_, score)| score.error_rad_s);
    let errors = sorted(errors.filter(|error| error.is_finite()));
    if errors.len() > 1 {
        let last = (errors.len() - 1) as f64;
        let points = errors.iter().enumerate().map(|(n, error)| (100.0 * n as f64 / last, *error)).collect();
        let line = Line::through("b", "rms error", points);
        let (x, y) = (
            Axis::linear("segments, %", 0.0, 100.0),
            Axis::around("rms error, rad/s", (0.0, errors[errors.len() - 1])),
        );
        let caption = format!(
            "Percentage of {} segments whose rms error over the second half is at most the given value.",
            errors.len()
        );
        blocks.push(Block::Figures(vec![(plain("rms error of the segments", &x, &y, &[line]), caption)]));
    }
    blocks
}

impl Trace {
    /// Draws the estimate and the measured rate over time, and their difference if the rate was measured.
    fn pictures(&self, name: &str, axis: &str) -> (Picture, Option<Picture>) {
        let start = self.points.first().map_or(0.0, |point| point.time_s);
        let end = self.points.last().map_or(1.0, |point| point.time_s - start);
        let time = Axis::linear("time in the segment, s", 0.0, end);
        let path = |value: fn(&Point) -> f64| self.parts(start, value);
        let range = |all: &[&Vec<Vec<(f64, f64)>>]| {
            let values = all.iter().flat_map(|parts| parts.iter().flatten()).map(|point| point.1);
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
        };
        let line = |class, label: &str, parts| Line { class, label: label.to_owned(), parts, dot: false };
        let (estimate, measured) = (path(|point| point.estimate), path(|point| point.measured));
        // The initial error of a filter may be large, so the axis follows the measured rate.
        let range_of = if measured.iter().flatten().next().is_some() { &measured } else { &estimate };
        let (low, high) = range(&[range_of]);
        let room = 0.25 * (high - low);
        let y = Axis::around(&format!("rate about {axis}, rad/s"), (low - room, high + room));
        let foot = low - room;
        let unobservable = self.unobservable(start, foot);
        let mut lines = vec![line("o", "reconstructed", estimate)];
        if measured.iter().flatten().next().is_some() {
            lines.insert(0, line("k d1", "measured", measured));
        }
        if !unobservable.is_empty() {
            lines.push(line("p wide", "unobservable", unobservable));
        }
        let picture = plain(&format!("rate about {axis}, segment {name}"), &time, &y, &lines);
        let error = self.parts(start, |point| point.estimate - point.measured);
        // The axis excludes the first quarter, in which the filter converges.
        let late = error.iter().flatten().filter(|point| point.0 >= 0.25 * end).map(|point| point.1.abs());
        let largest = late.fold(0.0, f64::max);
        let residual = error.iter().flatten().next().is_some().then(|| {
            let y = Axis::around("estimate − measured, rad/s", (-largest, largest));
            plain(&format!("error, segment {name}"), &time, &y, &[line("b", "estimate − measured", error)])
        });
        (picture, residual)
    }

    /// Returns the parts of a line, with a gap where the value is unknown.
    fn parts(&self, start: f64, value: fn(&Point) -> f64) -> Vec<Vec<(f64, f64)>> {
        let (mut parts, mut part) = (Vec::new(), Vec::new());
        for point in &self.points {
            let value = value(point);
            if value.is_finite() {
                part.push((point.time_s - start, value));
            } else if !part.is_empty() {
                parts.push(take(&mut part));
            }
        }
        parts.extend((!part.is_empty()).then_some(part));
        parts
    }

    /// Returns the unobservable intervals as strokes at a height.
    fn unobservable(&self, start: f64, height: f64) -> Vec<Vec<(f64, f64)>> {
        let steps = self.points.windows(2).filter(|pair| !pair[1].observed);
        steps.map(|pair| vec![(pair[0].time_s - start, height), (pair[1].time_s - start, height)]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_is_well_formed_and_bounded_for_any_log() {
        let mut page = HiddenPage::default();
        let mut segments = Vec::new();
        for segment in 0..200_u32 {
            let rows = if segment == 0 { 100_000 } else { 20 };
            for row in 0..rows {
                let time_s = f64::from(row) * 0.01;
                let measured = if segment == 3 || row % 7 == 3 { f64::NAN } else { time_s.sin() };
                page.push(
                    row == 0,
                    time_s,
                    if row == 0 { f64::NAN } else { time_s.sin() + 0.1 },
                    measured,
                    row % 5 != 0,
                );
            }
            let error_rad_s = if segment == 3 { f64::NAN } else { f64::from(segment) };
            let score = SegmentScore { error_rad_s, scored: u64::from(segment != 3), ..SegmentScore::default() };
            segments.push((format!("<{segment}>"), score));
        }
        assert!(page.traces.len() == SEGMENTS && page.traces[0].points.len() < POINTS);
        let facts = HiddenFacts {
            title: "a<b".to_owned(),
            axis: "z",
            paragraphs: vec!["&\n1".to_owned()],
            segments: &segments,
        };
        let html = page.html(&facts);
        assert!(html.len() < 1 << 20, "{}", html.len());
        let document = roxmltree::Document::parse(html.trim_start_matches("<!DOCTYPE html>")).unwrap();
        assert!(document.descendants().filter(|node| node.has_tag_name("figure")).count() >= DRAWN);
        assert!(html.contains("6 of the first 128 of 200 segments") && !html.contains("NaN"));
        assert!(html.contains("<p>&amp;<br/>\n1</p>") && !html.contains("class=\"verdict"), "a log has no verdict");
        let empty = HiddenPage::default().html(&HiddenFacts { segments: &[], ..facts });
        assert!(roxmltree::Document::parse(empty.trim_start_matches("<!DOCTYPE html>")).is_ok());
    }
}
