//! Charts from the samples of a run: motion, errors, V and lateness.

use super::axis::Axis;
use super::chart::{Picture, SHADES, Size, over_log_time, over_time, over_time_in, plane, range, strip};
use super::columns::{Columns, Extremes};
use super::error::ReportError;
use super::frame::Line;
use super::model::{Block, Section};
use super::source::Source;
use super::traces::{BODIES_SHOWN, Key, MetricTrace, Traces, observer_name};
use crate::analysis::digits;
use crate::bus::Signal;
use crate::rig;
use crate::scenario::Scenario;
use crate::scenario::claims;

/// The smallest error on an axis, below the rounding error of numbers about 1. Smaller errors are drawn at the bottom.
const ERROR_FLOOR: f64 = 1e-18;
/// The smallest V on an axis, about the square of the smallest error. Smaller values are drawn at the bottom.
const LYAPUNOV_FLOOR: f64 = 1e-34;
/// The classes of colour and dash pattern of the driven bodies.
const FOLLOWERS: [&str; BODIES_SHOWN] = ["o d0 wide", "g d3 wide", "p d4 wide", "y d1 wide"];
/// Line classes of the estimates of driven bodies.
const OBSERVERS: [&str; BODIES_SHOWN] = ["o d1", "g d1", "p d1", "y d0"];
/// The classes of colour and dash pattern of components and metrics.
const COMPONENTS: [&str; 4] = ["o d0", "b d1", "g d3", "p d4"];
/// The classes of a component of a command as it acts, and as it was asked for.
const COMMANDS: [[&str; 2]; 4] =
    [["o d0", "o d4 thin"], ["b d1", "b d4 thin"], ["g d3", "g d4 thin"], ["p d0", "p d4 thin"]];
/// The decades of lateness from the lightest to the darkest shade, starting at 1 µs.
const SHADE_DECADES: f64 = 5.0;

/// The labels of a body's motion with the observer, and of the reference run.
const OBSERVED: &str = "with the observer (this run)";
const COMPARED: &str = "with full state (computed here)";

type Figures = Vec<(Picture, String)>;

/// The time axis of all charts, the size of page-wide ones, and the times at which inputs change, with their descriptions.
pub struct Frames<'a> {
    pub time: &'a Axis,
    pub whole: Size,
    pub changes: &'a [(f64, String)],
}

/// Builds the sections with charts of the samples, of the reference run `full` if there is one, and of the fields named by
/// `shown`.
pub fn sections(
    source: &Source,
    traces: &Traces,
    full: Option<&Traces>,
    frames: &Frames<'_>,
    shown: &[String],
) -> Result<Vec<Section>, ReportError> {
    let Some(scenario) = &source.scenario else { return Ok(Vec::new()) };
    let (tick_s, time) = (scenario.tick_s(), frames.time);
    let mut sections = Vec::new();
    if !shown.is_empty() {
        let figures = shown.iter().map(|name| field(name, traces, frames, tick_s)).collect::<Result<_, _>>()?;
        sections.push(Section { id: "fields", title: "Fields", blocks: vec![Block::Figures(figures)] });
    }
    sections.push(motion(scenario, traces, full, time));
    sections.push(errors(source, scenario, traces, frames));
    let pictures = scenario.rig.pictures().into_iter();
    let certificate: Figures = pictures
        .filter_map(|picture| if let rig::Picture::Lyapunov(lyapunov) = picture { Some(lyapunov) } else { None })
        .flat_map(|lyapunov| lyapunov_figures(&lyapunov, traces, time, tick_s))
        .collect();
    if !certificate.is_empty() {
        let blocks = vec![Block::Figures(certificate)];
        sections.push(Section { id: "lyapunov", title: "V and its bound", blocks });
    }
    Ok(sections)
}

/// Draws a field, such as `leader/estimate.omega_rad_s`, or one of its elements, such as `leader/estimate.omega_rad_s[2]`.
fn field(name: &str, traces: &Traces, frames: &Frames<'_>, tick_s: f64) -> Result<(Picture, String), ReportError> {
    let lines: Vec<(&Key, &Columns<Extremes>)> = traces.named(name).collect();
    let Some((key, _)) = lines.first() else {
        return Err(ReportError::Field { name: name.to_owned(), known: traces.names() });
    };
    let y = Axis::around(&key.2, range(lines.iter().map(|(_, columns)| *columns), false));
    let line = |(place, (key, columns)): (usize, &(&Key, &Columns<Extremes>))| {
        let label = format!("{}[{}]", key.2, key.3);
        Line::over_time(COMPONENTS[place % COMPONENTS.len()], &label, columns, tick_s)
    };
    let lines: Vec<Line> = lines.iter().enumerate().map(line).collect();
    let caption = format!("{name}; the suffix of a field's name is its unit.");
    Ok((over_time_in(frames.whole, name, frames.time, &y, &lines), caption))
}

