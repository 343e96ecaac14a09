//! Second-order filters: they estimate the potential (φ̂) together with ŵ, and both follow the measurement.
//!
//! In (φ, w) an invariant relation φ̇ = ρ w, ẇ = g is a *linear* double integrator with a known input, whatever the
//! body does. So a filter with constant gains and the Kalman filter both converge from every guess. The papers'
//! first-order filter passes white noise of φ to ŵ with the gain |λ|; these filters integrate it once more. Not in
//! the papers.
//!
//! Components are decoupled: each has a scalar filter. φ itself must not be stored, because only its increments are
//! known: the state is the residual r = φ − φ̂.

use super::filter::{Increment, StepAgain};
use super::series;
use crate::state::{Persist, WeightWords, Words, persist_fields};
use crate::vector::zeros;
use nalgebra::SVector;

/// A second-order filter with constant poles: the error obeys ë + 2ζωₙė + ωₙ²e = 0 in W, at any step size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SecondOrderFilter<const N: usize> {
    bandwidth: SVector<f64, N>,
    damping: f64,
    estimate: SVector<f64, N>,
    residual: SVector<f64, N>,
    /// The gains for the stored weight: an equal tick needs no exponential.
    gains: Gains<N>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Gains<const N: usize> {
    weight: f64,
    potential: SVector<f64, N>,
    unknown: SVector<f64, N>,
}

impl<const N: usize> SecondOrderFilter<N> {
    /// Creates a filter with the bandwidths ωₙ (positive; rad per unit of W, rad/s where ρ = 1), the damping ratio ζ
    /// (positive; 1/√2 gives the flattest response) and an initial guess in the unit of w.
    pub fn new(bandwidth: SVector<f64, N>, damping: f64, guess: SVector<f64, N>) -> Self {
        let none = Gains { weight: 0.0, potential: SVector::zeros(), unknown: SVector::zeros() };
        Self { bandwidth, damping, estimate: guess, residual: SVector::zeros(), gains: none }
    }

    /// Returns the same filter with another initial guess.
    pub fn with_guess(self, guess: SVector<f64, N>) -> Self {
        Self { estimate: guess, ..self }
    }

    /// Returns the estimate ŵ at the end of the last step.
    #[inline]
    pub fn estimate(&self) -> &SVector<f64, N> {
        &self.estimate
    }

    /// Advances the estimate over a step in which the relation held.
    #[inline]
    pub fn step(&mut self, increment: &Increment<N>) {
        if increment.weight > 0.0 {
            if self.gains.weight != increment.weight {
                self.gains = self.place(increment.weight);
            }
            self.step_placed(increment);
        } else {
            self.predict(&increment.drift);
        }
    }

    /// Advances the estimate by its known drift alone, over a step without information about w.
    ///
    /// The change of φ over the step stays unknown, so φ̂ restarts at the next measured φ with a residual of zero.
    #[inline]
    pub fn predict(&mut self, drift: &SVector<f64, N>) {
        self.estimate += drift;
        self.residual = zeros();
    }

    #[inline(always)]
    fn step_placed(&mut self, increment: &Increment<N>) {
        let innovation =
            self.residual + increment.potential - (self.estimate * increment.weight + increment.drift_moment);
        self.estimate += increment.drift + self.gains.unknown.component_mul(&innovation);
        self.residual = innovation - self.gains.potential.component_mul(&innovation);
    }

    #[cold]
    fn place(&self, weight: f64) -> Gains<N> {
        let pairs = self.bandwidth.map(|bandwidth| place(bandwidth * weight, self.damping));
        Gains { weight, potential: pairs.map(|pair| pair.0), unknown: pairs.map(|pair| pair.1 / weight) }
    }
}

impl<const N: usize> Persist for SecondOrderFilter<N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.estimate.persist(words);
        self.residual.persist(words);
    }
}

impl<const N: usize> StepAgain<N> for SecondOrderFilter<N> {
    #[inline(always)]
    fn step_again(&mut self, increment: &Increment<N>) -> Option<&SVector<f64, N>> {
        if self.gains.weight != increment.weight || increment.weight <= 0.0 {
            return None;
        }
        self.step_placed(increment);
        Some(&self.estimate)
    }
}

/// Computes (K1, K2·W) that place the poles of one step at z = e^s, s = x(−ζ ± √(ζ² − 1)), x = ωₙW.
///
/// The step maps (r, e) to ((1 − K1)(r + W e), e − K2(r + W e)): its determinant is 1 − K1 = z₁z₂ and its trace 2 −
/// K1 − K2·W = z₁ + z₂, so K1 = 1 − z₁z₂ and K2·W = (1 − z₁)(1 − z₂), here without cancellation.
fn place(x: f64, damping: f64) -> (f64, f64) {
    let root = x * libm::sqrt((damping * damping - 1.0).abs());
    let potential = -libm::expm1(-2.0 * damping * x);
    let unknown = if damping < 1.0 {
        let fall = libm::expm1(-damping * x);
        fall * fall + 4.0 * (1.0 + fall) * series::sine_squared(0.5 * root)
    } else {
        libm::expm1(-damping * x + root) * libm::expm1(-damping * x - root)
    };
    (potential, unknown)
}

