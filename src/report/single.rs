//! The page of one run: its sections and their order.

use super::axis::Axis;
use super::chart::{Marks, marks};
use super::counterpart::counterpart;
use super::error::ReportError;
use super::inputs::RunView;
use super::model::{Model, latency_section};
use super::pictures::Frames;
use super::source::Source;
use super::traces::{Traces, trace};
use super::{inputs, late, percentiles, pictures, responses, tables};

/// Builds the page of a run, with the fields named by `shown`.
pub fn model(source: &Source, shown: &[String]) -> Result<Model, ReportError> {
    let mut remarks = source.missing.clone();
    let traces = match (&source.recording, &source.scenario) {
        (Some(recording), Some(scenario)) => Some(trace(recording, scenario, &responses::drawn(&[source])[0])?),
        _ => None,
    };
    if let Some(damage) = source.recording.as_ref().and_then(|recording| recording.damage()) {
        remarks.push(format!("the recording is damaged, and the page shows only its readable part: {damage}"));
    }
    if let Some(missing) = source.recording.as_ref().and_then(|recording| recording.incomplete()) {
        remarks.push(format!("the recording is not complete: {missing}"));
    }
    let (time, events) = times(source, traces.as_ref());
    let (marks, whole) = marks(&time, &events);
    let frames = Frames { time: &time, whole, changes: &events.changes };
    let mut sections = vec![tables::verdict(source, traces.as_ref())];
    if let Some(traces) = &traces {
        let full = source.scenario.as_ref().map_or(Ok(None), counterpart)?;
        sections.extend(pictures::sections(source, traces, full.as_ref(), &frames, shown)?);
    }
    sections.push(responses::section(&[RunView { name: "", source, traces: traces.as_ref() }]));
    let latencies = percentiles::pictures(&source.curves);
    if !latencies.is_empty() {
        sections.push(latency_section(latencies, tables::latencies(source)));
    }
    if let Some(traces) = &traces {
        sections.push(pictures::lateness(source, traces, &time));
    }
    sections.extend(source.late.as_ref().map(|report| late::section(report, &frames)));
    sections.push(tables::events(source, traces.as_ref()));
    sections.push(tables::books(source));
    sections.push(tables::certificate(source));
    sections.push(tables::machine(source));
    sections.retain(|section| !section.blocks.is_empty());
    let (title, subtitle) = headings(source);
    let unjudged = ("not judged: no summary".to_owned(), None);
    let verdict = source.summary.as_ref().map_or(unjudged, |summary| (summary.verdict.clone(), summary.accepted));
    Ok(Model { title, run: source.run(), subtitle, verdict, remarks, marks, sections })
}

fn headings(source: &Source) -> (String, String) {
    if let Some(summary) = &source.summary {
        let seconds = summary.last_tick as f64 / summary.tick_hz;
        let about = format!(
            "{}, {} Hz, {seconds} s; started {}; corotate {} ({})",
            summary.clock, summary.tick_hz, summary.started_utc, summary.version, summary.revision
        );
        return (summary.scenario.clone(), about);
    }
    let Some(info) = source.recording.as_ref().map(|recording| recording.info()) else {
        return (String::new(), String::new());
    };
    let about = format!(
        "{}, {} Hz; recording started {}; corotate {} ({})",
        info.clock,
        1e9 / info.period_ns as f64,
        info.started_utc,
        info.version,
        info.revision
    );
    (info.scenario_name.clone(), about)
}

/// Returns the time axis of all charts and its marks.
fn times(source: &Source, traces: Option<&Traces>) -> (Axis, Marks) {
    let tick_s = source.scenario.as_ref().map_or(0.0, |scenario| scenario.tick_s());
    let recorded = traces.and_then(|traces| traces.ticks).map(|(_, last)| last);
    let last = recorded.or(source.summary.as_ref().map(|summary| summary.last_tick)).unwrap_or(1).max(1);
    let time = Axis::time(last as f64 * tick_s);
    let faults = tables::faults(source).into_iter().filter(|fault| fault.from_tick <= last);
    let span = |fault: tables::FaultRow| {
        let to = fault.from_tick.saturating_add(fault.ticks).min(last);
        let label = format!("{} {}", fault.kind, fault.role);
        (fault.from_tick as f64 * tick_s, to as f64 * tick_s, fault.number, label)
    };
    let incidents = source.summary.iter().flat_map(|summary| &summary.incidents);
    let (missing, _) = traces.map_or_else(Default::default, Traces::missing);
    let unseen = traces.iter().flat_map(|traces| traces.unseen.keys().flat_map(|name| traces.unseen_spans(name).0));
    let seconds = |(from, to): (u64, u64)| (from as f64 * tick_s, to.min(last) as f64 * tick_s);
    let marks = Marks {
        unseen: merged(unseen.collect()).into_iter().map(seconds).collect(),
        faults: faults.map(span).collect(),
        incidents: incidents
            .map(|incident| (incident.tick as f64 * tick_s, format!("{} {}", incident.role, incident.action.name())))
            .collect(),
        missing: missing.iter().map(|(from, to)| (*from as f64 * tick_s, *to as f64 * tick_s)).collect(),
        changes: inputs::marks([("", source)], last as f64 * tick_s),
    };
    (time, marks)
}

/// Merges overlapping and adjacent spans, so that bands do not add up to a darker one.
fn merged(mut spans: Vec<(u64, u64)>) -> Vec<(u64, u64)> {
    spans.sort_unstable();
    spans.dedup_by(|next, last| {
        let touches = next.0 <= last.1;
        last.1 = if touches { last.1.max(next.1) } else { last.1 };
        touches
    });
    spans
}
