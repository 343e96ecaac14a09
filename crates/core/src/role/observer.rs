//! The observer: computes one estimate per measurement. A missed tick only makes the next step longer.
//!
//! It must not see the truth. A measurement that is not finite, lacks a component or is not accepted must not reach
//! the filter: the estimate then advances by the model.

use crate::sample::{Message, Sample, Stamp, status};
use crate::state::{Persist, Words};

/// The estimator of one rig.
pub trait Estimator {
    /// The measurement that the estimator reads.
    type Measurement: Sample;
    /// The estimate that the estimator writes.
    type Estimate: Sample;

    /// Returns true if a measurement has every component that the estimator needs, all of them finite.
    fn usable(&self, measurement: &Self::Measurement) -> bool {
        measurement.finite()
    }
    /// Returns true if a measurement has a new value of every field that an update needs. Otherwise the estimate coasts. By default all
    /// fields must be new; an estimator that updates with some of them overrides this and asks [`Sample::holds`].
    fn is_new(&self, measurement: &Self::Measurement) -> bool {
        !measurement.is_held()
    }
    /// Discards the past and starts at the configured guess, with `measurement` as the first. By default an update over 0 s.
    fn start(&mut self, measurement: &Self::Measurement) {
        self.update(measurement, 0.0);
    }
    /// Updates the estimate with a measurement taken `dt_s` seconds after the last one used. `dt_s` is positive, or 0
    /// for the first one by the default [`start`](Self::start).
    fn update(&mut self, measurement: &Self::Measurement, dt_s: f64);
    /// Advances the estimate by the model alone for `dt_s` seconds; without a model the estimate stays. The next
    /// update still spans the time from the last measurement used.
    fn coast(&mut self, _dt_s: f64) {}
    /// Writes the estimate with the given additional status bits, but not the stamp.
    fn write(&self, status: u64, out: &mut Self::Estimate);
    /// Takes new values of an input of the loop, such as a decay rate, from this tick on. `port` is the number that the rig gave to
    /// it.
    fn set_input(&mut self, _port: usize, _values: &[f64]) {}

    /// Updates the estimate with a usable measurement taken `dt_s` seconds after the last one and writes it, if the
    /// estimator has a fast path for this step. Returns false, with nothing changed, if it has none. The result is
    /// bit-identical to that of `update` and `write`.
    #[inline(always)]
    fn fast_step(&mut self, _: &Self::Measurement, _dt_s: f64, _: &mut Self::Estimate) -> bool {
        false
    }
}

/// An estimator that tracks the tick of the last measurement used.
///
/// A role is a plain state machine: samples in, samples out, the time in their stamps.
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::nalgebra::Vector1;
/// use corotate::observe::Increment;
/// use corotate::role::{InvariantRelation, Observer, RelationObserver};
///
/// corotate::sample! { Position = "doc/Position/v1" { position_m: f64, } }
/// corotate::sample! { Velocity = "doc/Velocity/v1" { velocity_m_s: f64, status: u64, } }
///
/// /// ∫v dt = Δx: a velocity that is not measured.
/// struct Uniform;
/// impl InvariantRelation<1> for Uniform {
///     type Measurement = Position;
///     type Estimate = Velocity;
///     fn increment(&self, last: &Position, now: &Position, dt_s: f64) -> Increment<1> {
///         let displacement = Vector1::new(now.position_m - last.position_m);
///         Increment::exact(displacement, dt_s, Vector1::zeros(), Vector1::zeros())
///     }
///     fn write(&self, _: &Position, velocity: &Vector1<f64>, status: u64, out: &mut Velocity) {
///         (out.velocity_m_s, out.status) = (velocity.x, status);
///     }
/// }
///
/// let mut observer = Observer::new(RelationObserver::new(Uniform, [5.0], [0.0]), 0.01);
/// let (mut measurement, mut estimate) = (Position::default(), Velocity::default());
/// for tick in (0..1000).filter(|tick| tick % 7 != 3) {
///     measurement.stamp.tick = tick; // every seventh measurement is missing: the next step is longer
///     measurement.position_m = 2.0 * tick as f64 * 0.01;
///     observer.step(&measurement, &mut estimate);
/// }
/// assert!((estimate.velocity_m_s - 2.0).abs() < 1e-12);
/// ```
#[derive(Debug)]
pub struct Observer<E> {
    estimator: E,
    tick_s: f64,
    /// The tick of the last measurement used.
    last: Option<u64>,
    /// The tick of the last estimate.
    last_output: u64,
    every_ticks: u64,
}