fn motion(scenario: &Scenario, traces: &Traces, full: Option<&Traces>, time: &Axis) -> Section {
    let tick_s = scenario.tick_s();
    let mut figures = Vec::new();
    for picture in scenario.rig.pictures() {
        match picture {
            rig::Picture::Plane(plane) => figures.extend(plane_figure(&plane, traces, full)),
            rig::Picture::Graph(graph) => figures.extend(graph_figure(&graph, traces, full, time, tick_s)),
            rig::Picture::Inputs(inputs) => figures.extend(input_figures(&inputs, traces, time, tick_s)),
            rig::Picture::Lyapunov(_) | rig::Picture::Onset => {}
        }
    }
    let mut blocks = vec![Block::Text(decimation(traces, scenario.tick_s()))];
    blocks.extend(unseen(traces));
    let hidden = traces.bodies.len().saturating_sub(BODIES_SHOWN + 1);
    if hidden > 0 {
        blocks.push(Block::Text(format!("{hidden} more bodies are scored but not drawn.")));
    }
    if scenario.rig.bodies().iter().any(|body| body.fleet.is_some()) {
        blocks.push(Block::Text("A fleet is drawn as a band from its smallest to its largest value.".to_owned()));
    }
    blocks.push(Block::Figures(figures));
    Section { id: "motion", title: "Motion", blocks }
}

/// Explains the grey bands of the charts over time, if there are any.
fn unseen(traces: &Traces) -> Option<Block> {
    let names: Vec<&str> = traces.unseen.keys().copied().collect();
    let text =
        format!("Grey bands mark intervals in which the estimate reported a degraded status: {}.", names.join(", "));
    (!names.is_empty()).then_some(Block::Text(text))
}

/// Describes how many ticks a column of a chart contains.
fn decimation(traces: &Traces, tick_s: f64) -> String {
    let stride = traces.values.values().map(Columns::stride).max().unwrap_or(1);
    let ticks = traces.ticks.map_or(0, |(first, last)| last - first + 1);
    if stride == 1 {
        return format!("All {ticks} ticks are drawn.");
    }
    let span = stride as f64 * tick_s;
    format!(
        "{ticks} ticks are drawn in columns of {stride} ({span} s). A column spans its smallest to its largest value, so \
         the charts show every peak."
    )
}

fn present<'a>(
    lines: impl IntoIterator<Item = Option<(&'a Columns<Extremes>, Line)>>,
) -> (Vec<&'a Columns<Extremes>>, Vec<Line>) {
    lines.into_iter().flatten().unzip()
}

/// Returns the drawn bodies after the first, with the names of their observers and the line classes of their estimates.
fn further_observed(traces: &Traces) -> impl Iterator<Item = (&String, String, &'static str)> {
    let bodies = traces.bodies.iter().enumerate().skip(1).zip(OBSERVERS);
    bodies.map(|((index, body), class)| (body, observer_name(index, body), class))
}

/// Draws the paths of all bodies and observers in a plane.
fn paths(traces: &Traces, name: &'static str) -> Vec<Line> {
    let path = |owner: &str, class, label: &str| {
        traces.paths.get(&(owner.to_owned(), name)).map(|columns| Line::path(class, label, columns))
    };
    let followers = traces.bodies.iter().skip(1).zip(FOLLOWERS).map(|(body, class)| path(body, class, body));
    let leader = traces.bodies.first().map(String::as_str).unwrap_or_default();
    let estimates = further_observed(traces).map(|(_, name, class)| path(&name, class, &name));
    let first = [path(leader, "k d0", leader), path("observer", "b d1", "observer")];
    followers.chain(estimates).chain(first).flatten().collect()
}

