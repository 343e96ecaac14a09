//! The observer that supplies one component of an angular velocity from the other two.

use crate::model::{RigidBody, closure};
use crate::observe::{
    Filter, HiddenRate, InertiaRatios, Interval, InvariantFilter, Observation, RateSample, Regressor,
};
use crate::role::Estimator;
use crate::sample::{RateEstimate, RateMeasurement, status};
use crate::state::{Persist, Words};
use nalgebra::{Vector1, Vector3};

/// The valid bits of all three components.
pub const ALL: u64 = 0b111;

/// Returns true if all values are finite, without a branch per value: 0·x is 0 unless x is not finite.
#[inline]
pub(super) fn finite(measurement: &RateMeasurement) -> bool {
    let nothing = |values: &[f64; 3]| values[0] * 0.0 + values[1] * 0.0 + values[2] * 0.0;
    nothing(&measurement.omega_rad_s) + nothing(&measurement.applied_rad_s2) == 0.0
}

/// Returns the measurement in the form that the relations use. Components that are not valid are 0.
#[inline]
pub(crate) fn seen(measurement: &RateMeasurement) -> RateSample {
    RateSample { rate_rad_s: measurement.omega_rad_s.into(), torque_rad_s2: measurement.applied_rad_s2.into() }
}

/// An observer that supplies one component from the other two.
#[derive(Debug, Clone)]
pub struct HiddenObserver {
    relation: HiddenRate,
    body: KnownBody,
    guess: Filter<1>,
    filter: Filter<1>,
    /// The valid bits of the components that the observer needs.
    needed: u64,
    last: Regressor,
    /// The angular velocity with the supplied component, rad/s. While no measurement is usable, the model advances
    /// it.
    rate: Vector3<f64>,
    /// The step of the last update; most steps are equal.
    interval: Interval,
    innovation: f64,
    status: u64,
}

impl HiddenObserver {
    /// Creates an observer of the component that `relation` supplies, for a body with the given coefficients,
    /// starting at `guess`.
    pub fn new(relation: HiddenRate, coefficients: Vector3<f64>, guess: Filter<1>) -> Self {
        let nothing = RateSample { rate_rad_s: Vector3::zeros(), torque_rad_s2: Vector3::zeros() };
        Self {
            relation,
            body: KnownBody::new(coefficients),
            guess,
            filter: guess,
            needed: ALL & !(1 << relation.hidden()),
            last: relation.regressor(&nothing),
            rate: nothing.rate_rad_s,
            interval: 1.0.into(),
            innovation: 0.0,
            status: status::INITIAL,
        }
    }

    /// Replaces the decay rate of a first-order filter, 1/s, positive. The estimate stays.
    pub(crate) fn set_decay_rate(&mut self, rate_per_s: f64) {
        if let Filter::First(first) = self.filter {
            self.filter = filter(rate_per_s, first.estimate().x);
        }
        if let Filter::First(first) = self.guess {
            self.guess = filter(rate_per_s, first.estimate().x);
        }
    }

    /// Restarts from a known estimate at a known instant.
    pub(crate) fn restart(&mut self, filter: Filter<1>, at: RateSample, status: u64) {
        (self.filter, self.innovation, self.status) = (filter, 0.0, status);
        self.store(&at, self.relation.regressor(&at));
    }

    fn store(&mut self, sample: &RateSample, regressor: Regressor) {
        (self.last, self.rate) = (regressor, self.relation.complete(&sample.rate_rad_s, self.filter.estimate().x));
    }

    /// Returns the status of the last step: bits of [`status`].
    pub(crate) fn status(&self) -> u64 {
        self.status
    }

    /// Returns the hidden component as the last step reconstructs it, less the estimate, rad/s.
    pub(crate) fn innovation(&self) -> f64 {
        self.innovation
    }

    /// Returns the angular velocity with the supplied component, rad/s.
    pub(crate) fn rate(&self) -> Vector3<f64> {
        self.rate
    }
}

impl Estimator for HiddenObserver {
    type Measurement = RateMeasurement;
    type Estimate = RateEstimate;

    #[inline]
    fn usable(&self, measurement: &RateMeasurement) -> bool {
        finite(measurement) && measurement.valid & self.needed == self.needed
    }

    fn start(&mut self, measurement: &RateMeasurement) {
        self.restart(self.guess, seen(measurement), status::INITIAL);
    }

