//! The filter of all three papers, stepped exactly.
//!
//! An invariant relation φ̇ = ρ w, ẇ = g ties an unknown w to a measured potential φ. The filter ŵ' = g + λ(ρ ŵ − φ̇)
//! has the error equation (w − ŵ)' = λ ρ (w − ŵ): \[D\](6)-(10), \[SZ\](4)-(8), \[S\](12)-(16). The papers' auxiliary
//! variables are eliminated, so that ŵ itself is the state and only *increments* of φ are needed.

use super::hurwitz::Hurwitz;
use crate::state::{Persist, Words};
use crate::vector::zeros;
use nalgebra::SVector;

/// The information of an invariant relation about its unknown w over one step from 0 to h.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Increment<const N: usize> {
    /// ∫ρ w dt: the growth of the measured potential less the share of a known input.
    pub potential: SVector<f64, N>,
    /// W = ∫ρ dt, never negative. At zero the step carries no information about w.
    pub weight: f64,
    /// 1/W, stored so that equal ticks need only one division.
    pub inverse_weight: f64,
    /// G(h) = ∫g dt: the known drift of w.
    pub drift: SVector<f64, N>,
    /// ∫ρ G dt: the part of the potential that the drift explains.
    pub drift_moment: SVector<f64, N>,
    /// The variance of the potential at the end of the step, from the variances of the measured quantities; 0 without
    /// noise.
    pub variance: SVector<f64, N>,
    /// The variance that the measurement at the end of the step adds to the drift of this step and the next; 0
    /// without noise.
    pub drift_variance: SVector<f64, N>,
    /// The covariance of potential and drift, which come from one measurement.
    pub drift_covariance: SVector<f64, N>,
}

impl<const N: usize> Increment<N> {
    /// Creates an increment without noise from its four integrals.
    #[inline]
    pub fn exact(
        potential: SVector<f64, N>,
        weight: impl Into<Span>,
        drift: SVector<f64, N>,
        moment: SVector<f64, N>,
    ) -> Self {
        let [variance, drift_variance, drift_covariance] = [zeros(); 3];
        let Span { length: weight, inverse: inverse_weight } = weight.into();
        Self {
            potential,
            weight,
            inverse_weight,
            drift,
            drift_moment: moment,
            variance,
            drift_variance,
            drift_covariance,
        }
    }

    /// Returns w at the end of the step as this step alone determines it: the estimate of a filter without memory.
    #[inline]
    pub fn reconstruction(&self) -> SVector<f64, N> {
        self.start() + self.drift
    }

    /// Returns w at the start of the step as this step alone determines it.
    #[inline]
    fn start(&self) -> SVector<f64, N> {
        (self.potential - self.drift_moment) * self.inverse_weight
    }
}

/// The length of a step, in time or in W, with its inverse, so that equal steps need only one division.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    length: f64,
    inverse: f64,
}

impl Span {
    /// Returns the length.
    #[inline]
    pub fn length(&self) -> f64 {
        self.length
    }

    /// Returns one over the length.
    #[inline]
    pub fn inverse(&self) -> f64 {
        self.inverse
    }
}

impl From<f64> for Span {
    #[inline]
    fn from(length: f64) -> Self {
        Self { length, inverse: 1.0 / length }
    }
}

/// A first-order filter of an unknown w in R^N: the error decays as e^{−rate·W}, or as e^{𝒜W}, at any step size.
///
/// An example with numbers of your own: the slope of a line that is measured at points. ρ = 1, so φ is the line
/// itself, and its increment from one point to the next is the potential.
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::nalgebra::Vector1;
/// use corotate::observe::{Increment, InvariantFilter};
///
/// let mut filter = InvariantFilter::new(Vector1::new(2.0), Vector1::new(0.0)); // decay rate in 1/s, initial guess
/// let line = |t: f64| 7.0 - 3.0 * t;
/// for step in 0..500 {
///     let (t, h) = (f64::from(step) * 0.01, 0.01);
///     let potential = Vector1::new(line(t + h) - line(t));
///     filter.step(&Increment::exact(potential, h, Vector1::zeros(), Vector1::zeros()));
/// }
/// // After 5 s the error of the guess has decayed by e^-10.
/// assert!((filter.estimate().x + 3.0).abs() < 3.1 * f64::exp(-10.0));
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InvariantFilter<const N: usize> {
    decay: Decay<N>,
    estimate: SVector<f64, N>,
}