/// Draws a plane with all paths, or with the path of the observed body and its reference.
fn plane_figure(view: &rig::Plane, traces: &Traces, full: Option<&Traces>) -> Option<(Picture, String)> {
    let path = |traces: &Traces, class, label: &str| {
        let body = traces.bodies.first().cloned().unwrap_or_default();
        traces.paths.get(&(body, view.title)).map(|columns| Line::path(class, label, columns))
    };
    let (lines, caption) = match (full, view.compared) {
        (Some(full), Some(caption)) => {
            let both = [path(full, "k d0", COMPARED), path(traces, "b d1", OBSERVED)];
            (both.into_iter().flatten().collect(), caption)
        }
        _ => (paths(traces, view.title), view.caption),
    };
    (!lines.is_empty()).then(|| (plane(view.title, view.axes, &lines, view.centred), caption.to_owned()))
}

/// Draws an element of a field over time: of every body, of the estimates and of the reference run.
fn graph_figure(
    graph: &rig::Graph,
    traces: &Traces,
    full: Option<&Traces>,
    time: &Axis,
    tick_s: f64,
) -> Option<(Picture, String)> {
    let line = |class, label: &str, columns| (columns, Line::over_time(class, label, columns, tick_s));
    let first = traces.bodies.first().map(String::as_str).unwrap_or_default();
    let own_classes = if full.is_some() { ["b d1", "s d2"] } else { ["k d0", "b d1"] };
    let own_label = if full.is_some() { OBSERVED } else { first };
    let compared = full.and_then(|full| full.get(first, "truth", graph.field, graph.element));
    let compared = compared.map(|columns| line("k d0", COMPARED, columns));
    let followers = traces.bodies.iter().skip(1).zip(FOLLOWERS).map(|(body, class)| {
        traces.get(body, "truth", graph.field, graph.element).map(|columns| line(class, body, columns))
    });
    let estimates = further_observed(traces).map(|(body, name, class)| {
        traces.get(body, "estimate", graph.field, graph.element).map(|columns| line(class, &name, columns))
    });
    let own = traces.get(first, "truth", graph.field, graph.element);
    let own = own.map(|columns| line(own_classes[0], own_label, columns));
    let estimate = traces.get(first, "estimate", graph.field, graph.element);
    let estimate = estimate.map(|columns| line(own_classes[1], "observer", columns));
    // The measurement is drawn only if it differs from the truth.
    let measured = traces.get(first, "measurement", graph.field, graph.element);
    let truth = own.as_ref().map(|(columns, _)| *columns);
    let noisy = measured.filter(|measured| truth.is_some_and(|truth| !same(measured, truth)));
    let noisy = noisy.map(|columns| line("grey d0 thin", "measured", columns));
    // A known constant without a truth is not drawn.
    let learned = estimate
        .as_ref()
        .is_none_or(|(columns, _)| truth.is_some() || range([*columns], false).0 < range([*columns], false).1);
    if !learned {
        return None;
    }
    let (columns, lines) =
        present([noisy].into_iter().chain(followers).chain(estimates).chain([compared, own, estimate]));
    let y = Axis::around(&graph.axis, range(columns, false));
    (!lines.is_empty()).then(|| (over_time(&graph.title, time, &y, &lines), graph.caption.clone()))
}

/// Returns true if both signals are equal wherever the first has values.
fn same(a: &Columns<Extremes>, b: &Columns<Extremes>) -> bool {
    a.iter().zip(b.iter()).all(|((_, a), (_, b))| a.is_empty() || a == b)
}

/// Draws the commands of each driven body, as they were asked for and as they acted.
fn input_figures(inputs: &rig::Inputs, traces: &Traces, time: &Axis, tick_s: f64) -> Figures {
    let mut figures = Vec::new();
    let (signal, applied) = inputs.applied;
    for body in traces.bodies.iter().take(BODIES_SHOWN + 1) {
        let component = |(element, name): (usize, &String)| {
            let line = |class, label: String, columns| (columns, Line::over_time(class, &label, columns, tick_s));
            let [strong, fine] = COMMANDS[element % COMMANDS.len()];
            // An undriven body has none.
            let asked = traces.get(body, Signal::Command.name(), inputs.field, element)?;
            let applied = traces.get(body, signal.name(), applied, element);
            let applied = applied.map(|columns| line(strong, format!("{name} applied"), columns));
            Some([applied, Some(line(fine, format!("{name} asked for"), asked))])
        };
        let (columns, lines) = present(inputs.components.iter().enumerate().filter_map(component).flatten());
        let (low, high) = range(columns, false);
        if low < 0.0 || high > 0.0 {
            let title = format!("control of {body} over time");
            let picture = over_time(&title, time, &Axis::around(&inputs.axis, (low, high)), &lines);
            let caption = format!(
                "Commands for {body}: as the controller asked for them at each tick, and as the body reports that they act from each \
                 tick on."
            );
            figures.push((picture, caption));
        }
    }
    figures
}

