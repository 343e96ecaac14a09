//! The responses to steps of inputs, tick by tick: set point, response and command in columns.
//!
//! Must not judge a response: its figures come from the summary.

use super::columns::{Columns, Extremes};
use super::frame::Line;
use crate::config::{ResponseField, set_point_of};
use crate::input::{Course, Values};
use crate::record::Recording;
use crate::sample::FieldKind;
use crate::scenario::Scenario;
use crate::score::StepResponse;

/// A window begins this part of its length before the step.
const BEFORE: u64 = 20;

/// The response to a step over its window.
#[derive(Debug)]
pub struct WindowTrace {
    pub step: StepResponse,
    pub field: ResponseField,
    pub set_point: Columns<Extremes>,
    pub response: Columns<Extremes>,
    pub command: Columns<Extremes>,
    tick_s: f64,
    /// The first and last tick.
    ticks: (u64, u64),
    target: Target,
    own: Option<Place>,
    /// The field of body 0 from which the response is measured; `None` if the response is absolute.
    leader: Option<Place>,
    applied: Option<Place>,
}

/// A number in the truth of a body: the index of the body and of the word.
#[derive(Debug, Clone, Copy)]
struct Place {
    body: usize,
    word: usize,
}

/// The set point of a response; constantly zero without an input.
#[derive(Debug)]
struct Target {
    /// The courses until the step and from it on.
    courses: Option<[Course; 2]>,
    element: usize,
}

/// Prepares the windows of steps. Leaves out steps of inputs that the scenario does not have.
pub fn windows(steps: &[StepResponse], scenario: &Scenario, recording: &Recording) -> Vec<WindowTrace> {
    steps.iter().filter_map(|step| WindowTrace::new(step, scenario, recording)).collect()
}

impl WindowTrace {
    fn new(step: &StepResponse, scenario: &Scenario, recording: &Recording) -> Option<Self> {
        let inputs = &scenario.inputs;
        let (number, info) = inputs.find(&step.key).ok()?;
        let (field, component) = (info.response?, step.component.checked_sub(1)?);
        let tick_s = scenario.tick_s();
        let length = ((step.over_s / tick_s).round() as u64).max(1);
        let lists = inputs.lists();
        // The courses before the step hold from the last change on.
        let changed = lists.all().iter().map(|(change, _)| change.tick).filter(|tick| *tick < step.tick).max();
        let first = step.tick.saturating_sub((length / BEFORE).max(1)).max(changed.unwrap_or(0));
        let element = field.element.unwrap_or(component);
        let (input, target) = match field.disturbs {
            true => (set_point_of(&inputs.infos, info), element),
            false => (Some(number), component),
        };
        let course = |input: usize, tick: u64| lists.courses_at(&inputs.infos, tick).get(input).copied();
        let courses =
            input.and_then(|input| Some([course(input, step.tick.saturating_sub(1))?, course(input, step.tick)?]));
        let place = |body, name, element| place(scenario, recording, body, name, element);
        Some(Self {
            step: step.clone(),
            field,
            set_point: Columns::default(),
            response: Columns::default(),
            command: Columns::default(),
            tick_s,
            ticks: (first, step.tick.saturating_add(length - 1)),
            target: Target { courses, element: target },
            own: place(field.body, field.field, element),
            leader: field.relative.then(|| place(0, field.field, element)).flatten(),
            applied: field.command.and_then(|command| place(field.body, command, component)),
        })
    }

    /// Takes the values of a tick, if the window has it. `truth` returns the truth of a body, if its sample is present.
    pub fn take<'a>(&mut self, tick: u64, truth: impl Fn(usize) -> Option<&'a [u64]>) {
        let (first, last) = self.ticks;
        if !(first..=last).contains(&tick) {
            return;
        }
        let number = |place: Place| truth(place.body)?.get(place.word).map(|bits| f64::from_bits(*bits));
        let at = tick - first;
        self.set_point.at(at).take(self.target.value(tick, self.step.tick));
        let leader = if self.field.relative { self.leader.and_then(number) } else { Some(0.0) };
        if let Some((own, leader)) = self.own.and_then(number).zip(leader) {
            self.response.at(at).take(own - leader);
        }
        if let Some(command) = self.applied.and_then(number) {
            self.command.at(at).take(command);
        }
    }

    /// Returns the times of the first and last tick after the step, s.
    pub fn ends_s(&self) -> [f64; 2] {
        let (first, last) = self.ticks;
        [first, last].map(|tick| (tick as f64 - self.step.tick as f64) * self.tick_s)
    }

    /// Returns the set point as a line over the time after the step. It is constant from tick to tick.
    pub fn set_point_line(&self, class: &'static str, label: &str) -> Line {
        let mut line = self.line(class, label, &self.set_point);
        for part in &mut line.parts {
            let corners = part.windows(2).flat_map(|pair| [(pair[1].0, pair[0].1), pair[1]]);
            *part = part.first().copied().into_iter().chain(corners).collect();
        }
        line
    }

    /// Returns one of the signals as a line over the time after the step.
    pub fn line(&self, class: &'static str, label: &str, columns: &Columns<Extremes>) -> Line {
        let mut line = Line::over_time(class, label, columns, self.tick_s);
        let [from_s, _] = self.ends_s();
        line.parts.iter_mut().flatten().for_each(|point| point.0 += from_s);
        line
    }
}

impl Target {
    fn value(&self, tick: u64, step: u64) -> f64 {
        let value = |values: Values| values.get(self.element).copied().unwrap_or(0.0);
        self.courses.map_or(0.0, |[before, after]| value(if tick < step { before } else { after }.at(tick)))
    }
}

/// Finds an element of a field in the truth of a single body.
fn place(scenario: &Scenario, recording: &Recording, body: usize, name: &str, element: usize) -> Option<Place> {
    let info = scenario.rig.bodies().get(body).filter(|info| info.fleet.is_none())?;
    let signal = recording.signals().iter().find(|signal| signal.body == info.name && signal.signal == "truth")?;
    let column = signal.layout.columns.iter().find(|column| column.name == name)?;
    let word = column.offset / size_of::<u64>() + element;
    (column.kind == FieldKind::F64 && element < column.count).then_some(Place { body, word })
}
