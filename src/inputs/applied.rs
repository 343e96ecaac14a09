//! The changes of inputs in a run, as its results list them.

use crate::config::Settings;
use crate::input::{Change, Shape};
use serde::{Deserialize, Serialize};
use toml::Value;

/// A change of an input in a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AppliedChange {
    /// The tick from which it acts.
    pub tick: u64,
    /// Its time from the first tick, s.
    pub time_s: f64,
    /// The scenario key.
    pub key: String,
    /// The new level, or the amplitude.
    pub value: Value,
    /// The name of the shape, as in a scenario.
    pub shape: String,
    /// The length of the shape, s; 0 for a step.
    #[serde(default)]
    pub duration_s: f64,
    /// True if another program asked for it during the run, false if it is part of the scenario.
    pub received: bool,
}

/// Returns the changes of a run up to its last tick, in the order of their ticks.
pub fn applied(scenario: &Settings) -> Vec<AppliedChange> {
    let inputs = &scenario.inputs;
    let described = |(change, received): (Change, bool)| {
        // The rows of a table are in the scenario.
        if matches!(change.shape, Shape::Row { .. }) {
            return None;
        }
        let info = inputs.infos.get(change.input)?;
        (change.tick <= scenario.last_tick).then(|| AppliedChange {
            tick: change.tick,
            time_s: scenario.time_s(change.tick),
            key: info.key.clone(),
            value: info.to_toml(&change.values),
            shape: name(&change.shape).to_owned(),
            duration_s: change.shape.ticks() as f64 * scenario.tick_s(),
            received,
        })
    };
    inputs.lists().all().into_iter().filter_map(described).collect()
}

fn name(shape: &Shape) -> &'static str {
    match shape {
        Shape::Step => "step",
        Shape::Ramp { .. } | Shape::Row { .. } => "ramp",
        Shape::Pulse { .. } => "pulse",
        Shape::Sine { .. } => "sine",
        Shape::Chirp { .. } => "chirp",
        Shape::Prbs { .. } => "prbs",
    }
}