/// Groups metrics by unit, in the order in which the units occur.
pub fn by_unit<T>(metrics: impl IntoIterator<Item = T>, name: impl Fn(&T) -> &str) -> Vec<(String, Vec<T>)> {
    let mut units: Vec<(String, Vec<T>)> = Vec::new();
    for metric in metrics {
        let (_, unit) = rig::named(name(&metric));
        match units.iter_mut().find(|(known, _)| *known == unit) {
            Some((_, metrics)) => metrics.push(metric),
            None => units.push((unit, vec![metric])),
        }
    }
    units
}

/// Returns the logarithmic axis of errors in a unit, and the title of their chart.
pub fn error_axis<'a>(unit: &str, all: impl IntoIterator<Item = &'a Columns<Extremes>>) -> (Axis, String) {
    let (low, high) = range(all, true);
    let (label, title) = match unit {
        "" => ("error".to_owned(), "errors".to_owned()),
        unit => (format!("error, {unit}"), format!("errors in {unit}")),
    };
    (Axis::decades(&label, (low.max(ERROR_FLOOR), high.max(ERROR_FLOOR))), title)
}

fn errors(source: &Source, scenario: &Scenario, traces: &Traces, frames: &Frames<'_>) -> Section {
    let has_values = |metric: &&MetricTrace| metric.values.iter().any(|(_, extremes)| !extremes.is_empty());
    let shown: Vec<&MetricTrace> = traces.metrics.iter().filter(has_values).collect();
    let rates = rates(scenario, &shown);
    let end_s = traces.ticks.map_or(0.0, |(_, last)| last as f64 * scenario.tick_s());
    let figures = by_unit(shown, |metric| metric.name)
        .into_iter()
        .flat_map(|(unit, shown)| errors_in(&unit, &shown, &rates, scenario, end_s, frames));
    let blocks = unseen(traces).into_iter().chain(figures).chain([rescored(source, traces)]).collect();
    Section { id: "errors", title: "Errors", blocks }
}

