//! The page of two runs: the first difference of their samples, and their errors, motion and latencies in the same charts.
//!
//! Must not judge which run is better.

use super::axis::Axis;
use super::chart::{Marks, Picture, Size, marks, over_time, over_time_in, plane, range};
use super::columns::{Columns, Extremes};
use super::error::ReportError;
use super::frame::Line;
use super::inputs::{self, RunView};
use super::model::{Block, Model, Section, latency_section};
use super::percentiles::{Curve, pictures};
use super::pictures::{by_unit, error_axis};
use super::responses;
use super::source::Source;
use super::tables::figures_cells;
use super::traces::{Key, MetricTrace, Traces, observer_name, trace};
use crate::analysis::digits;
use crate::launch::{MetricScore, StageFigures, Summary};
use crate::record::{Comparison, RecordError, Recording, Tolerances, diff};
use crate::rig;
use crate::score::StepResponse;
use std::collections::BTreeSet;

/// Line classes of both runs: A is solid and thin, B is dashed and wide, so both are visible where they coincide.
const CLASSES: [[&str; 2]; 4] =
    [["o d0", "o d1 wide"], ["b d0", "b d1 wide"], ["g d0", "g d1 wide"], ["p d0", "p d1 wide"]];
/// The longest list of values that is shown in one row; longer lists are compared element by element.
const LISTED: usize = 12;
/// The names of the runs in legends.
const NAMES: [&str; 2] = ["A", "B"];

/// A run with the traces of its recording.
struct Run<'a> {
    name: &'static str,
    source: &'a Source,
    traces: Option<Traces>,
    tick_s: f64,
}