/// A second-order filter with the Kalman filter's gains, which weigh the noise of the measurement and of the model's
/// drift.
///
/// Each [`Increment`] carries its measurement noise, including the part in the drift. The filter is optimal among
/// those that use only the relation; it does not use the information in the measured components beyond φ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KalmanFilter<const N: usize> {
    density: SVector<f64, N>,
    estimate: SVector<f64, N>,
    residual: SVector<f64, N>,
    covariance: [Covariance; N],
    /// True if φ̂ is tied to a measured φ: not before the first step, nor after a step without information.
    based: bool,
}

impl<const N: usize> KalmanFilter<N> {
    /// Creates a filter for an unknown that drifts randomly with the density `density` (not negative; (unit of w)²
    /// per unit of W, so per second where ρ = 1), with an initial guess of the standard deviation `deviation` (unit
    /// of w).
    ///
    /// Density zero is a perfect model: the memory then grows without limit.
    pub fn new(density: SVector<f64, N>, guess: SVector<f64, N>, deviation: SVector<f64, N>) -> Self {
        let covariance = core::array::from_fn(|index| Covariance {
            potential: 0.0,
            slope: 0.0,
            rest: deviation[index] * deviation[index],
        });
        Self { density, estimate: guess, residual: SVector::zeros(), covariance, based: false }
    }

    /// Returns the same filter with another initial guess.
    pub fn with_guess(self, guess: SVector<f64, N>) -> Self {
        Self { estimate: guess, ..self }
    }

    /// Returns the estimate ŵ at the end of the last step.
    #[inline]
    pub fn estimate(&self) -> &SVector<f64, N> {
        &self.estimate
    }

    /// Returns the standard deviation of the estimate under the assumed noise, in the unit of w.
    #[inline]
    pub fn deviation(&self) -> SVector<f64, N> {
        SVector::from_fn(|index, _| libm::sqrt(self.covariance[index].unknown()))
    }

    /// Advances the estimate over a step in which the relation held.
    #[inline]
    pub fn step(&mut self, increment: &Increment<N>) {
        if increment.weight > 0.0 {
            for index in 0..N {
                self.step_component(index, increment);
            }
            self.based = true;
        } else {
            self.predict(&increment.drift, 0.0);
        }
    }

    /// Advances the estimate by its known drift alone, over a step of weight `weight` without information about w.
    ///
    /// The change of φ over the step stays unknown, so φ̂ restarts at the next measured φ: its residual is zero, and
    /// its variance is that of one measurement, independent of all before.
    #[inline]
    pub fn predict(&mut self, drift: &SVector<f64, N>, weight: f64) {
        self.estimate += drift;
        self.residual = zeros();
        for (covariance, density) in self.covariance.iter_mut().zip(self.density.iter()) {
            *covariance = Covariance { potential: 0.0, slope: 0.0, rest: covariance.unknown() + density * weight };
        }
        self.based = false;
    }

    #[inline]
    fn step_component(&mut self, index: usize, increment: &Increment<N>) {
        let weight = increment.weight;
        let variance = increment.variance[index];
        let mut covariance = self.covariance[index];
        if !self.based {
            // φ at the start has the measurement noise of φ at the end: neighbouring samples have nearly the same
            // noise.
            covariance.potential = variance;
        }
        covariance.transport(weight, self.density[index]);
        let innovation = self.residual[index] + increment.potential[index]
            - (weight * self.estimate[index] + increment.drift_moment[index]);
        let mut estimate = self.estimate[index] + increment.drift[index];
        if variance > 0.0 {
            // The drift's noise correlates with the innovation's: that part is removed, and the rest adds to the
            // model's noise.
            let regression = increment.drift_covariance[index] / variance;
            estimate -= regression * innovation;
            covariance.slope += regression;
            covariance.rest +=
                (increment.drift_variance[index] - regression * increment.drift_covariance[index]).max(0.0);
        }
        let gain = covariance.measure(variance);
        self.estimate[index] = estimate + covariance.slope * gain * innovation;
        self.residual[index] = innovation - gain * innovation;
        self.covariance[index] = covariance;
    }
}

impl<const N: usize> Persist for KalmanFilter<N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.estimate.persist(words);
        self.residual.persist(words);
        self.covariance.persist(&mut WeightWords(words));
        self.based.persist(words);
    }
}

persist_fields!(Covariance, potential, slope, rest);

