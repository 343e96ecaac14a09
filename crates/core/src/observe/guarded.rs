//! A Kalman filter of all three angular velocities of a body, two of them measured, that converges from every guess.
//!
//! A relation uses only φ of the two measured components. The direction across φ (the curve on which the motion runs)
//! carries as much information again, which only a filter of the whole state uses. Linearised about its own estimate
//! (the extended Kalman filter), such a filter can diverge. Linearised about the estimate of a globally convergent
//! filter, it cannot: T. A. Johansen, T. I. Fossen, *The eXogenous Kalman filter (XKF)*, Int. J. Control 90(2), 2017.
//! Here that filter, the guard, is the relation's [`KalmanFilter`], whose equations are linear. It is used only where
//! the two estimates contradict each other, because a raw measurement is the noisier point of linearisation.
//!
//! The estimate of the whole state must not enter the guard's filter: the guard converges on its own.

use super::hidden_rate::{HiddenRate, HiddenRateError, Observation, RateSample};
use super::second_order::KalmanFilter;
use crate::model::{euler, rk4_step};
use crate::state::{Persist, WeightWords, Words};
use nalgebra::{Matrix3, Vector1, Vector3};

/// The distance from the guard, in the guard's standard deviations, beyond which the estimate contradicts it.
const CONTRADICTION: f64 = 4.0;

/// The smallest density of the guard's unknown, (rad/s)²/s. The guard linearises φ at raw measurements, so its memory
/// must be finite.
const GUARD_DENSITY: f64 = 1e-10;

/// The longest step of the linearisation, s.
const MAX_STEP_S: f64 = 0.01;

/// The largest number of linearisation steps in one step of the filter: a long gap costs accuracy, but not the
/// deadline.
const MAX_STEPS: f64 = 10_000.0;

/// The assumed noise of the sensors, of the body and of the guess.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateNoise {
    /// Standard deviations of one measured sample, rad/s; the hidden component's is not used.
    pub sensor_deviation_rad_s: Vector3<f64>,
    /// Density of the white noise that drives the hidden component, (rad/s)²/s; not negative.
    pub density: f64,
    /// Standard deviation of the initial guess, rad/s.
    pub guess_deviation_rad_s: f64,
}

/// Kalman filter of a body's angular velocity, guarded by the invariant relation of its hidden component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GuardedKalman {
    coefficients: Vector3<f64>,
    /// Index of the hidden component.
    hidden: usize,
    relation: HiddenRate,
    guard: KalmanFilter<1>,
    noise: RateNoise,
    state: Vector3<f64>,
    covariance: Matrix3<f64>,
}

impl GuardedKalman {
    /// Creates a filter for the hidden axis `axis` (1 to 3) of a body with the coefficients a of \[D\](2).
    ///
    /// `floor_rad_s` is as in [`HiddenRate::new`], `first` is the first sample, `guess_rad_s` is the hidden component
    /// in it.
    ///
    /// # Errors
    /// [`HiddenRateError`] if there is no such axis or the body is a sphere.
    pub fn new(
        coefficients: &Vector3<f64>,
        axis: usize,
        floor_rad_s: f64,
        noise: RateNoise,
        first: &RateSample,
        guess_rad_s: f64,
    ) -> Result<Self, HiddenRateError> {
        let relation = HiddenRate::new(coefficients, axis, floor_rad_s)?.with_noise(&noise.sensor_deviation_rad_s);
        let guard = KalmanFilter::new(
            Vector1::new(noise.density.max(GUARD_DENSITY)),
            Vector1::new(guess_rad_s),
            Vector1::new(noise.guess_deviation_rad_s),
        );
        let hidden = axis - 1;
        let (mut state, mut deviation) = (first.rate_rad_s, noise.sensor_deviation_rad_s);
        state[hidden] = guess_rad_s;
        deviation[hidden] = noise.guess_deviation_rad_s;
        let covariance = Matrix3::from_diagonal(&deviation.component_mul(&deviation));
        Ok(Self { coefficients: *coefficients, hidden, relation, guard, noise, state, covariance })
    }

