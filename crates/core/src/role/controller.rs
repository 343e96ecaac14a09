//! The controller: computes a driven body's command from the reference, the estimate and that body's measurement of the same tick.
//!
//! It must not combine samples of different ticks, and must not see the truth.

use crate::sample::{Message, Sample};
use crate::state::{Persist, Words};

/// The most numbers of a loop's reference.
pub const REFERENCE_MAX: usize = 12;

/// The values from which a law computes the command of a tick.
#[derive(Debug)]
pub struct LawInputs<'a, L: Law + ?Sized> {
    /// The tick of estimate and measurement.
    pub tick: u64,
    /// The period h, s.
    pub period_s: f64,
    /// The reference at this tick: the numbers of the rig's reference fields, in their order and units. Empty without them.
    pub reference: &'a [f64],
    /// The estimate of the first body's state.
    pub estimate: &'a L::Estimate,
    /// The estimate of the driven body's own state; `None` if the body has no observer.
    pub own_estimate: Option<&'a L::Estimate>,
    /// The driven body's own measurement.
    pub measurement: &'a L::Measurement,
}

impl<L: Law + ?Sized> LawInputs<'_, L> {
    /// Returns the time since tick 0, s.
    pub fn time_s(&self) -> f64 {
        self.tick as f64 * self.period_s
    }
}

/// The control law of one rig for one driven body.
pub trait Law {
    /// The estimate of a body's state.
    type Estimate: Sample;
    /// The driven body's measurement.
    type Measurement: Message + ?Sized;
    /// The driven body's command.
    type Command: Message + ?Sized;

    /// Writes the command, but not the stamp.
    fn command(&mut self, inputs: &LawInputs<'_, Self>, out: &mut Self::Command);
    /// Takes new values of an input of the loop, such as a gain or a set point, from this tick on. `port` is the number that the
    /// rig gave to it.
    fn set_input(&mut self, _port: usize, _values: &[f64]) {}
}

/// A law for one driven body that also stamps its commands.
#[derive(Debug)]
pub struct Controller<L> {
    law: L,
    period_s: f64,
    reference: [f64; REFERENCE_MAX],
    /// The number of numbers of the reference.
    referred: usize,
    every_ticks: u64,
}

impl<L: Law> Controller<L> {
    /// Creates a controller without a reference. `period_s` is the period h in seconds.
    pub fn new(law: L, period_s: f64) -> Self {
        Self { law, period_s, reference: [0.0; REFERENCE_MAX], referred: 0, every_ticks: 1 }
    }

    /// Adds the reference at tick 0; numbers beyond [`REFERENCE_MAX`] are left out.
    #[must_use]
    pub fn with_reference(mut self, reference: &[f64]) -> Self {
        self.referred = reference.len().min(REFERENCE_MAX);
        self.set_reference(0, reference);
        self
    }

    /// Computes at every n-th tick only. In between the last command is sent again.
    #[must_use]
    pub fn every(self, ticks: u64) -> Self {
        Self { every_ticks: ticks.max(1), ..self }
    }

    /// Returns true if the controller computes at this tick.
    #[inline]
    pub fn is_due(&self, tick: u64) -> bool {
        self.every_ticks == 1 || tick.is_multiple_of(self.every_ticks)
    }

    /// Passes new values of an input to the law.
    pub fn set_input(&mut self, port: usize, values: &[f64]) {
        self.law.set_input(port, values);
    }

    /// Replaces the numbers of the reference from number `first` on.
    pub fn set_reference(&mut self, first: usize, values: &[f64]) {
        let own = self.reference[..self.referred].iter_mut().skip(first);
        own.zip(values).for_each(|(own, value)| *own = *value);
    }

    /// Computes command k from the estimates and the measurement of tick k. `own_estimate` is that of the driven body, if it has an
    /// observer. The caller sets the stamp's `generation` and `sent_ns`.
    ///
    /// The command's origin is that of the estimate: the observed body's measurement.
    #[inline(always)]
    pub fn step(
        &mut self,
        estimate: &L::Estimate,
        own_estimate: Option<&L::Estimate>,
        measurement: &L::Measurement,
        out: &mut L::Command,
    ) {
        let tick = estimate.stamp().tick;
        debug_assert_eq!(tick, measurement.stamp().tick);
        debug_assert!(own_estimate.is_none_or(|own| own.stamp().tick == tick));
        let (period_s, reference) = (self.period_s, &self.reference[..self.referred]);
        self.law.command(&LawInputs { tick, period_s, reference, estimate, own_estimate, measurement }, out);
        out.stamp_mut().answer(estimate.stamp());
    }
}

impl<L: Persist> Persist for Controller<L> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.law.persist(words);
    }
}