/// The covariance of the errors of (φ̂, ŵ) as L·D·Lᵀ. Every operation adds and multiplies non-negative numbers, so
/// rounding cannot make it indefinite.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Covariance {
    /// Var φ.
    potential: f64,
    /// Cov(φ, w)/Var φ: the expected error of ŵ per unit of the error of φ̂.
    slope: f64,
    /// Var w given φ.
    rest: f64,
}

impl Covariance {
    /// Returns Var w.
    #[inline]
    fn unknown(&self) -> f64 {
        self.potential * self.slope * self.slope + self.rest
    }

    /// Propagates the covariance over a step of the double integrator of weight `w`, with white noise of density `q`
    /// on the unknown.
    #[inline]
    fn transport(&mut self, w: f64, q: f64) {
        let Self { potential, slope, rest } = *self;
        let turn = slope * w;
        let grown = potential * (1.0 + turn) * (1.0 + turn) + w * w * rest + q * w * w * w / 3.0;
        if grown > 0.0 {
            let cross = potential * (1.0 + turn) * slope + w * rest + q * w * w / 2.0;
            // Without noise the determinant stays, because the transition has determinant one.
            let mixed = potential * ((1.0 + 0.5 * turn) * (1.0 + 0.5 * turn) + turn * turn / 12.0) + w * w * rest / 3.0;
            let determinant = potential * rest + q * w * mixed + q * q * w * w * w * w / 12.0;
            *self = Self { potential: grown, slope: cross / grown, rest: determinant / grown };
        }
    }