impl<E: Estimator> Observer<E> {
    /// Creates an observer at its initial guess. `tick_s` is the period h in seconds.
    pub fn new(estimator: E, tick_s: f64) -> Self {
        Self { estimator, tick_s, last: None, last_output: 0, every_ticks: 1 }
    }

    /// Computes at every n-th tick only. In between the last estimate is sent again.
    #[must_use]
    pub fn every(self, ticks: u64) -> Self {
        Self { every_ticks: ticks.max(1), ..self }
    }

    /// Returns true if the observer computes at this tick.
    #[inline]
    pub fn is_due(&self, tick: u64) -> bool {
        self.every_ticks == 1 || tick.is_multiple_of(self.every_ticks)
    }

    /// Passes new values of an input to the estimator.
    pub fn set_input(&mut self, port: usize, values: &[f64]) {
        self.estimator.set_input(port, values);
    }

    /// Computes estimate k from measurement k. The caller sets the stamp's `generation` and `sent_ns`.
    ///
    /// The first measurement yields the initial guess. A restarted sender measures the same body, so its first
    /// measurement is only a longer step.
    #[inline(always)]
    pub fn step(&mut self, measurement: &E::Measurement, out: &mut E::Estimate) {
        let stamp = measurement.stamp();
        let next = self.last.is_some_and(|last| last.checked_add(1) == Some(stamp.tick));
        if next && !measurement.is_held() && self.estimator.fast_step(measurement, self.tick_s, out) {
            (self.last, self.last_output) = (Some(stamp.tick), stamp.tick);
            out.stamp_mut().answer(stamp);
        } else {
            self.step_any(measurement, out);
        }
    }

    /// The general path, not inlined so that the fast path saves no registers for it.
    #[inline(never)]
    fn step_any(&mut self, measurement: &E::Measurement, out: &mut E::Estimate) {
        let status = if !self.estimator.usable(measurement) {
            status::UNUSABLE
        } else if !self.estimator.is_new(measurement) {
            status::HELD
        } else {
            0
        };
        if status == 0 {
            self.learn(measurement);
        } else {
            self.coast(measurement.stamp().tick);
        }
        self.write(measurement.stamp(), status, out);
    }

    /// Computes estimate k without measurement k, which arrived under this stamp but was not accepted.
    #[inline]
    pub fn reject(&mut self, stamp: &Stamp, out: &mut E::Estimate) {
        self.coast(stamp.tick);
        self.write(stamp, status::UNUSABLE | status::REJECTED, out);
    }

    fn write(&mut self, stamp: &Stamp, status: u64, out: &mut E::Estimate) {
        self.last_output = stamp.tick;
        self.estimator.write(status, out);
        out.stamp_mut().answer(stamp);
    }

    fn learn(&mut self, measurement: &E::Measurement) {
        let tick = measurement.stamp().tick;
        match self.last {
            Some(last) if last < tick => self.estimator.update(measurement, (tick - last) as f64 * self.tick_s),
            // A repeated tick carries no information; an older one cannot arrive on an ordered link.
            Some(_) => return,
            None => self.estimator.start(measurement),
        }
        self.last = Some(tick);
    }

    fn coast(&mut self, tick: u64) {
        if self.last.is_some() && tick > self.last_output {
            self.estimator.coast((tick - self.last_output) as f64 * self.tick_s);
        }
    }
}

impl<E: Persist> Persist for Observer<E> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.estimator.persist(words);
        self.last.persist(words);
        self.last_output.persist(words);
    }
}
