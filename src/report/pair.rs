//! Two runs on one page: where their samples differ first, and their errors, motion and latencies drawn over each other.
//!
//! Must not judge which of them is better.

use super::axis::Axis;
use super::chart::{Marks, Picture, Size, marks, over_time, over_time_in, plane, range};
use super::columns::{Columns, Extremes};
use super::error::ReportError;
use super::frame::Line;
use super::model::{Block, Model, Section, latency_section};
use super::percentiles::{Curve, pictures};
use super::pictures::{by_unit, error_axis};
use super::source::Source;
use super::tables::figures_cells;
use super::traces::{Key, MetricTrace, Traces, trace};
use crate::analysis::digits;
use crate::launch::{MetricScore, StageFigures, Summary};
use crate::record::{Comparison, RecordError, Recording, Tolerances, diff};
use crate::rig;
use std::collections::BTreeSet;

/// The first run is drawn solid and thin on the second, which is dashed and wide: where they are the same, both are seen.
const CLASSES: [[&str; 2]; 4] =
    [["o d0", "o d1 wide"], ["b d0", "b d1 wide"], ["g d0", "g d1 wide"], ["p d0", "p d1 wide"]];
/// Lists of more values are compared by their elements.
const LISTED: usize = 12;
/// What the runs are called in legends.
const NAMES: [&str; 2] = ["A", "B"];

/// A run with what its recording shows.
struct Run<'a> {
    name: &'static str,
    source: &'a Source,
    traces: Option<Traces>,
    tick_s: f64,
}

impl<'a> Run<'a> {
    fn of(name: &'static str, source: &'a Source) -> Result<Self, ReportError> {
        let traces = match (&source.recording, &source.scenario) {
            (Some(recording), Some(scenario)) => Some(trace(recording, scenario)?),
            _ => None,
        };
        let tick_s = source.scenario.as_ref().map_or(0.0, |scenario| scenario.tick_s());
        Ok(Self { name, source, traces, tick_s })
    }

    fn end_s(&self) -> f64 {
        self.traces.as_ref().and_then(|traces| traces.ticks).map_or(0.0, |(_, last)| last as f64 * self.tick_s)
    }

    fn line(&self, place: usize, label: &str, columns: &Columns<Extremes>) -> Line {
        let which = usize::from(self.name == NAMES[1]);
        Line::of(CLASSES[place % CLASSES.len()][which], &format!("{label}, {}", self.name), columns, self.tick_s)
    }
}

/// Draws up the page of two runs, with the fields that are asked for by name.
pub fn model(a: &Source, b: &Source, shown: &[String]) -> Result<Model, ReportError> {
    let runs = [Run::of(NAMES[0], a)?, Run::of(NAMES[1], b)?];
    let compared = match (&a.recording, &b.recording) {
        (Some(a), Some(b)) => Some(compare(a, b)?),
        _ => None,
    };
    let first = compared.as_ref().and_then(|found| found.as_ref().ok()).and_then(Comparison::first);
    let time = Axis::time(runs.iter().map(Run::end_s).fold(runs[0].tick_s.max(1e-9), f64::max));
    let flag = first.map(|(_, first)| (first.tick as f64 * runs[0].tick_s, "first difference".to_owned()));
    let (marks, whole) = marks(&time, &Marks { incidents: flag.into_iter().collect(), ..Marks::default() });
    let mut sections = vec![told(&runs), scenarios(&runs), differences(compared.as_ref(), runs[0].tick_s)];
    if !shown.is_empty() {
        let figures = shown.iter().map(|name| field(name, &runs, whole, &time)).collect::<Result<_, _>>()?;
        sections.push(Section { id: "fields", title: "Fields", blocks: vec![Block::Figures(figures)] });
    }
    sections.extend([errors(&runs, whole, &time), motion(&runs, &time)]);
    let latencies = pictures(&curves(&runs));
    if !latencies.is_empty() {
        sections.push(latency_section(latencies, latency_rows(&runs)));
    }
    sections.retain(|section| !section.blocks.is_empty());
    let verdict = match (&compared, first) {
        (Some(Ok(found)), _) if found.same() => ("no value differs".to_owned(), Some(true)),
        (Some(Ok(_)), Some((_, first))) => (format!("they differ from tick {} on", first.tick), None),
        (Some(Ok(_)), None) => ("no value differs, but one has more samples".to_owned(), None),
        _ => ("samples not compared".to_owned(), None),
    };
    let title =
        if name(a) == name(b) { format!("{}: A and B", name(a)) } else { format!("{} and {}", name(a), name(b)) };
    let subtitle = format!("A: {}. B: {}.", about(a), about(b));
    let missing = |run: &Run<'_>| {
        let name = run.name;
        run.source.missing.iter().map(move |text| format!("{name}: {text}")).collect::<Vec<_>>()
    };
    let remarks = runs.iter().flat_map(missing).collect();
    Ok(Model { title, run: None, subtitle, verdict, remarks, marks, sections })
}