impl<'a> Run<'a> {
    /// Reads a run, with the responses to `steps`.
    fn new(name: &'static str, source: &'a Source, steps: &[StepResponse]) -> Result<Self, ReportError> {
        let traces = match (&source.recording, &source.scenario) {
            (Some(recording), Some(scenario)) => Some(trace(recording, scenario, steps)?),
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
        Line::over_time(CLASSES[place % CLASSES.len()][which], &format!("{label}, {}", self.name), columns, self.tick_s)
    }
}

/// Builds the page of two runs, with the fields named by `shown`.
pub fn model(a: &Source, b: &Source, shown: &[String]) -> Result<Model, ReportError> {
    let steps = responses::drawn(&[a, b]);
    let runs = [Run::new(NAMES[0], a, &steps[0])?, Run::new(NAMES[1], b, &steps[1])?];
    let compared = match (&a.recording, &b.recording) {
        (Some(a), Some(b)) => Some(compare(a, b)?),
        _ => None,
    };
    let first = compared.as_ref().and_then(|found| found.as_ref().ok()).and_then(Comparison::first);
    let time = Axis::time(runs.iter().map(Run::end_s).fold(runs[0].tick_s.max(1e-9), f64::max));
    let flag = first.map(|(_, first)| (first.tick as f64 * runs[0].tick_s, "first difference".to_owned()));
    let changes = inputs::marks(runs.each_ref().map(|run| (run.name, run.source)), time.ends()[1]);
    let (marks, whole) = marks(&time, &Marks { incidents: flag.into_iter().collect(), changes, ..Marks::default() });
    let mut sections = vec![verdicts(&runs), scenarios(&runs), differences(compared.as_ref(), runs[0].tick_s)];
    if !shown.is_empty() {
        let figures = shown.iter().map(|name| field(name, &runs, whole, &time)).collect::<Result<_, _>>()?;
        sections.push(Section { id: "fields", title: "Fields", blocks: vec![Block::Figures(figures)] });
    }
    sections.extend([errors(&runs, whole, &time), motion(&runs, &time)]);
    let views = runs.each_ref().map(|run| RunView { name: run.name, source: run.source, traces: run.traces.as_ref() });
    sections.push(responses::section(&views));
    let latencies = pictures(&curves(&runs));
    if !latencies.is_empty() {
        sections.push(latency_section(latencies, latency_rows(&runs)));
    }
    sections.retain(|section| !section.blocks.is_empty());
    let verdict = match (&compared, first) {
        (Some(Ok(found)), _) if found.same() => ("no value differs".to_owned(), Some(true)),
        (Some(Ok(_)), Some((_, first))) => (format!("first difference at tick {}", first.tick), None),
        (Some(Ok(_)), None) => ("common samples are equal; one run has more".to_owned(), None),
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

/// Compares two recordings; the inner error is the reason that their samples cannot be compared.
fn compare(a: &Recording, b: &Recording) -> Result<Result<Comparison, String>, ReportError> {
    match diff(a, b, Tolerances::default()) {
        Err(RecordError::Layout { service, .. }) => Ok(Err(format!("the layouts of {service} differ"))),
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
        format!("{}, {}, started {}", info.scenario_name, info.clock, info.started_utc)
    });
    let summarised = source.summary.as_ref().map(|s| format!("{}, {}, started {}", s.scenario, s.clock, s.started_utc));
    format!("{}{run}", summarised.or(recorded).unwrap_or_default())
}

/// An accessor of one statistic of a metric.
type Pick = fn(&MetricScore) -> Option<f64>;

/// Returns the section with the verdicts and metrics from both summaries.
fn verdicts(runs: &[Run<'_>; 2]) -> Section {
    let number = |value: Option<f64>| value.map_or("–".to_owned(), digits);
    let summary = |run: &Run<'_>| run.source.summary.as_ref().map_or("–".to_owned(), |s| s.verdict.clone());
    let metric = |run: &'_ Run<'_>, name: &str, pick: Pick| {
        let metrics = run.source.summary.iter().flat_map(|summary: &Summary| &summary.score.metrics);
        number(metrics.filter(|metric| metric.name == name).find_map(pick))
    };
    let mut names: Vec<&str> = Vec::new();
    for metric in runs.iter().filter_map(|run| run.source.summary.as_ref()).flat_map(|summary| &summary.score.metrics) {
        if !names.contains(&metric.name.as_str()) {
            names.push(&metric.name);
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
        for (statistic, pick) in figures {
            rows.push(vec![format!("{name}, {statistic}"), metric(&runs[0], name, pick), metric(&runs[1], name, pick)]);
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
    Section { id: "verdict", title: "Verdicts and metrics", blocks: vec![table] }
}

/// Returns the section with the keys whose values differ between the scenarios.
fn scenarios(runs: &[Run<'_>; 2]) -> Section {
    let [a, b] = runs.each_ref().map(|run| run.source.scenario.as_ref());
    let block = match (a, b) {
        (Some(a), Some(b)) => {
            let mut rows = Vec::new();
            differing_tables("", &a.resolved, &b.resolved, &mut rows);
            match rows.len() {
                0 => Block::Text("Both runs have the same scenario.".to_owned()),
                _ => Block::table("", vec!["key", "A", "B"], rows),
            }
        }
        _ => Block::Text("The scenarios cannot be compared: a scenario is missing.".to_owned()),
    };
    Section { id: "scenarios", title: "Scenario differences", blocks: vec![block] }
}

fn differing_tables(key: &str, a: &toml::Table, b: &toml::Table, rows: &mut Vec<Vec<String>>) {
    let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    for name in keys {
        let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
        differing(&key, a.get(name), b.get(name), rows);
    }
}

/// Adds a row for every key at or below `key` whose values differ.
fn differing(key: &str, a: Option<&toml::Value>, b: Option<&toml::Value>, rows: &mut Vec<Vec<String>>) {
    use toml::Value::{Array, Table};
    let empty = toml::Table::new();
    match (a, b) {
        _ if a == b => {}
        (Some(Table(a)), Some(Table(b))) => differing_tables(key, a, b, rows),
        (Some(Table(a)), None) if !a.is_empty() => differing_tables(key, a, &empty, rows),
        (None, Some(Table(b))) if !b.is_empty() => differing_tables(key, &empty, b, rows),
        // Lists of tables and long lists are compared element by element.
        (Some(Array(list)), _) | (_, Some(Array(list)))
            if list.len() > LISTED || list.iter().any(toml::Value::is_table) =>
        {
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

/// Returns the section with the first difference, and the differences of every signal.
fn differences(compared: Option<&Result<Comparison, String>>, tick_s: f64) -> Section {
    let mut blocks = Vec::new();
    match compared {
        None => blocks.push(Block::Text("The samples cannot be compared: only recorded runs have samples.".to_owned())),
        Some(Err(reason)) => blocks.push(Block::Text(format!("The samples cannot be compared: {reason}."))),
        Some(Ok(found)) => {
            blocks.push(Block::Text(match found.first() {
                Some((signal, first)) => format!(
                    "First difference: {} {} at tick {} ({} s), {:e} in A and {:e} in B. It is marked on every time axis.",
                    signal.name,
                    first.field,
                    first.tick,
                    digits(first.tick as f64 * tick_s),
                    first.values[0],
                    first.values[1]
                ),
                None => "All common values are equal bit for bit.".to_owned(),
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
            let head =
                vec!["signal", "common ticks", "only in A", "only in B", "first at tick", "largest", "at", "rms"];
            blocks.push(Block::table("Differences of common signals", head, rows));
            for (run, names) in NAMES.iter().zip(&found.only).filter(|(_, names)| !names.is_empty()) {
                blocks.push(Block::Text(format!("Only in {run}: {}.", names.join(", "))));
            }
        }
    }
    Section { id: "differences", title: "Sample differences", blocks }
}

/// Draws a named field of both runs.
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
    Ok((over_time_in(whole, name, time, &y, &lines), format!("{name}; the suffix of a field's name is its unit.")))
}

fn errors(runs: &[Run<'_>; 2], whole: Size, time: &Axis) -> Section {
    let scored = |run| {
        let Run { traces, .. }: &Run<'_> = run;
        let metrics = traces.iter().flat_map(|traces| &traces.metrics);
        metrics.map(move |metric| (run, metric)).filter(|(_, metric)| metric.values.iter().any(|(_, e)| !e.is_empty()))
    };
    let caption = "Errors at every tick, computed from the recordings. Zeros are drawn at the bottom.";
    let figure = |(unit, shown): (String, Vec<(&Run<'_>, &MetricTrace)>)| {
        let (y, title) = error_axis(&unit, shown.iter().map(|(_, metric)| &metric.values));
        let place = |name| shown.iter().position(|(_, metric)| metric.name == name).unwrap_or(0);
        let line = |(run, metric): &(&Run<'_>, &MetricTrace)| run.line(place(metric.name), metric.name, &metric.values);
        let lines: Vec<Line> = shown.iter().map(line).collect();
        let title = format!("{title} of both runs over time, logarithmic");
        Block::Figures(vec![(over_time_in(whole, &title, time, &y, &lines), caption.to_owned())])
    };
    let blocks = by_unit(runs.iter().flat_map(scored), |(_, metric)| metric.name).into_iter().map(figure).collect();
    Section { id: "errors", title: "Errors", blocks }
}

fn motion(runs: &[Run<'_>; 2], time: &Axis) -> Section {
    let mut figures = Vec::new();
    let pictures = runs[0].source.scenario.as_ref().map(|scenario| scenario.rig.pictures()).unwrap_or_default();
    for picture in pictures {
        match picture {
            rig::Picture::Plane(plane) => figures.extend(paths(&plane, runs)),
            rig::Picture::Graph(graph) => figures.extend(graph_figure(&graph, runs, time)),
            rig::Picture::Inputs(_) | rig::Picture::Lyapunov(_) | rig::Picture::Onset => {}
        }
    }
    let blocks = if figures.is_empty() { Vec::new() } else { vec![Block::Figures(figures)] };
    Section { id: "motion", title: "Motion", blocks }
}

/// Draws the truths and the estimates of both runs over time.
fn graph_figure(graph: &rig::Graph, runs: &[Run<'_>; 2], time: &Axis) -> Option<(Picture, String)> {
    let (mut lines, mut columns) = (Vec::new(), Vec::new());
    for run in runs {
        let Some(traces) = &run.traces else { continue };
        let bodies = || traces.bodies.iter().enumerate();
        let estimates = bodies().map(|(index, body)| (body, "estimate", observer_name(index, body)));
        let truths = bodies().map(|(_, body)| (body, "truth", body.clone()));
        for (place, (body, signal, label)) in truths.chain(estimates).enumerate() {
            if let Some(found) = traces.get(body, signal, graph.field, graph.element) {
                lines.push(run.line(place, &label, found));
                columns.push(found);
            }
        }
    }
    let y = Axis::around(&graph.axis, range(columns, false));
    (!lines.is_empty()).then(|| (over_time(&graph.title, time, &y, &lines), graph.caption.clone()))
}

/// Draws the path of the first body of both runs in a plane.
fn paths(view: &rig::Plane, runs: &[Run<'_>; 2]) -> Option<(Picture, String)> {
    let path = |(place, run): (usize, &Run<'_>)| {
        let traces = run.traces.as_ref()?;
        let body = traces.bodies.first()?.clone();
        let label = format!("{body}, {}", run.name);
        traces.paths.get(&(body, view.title)).map(|columns| Line::path(CLASSES[place][place], &label, columns))
    };
    let lines: Vec<Line> = runs.iter().enumerate().filter_map(path).collect();
    (!lines.is_empty()).then(|| (plane(view.title, view.axes, &lines, view.centred), view.caption.to_owned()))
}

/// Returns the latency curves of both runs, with the name of the run after each role.
fn curves(runs: &[Run<'_>; 2]) -> Vec<Curve> {
    let renamed = |run: &Run<'_>| {
        let name = run.name;
        let named = move |curve: &Curve| Curve { role: format!("{}, {name}", curve.role), ..curve.clone() };
        run.source.curves.iter().map(named).collect::<Vec<_>>()
    };
    let mut curves: Vec<Curve> = runs.iter().flat_map(renamed).collect();
    // Both runs of a role are adjacent.
    curves.sort_by(|a, b| (&a.stage, &a.role).cmp(&(&b.stage, &b.role)));
    curves
}

fn latency_rows(runs: &[Run<'_>; 2]) -> Block {
    let rows_of_run = |run: &Run<'_>| {
        let name = run.name;
        let stages = run.source.summary.iter().flat_map(|summary| &summary.latencies);
        let row = move |stage: &StageFigures| {
            let mut row = vec![stage.role.clone(), stage.stage.clone(), name.to_owned()];
            row.extend(figures_cells(&stage.figures));
            row
        };
        stages.map(row).collect::<Vec<_>>()
    };
    let mut rows: Vec<Vec<String>> = runs.iter().flat_map(rows_of_run).collect();
    // A stable sort keeps the order of the summary and puts both runs of a stage next to each other.
    let places: Vec<(String, String)> = rows.iter().map(|row| (row[0].clone(), row[1].clone())).collect();
    rows.sort_by_key(|row| places.iter().position(|place| place.0 == row[0] && place.1 == row[1]));
    let head = vec!["role", "stage", "run", "count", "missed", "50 %, µs", "99 %, µs", "99.9 %, µs", "max, µs"];
    Block::table("", head, rows)
}
