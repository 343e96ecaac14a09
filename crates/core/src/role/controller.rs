//! The controller: computes a follower's command from the estimate and that follower's measurement of the same tick.
//!
//! It must not combine samples of different ticks, and must not see the truth.

use crate::sample::{Message, Sample};
use crate::state::{Persist, Words};

/// The control law of one rig for one follower.
pub trait Law {
    /// The estimate of the leader's state.
    type Estimate: Sample;
    /// The follower's measurement.
    type Measurement: Message + ?Sized;
    /// The follower's command.
    type Command: Message + ?Sized;

    /// Writes the command, but not the stamp.
    fn command(&mut self, estimate: &Self::Estimate, measurement: &Self::Measurement, out: &mut Self::Command);
    /// Takes new values of an input of the loop, such as a gain or a reference, from this tick on. `port` is the number that the
    /// rig gave to it.
    fn set_input(&mut self, _port: usize, _values: &[f64]) {}
}

/// A law for one follower that also stamps its commands.
#[derive(Debug)]
pub struct Controller<L> {
    law: L,
}

impl<L: Law> Controller<L> {
    /// Creates a controller for one follower.
    pub fn new(law: L) -> Self {
        Self { law }
    }

    /// Passes new values of an input to the law.
    pub fn set_input(&mut self, port: usize, values: &[f64]) {
        self.law.set_input(port, values);
    }

    /// Computes command k from estimate k and measurement k. The caller sets the stamp's `generation` and `sent_ns`.
    ///
    /// The command's origin is that of the estimate: the leader's measurement.
    #[inline(always)]
    pub fn step(&mut self, estimate: &L::Estimate, measurement: &L::Measurement, out: &mut L::Command) {
        debug_assert_eq!(estimate.stamp().tick, measurement.stamp().tick);
        self.law.command(estimate, measurement, out);
        let out = out.stamp_mut();
        out.tick = estimate.stamp().tick;
        out.origin_ns = estimate.stamp().origin_ns;
    }
}

impl<L: Persist> Persist for Controller<L> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.law.persist(words);
    }
}
