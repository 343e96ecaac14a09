//! The responses to steps of inputs: a chart of set point, response and command for each, and the table of their figures.
//!
//! Two runs are compared step by step. Must not compute a figure: the run did.

use super::axis::Axis;
use super::chart::{Picture, range};
use super::columns::{Columns, Extremes};
use super::frame::Line;
use super::inputs::{self, ROWS, RunView, shortened};
use super::model::{Block, Section};
use super::panels::{Plot, panels};
use super::source::Source;
use super::windows::WindowTrace;
use crate::analysis::digits;
use crate::rig::named;
use crate::score::StepResponse;

/// The largest number of responses that are drawn.
const CHARTS: usize = 6;
/// The classes of response and command, by run: the first is thin and solid, the second wide and dashed.
const RESPONSE: [&str; 2] = ["b d0", "b d1 wide"];
const COMMAND: [&str; 2] = ["o d0", "o d1 wide"];
const SET_POINT: &str = "k d2";

/// The responses of the runs to the same step; `None` for a run without this step.
type Group<'a> = Vec<Option<&'a StepResponse>>;

/// Returns the steps of each run whose responses are drawn.
pub fn drawn(sources: &[&Source]) -> Vec<Vec<StepResponse>> {
    let lists: Vec<&[StepResponse]> = sources.iter().map(|source| source.responses()).collect();
    let groups = groups(&lists);
    let steps = |run: usize| groups.iter().take(CHARTS).filter_map(|group| group[run].cloned()).collect();
    (0..lists.len()).map(steps).collect()
}

/// Groups the responses of all runs by their step: at the same time if possible, otherwise in the order of time.
fn groups<'a>(lists: &[&'a [StepResponse]]) -> Vec<Group<'a>> {
    let alone = |run: usize, response: &'a StepResponse| {
        (0..lists.len()).map(|place| (place == run).then_some(response)).collect::<Group<'a>>()
    };
    let Some((first, rest)) = lists.split_first() else { return Vec::new() };
    let mut groups: Vec<Group<'a>> = first.iter().map(|response| alone(0, response)).collect();
    for (run, list) in (1..).zip(rest) {
        let mut unmatched: Vec<&StepResponse> = list.iter().collect();
        for at_the_same_time in [true, false] {
            unmatched.retain(|response| {
                let same = |group: &&mut Group<'a>| {
                    group[run].is_none()
                        && group[0].is_some_and(|first| {
                            is_same_step(first, response) && (!at_the_same_time || first.time_s == response.time_s)
                        })
                };
                let group = groups.iter_mut().find(same);
                group.map(|group| group[run] = Some(response)).is_none()
            });
        }
        groups.extend(unmatched.into_iter().map(|response| alone(run, response)));
    }
    let time_s = |group: &Group<'_>| group.iter().flatten().map(|response| response.time_s).next().unwrap_or(0.0);
    groups.sort_by(|a, b| time_s(a).total_cmp(&time_s(b)));
    groups
}

/// Returns true if the same component of an input steps between the same values.
fn is_same_step(a: &StepResponse, b: &StepResponse) -> bool {
    (&a.key, a.component, a.from, a.to) == (&b.key, b.component, b.from, b.to)
}

