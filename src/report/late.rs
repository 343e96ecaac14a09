//! The section with late ticks and their causes.

use super::axis::Axis;
use super::chart::{Picture, over_time_in};
use super::frame::Line;
use super::model::{Block, Section};
use super::pictures::Frames;
use super::timeline::timelines;
use crate::late::{CauseKind, CauseTotal, LateReport, LateTick, cause_rows, header, pattern};
use std::collections::HashSet;

/// The unit of delays on a page.
const US: &str = "µs";
/// The classes of the causes with the largest sums; the rest has one class.
const CAUSES: [&str; 7] = ["spot o", "spot b", "spot g", "spot p", "spot y", "spot s", "spot k"];
const REST: &str = "spot grey";
/// The largest number of rows of the table of causes.
const ROWS: usize = 20;
/// The number of late ticks that are drawn with their cores.
const TIMELINES: usize = 10;

/// Builds the section.
pub fn section(report: &LateReport, frames: &Frames<'_>) -> Section {
    let mut blocks = vec![Block::Text(format!("{}.", header(report, US)))];
    blocks.extend(report.note.iter().map(|note| Block::Text(format!("Note: {note}."))));
    if let Some(tracer) = report.tracer.filter(|tracer| tracer.overruns > 0) {
        let text = format!("The kernel's trace lacks events: its buffer was full {} times.", tracer.overruns);
        blocks.push(Block::Text(text));
    }
    if !report.ticks.is_empty() {
        let caption =
            "Delay of every examined late tick at its due time, by the main cause of the first late tick of its chain."
                .to_owned();
        blocks.push(Block::Figures(vec![(over_time(report, frames), caption)]));
    }
    let head = ["cause", "ticks", "worst, µs", "sum, µs"].to_vec();
    let rows: Vec<Vec<String>> = cause_rows(report, ROWS).into_iter().map(Vec::from).collect();
    blocks.push(Block::table("Late ticks by cause", head, rows));
    blocks.extend(report.patterns.iter().map(|found| Block::Text(format!("{}.", pattern(found)))));
    let worst: Vec<&LateTick> = report.worst_first().into_iter().filter(|late| !late.slices.is_empty()).collect();
    let (worst, _) = report.heads(&worst, TIMELINES);
    let drawn = timelines(report, &worst, US);
    if !drawn.is_empty() {
        let text = "The cores around the worst late ticks. A line without a box is an idle core; where a row is blank, the trace \
                    has no event.";
        blocks.push(Block::Text(text.to_owned()));
        blocks.push(Block::Figures(drawn));
    }
    Section { id: "late", title: "Late ticks", blocks }
}

/// Draws the delays over time, one colour per cause.
fn over_time(report: &LateReport, frames: &Frames<'_>) -> Picture {
    let mut lines = series(report);
    if report.late_us > 0.0 {
        let ends = frames.time.ends().map(|end_s| (end_s, report.late_us));
        lines.push(Line::through("limit k d1", "limit", ends.to_vec()));
    }
    let delays = || lines.iter().flat_map(|line| line.parts.iter().flatten()).map(|point| point.1);
    let least = delays().filter(|us| *us > 0.0).fold(f64::INFINITY, f64::min);
    let y = Axis::log_between("delay, µs, logarithmic", 0.8 * least, 1.25 * delays().fold(0.0, f64::max));
    over_time_in(frames.whole, "delays of late ticks over time", frames.time, &y, &lines)
}