/// Draws the errors of one unit over time, and over the logarithm of time if the rig requests it.
fn errors_in(
    unit: &str,
    shown: &[&MetricTrace],
    rates: &[Rate],
    scenario: &Scenario,
    end_s: f64,
    frames: &Frames<'_>,
) -> Vec<Block> {
    let tick_s = scenario.tick_s();
    let (y, title) = error_axis(unit, shown.iter().map(|metric| &metric.values));
    let line =
        |(metric, class): (&&MetricTrace, &'static str)| Line::over_time(class, metric.name, &metric.values, tick_s);
    let mut lines: Vec<Line> = shown.iter().zip(COMPONENTS.into_iter().cycle()).map(line).collect();
    lines.extend(limits(scenario, shown, end_s));
    let mut early = lines.clone();
    let falling: Vec<Line> = rates.iter().filter_map(|rate| rate.line(shown, y.foot(), end_s)).collect();
    let mut caption = "Errors at every tick. Zeros are drawn at the bottom.".to_owned();
    if !falling.is_empty() {
        caption += " A straight grey line is the decay rate of small errors, drawn from the first error on.";
    }
    lines.extend(falling);
    let picture = over_time_in(frames.whole, &format!("{title} over time, logarithmic"), frames.time, &y, &lines);
    let mut figures = vec![Block::Figures(vec![(picture, caption)])];
    let onset = scenario.rig.pictures().iter().any(|picture| matches!(picture, rig::Picture::Onset));
    if onset && end_s > tick_s {
        // Tick 0 is drawn at the first tick, since a logarithmic axis has no zero.
        let later = |(at, value): &(f64, f64)| (at.max(tick_s), *value);
        early.iter_mut().flat_map(|line| &mut line.parts).for_each(|part| *part = part.iter().map(later).collect());
        let (title, time) = (format!("{title} over the logarithm of time"), Axis::log_time(tick_s, end_s));
        let caption = "The same errors over the logarithm of time, which shows the first ticks in detail.";
        figures
            .push(Block::Figures(vec![(over_log_time(&title, &time, &y, &early, frames.changes), caption.to_owned())]));
    }
    figures
}

/// A predicted decay rate of a metric.
struct Rate {
    metric: &'static str,
    class: &'static str,
    label: &'static str,
    per_s: f64,
}

/// Returns the claimed rate of the loop for the first metric, and the observer's rate for the estimation error.
fn rates(scenario: &Scenario, shown: &[&MetricTrace]) -> Vec<Rate> {
    let rates: Vec<Option<f64>> = claims(scenario).iter().map(|claim| claim.loop_rate_per_s).collect();
    // The metric is that of the worst body, so a rate is drawn only if every body has one.
    let claimed =
        rates.iter().copied().collect::<Option<Vec<f64>>>().and_then(|rates| rates.into_iter().reduce(f64::min));
    let estimate = shown.iter().find(|metric| metric.name.starts_with("estimate_error"));
    let both =
        [("grey d2", "loop", claimed, shown.first()), ("grey d4", "observer", observer_rate(scenario), estimate)];
    let rate = |(class, label, per_s, metric): (&'static str, &'static str, Option<f64>, Option<&&MetricTrace>)| {
        let per_s = per_s.filter(|rate| rate.is_finite() && *rate > 0.0)?;
        Some(Rate { metric: metric?.name, class, label, per_s })
    };
    both.into_iter().filter_map(rate).collect()
}

impl Rate {
    /// Returns a line with this decay rate from the first error on, if its metric is shown.
    fn line(&self, shown: &[&MetricTrace], foot: f64, end_s: f64) -> Option<Line> {
        let metric = shown.iter().find(|metric| metric.name == self.metric)?;
        let from = metric.values.iter().find(|(_, extremes)| !extremes.is_empty())?.1.first;
        let to_s = ((from / foot).ln() / self.per_s).min(end_s);
        let end = (to_s, from * (-self.per_s * to_s).exp());
        let label = format!("{}: exp(−{} t)", self.label, digits(self.per_s));
        (to_s > 0.0).then(|| Line::through(self.class, &label, vec![(0.0, from), end]))
    }
}

/// Returns the limits of `[accept]` as lines that begin at the time from which they apply.
fn limits(scenario: &Scenario, shown: &[&MetricTrace], end_s: f64) -> Vec<Line> {
    const SETTLED: [&str; 4] = ["limit o d1", "limit b d1", "limit g d1", "limit p d1"];
    const DECLARED: [&str; 4] = ["limit o d2", "limit b d2", "limit g d2", "limit p d2"];
    let accept = &scenario.accept;
    let kinds = [
        ("limit of", &accept.metric_max, accept.settled_by_s, SETTLED),
        ("declared bound of", &accept.metric_peak, accept.peak_from_s, DECLARED),
    ];
    let mut lines = Vec::new();
    for (kind, limits, from_s, classes) in kinds {
        for (metric, class) in shown.iter().zip(classes.into_iter().cycle()) {
            if let Some(limit) = limits.get(metric.name).filter(|_| from_s < end_s) {
                let label = format!("{kind} {}", metric.name);
                lines.push(Line::through(class, &label, vec![(from_s, *limit), (end_s, *limit)]));
            }
        }
    }
    lines
}

/// The design decay rate of the first-order observer, 1/s; the slower one if there are two.
fn observer_rate(scenario: &Scenario) -> Option<f64> {
    let value = scenario.resolved.get("observer")?.get("decay_rate_per_s")?;
    let rates = value.as_array().cloned().unwrap_or_else(|| vec![value.clone()]);
    rates.iter().filter_map(toml::Value::as_float).reduce(f64::min)
}

/// Returns the table of metrics, from the recording and from the run.
fn rescored(source: &Source, traces: &Traces) -> Block {
    let number = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.4e}"));
    let row = |metric: &MetricTrace| {
        let metrics = source.summary.iter().flat_map(|summary| &summary.score.metrics);
        let scored = metrics.into_iter().find(|scored| scored.name == metric.name);
        vec![
            metric.name.to_owned(),
            number(Some(metric.last).filter(|last| !last.is_nan())),
            number(scored.map(|scored| scored.last).filter(|last| last.is_finite())),
            number(metric.settled_max),
            number(scored.and_then(|scored| scored.settled_max)),
            number(scored.and_then(|scored| scored.peak)),
            scored.and_then(|scored| scored.settled_at_s).map_or("–".to_owned(), digits),
        ]
    };
    let head = vec![
        "metric",
        "at the end (recording)",
        "at the end (run)",
        "largest settled (recording)",
        "largest settled (run)",
        "peak (run)",
        "within limit from, s",
    ];
    let caption = format!("Metrics ({} ticks with all samples)", traces.scored_ticks);
    Block::table(&caption, head, traces.metrics.iter().map(row).collect())
}