/// Builds the section with the changes of inputs and the responses of one run, or of two side by side.
pub fn section(runs: &[RunView<'_>]) -> Section {
    let blocks = inputs::blocks(runs).into_iter().chain(blocks(runs)).collect();
    Section { id: "inputs", title: "Changes of inputs", blocks }
}

/// Returns the charts and the table of the responses.
fn blocks(runs: &[RunView<'_>]) -> Vec<Block> {
    let lists: Vec<&[StepResponse]> = runs.iter().map(|run| run.source.responses()).collect();
    let groups = groups(&lists);
    let figures: Vec<(Picture, String)> = groups.iter().take(CHARTS).filter_map(|group| figure(group, runs)).collect();
    let mut blocks = Vec::new();
    if !figures.is_empty() {
        let (drawn, all) = (figures.len(), groups.len());
        let text = "Responses to steps, until the next change of an input or the end";
        let part = if drawn < all { format!(": the first {drawn} of {all}") } else { String::new() };
        blocks.extend([Block::Text(format!("{text}{part}.")), Block::Figures(figures)]);
    }
    blocks.extend(table(&groups, runs));
    blocks
}

/// Returns the table of the figures of all responses, with a row for each run.
fn table(groups: &[Group<'_>], runs: &[RunView<'_>]) -> Vec<Block> {
    let several = runs.len() > 1;
    let rows = groups.iter().flat_map(|group| {
        let responses = group.iter().zip(runs).filter_map(|(response, run)| Some((run, (*response)?)));
        responses.map(move |(run, response)| row(response, several.then_some(run.name)))
    });
    let rows: Vec<Vec<String>> = rows.collect();
    let count = rows.len();
    let figures =
        ["at, s", "rise time, s", "overshoot, %", "settling time, s", "steady-state error", "peak of the command"];
    let head = ["input", "step"].into_iter().chain(several.then_some("run")).chain(figures);
    let caption = "Responses to steps; the steady-state error has the unit of the response";
    let table = Block::table(caption, head.collect(), rows.into_iter().take(ROWS).collect());
    shortened(table, count, "responses")
}

fn row(response: &StepResponse, run: Option<&str>) -> Vec<String> {
    let number = |value: Option<f64>| value.filter(|value| value.is_finite()).map_or("–".to_owned(), digits);
    let rounded = |value: f64| format!("{value:.3e}");
    let mut row = vec![name(response), step(response)];
    row.extend(run.map(str::to_owned));
    row.extend([
        digits(response.time_s),
        number(response.rise_time_s),
        response.overshoot.map_or("–".to_owned(), |part| format!("{:.1}", 100.0 * part)),
        number(response.settling_time_s),
        Some(response.steady_state_error).filter(|error| error.is_finite()).map_or("–".to_owned(), rounded),
        response.command_max.map_or("–".to_owned(), rounded),
    ]);
    row
}

/// Returns the name of the component that steps.
fn name(response: &StepResponse) -> String {
    format!("{}[{}]", response.key, response.component)
}

fn step(response: &StepResponse) -> String {
    format!("{} → {}", digits(response.from), digits(response.to))
}

/// Draws set point, response and command of all runs over the time after the step.
fn figure(group: &Group<'_>, runs: &[RunView<'_>]) -> Option<(Picture, String)> {
    let windows: Vec<(&RunView<'_>, usize, &WindowTrace)> = group
        .iter()
        .zip(runs)
        .enumerate()
        .filter_map(|(place, (response, run))| Some((run, place, window(run, (*response)?)?)))
        .collect();
    let &(first_run, _, first) = windows.first()?;
    let ends = windows.iter().map(|(.., window)| window.ends_s());
    let [from_s, to_s] = ends.reduce(|[from, to], next| [from.min(next[0]), to.max(next[1])])?;
    let x = Axis::linear("time after the step, s", from_s, to_s);
    let own = |classes: [&'static str; 2], what: &str, columns: fn(&WindowTrace) -> &Columns<Extremes>| {
        let label = |run: &RunView<'_>| if runs.len() > 1 { format!("{what}, {}", run.name) } else { what.to_owned() };
        let line = |(run, place, window): &(&RunView<'_>, usize, &WindowTrace)| {
            window.line(classes[*place % classes.len()], &label(run), columns(window))
        };
        windows.iter().map(line).filter(|line| !line.parts.is_empty()).collect::<Vec<Line>>()
    };
    let responses = own(RESPONSE, "response", |window| &window.response);
    let commands = own(COMMAND, "command", |window| &window.command);
    if responses.is_empty() {
        return None;
    }
    let all = |columns: fn(&WindowTrace) -> &Columns<Extremes>| windows.iter().map(move |(.., trace)| columns(trace));
    let upper = range(all(|window| &window.response).chain(all(|window| &window.set_point)), false);
    let lines = std::iter::once(first.set_point_line(SET_POINT, "set point")).chain(responses).collect();
    let upper = Plot { y: axis("response", first.field.field, upper), lines };
    let lower = first.field.command.filter(|_| !commands.is_empty()).map(|field| {
        let y = axis("command", field, range(all(|window| &window.command), false)).sparse();
        Plot { y, lines: commands }
    });
    let title = format!("response to a step of {}, {}", name(&first.step), step(&first.step));
    Some((panels(&title, &x, &upper, lower.as_ref()), caption(first_run, first, &windows)))
}

/// Returns the traced window of a response.
fn window<'a>(run: &RunView<'a>, response: &StepResponse) -> Option<&'a WindowTrace> {
    let place = |step: &StepResponse| (step.tick, step.component);
    let same = |trace: &&WindowTrace| place(&trace.step) == place(response) && trace.step.key == response.key;
    run.traces?.windows.iter().find(same)
}

/// Returns the axis of a field, with its unit.
fn axis(what: &str, field: &str, values: (f64, f64)) -> Axis {
    let (_, unit) = named(field);
    let label = if unit.is_empty() { what.to_owned() } else { format!("{what}, {unit}") };
    Axis::around(&label, values)
}

/// Names the step, and the fields that are drawn.
fn caption(run: &RunView<'_>, window: &WindowTrace, windows: &[(&RunView<'_>, usize, &WindowTrace)]) -> String {
    let times: Vec<String> = windows.iter().map(|(.., window)| digits(window.step.time_s)).collect();
    let at = if times.iter().all(|time| *time == times[0]) { times[0].clone() } else { times.join(" and ") };
    let bodies = run.source.scenario.as_ref().map_or(&[][..], |scenario| scenario.rig.bodies());
    let body = |index: usize| bodies.get(index).map_or(String::new(), |body| body.name.to_string());
    let field = &window.field;
    let relative = if field.relative { format!(" relative to {}", body(0)) } else { String::new() };
    let command = field.command.map_or(String::new(), |command| format!("; command: {command}"));
    format!(
        "{}, {} at {at} s. Response: {} of {}{relative}{command}.",
        name(&window.step),
        step(&window.step),
        field.field,
        body(field.body)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn response(key: &str, tick: u64, to: f64) -> StepResponse {
        StepResponse {
            key: key.to_owned(),
            component: 1,
            tick,
            time_s: tick as f64,
            from: 0.0,
            to,
            over_s: 1.0,
            rise_time_s: None,
            overshoot: None,
            settling_time_s: None,
            steady_state_error: 0.0,
            deviation_max: 0.0,
            command_max: None,
        }
    }

    #[test]
    fn steps_of_two_runs_are_matched_by_time_and_then_in_their_order() {
        let a = [response("x", 1, 1.0), response("x", 3, 1.0), response("y", 4, 1.0)];
        let b = [response("x", 2, 1.0), response("x", 3, 1.0), response("y", 4, 2.0), response("x", 9, 1.0)];
        let groups = groups(&[&a, &b]);
        let ticks: Vec<Vec<Option<u64>>> =
            groups.iter().map(|group| group.iter().map(|response| response.map(|r| r.tick)).collect()).collect();
        let expected = [[Some(1), Some(2)], [Some(3), Some(3)], [Some(4), None], [None, Some(4)], [None, Some(9)]];
        assert_eq!(ticks, expected);
        assert_eq!(super::groups(&[&a]).len(), 3);
        assert!(super::groups(&[&[], &[]]).is_empty());
    }
}
