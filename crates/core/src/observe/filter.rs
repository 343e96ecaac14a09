//! The one filter behind all three papers, stepped exactly.
//!
//! An invariant relation φ̇ = ρ w, ẇ = g ties an unknown w to a measured potential φ. The filter
//! ŵ' = g + λ(ρ ŵ − φ̇) has the error equation (w − ŵ)' = λ ρ (w − ŵ): \[D\](6)-(10), \[SZ\](4)-(8), \[S\](12)-(16) with their
//! auxiliary variables eliminated, so that ŵ itself is the state and only *increments* of φ are ever needed.

use super::Hurwitz;
use crate::state::{Persist, Words};
use crate::vector::zeros;
use nalgebra::SVector;

/// What an invariant relation learned about its unknown w over one step from 0 to h.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Increment<const N: usize> {
    /// ∫ρ w dt: the growth of the measured potential, a known input's share taken out.
    pub potential: SVector<f64, N>,
    /// W = ∫ρ dt, never negative. Zero: the step tells nothing about w.
    pub weight: f64,
    /// 1/W, so that equal ticks pay for one division only.
    pub inverse_weight: f64,
    /// G(h) = ∫g dt: how far w drifted by what is known.
    pub drift: SVector<f64, N>,
    /// ∫ρ G dt: the part of the potential that the drift explains.
    pub drift_moment: SVector<f64, N>,
    /// Variance of the potential at the end of the step, from the variances of what is measured; 0 without noise.
    pub variance: SVector<f64, N>,
    /// Variance of what the measurement at the end of the step adds to the drift of this step and the next; 0 without noise.
    pub drift_variance: SVector<f64, N>,
    /// Covariance of the two: both come from one measurement.
    pub drift_covariance: SVector<f64, N>,
}

impl<const N: usize> Increment<N> {
    /// An increment without noise, from its four integrals.
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

    /// w at the end of the step as this step alone has it: what a filter that forgot everything else would say.
    #[inline]
    pub fn reconstruction(&self) -> SVector<f64, N> {
        self.start() + self.drift
    }

    /// The same at the start of the step.
    #[inline]
    fn start(&self) -> SVector<f64, N> {
        (self.potential - self.drift_moment) * self.inverse_weight
    }
}

/// The length of a step, in time or in W, with its inverse: a division that equal steps pay for once.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    length: f64,
    inverse: f64,
}

impl Span {
    /// The length.
    #[inline]
    pub fn length(&self) -> f64 {
        self.length
    }

    /// One over the length.
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

/// First-order filter of an unknown w in R^N: the error decays as e^{−rate·W}, or as e^{𝒜W}, at any step size.
///
/// On numbers of your own: the slope of a line of which only points are measured. ρ = 1, so φ is the line itself, and its
/// increment from one point to the next is the potential.
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::nalgebra::Vector1;
/// use corotate::observe::{Increment, InvariantFilter};
///
/// let mut filter = InvariantFilter::new(Vector1::new(2.0), Vector1::new(0.0)); // 1/s, and the guess
/// let line = |t: f64| 7.0 - 3.0 * t;
/// for step in 0..500 {
///     let (t, h) = (f64::from(step) * 0.01, 0.01);
///     let potential = Vector1::new(line(t + h) - line(t));
///     filter.step(&Increment::exact(potential, h, Vector1::zeros(), Vector1::zeros()));
/// }
/// // After 5 s the error of the guess has fallen by e^-10.
/// assert!((filter.estimate().x + 3.0).abs() < 3.1 * f64::exp(-10.0));
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InvariantFilter<const N: usize> {
    decay: Decay<N>,
    estimate: SVector<f64, N>,
}

/// How the error decays.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Decay<const N: usize> {
    /// Each component by itself.
    Diagonal {
        rate: SVector<f64, N>,
        /// e^{−rate·W} for the weight it was computed for: an equal tick pays for no exponential.
        factor: (f64, SVector<f64, N>),
    },
    /// All together. Its relation, the identifier's, has another weight at every step: nothing is kept.
    Matrix(Hurwitz<N>),
}