/// The law by which the error decays.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Decay<const N: usize> {
    /// Each component decays by itself.
    Diagonal {
        rate: SVector<f64, N>,
        /// e^{−rate·W} for the weight in the first element: an equal tick needs no exponential.
        factor: (f64, SVector<f64, N>),
    },
    /// The components are coupled. Nothing is cached: the identifier's relation has another weight at every step.
    Matrix(Hurwitz<N>),
}

impl<const N: usize> InvariantFilter<N> {
    /// Creates a filter with decay rates −λ (positive; 1/s where ρ = 1) and an initial guess in the unit of w.
    pub fn new(rate: SVector<f64, N>, guess: SVector<f64, N>) -> Self {
        Self { decay: Decay::Diagonal { rate, factor: (0.0, SVector::repeat(1.0)) }, estimate: guess }
    }

    /// Creates a filter whose error obeys δ̇ = ρ 𝒜 δ, \[SZ\](8), with an initial guess in the unit of w.
    ///
    /// A diagonal 𝒜 is the same as [`InvariantFilter::new`] with the rates −𝒜_ii.
    pub fn with_matrix(matrix: Hurwitz<N>, guess: SVector<f64, N>) -> Self {
        match matrix.diagonal() {
            Some(diagonal) => Self::new(-diagonal, guess),
            None => Self { decay: Decay::Matrix(matrix), estimate: guess },
        }
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
    ///
    /// The step is exact at any length: with w(s) = w0 + G(s) and w0 fixed by the potential, ŵ(h) = w(h) − e^{λW}(w0
    /// − ŵ(0)) solves the filter's equation.
    #[inline]
    pub fn step(&mut self, increment: &Increment<N>) {
        if increment.weight > 0.0 {
            let left = self.decay.apply(increment.weight, self.estimate - increment.start());
            self.estimate = increment.reconstruction() + left;
        } else {
            self.predict(&increment.drift);
        }
    }

    /// Advances the estimate by its known drift alone, over a step without information about w.
    #[inline]
    pub fn predict(&mut self, drift: &SVector<f64, N>) {
        self.estimate += drift;
    }
}

impl<const N: usize> Persist for InvariantFilter<N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.estimate.persist(words);
    }
}

/// A filter with a fast path for a step that equals its last one.
pub trait StepAgain<const N: usize> {
    /// Advances the estimate over a step in which the relation held and whose positive weight equals the last one,
    /// and returns the estimate. Returns `None` and changes nothing for any other step. The result is bit-identical
    /// to that of the filter's own step.
    fn step_again(&mut self, increment: &Increment<N>) -> Option<&SVector<f64, N>>;
}

impl<const N: usize> StepAgain<N> for InvariantFilter<N> {
    #[inline(always)]
    fn step_again(&mut self, increment: &Increment<N>) -> Option<&SVector<f64, N>> {
        match &self.decay {
            Decay::Diagonal { factor: (weight, left), .. } if *weight == increment.weight && *weight > 0.0 => {
                let left = left.component_mul(&(self.estimate - increment.start()));
                self.estimate = increment.reconstruction() + left;
                Some(&self.estimate)
            }
            _ => None,
        }
    }
}

impl<const N: usize> Decay<N> {
    /// Returns the remaining error after a step of the given weight.
    #[inline]
    fn apply(&mut self, weight: f64, error: SVector<f64, N>) -> SVector<f64, N> {
        match self {
            Self::Diagonal { rate, factor } => {
                if factor.0 != weight {
                    *factor = (weight, remainder(rate, weight));
                }
                factor.1.component_mul(&error)
            }
            Self::Matrix(matrix) => matrix.decayed(weight, &error),
        }
    }
}

