//! A role whose samples are computed by a function of the embedding program instead of the built-in observer, law or
//! body. Links, clock, counters, guards and supervision stay the same.
//!
//! Must not keep state between ticks: the function owns its state, which ends with its process.

use super::error::NodeError;
use super::node::ports::ports;
use super::role_id::RoleId;
use super::role_values::CurrentValues;
use crate::config::Settings;
use crate::sample::{Field, Stamp};

/// Length of a stamp, words.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();

/// The samples of one tick of a role.
#[derive(Debug)]
pub struct TickSamples<'a> {
    /// The tick.
    pub tick: u64,
    /// Input samples as words with stamps, in the order of the seat description; `None` where a sample is missing or
    /// rejected by its guard.
    pub inputs: &'a [Option<&'a [u64]>],
    /// Values, at this tick, of the scenario's inputs that the role uses, in the order of
    /// [`role_values`](super::role_values()): gains, set points, disturbances.
    pub values: &'a [f64],
    /// Output samples as words without stamps, in the order of the seat description. Initially zero, except `valid`,
    /// whose bits are all set. A truth that stays unchanged takes the measurement's values.
    pub outputs: &'a mut [Vec<u64>],
}

/// A function that computes the output samples of a role.
pub trait RoleFunction {
    /// Computes one tick. The role waits for it: in real time a slow computation makes the tick late.
    ///
    /// # Errors
    /// The reason, as text; the role ends with it.
    fn compute(&mut self, tick: TickSamples<'_>) -> Result<(), String>;
}

/// A role function with its sample buffers.
pub(crate) struct FunctionRole {
    compute: Box<dyn RoleFunction>,
    values: CurrentValues,
    blank: Vec<Vec<u64>>,
    outputs: Vec<Vec<u64>>,
    /// Fields common to a plant's measurement and truth: first word in each, and number of words.
    common: Vec<(usize, usize, usize)>,
}

impl FunctionRole {
    pub fn new(compute: Box<dyn RoleFunction>, scenario: &Settings, role: RoleId, valid: u64) -> Self {
        let (ports, values) = (ports(scenario, role), CurrentValues::new(&scenario.inputs, role));
        let blank: Vec<Vec<u64>> = ports
            .writes
            .iter()
            .map(|port| {
                let mut words = vec![0; port.size / size_of::<u64>() - STAMP];
                for field in port.fields.iter().filter(|field| field.name == "valid") {
                    words[field.offset / size_of::<u64>() - STAMP] = valid;
                }
                words
            })
            .collect();
        let common = match &ports.writes[..] {
            [measurement, truth] if ports.reads.len() <= 1 => common(&measurement.fields, &truth.fields),
            _ => Vec::new(),
        };
        Self { compute, values, outputs: blank.clone(), blank, common }
    }

    /// Calls the function for one tick.
    pub fn tick(&mut self, tick: u64, inputs: &[Option<&[u64]>]) -> Result<(), NodeError> {
        self.outputs.iter_mut().zip(&self.blank).for_each(|(output, blank)| output.copy_from_slice(blank));
        let (values, outputs) = (self.values.at(tick), &mut self.outputs[..]);
        self.compute
            .compute(TickSamples { tick, inputs, values, outputs })
            .map_err(|reason| NodeError::Computed { reason })
    }

    /// Copies output `index` into a sample, after the stamp.
    pub fn write(&self, index: usize, words: &mut [u64]) {
        words[STAMP..].copy_from_slice(&self.outputs[index]);
    }

    /// Copies the truth of a plant into a sample. If the function left it unchanged, the measured values replace it.
    pub fn write_truth(&self, words: &mut [u64]) {
        self.write(1, words);
        if self.outputs[1] == self.blank[1] {
            for (from, to, count) in &self.common {
                words[STAMP + to..][..*count].copy_from_slice(&self.outputs[0][*from..][..*count]);
            }
        }
    }
}

/// Returns the fields of equal name, kind and length in two samples.
fn common(from: &[Field], to: &[Field]) -> Vec<(usize, usize, usize)> {
    let place = |field: &Field| field.offset / size_of::<u64>() - STAMP;
    let same = |a: &Field, b: &Field| (a.name, a.kind, a.count) == (b.name, b.kind, b.count);
    let pair = |a: &Field| to.iter().find(|b| same(a, b)).map(|b| (place(a), place(b), a.count));
    from.iter().filter_map(pair).collect()
}