impl<const N: usize> InvariantFilter<N> {
    /// A filter with decay rates −λ (positive; per second where ρ = 1) and an initial guess in the unit of w.
    pub fn new(rate: SVector<f64, N>, guess: SVector<f64, N>) -> Self {
        Self { decay: Decay::Diagonal { rate, factor: (0.0, SVector::repeat(1.0)) }, estimate: guess }
    }

    /// A filter whose error obeys δ̇ = ρ 𝒜 δ, \[SZ\](8), with an initial guess in the unit of w.
    ///
    /// A diagonal 𝒜 is the same as [`InvariantFilter::new`] with the rates −𝒜_ii.
    pub fn with_matrix(matrix: Hurwitz<N>, guess: SVector<f64, N>) -> Self {
        match matrix.diagonal() {
            Some(diagonal) => Self::new(-diagonal, guess),
            None => Self { decay: Decay::Matrix(matrix), estimate: guess },
        }
    }

    /// The same filter, begun at another guess.
    pub fn with_guess(self, guess: SVector<f64, N>) -> Self {
        Self { estimate: guess, ..self }
    }

    /// The estimate ŵ at the end of the last step.
    #[inline]
    pub fn estimate(&self) -> &SVector<f64, N> {
        &self.estimate
    }

    /// Moves the estimate over one step in which the relation held.
    ///
    /// Exact: with w(s) = w0 + G(s) and w0 fixed by the potential, ŵ(h) = w(h) − e^{λW}(w0 − ŵ(0)) solves the filter's
    /// equation, however long the step is.
    #[inline]
    pub fn step(&mut self, increment: &Increment<N>) {
        if increment.weight > 0.0 {
            let left = self.decay.apply(increment.weight, self.estimate - increment.start());
            self.estimate = increment.reconstruction() + left;
        } else {
            self.predict(&increment.drift);
        }
    }

    /// Moves the estimate by its known drift alone, over a step that tells nothing about w.
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

/// A filter that takes a step like its last one without computing anything anew.
pub trait StepAgain<const N: usize> {
    /// Moves the estimate over a step of the same positive weight as the last, in which the relation held, and gives it;
    /// `None`, and nothing done, for any other step. The same bits as by the filter's own step.
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
    /// What is left of an error after a step of the given weight.
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

/// e^{−rate·W}.
#[cold]
fn remainder<const N: usize>(rate: &SVector<f64, N>, weight: f64) -> SVector<f64, N> {
    rate.map(|rate| libm::exp(-rate * weight))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix2, Vector1, Vector2};

    /// w = 2 + 3s over a step of `h`, ρ = 1: the increment that a perfect relation reports.
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
    fn a_diagonal_matrix_gives_the_bits_of_its_rates() {
        let rate = Vector2::new(5.0, 0.3);
        let matrix = Hurwitz::new(Matrix2::from_diagonal(&-rate)).unwrap();
        let guess = Vector2::new(0.1, -0.7);
        let (mut one, mut other) = (InvariantFilter::new(rate, guess), InvariantFilter::with_matrix(matrix, guess));
        for step in 1..100 {
            let w = f64::from(step);
            let (potential, drift) = (Vector2::new(w.sin(), w.cos()), Vector2::new(0.1, 0.2) / w);
            let increment = Increment::exact(potential, 0.01 * (step % 7) as f64, drift, Vector2::zeros());
            one.step(&increment);
            other.step(&increment);
            assert_eq!(one.estimate(), other.estimate());
        }
    }

    /// δ(W) = e^{−W} (cos 2W, −sin 2W): two components that exchange their errors while these decay.
    #[test]
    fn a_matrix_turns_the_error_while_it_decays() {
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