/// Computes e^{−rate·W}.
#[cold]
fn remainder<const N: usize>(rate: &SVector<f64, N>, weight: f64) -> SVector<f64, N> {
    rate.map(|rate| libm::exp(-rate * weight))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix2, Vector1, Vector2};

    /// Returns the increment of a perfect relation for w = `w0` + 3s over a step of `h`, ρ = 1.
    fn ramp(w0: f64, h: f64) -> Increment<1> {
        let moment = Vector1::new(1.5 * h * h);
        Increment::exact(Vector1::new(w0 * h) + moment, h, Vector1::new(3.0 * h), moment)
    }

    #[test]
    fn the_error_decays_by_the_exponential_at_any_step() {
        for h in [1e-3, 0.1, 3.0] {
            let mut filter = InvariantFilter::new(Vector1::new(5.0), Vector1::new(0.5));
            filter.step(&ramp(2.0, h));
            let error = 2.0 + 3.0 * h - filter.estimate().x;
            assert!((error - 1.5 * (-5.0 * h).exp()).abs() < 1e-12, "h {h}: {error}");
        }
    }

    #[test]
    fn two_half_steps_equal_one_whole() {
        let mut whole = InvariantFilter::new(Vector1::new(5.0), Vector1::new(0.5));
        let mut halves = whole;
        whole.step(&ramp(2.0, 0.4));
        halves.step(&ramp(2.0, 0.2));
        halves.step(&ramp(2.6, 0.2));
        assert!((whole.estimate() - halves.estimate()).amax() < 1e-14);
    }

    #[test]
    fn a_step_without_weight_moves_by_the_drift_alone() {
        let mut filter = InvariantFilter::new(Vector2::new(5.0, 1.0), Vector2::new(0.5, 0.25));
        let nothing = Vector2::zeros();
        filter.step(&Increment::exact(nothing, 0.0, Vector2::new(1.0, 2.0), nothing));
        assert_eq!(*filter.estimate(), Vector2::new(1.5, 2.25));
    }
    #[test]
    fn a_diagonal_matrix_is_bit_identical_to_its_rates() {
        let rate = Vector2::new(5.0, 0.3);
        let matrix = Hurwitz::new(Matrix2::from_diagonal(&-rate)).unwrap();
        let guess = Vector2::new(0.1, -0.7);
        let (mut by_rates, mut by_matrix) =
            (InvariantFilter::new(rate, guess), InvariantFilter::with_matrix(matrix, guess));
        for step in 1..100 {
            let w = f64::from(step);
            let (potential, drift) = (Vector2::new(w.sin(), w.cos()), Vector2::new(0.1, 0.2) / w);
            let increment = Increment::exact(potential, 0.01 * (step % 7) as f64, drift, Vector2::zeros());
            by_rates.step(&increment);
            by_matrix.step(&increment);
            assert_eq!(by_rates.estimate(), by_matrix.estimate());
        }
    }

    /// δ(W) = e^{−W} (cos 2W, −sin 2W): two coupled components whose errors rotate while they decay.
    #[test]
    fn a_matrix_rotates_the_error_while_it_decays() {
        let matrix = Hurwitz::new(Matrix2::new(-1.0, 2.0, -2.0, -1.0)).unwrap();
        let truth = Vector2::new(0.25, -0.5);
        let mut filter = InvariantFilter::with_matrix(matrix, truth - Vector2::new(1.0, 0.0));
        let mut total = 0.0_f64;
        for step in 0..60 {
            let weight = 0.002 * f64::from(step);
            total += weight;
            let nothing = Vector2::zeros();
            let potential = truth * weight;
            filter.step(&Increment::exact(potential, weight, nothing, nothing));
            let (sin, cos) = (2.0 * total).sin_cos();
            let error = truth - filter.estimate() - Vector2::new(cos, -sin) * (-total).exp();
            assert!(error.norm() < 1e-14, "after {total}: {error}");
        }
    }
}
