//! The controller: the estimate and one follower's measurement of the same tick in, that follower's command out.
//!
//! Must not pair samples of different ticks, and must not see the truth.

use crate::sample::{Message, Sample};
use crate::state::{Persist, Words};

/// The control law of one rig for one follower.
pub trait Law {
    /// What it knows of the leader.
    type Estimate: Sample;
    /// What it knows of the follower.
    type Measurement: Message + ?Sized;
    /// What it decides.
    type Command: Message + ?Sized;

    /// Writes the command, everything but the stamp.
    fn command(&mut self, estimate: &Self::Estimate, measurement: &Self::Measurement, out: &mut Self::Command);
}

/// A law with its follower's stamp discipline.
#[derive(Debug)]
pub struct Controller<L> {
    law: L,
}

impl<L: Law> Controller<L> {
    /// A controller for one follower.
    pub fn new(law: L) -> Self {
        Self { law }
    }

    /// Turns estimate k and measurement k into command k. The caller fills the stamp's `generation` and `sent_ns`.
    ///
    /// The command continues the estimate's chain: its origin is the leader's measurement.
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