/// What of two recordings differs, or why their samples cannot be compared.
fn compare(a: &Recording, b: &Recording) -> Result<Result<Comparison, String>, ReportError> {
    match diff(a, b, Tolerances::default()) {
        Err(RecordError::Layout { service, .. }) => Ok(Err(format!("{service} has another layout in each"))),
        found => Ok(Ok(found?)),
    }
}

fn name(source: &Source) -> String {
    let recorded = source.recording.as_ref().map(|recording| recording.info().scenario_name.clone());
    source.summary.as_ref().map(|summary| summary.scenario.clone()).or(recorded).unwrap_or_default()
}

fn about(source: &Source) -> String {
    let run = source.run().map_or(String::new(), |run| format!(" (run {run})"));
    let recorded = source.recording.as_ref().map(|recording| {
        let info = recording.info();
        format!("{}, {}, begun {}", info.scenario_name, info.clock, info.started_utc)
    });
    let told = source.summary.as_ref().map(|s| format!("{}, {}, started {}", s.scenario, s.clock, s.started_utc));
    format!("{}{run}", told.or(recorded).unwrap_or_default())
}

/// A figure of a metric.
type Pick = fn(&MetricScore) -> Option<f64>;

/// What the launchers of both said.
fn told(runs: &[Run<'_>; 2]) -> Section {
    let number = |value: Option<f64>| value.map_or("–".to_owned(), digits);
    let summary = |run: &Run<'_>| run.source.summary.as_ref().map_or("–".to_owned(), |s| s.verdict.clone());
    let metric = |run: &'_ Run<'_>, name: &str, pick: Pick| {
        let metrics = run.source.summary.iter().flat_map(|summary: &Summary| &summary.score.metrics);
        number(metrics.filter(|metric| metric.name == name).find_map(pick))
    };
    let mut names: Vec<&str> = Vec::new();
    for told in runs.iter().filter_map(|run| run.source.summary.as_ref()).flat_map(|summary| &summary.score.metrics) {
        if !names.contains(&told.name.as_str()) {
            names.push(&told.name);
        }
    }
    let mut rows = vec![vec!["verdict".to_owned(), summary(&runs[0]), summary(&runs[1])]];
    let figures: [(&str, Pick); 4] = [
        ("at the end", |metric| Some(metric.last).filter(|last| last.is_finite())),
        ("largest settled", |metric| metric.settled_max),
        ("peak", |metric| metric.peak),
        ("within its limit from, s", |metric| metric.settled_at_s),
    ];
    for name in names {
        for (what, pick) in figures {
            rows.push(vec![format!("{name}, {what}"), metric(&runs[0], name, pick), metric(&runs[1], name, pick)]);
        }
    }
    let ticks = |run: &Run<'_>, role: &str| {
        let summary = run.source.summary.as_ref()?;
        let ticks = summary.books.roles.get(role)?;
        Some(format!("{} of {}", ticks.missed, ticks.elapsed))
    };
    for role in runs.iter().filter_map(|run| run.source.summary.as_ref()).flat_map(|s| s.books.roles.keys()) {
        let row = vec![
            format!("{role}, missed ticks"),
            ticks(&runs[0], role).unwrap_or("–".to_owned()),
            ticks(&runs[1], role).unwrap_or("–".to_owned()),
        ];
        if !rows.contains(&row) {
            rows.push(row);
        }
    }
    let table = Block::table("", vec!["", "A", "B"], rows);
    Section { id: "verdict", title: "What was told of them", blocks: vec![table] }
}