    fn update(&mut self, measurement: &RateMeasurement, dt_s: f64) {
        let sample = seen(measurement);
        let to = self.relation.regressor(&sample);
        if self.interval.length() != dt_s {
            self.interval = dt_s.into();
        }
        match self.relation.observe(&self.last, &to, self.interval, self.filter.estimate().x) {
            Observation::Seen(increment) => {
                self.filter.step(&increment);
                self.innovation = (increment.reconstruction() - self.filter.estimate()).x;
                self.status = 0;
            }
            Observation::Unobservable { drift } => {
                self.filter.predict(&drift, dt_s);
                self.status |= status::UNOBSERVABLE;
            }
        }
        self.store(&sample, to);
    }

    /// Takes the fast path for a step as long as the last one, if all needed components are measured.
    #[inline(always)]
    fn fast_step(&mut self, measurement: &RateMeasurement, dt_s: f64, out: &mut RateEstimate) -> bool {
        let ([x, y, z], [u, v, w]) = (measurement.omega_rad_s, measurement.applied_rad_s2);
        // 0·x is 0 unless x is not finite. If only the sum overflows, the step takes the general path.
        let finite = ((x + y) + (z + u) + (v + w)) * 0.0 == 0.0;
        if !finite || measurement.valid & self.needed != self.needed || self.interval.length() != dt_s {
            return false;
        }
        let sample = seen(measurement);
        let to = self.relation.regressor(&sample);
        let (ends, estimate) = ([&self.last, &to], self.filter.estimate().x);
        let done = match &mut self.filter {
            Filter::First(filter) => self.relation.fast_step(ends, &self.interval, estimate, filter),
            Filter::Second(filter) => self.relation.fast_step(ends, &self.interval, estimate, filter),
            Filter::Kalman(_) => None,
        };
        let Some((estimate, innovation)) = done else { return false };
        (self.innovation, self.status, self.last) = (innovation, 0, to);
        self.rate = self.relation.complete(&sample.rate_rad_s, estimate);
        self.write(0, out);
        true
    }

    fn coast(&mut self, dt_s: f64) {
        self.rate = self.body.flow(&self.rate, &self.relation.torque(&self.last), dt_s);
    }

    #[inline(always)]
    fn write(&self, status: u64, out: &mut RateEstimate) {
        self.body.write(&self.rate, out);
        out.innovation_rad_s = self.innovation;
        out.excitation = 0.0;
        out.status = self.status | status;
        out.valid = if out.status & status::INITIAL == 0 { ALL } else { self.needed };
    }
}

impl Persist for HiddenObserver {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.filter.persist(words);
        self.relation.persist_regressor(&mut self.last, words);
        self.rate.persist(words);
        self.innovation.persist(words);
        self.status.persist(words);
    }
}

/// A body with its coefficients and the quantities derived from them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct KnownBody {
    pub(super) coefficients: Vector3<f64>,
    closure: f64,
    inertia_ratios: [f64; 2],
}

impl KnownBody {
    /// Computes the derived quantities of a body with these coefficients.
    pub fn new(coefficients: Vector3<f64>) -> Self {
        let closure = closure(&coefficients);
        let ratios = InertiaRatios::new(&coefficients).map_or([0.0; 2], |ratios| [ratios.second, ratios.third]);
        Self { coefficients, closure, inertia_ratios: ratios }
    }

    /// Returns the angular velocity of the body `dt_s` seconds after `rate`, under this torque over inertia, rad/s².
    pub(super) fn flow(&self, rate: &Vector3<f64>, torque: &Vector3<f64>, dt_s: f64) -> Vector3<f64> {
        RigidBody::with_coefficients(self.coefficients).flow(rate, torque, dt_s)
    }

    /// Writes the angular velocity with the coefficients and the derived quantities.
    #[inline]
    pub fn write(&self, rate: &Vector3<f64>, out: &mut RateEstimate) {
        // One by one, not as a vector: a vector load would wait for the separate stores to leave the store buffer.
        out.omega_rad_s = [rate.x, rate.y, rate.z];
        out.coefficients = self.coefficients.into();
        out.closure = self.closure;
        out.inertia_ratios = self.inertia_ratios;
    }
}

/// Returns a filter of the hidden component with the given decay rate, 1/s, at the given estimate, rad/s.
pub(crate) fn filter(decay_rate_per_s: f64, estimate_rad_s: f64) -> Filter<1> {
    Filter::First(InvariantFilter::new(Vector1::new(decay_rate_per_s), Vector1::new(estimate_rad_s)))
}
