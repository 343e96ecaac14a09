//! The observers of this rig: which components are measured, which one is supplied, and from what.

use super::learner::Learner;
use crate::model::RigidBody;
use crate::observe::{
    Filter, GuardedKalman, HiddenRate, InertiaRatios, InvariantFilter, Observation, RateNoise, RateSample, Span,
};
use crate::role::Estimator;
use crate::sample::{RateEstimate, RateMeasurement, status};
use nalgebra::{Vector1, Vector3};

/// All components of a vector.
pub(super) const ALL: u64 = 0b111;

/// An observer of this rig.
#[derive(Debug)]
#[allow(clippy::large_enum_variant, reason = "there is one in a process, and it is used at every tick")]
pub enum RateObserver {
    /// One component is never measured.
    Hidden(HiddenObserver),
    /// The same with known noise.
    Kalman(KalmanObserver),
    /// All are measured until one is lost; the inertia is learned meanwhile.
    Learner(Learner),
}

impl Estimator for RateObserver {
    type Measurement = RateMeasurement;
    type Estimate = RateEstimate;

    #[inline]
    fn usable(&self, measurement: &RateMeasurement) -> bool {
        // 0·x is 0 unless x is not finite; without a branch for every value.
        let finite = |values: &[f64; 3]| values.iter().map(|value| value * 0.0).sum::<f64>() == 0.0;
        let needed = match self {
            Self::Hidden(observer) => measurement.valid & observer.needed() == observer.needed(),
            Self::Kalman(observer) => measurement.valid & observer.needed() == observer.needed(),
            Self::Learner(_) => (measurement.valid & ALL).count_ones() >= 2,
        };
        needed && finite(&measurement.omega_rad_s) && finite(&measurement.applied_rad_s2)
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

    /// What is learning its model has none to go on by: it stays.
    fn coast(&mut self, dt_s: f64) {
        match self {
            Self::Hidden(observer) => observer.coast(dt_s),
            Self::Kalman(observer) => observer.coast(dt_s),
            Self::Learner(_) => {}
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

/// What a measurement tells the relations. Components that are not valid are 0.
#[inline]
pub(super) fn seen(measurement: &RateMeasurement) -> RateSample {
    RateSample { rate_rad_s: measurement.omega_rad_s.into(), torque_rad_s2: measurement.applied_rad_s2.into() }
}

/// Supplies one component from the other two.
#[derive(Debug, Clone)]
pub struct HiddenObserver {
    relation: HiddenRate,
    body: Knowledge,
    guess: Filter<1>,
    filter: Filter<1>,
    hidden: usize,
    last: RateSample,
    /// The step of the last update, s: most are equal.
    span: Span,
    /// Where the model has taken the body since, while no measurement was usable.
    coasted: Option<Vector3<f64>>,
    innovation: f64,
    status: u64,
}

impl HiddenObserver {
    /// An observer of component `hidden` (0 to 2) of a body with the given coefficients, which starts at `guess`.
    pub(super) fn new(relation: HiddenRate, coefficients: Vector3<f64>, guess: Filter<1>, hidden: usize) -> Self {
        let last = RateSample { rate_rad_s: Vector3::zeros(), torque_rad_s2: Vector3::zeros() };
        Self {
            relation,
            body: Knowledge::new(coefficients),
            guess,
            filter: guess,
            hidden,
            last,
            span: 1.0.into(),
            coasted: None,
            innovation: 0.0,
            status: status::INITIAL,
        }
    }

    fn needed(&self) -> u64 {
        ALL & !(1 << self.hidden)
    }

    fn start(&mut self, measurement: &RateMeasurement) {
        self.begin(self.guess, seen(measurement), status::INITIAL);
    }

    /// Begins anew from a known estimate at a known instant.
    pub(super) fn begin(&mut self, filter: Filter<1>, at: RateSample, status: u64) {
        (self.filter, self.last, self.coasted, self.innovation, self.status) = (filter, at, None, 0.0, status);
    }

    #[inline]
    pub(super) fn update(&mut self, measurement: &RateMeasurement, dt_s: f64) {
        let to = seen(measurement);
        if self.span.length() != dt_s {
            self.span = dt_s.into();
        }
        match self.relation.observe(&self.last, &to, self.span, self.filter.estimate().x) {
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
        // From where it came, not from the copy: a copy of a copy waits until that has been written.
        self.last = seen(measurement);
        self.coasted = None;
    }

    fn coast(&mut self, dt_s: f64) {
        self.coasted = Some(self.body.flow(&self.rate(), &self.last, dt_s));
    }

    /// What the last step did: bits of [`status`].
    pub(super) fn status(&self) -> u64 {
        self.status
    }

    /// The hidden component as the last step reconstructs it, less the estimate, rad/s.
    pub(super) fn innovation(&self) -> f64 {
        self.innovation
    }

    /// The angular velocity with the supplied component in its place, rad/s.
    #[inline]
    pub(super) fn rate(&self) -> Vector3<f64> {
        self.coasted.unwrap_or_else(|| {
            let (measured, hidden) = (&self.last.rate_rad_s, self.filter.estimate().x);
            // Chosen bit by bit, not written at an index: three values that stay in registers.
            let chosen = |axis: usize| if axis == self.hidden { u64::MAX } else { 0 };
            let component = |axis: usize| {
                f64::from_bits(hidden.to_bits() & chosen(axis) | measured[axis].to_bits() & !chosen(axis))
            };
            Vector3::new(component(0), component(1), component(2))
        })
    }

    #[inline]
    pub(super) fn write(&self, status: u64, out: &mut RateEstimate) {
        self.body.write(&self.rate(), out);
        out.innovation_rad_s = self.innovation;
        out.excitation = 0.0;
        out.status = self.status | status;
        out.valid = if out.status & status::INITIAL == 0 { ALL } else { self.needed() };
    }
}

/// What coefficients say of a body. Where they are known it is computed once.
#[derive(Debug, Clone, Copy)]
pub(super) struct Knowledge {
    coefficients: Vector3<f64>,
    closure: f64,
    inertia_ratios: [f64; 2],
}

impl Knowledge {
    /// What these coefficients say.
    pub fn new(coefficients: Vector3<f64>) -> Self {
        let closure = coefficients.sum() + coefficients.product();
        let ratios = InertiaRatios::new(&coefficients).map_or([0.0; 2], |ratios| [ratios.second, ratios.third]);
        Self { coefficients, closure, inertia_ratios: ratios }
    }

    /// Where a body of which this is true goes from `rate` in `dt_s` seconds, under the torque of `last`.
    fn flow(&self, rate: &Vector3<f64>, last: &RateSample, dt_s: f64) -> Vector3<f64> {
        RigidBody::with_coefficients(self.coefficients).flow(rate, &last.torque_rad_s2, dt_s)
    }

    /// Writes it beside a motion.
    #[inline]
    pub fn write(&self, rate: &Vector3<f64>, out: &mut RateEstimate) {
        out.omega_rad_s = (*rate).into();
        out.coefficients = self.coefficients.into();
        out.closure = self.closure;
        out.inertia_ratios = self.inertia_ratios;
    }
}

/// A filter of the hidden component with the given decay rate, 1/s, at the given estimate, rad/s.
pub(super) fn filter(decay_rate_per_s: f64, estimate_rad_s: f64) -> Filter<1> {
    Filter::First(InvariantFilter::new(Vector1::new(decay_rate_per_s), Vector1::new(estimate_rad_s)))
}

/// Supplies one component from the other two, all of them filtered: the noise of the sensors is known.
#[derive(Debug)]
pub struct KalmanObserver {
    body: Knowledge,
    noise: RateNoise,
    hidden: usize,
    floor_rad_s: f64,
    guess_rad_s: f64,
    /// None before the first measurement.
    filter: Option<GuardedKalman>,
    last: RateSample,
    /// Where the model has taken the body since, while no measurement was usable.
    coasted: Option<Vector3<f64>>,
    status: u64,
}

impl KalmanObserver {
    /// An observer of component `hidden` (0 to 2) of a body with the given coefficients.
    pub(super) fn new(
        coefficients: Vector3<f64>,
        noise: RateNoise,
        hidden: usize,
        floor_rad_s: f64,
        guess_rad_s: f64,
    ) -> Self {
        let last = RateSample { rate_rad_s: Vector3::zeros(), torque_rad_s2: Vector3::zeros() };
        let body = Knowledge::new(coefficients);
        let (filter, coasted) = (None, None);
        Self { body, noise, hidden, floor_rad_s, guess_rad_s, filter, last, coasted, status: status::INITIAL }
    }

    fn needed(&self) -> u64 {
        ALL & !(1 << self.hidden)
    }

    fn start(&mut self, measurement: &RateMeasurement) {
        (self.last, self.coasted) = (seen(measurement), None);
        self.status = status::INITIAL;
        let (axis, first) = (self.hidden + 1, &self.last);
        // That the component can be observed was checked when the scenario was resolved.
        self.filter =
            GuardedKalman::new(&self.body.coefficients, axis, self.floor_rad_s, self.noise, first, self.guess_rad_s)
                .ok();
    }

    #[inline]
    fn update(&mut self, measurement: &RateMeasurement, dt_s: f64) {
        let to = seen(measurement);
        if let Some(filter) = &mut self.filter {
            let held = filter.step(&self.last, &to, dt_s);
            self.status = if held { 0 } else { status::UNOBSERVABLE };
        }
        (self.last, self.coasted) = (to, None);
    }

    fn coast(&mut self, dt_s: f64) {
        self.coasted = Some(self.body.flow(&self.rate(), &self.last, dt_s));
    }

    fn rate(&self) -> Vector3<f64> {
        let filtered = || self.filter.as_ref().map_or(self.last.rate_rad_s, |filter| *filter.estimate());
        self.coasted.unwrap_or_else(filtered)
    }

    #[inline]
    fn write(&self, status: u64, out: &mut RateEstimate) {
        self.body.write(&self.rate(), out);
        out.innovation_rad_s = 0.0;
        out.excitation = 0.0;
        out.status = self.status | status;
        out.valid = if out.status & status::INITIAL == 0 { ALL } else { self.needed() };
    }
}
