//! The responses to steps of set points and disturbances: rise time, overshoot, settling time, steady-state error, peak of the command.
//!
//! Must not decide whether a response is good; the scenario's criteria do.

use crate::config::{InputInfo, ResponseField};
use serde::{Deserialize, Serialize};

/// The most steps of a run whose responses are kept.
const RESPONSES_MAX: usize = 200;
/// The most ticks over which a response is observed.
const TICKS_MAX: usize = 200_000;
/// The band about the final value in which a response has settled, as a part of the step, or of the peak after a disturbance.
const SETTLED_PART: f64 = 0.02;
/// The parts of the step between which the rise time is measured.
const RISE: [f64; 2] = [0.1, 0.9];

/// The response of one component to a step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepResponse {
    /// The key of the input.
    pub key: String,
    /// The component, from 1.
    pub component: usize,
    /// The tick of the step, and its time from the first tick, s.
    pub tick: u64,
    /// See `tick`.
    pub time_s: f64,
    /// The value of the input before and after the step.
    pub from: f64,
    /// See `from`.
    pub to: f64,
    /// The time over which the response is observed, s: to the next change of an input, or the end.
    pub over_s: f64,
    /// The time from 10 % to 90 % of a set point's step, s; `None` for a disturbance, or if it is not reached.
    pub rise_time_s: Option<f64>,
    /// The largest excess over the new set point as a part of the step; for a disturbance `None`.
    pub overshoot: Option<f64>,
    /// The time from the step until the response stays within 2 % of the step, or of the largest deviation after a disturbance, s;
    /// `None` if it does not stay there.
    pub settling_time_s: Option<f64>,
    /// The distance from the set point at the end, in the unit of the set point; NaN, null in JSON, if every sample is missing.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub steady_state_error: f64,
    /// The largest distance from the set point, in its unit.
    pub deviation_max: f64,
    /// The largest magnitude of the actuators' command in this component, in its unit; `None` if the rig does not name it.
    pub command_max: Option<f64>,
}

/// The responses that a run observes.
#[derive(Debug, Default)]
pub struct Responses {
    observed: Vec<Observed>,
    finished: Vec<StepResponse>,
    tick_s: f64,
}

/// A response while it is observed.
#[derive(Debug)]
struct Observed {
    field: ResponseField,
    /// The input that stepped, and the values of one component before and after.
    key: String,
    component: usize,
    tick: u64,
    from: f64,
    to: f64,
    /// The set point, if the input is a disturbance.
    set_point: f64,
    /// The response at each tick, and the largest command.
    values: Vec<f64>,
    command_max: Option<f64>,
}

impl Responses {
    pub fn new(tick_s: f64) -> Self {
        Self { tick_s, ..Self::default() }
    }

    /// Ends the observation of all responses: an input changes.
    pub fn end(&mut self) {
        let finished = self.observed.drain(..).map(|observed| observed.finish(self.tick_s));
        self.finished.extend(finished);
    }

    /// Begins to observe the components of an input that step at a tick. `set_point` has the components of the set point that the
    /// response to a disturbance should keep.
    pub fn begin(&mut self, info: &InputInfo, tick: u64, (from, to): (&[f64], &[f64]), set_point: &[f64]) {
        let Some(field) = info.response else { return };
        for component in (0..info.initial.len()).filter(|component| from[*component] != to[*component]) {
            if self.observed.len() + self.finished.len() >= RESPONSES_MAX {
                return;
            }
            self.observed.push(Observed {
                field,
                key: info.key.clone(),
                component,
                tick,
                from: from[component],
                to: to[component],
                set_point: set_point.get(field.element.unwrap_or(component)).copied().unwrap_or(0.0),
                values: Vec::new(),
                command_max: None,
            });
        }
    }

    /// Returns true while some response is observed.
    #[inline]
    pub fn are_observed(&self) -> bool {
        !self.observed.is_empty()
    }

    /// Takes the values of one tick. `number` returns an element of a field of a body's truth; `None` if the sample is missing.
    pub fn take(&mut self, number: impl Fn(usize, &str, usize) -> Option<f64>) {
        for observed in self.observed.iter_mut().filter(|observed| observed.values.len() < TICKS_MAX) {
            let ResponseField { body, field, element, relative, command, .. } = observed.field;
            let element_or = element.unwrap_or(observed.component);
            let own = number(body, field, element_or);
            let reference = if relative { number(0, field, element_or) } else { Some(0.0) };
            observed.values.push(own.zip(reference).map_or(f64::NAN, |(own, reference)| own - reference));
            let command = command.and_then(|command| number(body, command, observed.component)).map(f64::abs);
            observed.command_max = observed.command_max.into_iter().chain(command).reduce(f64::max);
        }
    }

    /// Ends all observations and returns the responses in the order of their steps.
    pub fn finish(&mut self) -> Vec<StepResponse> {
        self.end();
        std::mem::take(&mut self.finished)
    }
}

impl Observed {
    fn finish(self, tick_s: f64) -> StepResponse {
        let target = if self.field.disturbs { self.set_point } else { self.to };
        let step = self.to - self.from;
        let known = || self.values.iter().copied().enumerate().filter(|(_, value)| value.is_finite());
        let deviation = |value: f64| (value - target).abs();
        let deviation_max = known().map(|(_, value)| deviation(value)).fold(0.0, f64::max);
        let band = SETTLED_PART * if self.field.disturbs { deviation_max } else { step.abs() };
        let last_outside = known().rfind(|(_, value)| deviation(*value) > band).map(|(tick, _)| tick);
        let settled = last_outside.map_or(0, |tick| tick + 1);
        let time_s = |ticks: usize| ticks as f64 * tick_s;
        let crossing = |part: f64| known().find(|(_, value)| (value - self.from) / step >= part).map(|(tick, _)| tick);
        let rise_time_s = match RISE.map(crossing) {
            [Some(low), Some(high)] if !self.field.disturbs => Some(time_s(high - low)),
            _ => None,
        };
        let excess = known().map(|(_, value)| (value - self.to) / step).fold(0.0, f64::max);
        StepResponse {
            key: self.key.clone(),
            component: self.component + 1,
            tick: self.tick,
            time_s: self.tick as f64 * tick_s,
            from: self.from,
            to: self.to,
            over_s: time_s(self.values.len()),
            rise_time_s,
            overshoot: (!self.field.disturbs).then_some(excess),
            settling_time_s: (settled < self.values.len()).then(|| time_s(settled)),
            steady_state_error: known().next_back().map_or(f64::NAN, |(_, value)| deviation(value)),
            deviation_max,
            command_max: self.command_max,
        }
    }
}