    /// Updates the covariance by a measurement of φ of the given variance. Returns the gain of φ̂; that of ŵ is
    /// `slope` times as large.
    #[inline]
    fn measure(&mut self, variance: f64) -> f64 {
        let total = self.potential + variance;
        if total > 0.0 {
            let gain = self.potential / total;
            // Slope and rest are conditional on φ, so a measurement of φ leaves them unchanged.
            self.potential = gain * variance;
            gain
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Vector1, Vector2};

    const DENSITY: f64 = 1e-4;
    const VARIANCE: f64 = 1e-6;

    fn increment(potential: f64, weight: f64, variance: f64) -> Increment<1> {
        let nothing = Vector1::zeros();
        let exact = Increment::exact(Vector1::new(potential), weight, nothing, nothing);
        Increment { variance: Vector1::new(variance), ..exact }
    }

    fn kalman(guess: f64, deviation: f64) -> KalmanFilter<1> {
        KalmanFilter::new(Vector1::new(DENSITY), Vector1::new(guess), Vector1::new(deviation))
    }

    fn normals(seed: u64) -> impl FnMut() -> f64 {
        let mut noise = crate::model::Noise::new(seed, 0, [1.0], [0.0]);
        move || noise.sample().x
    }

    #[test]
    fn the_error_has_the_designed_poles_at_any_step() {
        for (damping, bandwidth) in [(0.5, 0.7), (1.0, 0.7), (2.0, 0.7), (0.1, 3.0)] {
            for weight in [1e-3, 0.1, 3.0] {
                let mut filter = SecondOrderFilter::new(Vector1::new(bandwidth), damping, Vector1::new(0.5));
                let mut errors = [0.0; 3];
                for error in &mut errors {
                    filter.step(&increment(2.0 * weight, weight, 0.0));
                    *error = 2.0 - filter.estimate().x;
                }
                let x = bandwidth * weight;
                let middle: f64 = (-damping * x).exp();
                let root = x * (damping * damping - 1.0).abs().sqrt();
                let sum = 2.0 * middle * if damping < 1.0 { root.cos() } else { root.cosh() };
                let expected = sum * errors[1] - middle * middle * errors[0];
                assert!((errors[2] - expected).abs() < 1e-14, "{damping} {bandwidth} {weight}: {errors:?} {expected}");
            }
        }
    }

    #[test]
    fn weights_over_five_decades_do_not_destabilise_the_filter() {
        let mut normal = normals(3);
        for damping in [0.3, core::f64::consts::FRAC_1_SQRT_2, 1.5] {
            let mut filter = SecondOrderFilter::new(Vector1::new(2.0), damping, Vector1::new(-50.0));
            let mut kalman = kalman(-50.0, 50.0);
            let (mut total, mut worst) = (0.0, 0.0_f64);
            while total < 60.0 {
                let weight = libm::exp(-5.0 + 3.0 * normal()).min(10.0);
                total += weight;
                filter.step(&increment(2.0 * weight, weight, 0.0));
                kalman.step(&increment(2.0 * weight, weight, VARIANCE));
                worst = worst.max((2.0 - filter.estimate().x).abs());
            }
            assert!(worst <= 60.0, "{damping}: overshoot to {worst}");
            assert!((2.0 - filter.estimate().x).abs() < 1e-6, "{damping}: {}", filter.estimate().x);
            assert!((2.0 - kalman.estimate().x).abs() < 1e-3, "{damping}: {}", kalman.estimate().x);
        }
    }

    #[test]
    fn a_step_without_information_moves_by_the_drift_and_resets_the_potential() {
        let mut filter = SecondOrderFilter::new(Vector2::new(2.0, 1.0), 0.7, Vector2::new(0.5, 0.25));
        let exact = Increment::exact(Vector2::new(0.3, 0.1), 0.1, Vector2::zeros(), Vector2::zeros());
        filter.step(&exact);
        let before = *filter.estimate();
        filter.step(&Increment { weight: 0.0, drift: Vector2::new(1.0, 2.0), ..exact });
        assert_eq!(*filter.estimate(), before + Vector2::new(1.0, 2.0));
        assert_eq!(filter.residual, Vector2::zeros());
    }

    /// Returns the error over the deviation of the estimate at three ticks: the unknown drifts with the assumed
    /// density, is measured with noise, and is not measured for 5 s.
    fn normalised_errors(seed: u64) -> [f64; 3] {
        let (h, mut normal) = (0.02, normals(seed));
        let (mut phi, mut w) = (0.0, 3.0 + 0.5 * normal());
        let mut filter = kalman(3.0, 0.5);
        let mut seen = phi + VARIANCE.sqrt() * normal();
        let mut normalised = [0.0; 3];
        for tick in 1..=800 {
            let (kick, second) = (normal(), normal());
            // The exact covariance of (∫w, w) under white noise.
            phi += h * w + (DENSITY * h * h * h).sqrt() * (0.5 * kick + second / 12.0_f64.sqrt());
            w += (DENSITY * h).sqrt() * kick;
            let now = phi + VARIANCE.sqrt() * normal();
            if (300..550).contains(&tick) {
                filter.predict(&Vector1::zeros(), h);
            } else {
                filter.step(&increment(now - seen, h, VARIANCE));
            }
            seen = now;
            if let Some(slot) = [299, 549, 560].iter().position(|&end| end == tick) {
                normalised[slot] = (w - filter.estimate().x) / filter.deviation().x;
            }
        }
        normalised
    }

    #[test]
    fn the_deviation_is_consistent_before_during_and_after_a_gap() {
        const RUNS: u64 = 2000;
        let mut squares = [0.0; 3];
        for seed in 0..RUNS {
            for (square, value) in squares.iter_mut().zip(normalised_errors(seed)) {
                *square += value * value / RUNS as f64;
            }
        }
        // The mean is 1; its standard error is √(2/2000) = 0.032.
        assert!(squares.iter().all(|square| (square - 1.0).abs() < 0.12), "{squares:?}");
    }

    #[test]
    fn the_covariance_equals_the_textbook_equations() {
        let (w, q, r) = (0.3, 0.02, 0.5);
        let mut covariance = Covariance { potential: 0.7, slope: -0.4, rest: 0.2 };
        let (a, b, c) = (0.7, -0.28, covariance.unknown());
        covariance.transport(w, q);
        let a1 = a + 2.0 * w * b + w * w * c + q * w * w * w / 3.0;
        let (b1, c1) = (b + w * c + q * w * w / 2.0, c + q * w);
        let gain = covariance.measure(r);
        let total = a1 + r;
        assert!((gain - a1 / total).abs() < 1e-15);
        assert!((gain * covariance.slope - b1 / total).abs() < 1e-15);
        assert!((covariance.unknown() - (c1 - b1 * b1 / total)).abs() < 1e-15);
    }

    #[test]
    fn rounding_leaves_the_covariance_positive() {
        let mut filter = KalmanFilter::new(Vector1::zeros(), Vector1::new(0.0), Vector1::new(1e8));
        for tick in 0..200_000 {
            filter.step(&increment(2e-3, 1e-3, 1e-14));
            let deviation = filter.deviation().x;
            assert!(deviation > 0.0 && deviation < 1.01e8, "tick {tick}: {deviation}");
        }
        assert!((filter.estimate().x - 2.0).abs() < 1e-9, "{}", filter.estimate().x);
    }

    #[test]
    fn zero_noise_and_zero_deviation_do_not_divide_by_zero() {
        let mut filter = KalmanFilter::new(Vector1::zeros(), Vector1::new(0.5), Vector1::zeros());
        filter.step(&increment(2e-3, 1e-3, 0.0));
        assert_eq!((filter.estimate().x, filter.deviation().x), (0.5, 0.0));
        let mut curious = KalmanFilter::new(Vector1::zeros(), Vector1::new(0.5), Vector1::new(1.0));
        curious.step(&increment(2e-3, 1e-3, 0.0));
        assert!((curious.estimate().x - 2.0).abs() < 1e-15);
    }
}