/// The keys of the scenarios that differ.
fn scenarios(runs: &[Run<'_>; 2]) -> Section {
    let [a, b] = runs.each_ref().map(|run| run.source.scenario.as_ref());
    let block = match (a, b) {
        (Some(a), Some(b)) => {
            let mut rows = Vec::new();
            differing_tables("", &a.resolved, &b.resolved, &mut rows);
            match rows.len() {
                0 => Block::Text("Both ran the same scenario: every key has the same value.".to_owned()),
                _ => Block::table("", vec!["key", "A", "B"], rows),
            }
        }
        _ => Block::Text("The scenarios cannot be compared: one of the runs does not tell its own.".to_owned()),
    };
    Section { id: "scenarios", title: "What differs between the scenarios", blocks: vec![block] }
}

fn differing_tables(key: &str, a: &toml::Table, b: &toml::Table, rows: &mut Vec<Vec<String>>) {
    let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    for name in keys {
        let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
        differing(&key, a.get(name), b.get(name), rows);
    }
}

/// Adds a row for every key below this one whose values differ.
fn differing(key: &str, a: Option<&toml::Value>, b: Option<&toml::Value>, rows: &mut Vec<Vec<String>>) {
    use toml::Value::{Array, Table};
    let none = toml::Table::new();
    match (a, b) {
        _ if a == b => {}
        (Some(Table(a)), Some(Table(b))) => differing_tables(key, a, b, rows),
        (Some(Table(of)), None) if !of.is_empty() => differing_tables(key, of, &none, rows),
        (None, Some(Table(of))) if !of.is_empty() => differing_tables(key, &none, of, rows),
        // Lists of tables, and those too long to be read, by their elements.
        (Some(Array(of)), _) | (_, Some(Array(of))) if of.len() > LISTED || of.iter().any(toml::Value::is_table) => {
            let lists = [a, b].map(|value| value.and_then(toml::Value::as_array).map_or(&[][..], Vec::as_slice));
            for index in 0..lists[0].len().max(lists[1].len()) {
                let [a, b] = lists.map(|list| list.get(index));
                differing(&format!("{key}[{index}]"), a, b, rows);
            }
        }
        _ => {
            let text = |value: Option<&toml::Value>| value.map_or("–".to_owned(), toml::Value::to_string);
            rows.push(vec![key.to_owned(), text(a), text(b)]);
        }
    }
}

/// The first difference, and every signal's.
fn differences(compared: Option<&Result<Comparison, String>>, tick_s: f64) -> Section {
    let mut blocks = Vec::new();
    match compared {
        None => blocks.push(Block::Text("Samples are compared where both runs were recorded.".to_owned())),
        Some(Err(reason)) => blocks.push(Block::Text(format!("Samples cannot be compared: {reason}."))),
        Some(Ok(found)) => {
            blocks.push(Block::Text(match found.first() {
                Some((signal, first)) => format!(
                    "The first value that differs: {} {} at tick {} ({} s): {:e} in A, {:e} in B. It is marked on every \
                     time axis.",
                    signal.name,
                    first.field,
                    first.tick,
                    digits(first.tick as f64 * tick_s),
                    first.values[0],
                    first.values[1]
                ),
                None => "No value differs, bit for bit.".to_owned(),
            }));
            let row = |signal: &crate::record::SignalDiff| {
                let (max, at) = signal.max.as_ref().map_or(("0".to_owned(), "–".to_owned()), |(max, field, tick)| {
                    (format!("{max:.2e}"), format!("{field}, tick {tick}"))
                });
                let first = signal.first.as_ref().map_or("–".to_owned(), |first| first.tick.to_string());
                let [a, b] = signal.only.map(|ticks| ticks.to_string());
                vec![
                    signal.name.clone(),
                    signal.compared.to_string(),
                    a,
                    b,
                    first,
                    max,
                    at,
                    format!("{:.2e}", signal.rms),
                ]
            };
            let rows = found.signals.iter().map(row).collect();
            let head = vec!["signal", "ticks of both", "only A", "only B", "differs from tick", "largest", "at", "rms"];
            blocks.push(Block::table("Signals that both have", head, rows));
            for (which, names) in NAMES.iter().zip(&found.only).filter(|(_, names)| !names.is_empty()) {
                blocks.push(Block::Text(format!("Only {which} has {}.", names.join(", "))));
            }
        }
    }
    Section { id: "differences", title: "Where they differ", blocks }
}

/// A field of both, by its name.
fn field(name: &str, runs: &[Run<'_>; 2], whole: Size, time: &Axis) -> Result<(Picture, String), ReportError> {
    let mut found: Vec<(&Run<'_>, &Key, &Columns<Extremes>)> = Vec::new();
    for run in runs {
        let traces = run.traces.iter();
        found.extend(traces.flat_map(|traces| traces.named(name)).map(|(key, columns)| (run, key, columns)));
    }
    let Some((_, key, _)) = found.first() else {
        return Err(ReportError::Field {
            name: name.to_owned(),
            known: runs[0].traces.as_ref().map_or(String::new(), Traces::names),
        });
    };
    let y = Axis::around(&key.2, range(found.iter().map(|(.., columns)| *columns), false));
    let line = |(run, key, columns): &(&Run<'_>, &Key, &Columns<Extremes>)| {
        run.line(key.3, &format!("{}[{}]", key.2, key.3), columns)
    };
    let lines: Vec<Line> = found.iter().map(line).collect();
    Ok((over_time_in(whole, name, time, &y, &lines), format!("{name}; the last part of a field's name is its unit.")))
}

fn errors(runs: &[Run<'_>; 2], whole: Size, time: &Axis) -> Section {
    let of = |run| {
        let Run { traces, .. }: &Run<'_> = run;
        let metrics = traces.iter().flat_map(|traces| &traces.metrics);
        metrics.map(move |metric| (run, metric)).filter(|(_, metric)| metric.values.iter().any(|(_, e)| !e.is_empty()))
    };
    let caption = "Every tick of each run, scored from its own recording.";
    let figure = |(unit, shown): (String, Vec<(&Run<'_>, &MetricTrace)>)| {
        let (y, title) = error_axis(&unit, shown.iter().map(|(_, metric)| &metric.values));
        let place = |name| shown.iter().position(|(_, metric)| metric.name == name).unwrap_or(0);
        let line = |(run, metric): &(&Run<'_>, &MetricTrace)| run.line(place(metric.name), metric.name, &metric.values);
        let lines: Vec<Line> = shown.iter().map(line).collect();
        let title = format!("{title} of both over time, logarithmic");
        Block::Figures(vec![(over_time_in(whole, &title, time, &y, &lines), caption.to_owned())])
    };
    let blocks = by_unit(runs.iter().flat_map(of), |(_, metric)| metric.name).into_iter().map(figure).collect();
    Section { id: "errors", title: "Errors", blocks }
}

fn motion(runs: &[Run<'_>; 2], time: &Axis) -> Section {
    let mut figures = Vec::new();
    let pictures = runs[0].source.scenario.as_ref().map(|scenario| scenario.rig.pictures()).unwrap_or_default();
    for picture in pictures {
        match picture {
            rig::Picture::Plane(of) => figures.extend(paths(&of, runs)),
            rig::Picture::Graph(of) => figures.extend(graph(&of, runs, time)),
            rig::Picture::Inputs(_) | rig::Picture::Lyapunov(_) | rig::Picture::Onset => {}
        }
    }
    let blocks = if figures.is_empty() { Vec::new() } else { vec![Block::Figures(figures)] };
    Section { id: "motion", title: "Motion", blocks }
}

/// The truth of every body in both, and the estimate's.
fn graph(of: &rig::Graph, runs: &[Run<'_>; 2], time: &Axis) -> Option<(Picture, String)> {
    let (mut lines, mut columns) = (Vec::new(), Vec::new());
    for run in runs {
        let Some(traces) = &run.traces else { continue };
        let seen = traces.bodies.first().map(|body| (body, "estimate", "observer"));
        let truths = traces.bodies.iter().map(|body| (body, "truth", body.as_str()));
        for (place, (body, signal, label)) in truths.chain(seen).enumerate() {
            if let Some(found) = traces.get(body, signal, of.field, of.element) {
                lines.push(run.line(place, label, found));
                columns.push(found);
            }
        }
    }
    let y = Axis::around(&of.axis, range(columns, false));
    (!lines.is_empty()).then(|| (over_time(&of.title, time, &y, &lines), of.caption.clone()))
}

/// The first body's path in a plane, in both.
fn paths(of: &rig::Plane, runs: &[Run<'_>; 2]) -> Option<(Picture, String)> {
    let path = |(which, run): (usize, &Run<'_>)| {
        let traces = run.traces.as_ref()?;
        let body = traces.bodies.first()?.clone();
        let label = format!("{body}, {}", run.name);
        traces.paths.get(&(body, of.title)).map(|columns| Line::path(CLASSES[which][which], &label, columns))
    };
    let lines: Vec<Line> = runs.iter().enumerate().filter_map(path).collect();
    (!lines.is_empty()).then(|| (plane(of.title, of.axes, &lines, of.centred), of.caption.to_owned()))
}

/// The latencies of both, each role by the name of its run.
fn curves(runs: &[Run<'_>; 2]) -> Vec<Curve> {
    let of = |run: &Run<'_>| {
        let name = run.name;
        let named = move |curve: &Curve| Curve { role: format!("{}, {name}", curve.role), ..curve.clone() };
        run.source.curves.iter().map(named).collect::<Vec<_>>()
    };
    let mut curves: Vec<Curve> = runs.iter().flat_map(of).collect();
    // The two of a role beside each other.
    curves.sort_by(|one, other| (&one.stage, &one.role).cmp(&(&other.stage, &other.role)));
    curves
}

fn latency_rows(runs: &[Run<'_>; 2]) -> Block {
    let of = |run: &Run<'_>| {
        let name = run.name;
        let stages = run.source.summary.iter().flat_map(|summary| &summary.latencies);
        let row = move |stage: &StageFigures| {
            let mut row = vec![stage.role.clone(), stage.stage.clone(), name.to_owned()];
            row.extend(figures_cells(&stage.figures));
            row
        };
        stages.map(row).collect::<Vec<_>>()
    };
    let mut rows: Vec<Vec<String>> = runs.iter().flat_map(of).collect();
    // Stable: stages stay in the order of the summary, the two of one beside each other.
    let places: Vec<(String, String)> = rows.iter().map(|row| (row[0].clone(), row[1].clone())).collect();
    rows.sort_by_key(|row| places.iter().position(|place| place.0 == row[0] && place.1 == row[1]));
    let head = vec!["role", "stage", "run", "count", "missed", "50 %, µs", "99 %, µs", "99.9 %, µs", "max, µs"];
    Block::table("", head, rows)
}