fn lyapunov_figures(lyapunov: &rig::Lyapunov, traces: &Traces, time: &Axis, tick_s: f64) -> Figures {
    let mut figures = Vec::new();
    let bodies = traces.bodies.iter().skip(1).zip(COMPONENTS);
    let v = bodies.filter_map(|(body, class)| {
        let columns = traces.get(body, "command", lyapunov.field, 0)?;
        Some((columns, Line::over_time(class, body, columns, tick_s)))
    });
    let (columns, lines): (Vec<_>, Vec<_>) = v.unzip();
    let (low, high) = range(columns, true);
    if high > 0.0 {
        let y = Axis::decades(lyapunov.axes[0], (low.max(LYAPUNOV_FLOOR), high.max(LYAPUNOV_FLOOR)));
        let caption = format!("{}, computed by the controller from the estimate.", lyapunov.function);
        figures.push((over_time("V over time, logarithmic", time, &y, &lines), caption));
    }
    for (body, [fell, bound]) in &traces.falls {
        let (low, high) = range([bound], true);
        let y = Axis::decades(lyapunov.axes[1], (low.max(LYAPUNOV_FLOOR), high.max(LYAPUNOV_FLOOR)));
        let lines = [
            Line::over_time("o d0", "measured, tick to tick", fell, tick_s),
            Line::over_time("k d1", "bound", bound, tick_s),
        ];
        let caption = format!(
            "Decay rate of V of {body}, and its lower limit, {}: the certificate holds where the measured rate is at least \
             the limit. Drawn while V exceeds rounding errors. Where V rose, the rate is drawn at the bottom.",
            lyapunov.bound
        );
        figures.push((over_time("decay rate of V and its bound", time, &y, &lines), caption));
    }
    figures
}

/// Builds the section with the lateness of every role over time.
pub fn lateness(source: &Source, traces: &Traces, time: &Axis) -> Section {
    let tick_s = source.scenario.as_ref().map_or(0.0, |scenario| scenario.tick_s());
    let has_values = |row: &&super::traces::RoleTrace| row.lateness_us.iter().next().is_some();
    let rows: Vec<(String, &Columns<Extremes>)> =
        traces.roles.iter().filter(has_values).map(|row| (row.role.clone(), &row.lateness_us)).collect();
    let early = traces.roles.iter().filter(|row| row.early.0 > 0).map(|row| {
        let (samples, us) = row.early;
        Block::Text(format!(
            "{samples} samples of {} have stamps up to {us:.1} µs before their due time, so the role has another clock. \
             They are not drawn.",
            row.role
        ))
    });
    let early: Vec<Block> = early.collect();
    if rows.is_empty() {
        let text = "Lateness exists only with clock = \"realtime\": other clocks have no due times.";
        let blocks = if early.is_empty() { vec![Block::Text(text.to_owned())] } else { early };
        return Section { id: "lateness", title: "Lateness over time", blocks };
    }
    let shade = |extremes: &Extremes| (!extremes.is_empty()).then(|| extremes.max.max(1.0).log10() / SHADE_DECADES);
    let picture = strip("lateness of every role over time", time, &rows, tick_s, shade);
    let caption = "Time from the due time of a tick until the role sent its sample: the largest value in each column. Columns \
                   without samples are blank.";
    let scale = (0..SHADES).map(|index| {
        let from = |index: usize| 10_f64.powf(SHADE_DECADES * index as f64 / SHADES as f64);
        if index + 1 == SHADES {
            format!("from {:.0} µs", from(index))
        } else {
            format!("{:.0}–{:.0} µs", from(index), from(index + 1))
        }
    });
    let mut blocks = vec![Block::Figures(vec![(picture, caption.to_owned())]), Block::Scale(scale.collect())];
    blocks.extend(early);
    Section { id: "lateness", title: "Lateness over time", blocks }
}
