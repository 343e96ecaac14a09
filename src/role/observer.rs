//! The observer: measurements in, estimates out, one per measurement; a missed tick is only a longer step.
//!
//! Must not see the truth, and must not let a measurement that is not finite or lacks a component reach its filter.

use crate::sample::Sample;

/// The estimator of one rig.
pub trait Estimator {
    /// What it learns from.
    type Measurement: Sample;
    /// What it says.
    type Estimate: Sample;

    /// Whether a measurement has every component the estimator needs, all finite.
    fn usable(&self, measurement: &Self::Measurement) -> bool;
    /// Forgets the past and starts at the configured guess, with `measurement` as the first.
    fn start(&mut self, measurement: &Self::Measurement);
    /// Learns from a measurement `dt_s` seconds after the last one learned from. `dt_s` is positive.
    fn update(&mut self, measurement: &Self::Measurement, dt_s: f64);
    /// Writes the estimate, with the given further status bits, everything but the stamp.
    fn write(&self, status: u64, out: &mut Self::Estimate);
}

/// An estimator with its memory of which measurement it learned from last.
#[derive(Debug)]
pub struct Observer<E> {
    estimator: E,
    tick_s: f64,
    /// Tick and generation of the last measurement learned from.
    last: Option<(u64, u64)>,
}

impl<E: Estimator> Observer<E> {
    /// An observer at its initial guess. `tick_s` is the period h in seconds.
    pub fn new(estimator: E, tick_s: f64) -> Self {
        Self { estimator, tick_s, last: None }
    }

    /// Turns measurement k into estimate k. The caller fills the stamp's `generation` and `sent_ns`.
    ///
    /// The first measurement, and the first of a restarted sender, yields the initial guess.
    #[inline]
    pub fn step(&mut self, measurement: &E::Measurement, out: &mut E::Estimate) {
        let stamp = measurement.stamp();
        let status = if self.estimator.usable(measurement) {
            self.learn(measurement);
            0
        } else {
            crate::sample::status::UNUSABLE
        };
        self.estimator.write(status, out);
        let out = out.stamp_mut();
        out.tick = stamp.tick;
        out.origin_ns = stamp.origin_ns;
    }

    #[inline]
    fn learn(&mut self, measurement: &E::Measurement) {
        let stamp = measurement.stamp();
        match self.last {
            Some((tick, generation)) if generation == stamp.generation && tick < stamp.tick => {
                self.estimator.update(measurement, (stamp.tick - tick) as f64 * self.tick_s);
            }
            // The same tick again teaches nothing; an older one cannot come on an ordered link.
            Some((_, generation)) if generation == stamp.generation => return,
            _ => self.estimator.start(measurement),
        }
        self.last = Some((stamp.tick, stamp.generation));
    }
}
