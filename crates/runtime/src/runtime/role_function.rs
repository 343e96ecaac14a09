//! A role whose samples a function of a program's own computes, in the place of our observer, law or body. Links, clock, counters,
//! guards and supervision stay those of every role.
//!
//! Must not keep anything of a tick: what a function remembers is its own, and ends with its process.

use super::error::NodeError;
use super::node::ports::Ports;
use crate::sample::{Field, Stamp};

/// Words of a stamp.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();

/// One tick of a role, to be computed.
#[derive(Debug)]
pub struct TickSamples<'a> {
    /// Which.
    pub tick: u64,
    /// The samples that it reads, as words with their stamps, in the order of its seat; none where a sample is missing or was not
    /// believed.
    pub inputs: &'a [Option<&'a [u64]>],
    /// The samples that it writes, as words without their stamps, in the order of its seat: zeros, but for `valid`, of which all
    /// bits are set. A truth that is left so has the measurement's values.
    pub outputs: &'a mut [Vec<u64>],
}

/// Computes what a role sends.
pub trait RoleFunction {
    /// Computes one tick. It is waited for: in real time a tick that it takes too long for is late, as any other.
    ///
    /// # Errors
    /// Why it cannot go on; the role ends with that.
    fn compute(&mut self, tick: TickSamples<'_>) -> Result<(), String>;
}

/// A function with the samples that it fills.
pub(crate) struct FunctionRole {
    compute: Box<dyn RoleFunction>,
    blank: Vec<Vec<u64>>,
    outputs: Vec<Vec<u64>>,
    /// Where a plant's measurement has what its truth has too: words from, words to, how many.
    common: Vec<(usize, usize, usize)>,
}

impl FunctionRole {
    pub fn new(compute: Box<dyn RoleFunction>, ports: &Ports, valid: u64) -> Self {
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
        Self { compute, outputs: blank.clone(), blank, common }
    }

    /// Computes a tick.
    pub fn tick(&mut self, tick: u64, inputs: &[Option<&[u64]>]) -> Result<(), NodeError> {
        self.outputs.iter_mut().zip(&self.blank).for_each(|(output, blank)| output.copy_from_slice(blank));
        let outputs = &mut self.outputs[..];
        self.compute.compute(TickSamples { tick, inputs, outputs }).map_err(|reason| NodeError::Computed { reason })
    }

    /// Writes what was computed into a sample, after its stamp.
    pub fn write(&self, index: usize, words: &mut [u64]) {
        words[STAMP..].copy_from_slice(&self.outputs[index]);
    }

    /// The same for a plant's truth: what the function does not tell, its sensors say.
    pub fn write_truth(&self, words: &mut [u64]) {
        self.write(1, words);
        if self.outputs[1] == self.blank[1] {
            for (from, to, count) in &self.common {
                words[STAMP + to..][..*count].copy_from_slice(&self.outputs[0][*from..][..*count]);
            }
        }
    }
}

/// Where two samples have fields of one name and kind.
fn common(from: &[Field], to: &[Field]) -> Vec<(usize, usize, usize)> {
    let place = |field: &Field| field.offset / size_of::<u64>() - STAMP;
    let same = |a: &Field, b: &Field| (a.name, a.kind, a.count) == (b.name, b.kind, b.count);
    let pair = |a: &Field| to.iter().find(|b| same(a, b)).map(|b| (place(a), place(b), a.count));
    from.iter().filter_map(pair).collect()
}
