//! The observers of angular velocities: the measured components, the supplied one, and its sources.

use super::hidden::{ALL, HiddenObserver, KnownBody, finite, seen};
use super::learner::Learner;
use super::port;
use crate::observe::{GuardedKalman, RateNoise, RateSample};
use crate::role::Estimator;
use crate::sample::{RateEstimate, RateMeasurement, status};
use crate::state::{Persist, Words};
use nalgebra::Vector3;

/// An observer of an angular velocity.
#[derive(Debug)]
#[allow(clippy::large_enum_variant, reason = "there is one in a process, and it is used at every tick")]
pub enum RateObserver {
    /// One component is never measured.
    Hidden(HiddenObserver),
    /// One component is never measured, and the sensors' noise is known.
    Kalman(KalmanObserver),
    /// All components are measured until one is lost; the inertia is learned meanwhile.
    Learner(Learner),
}

impl Estimator for RateObserver {
    type Measurement = RateMeasurement;
    type Estimate = RateEstimate;

    #[inline]
    fn usable(&self, measurement: &RateMeasurement) -> bool {
        match self {
            Self::Hidden(observer) => observer.usable(measurement),
            Self::Kalman(observer) => finite(measurement) && measurement.valid & observer.needed() == observer.needed(),
            Self::Learner(_) => finite(measurement) && (measurement.valid & ALL).count_ones() >= 2,
        }
    }

    fn start(&mut self, measurement: &RateMeasurement) {
        match self {
            Self::Hidden(observer) => observer.start(measurement),
            Self::Kalman(observer) => observer.start(measurement),
            Self::Learner(observer) => observer.start(measurement),
        }
    }

    #[inline]
    fn update(&mut self, measurement: &RateMeasurement, dt_s: f64) {
        match self {
            Self::Hidden(observer) => observer.update(measurement, dt_s),
            Self::Kalman(observer) => observer.update(measurement, dt_s),
            Self::Learner(observer) => observer.update(measurement, dt_s),
        }
    }

    #[inline(always)]
    fn fast_step(&mut self, measurement: &RateMeasurement, dt_s: f64, out: &mut RateEstimate) -> bool {
        match self {
            Self::Hidden(observer) => observer.fast_step(measurement, dt_s, out),
            _ => false,
        }
    }

    /// A learner has no model to advance by: its estimate stays.
    fn coast(&mut self, dt_s: f64) {
        match self {
            Self::Hidden(observer) => observer.coast(dt_s),
            Self::Kalman(observer) => observer.coast(dt_s),
            Self::Learner(_) => {}
        }
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        if let (Self::Hidden(observer), port::DECAY, [rate]) = (self, port, values) {
            observer.set_decay_rate(*rate);
        }
    }

    #[inline]
    fn write(&self, status: u64, out: &mut RateEstimate) {
        match self {
            Self::Hidden(observer) => observer.write(status, out),
            Self::Kalman(observer) => observer.write(status, out),
            Self::Learner(observer) => observer.write(status, out),
        }
    }
}

impl Persist for RateObserver {
    fn persist<W: Words>(&mut self, words: &mut W) {
        match self {
            Self::Hidden(observer) => observer.persist(words),
            Self::Kalman(observer) => observer.persist(words),
            Self::Learner(observer) => observer.persist(words),
        }
    }
}

/// An observer that supplies one component from the other two and filters all of them, for sensors of known noise.
#[derive(Debug)]
pub struct KalmanObserver {
    body: KnownBody,
    noise: RateNoise,
    hidden: usize,
    floor_rad_s: f64,
    guess_rad_s: f64,
    /// Absent before the first measurement.
    filter: Option<GuardedKalman>,
    last: RateSample,
    /// The angular velocity advanced by the model, while no measurement was usable.
    coasted: Option<Vector3<f64>>,
    status: u64,
}

impl KalmanObserver {
    /// Creates an observer of component `hidden` (0 to 2) of a body with the given coefficients.
    pub fn new(
        coefficients: Vector3<f64>,
        noise: RateNoise,
        hidden: usize,
        floor_rad_s: f64,
        guess_rad_s: f64,
    ) -> Self {
        let last = RateSample { rate_rad_s: Vector3::zeros(), torque_rad_s2: Vector3::zeros() };
        let body = KnownBody::new(coefficients);
        let (filter, coasted) = (None, None);
        Self { body, noise, hidden, floor_rad_s, guess_rad_s, filter, last, coasted, status: status::INITIAL }
    }

    fn needed(&self) -> u64 {
        ALL & !(1 << self.hidden)
    }

    fn start(&mut self, measurement: &RateMeasurement) {
        (self.last, self.coasted) = (seen(measurement), None);
        self.status = status::INITIAL;
        self.filter = self.new_filter();
    }

    /// Creates a filter that begins at the last sample. The check of the scenario ensures that the component is
    /// observable.
    fn new_filter(&self) -> Option<GuardedKalman> {
        let (axis, first) = (self.hidden + 1, &self.last);
        GuardedKalman::new(&self.body.coefficients, axis, self.floor_rad_s, self.noise, first, self.guess_rad_s).ok()
    }

    fn update(&mut self, measurement: &RateMeasurement, dt_s: f64) {
        let to = seen(measurement);
        if let Some(filter) = &mut self.filter {
            let held = filter.step(&self.last, &to, dt_s);
            self.status = if held { 0 } else { status::UNOBSERVABLE };
        }
        (self.last, self.coasted) = (to, None);
    }

    fn coast(&mut self, dt_s: f64) {
        self.coasted = Some(self.body.flow(&self.rate(), &self.last.torque_rad_s2, dt_s));
    }

    fn rate(&self) -> Vector3<f64> {
        let filtered = || self.filter.as_ref().map_or(self.last.rate_rad_s, |filter| *filter.estimate());
        self.coasted.unwrap_or_else(filtered)
    }

    fn write(&self, status: u64, out: &mut RateEstimate) {
        self.body.write(&self.rate(), out);
        out.innovation_rad_s = 0.0;
        out.excitation = 0.0;
        out.status = self.status | status;
        out.valid = if out.status & status::INITIAL == 0 { ALL } else { self.needed() };
    }
}

impl Persist for KalmanObserver {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.last.persist(words);
        self.coasted.persist(words);
        self.status.persist(words);
        let mut begun = self.filter.is_some();
        begun.persist(words);
        if let Some(mut filter) = self.filter.or_else(|| self.new_filter()) {
            filter.persist(words);
            self.filter = begun.then_some(filter);
        }
    }
}