    /// Returns the angular velocity at the end of the last step, rad/s. The measured components are filtered too.
    #[inline]
    pub fn estimate(&self) -> &Vector3<f64> {
        &self.state
    }

    /// Returns the standard deviation of the estimate under the assumed noise, rad/s.
    #[inline]
    pub fn deviation(&self) -> Vector3<f64> {
        self.covariance.diagonal().map(|variance| libm::sqrt(variance.max(0.0)))
    }

    /// Advances the estimate over the step of `dt_s` seconds (positive) between two finite samples; `from` is the
    /// last one used. Returns true if the relation held over the step.
    #[inline]
    pub fn step(&mut self, from: &RateSample, to: &RateSample, dt_s: f64) -> bool {
        self.predict(from, dt_s);
        for index in [(self.hidden + 1) % 3, (self.hidden + 2) % 3] {
            self.correct(index, to.rate_rad_s[index]);
        }
        let (from, to) = (self.relation.regressor(from), self.relation.regressor(to));
        let seen = self.relation.observe(&from, &to, dt_s, self.guard.estimate().x);
        match &seen {
            Observation::Seen(increment) => self.guard.step(increment),
            Observation::Unobservable { drift } => self.guard.predict(drift, dt_s),
        }
        matches!(seen, Observation::Seen(_))
    }

    #[inline]
    fn predict(&mut self, from: &RateSample, dt_s: f64) {
        let mut point = self.point(from);
        let mut deviation = self.state - point;
        let steps = libm::ceil(dt_s / MAX_STEP_S - 1e-6).clamp(1.0, MAX_STEPS);
        let h = dt_s / steps;
        for _ in 0..steps as u64 {
            let transition = self.transition(&point, h);
            point = rk4_step(|x| euler(&self.coefficients, x, &from.torque_rad_s2), &point, h);
            deviation = transition * deviation;
            self.covariance = transition * self.covariance * transition.transpose();
            self.covariance[(self.hidden, self.hidden)] += self.noise.density * h;
        }
        self.state = point + deviation;
    }

    /// Returns the point of linearisation: the own estimate, or, where the guard contradicts it, the measurement with
    /// the guard's.
    #[inline]
    fn point(&self, from: &RateSample) -> Vector3<f64> {
        let guard = self.guard.estimate().x;
        let distance = (self.state[self.hidden] - guard).abs();
        if distance <= CONTRADICTION * self.guard.deviation().x {
            return self.state;
        }
        let mut point = from.rate_rad_s;
        point[self.hidden] = guard;
        point
    }

    /// Computes the transition of a deviation from `x` over `h` seconds, to second order.
    #[inline]
    fn transition(&self, x: &Vector3<f64>, h: f64) -> Matrix3<f64> {
        let a = self.coefficients * h;
        #[rustfmt::skip]
        let jacobian = Matrix3::new(
            0.0, a.x * x.z, a.x * x.y,
            a.y * x.z, 0.0, a.y * x.x,
            a.z * x.y, a.z * x.x, 0.0,
        );
        Matrix3::identity() + jacobian + jacobian * jacobian * 0.5
    }

    /// Corrects the estimate by one measured component, in Joseph's form, which stays positive definite under
    /// rounding.
    #[inline]
    fn correct(&mut self, index: usize, measured: f64) {
        let variance = self.noise.sensor_deviation_rad_s[index] * self.noise.sensor_deviation_rad_s[index];
        let total = self.covariance[(index, index)] + variance;
        if total > 0.0 {
            let gain: Vector3<f64> = self.covariance.column(index) / total;
            self.state += gain * (measured - self.state[index]);
            let half = self.covariance - gain * self.covariance.row(index);
            let full = half - (half.column(index) - gain * variance) * gain.transpose();
            self.covariance = (full + full.transpose()) * 0.5;
        }
    }
}

impl Persist for GuardedKalman {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.guard.persist(words);
        self.state.persist(words);
        self.covariance.persist(&mut WeightWords(words));
    }
}