/// Returns the points of each cause: those with the largest sums, then all others together.
fn series(report: &LateReport) -> Vec<Line> {
    type Key<'a> = (CauseKind, &'a str);
    let key = |late| report.first_cause(late).map(|cause| -> Key<'_> { (cause.kind, &cause.name) });
    let keys: Vec<Option<Key<'_>>> = report.ticks.iter().map(key).collect();
    let occurring: HashSet<&Key<'_>> = keys.iter().flatten().collect();
    let mut causes = report.causes.iter().filter(|total| occurring.contains(&(total.kind, total.name.as_str())));
    let named: Vec<&CauseTotal> = causes.by_ref().take(CAUSES.len()).collect();
    let rest = if causes.next().is_some() { "other or unknown" } else { "unknown" };
    let mut lines: Vec<Line> = CAUSES
        .iter()
        .zip(&named)
        .map(|(class, total)| Line { class, label: total.cause.clone(), parts: Vec::new(), dot: false })
        .chain([Line { class: REST, label: rest.to_owned(), parts: Vec::new(), dot: false }])
        .collect();
    for (late, key) in report.ticks.iter().zip(keys) {
        let place = named.iter().position(|total| key == Some((total.kind, &total.name)));
        lines[place.unwrap_or(named.len())].parts.push(vec![(late.time_s, late.late_us)]);
    }
    lines.retain(|line| !line.parts.is_empty());
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::late::{Slice, fixture};
    use crate::report::chart::Size;

    fn built(report: &LateReport) -> Section {
        section(report, &Frames { time: &Axis::time(10.0), whole: Size::Whole(0), changes: &[] })
    }

    fn figures(section: &Section) -> Vec<&(Picture, String)> {
        let figures =
            section.blocks.iter().filter_map(|block| if let Block::Figures(all) = block { Some(all) } else { None });
        figures.flatten().collect()
    }

    #[test]
    fn the_section_has_a_point_per_late_tick_and_the_cores_of_the_worst() {
        let report = fixture::report();
        let section = built(&report);
        let figures = figures(&section);
        assert_eq!(figures.len(), 1 + 6, "ten ticks have slices, and four of them are in chains of the others");
        // Single points are drawn as short lines.
        let svg = roxmltree::Document::parse(&figures[0].0.svg).unwrap();
        let spots =
            svg.descendants().filter(|node| node.attribute("class").is_some_and(|class| class.contains("spot")));
        let points = spots.filter_map(|node| node.attribute("d")).flat_map(|path| path.matches('M'));
        assert_eq!(points.count(), report.ticks.len());
        assert_eq!(figures[0].0.legend.len(), CAUSES.len() + 2, "seven causes, the rest and the limit");
        assert!(section.blocks.iter().any(|block| matches!(block, Block::Text(text) if text.contains("12 of 73"))));
        let rows = section
            .blocks
            .iter()
            .find_map(|block| if let Block::Table { rows, .. } = block { Some(rows) } else { None });
        assert_eq!(rows.unwrap().len(), report.causes.len());
    }

    #[test]
    fn a_timeline_is_well_formed_for_any_slices() {
        let mut report = fixture::report();
        let slice = report.worst_first()[0].slices[0].clone();
        let numbers = [f64::MIN, -1.0, 0.0, 1e-9, 500.0, 12_400.0, f64::MAX];
        let pairs = numbers.into_iter().flat_map(|from_us| numbers.map(|to_us| (from_us, to_us)));
        let slices = pairs.enumerate().map(|(core, (from_us, to_us))| Slice {
            core: usize::MAX - core,
            name: "<a&\u{1b}>".to_owned(),
            from_us,
            to_us,
            ..slice.clone()
        });
        report.ticks.iter_mut().for_each(|late| late.slices = slices.clone().collect());
        report.ticks[0].late_us = f64::MAX;
        report.ticks[1].time_s = f64::MAX;
        report.ticks[2].late_us = -5.0;
        let section = built(&report);
        for (picture, caption) in figures(&section) {
            roxmltree::Document::parse(&picture.svg).unwrap();
            assert!(!picture.svg.contains("NaN") && !picture.svg.contains("inf\""), "{}", picture.svg);
            assert!(!caption.is_empty());
        }
        assert!(figures(&section)[1].1.ends_with("cores are not drawn."));
    }

    #[test]
    fn many_short_slices_take_a_bounded_number_of_boxes() {
        let mut report = fixture::report();
        let slice = report.worst_first()[0].slices[1].clone();
        let short = |index: u32| Slice { from_us: f64::from(index), to_us: f64::from(index) + 0.4, ..slice.clone() };
        report.ticks[0].slices = (0..100_000).map(short).collect();
        let (picture, _) = timelines(&report, &[&report.ticks[0]], US).remove(0);
        assert!(picture.svg.matches("<path class=\"box").count() < 2000);
    }

    #[test]
    fn without_late_ticks_there_is_no_figure() {
        let report =
            LateReport { ticks: Vec::new(), causes: Vec::new(), patterns: Vec::new(), counted: 0, ..fixture::report() };
        assert!(figures(&built(&report)).is_empty());
    }

    #[test]
    #[ignore = "writes late.json to the run directory COROTATE_RUN, so that a page with it can be looked at"]
    fn write_a_report_to_look_at() {
        let directory = std::path::PathBuf::from(std::env::var("COROTATE_RUN").unwrap());
        let summary = std::fs::read(directory.join("summary.json")).unwrap();
        let summary: serde_json::Value = serde_json::from_slice(&summary).unwrap();
        let report = LateReport { run: serde_json::from_value(summary["run"].clone()).unwrap(), ..fixture::report() };
        std::fs::write(directory.join("late.json"), serde_json::to_vec(&report).unwrap()).unwrap();
    }
}
