//! The observer: measurements in, estimates out, one per measurement; a missed tick is only a longer step.
//!
//! Must not see the truth, and must not let a measurement that is not finite, lacks a component or is not believed reach its
//! filter: the estimate goes on by the model then.

use crate::sample::{Message, Sample, Stamp, status};
use crate::state::{Persist, Words};

/// The estimator of one rig.
pub trait Estimator {
    /// What it learns from.
    type Measurement: Sample;
    /// What it says.
    type Estimate: Sample;

    /// Whether a measurement has every component the estimator needs, all finite.
    fn usable(&self, measurement: &Self::Measurement) -> bool {
        measurement.finite()
    }
    /// Forgets the past and starts at the configured guess, with `measurement` as the first.
    fn start(&mut self, measurement: &Self::Measurement);
    /// Learns from a measurement `dt_s` seconds after the last one learned from. `dt_s` is positive.
    fn update(&mut self, measurement: &Self::Measurement, dt_s: f64);
    /// Goes on by the model alone for `dt_s` seconds, or stays where there is none. The next update is still one from the
    /// last measurement learned from.
    fn coast(&mut self, _dt_s: f64) {}
    /// Writes the estimate, with the given further status bits, everything but the stamp.
    fn write(&self, status: u64, out: &mut Self::Estimate);

    /// Learns from a usable measurement `dt_s` seconds after the last one and writes the estimate, if that is the usual step
    /// for which the estimator has a shorter way; false, and nothing done, if not. The same bits as the long way.
    #[inline(always)]
    fn step_usual(&mut self, _: &Self::Measurement, _dt_s: f64, _: &mut Self::Estimate) -> bool {
        false
    }
}

/// An estimator with its memory of which measurement it learned from last.
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
///         let way = Vector1::new(now.position_m - last.position_m);
///         Increment::exact(way, dt_s, Vector1::zeros(), Vector1::zeros())
///     }
///     fn write(&self, _: &Position, velocity: &Vector1<f64>, status: u64, out: &mut Velocity) {
///         (out.velocity_m_s, out.status) = (velocity.x, status);
///     }
/// }
///
/// let mut observer = Observer::new(RelationObserver::new(Uniform, [5.0], [0.0]), 0.01);
/// let (mut measurement, mut estimate) = (Position::default(), Velocity::default());
/// for tick in (0..1000).filter(|tick| tick % 7 != 3) {
///     measurement.stamp.tick = tick; // every seventh is missing, and only a longer step
///     measurement.position_m = 2.0 * tick as f64 * 0.01;
///     observer.step(&measurement, &mut estimate);
/// }
/// assert!((estimate.velocity_m_s - 2.0).abs() < 1e-12);
/// ```
#[derive(Debug)]
pub struct Observer<E> {
    estimator: E,
    tick_s: f64,
    /// The tick of the last measurement learned from.
    last: Option<u64>,
    /// The tick of the last estimate.
    last_output: u64,
}

impl<E: Estimator> Observer<E> {
    /// An observer at its initial guess. `tick_s` is the period h in seconds.
    pub fn new(estimator: E, tick_s: f64) -> Self {
        Self { estimator, tick_s, last: None, last_output: 0 }
    }

    /// Turns measurement k into estimate k. The caller fills the stamp's `generation` and `sent_ns`.
    ///
    /// The first measurement yields the initial guess. A sender that was started anew speaks of the same body, which has
    /// moved on: its first measurement is only a longer step.
    #[inline(always)]
    pub fn step(&mut self, measurement: &E::Measurement, out: &mut E::Estimate) {
        let stamp = measurement.stamp();
        let next = self.last.is_some_and(|last| last.checked_add(1) == Some(stamp.tick));
        if next && self.estimator.step_usual(measurement, self.tick_s, out) {
            (self.last, self.last_output) = (Some(stamp.tick), stamp.tick);
            Self::sign(stamp, out);
        } else {
            self.step_any(measurement, out);
        }
    }

    /// Apart, so that the short way has nothing to keep for it.
    #[inline(never)]
    fn step_any(&mut self, measurement: &E::Measurement, out: &mut E::Estimate) {
        let status = if self.estimator.usable(measurement) {
            self.learn(measurement);
            0
        } else {
            self.coast(measurement.stamp().tick);
            status::UNUSABLE
        };
        self.write(measurement.stamp(), status, out);
    }

    /// Makes estimate k without measurement k, which was there under this stamp and is not believed.
    #[inline]
    pub fn reject(&mut self, stamp: &Stamp, out: &mut E::Estimate) {
        self.coast(stamp.tick);
        self.write(stamp, status::UNUSABLE | status::REJECTED, out);
    }

    fn write(&mut self, stamp: &Stamp, status: u64, out: &mut E::Estimate) {
        self.last_output = stamp.tick;
        self.estimator.write(status, out);
        Self::sign(stamp, out);
    }

    #[inline]
    fn sign(stamp: &Stamp, out: &mut E::Estimate) {
        let out = out.stamp_mut();
        out.tick = stamp.tick;
        out.origin_ns = stamp.origin_ns;
    }

    fn learn(&mut self, measurement: &E::Measurement) {
        let tick = measurement.stamp().tick;
        match self.last {
            Some(last) if last < tick => self.estimator.update(measurement, (tick - last) as f64 * self.tick_s),
            // The same tick again teaches nothing; an older one cannot come on an ordered link.
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
