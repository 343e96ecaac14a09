//! The one filter behind all three papers, stepped exactly.
//!
//! An invariant relation φ̇ = ρ w, ẇ = g ties an unknown w to a measured potential φ. The filter
//! ŵ' = g + λ(ρ ŵ − φ̇) has the error equation (w − ŵ)' = λ ρ (w − ŵ): \[D\](6)-(10), \[SZ\](4)-(8), \[S\](12)-(16) with their
//! auxiliary variables eliminated, so that ŵ itself is the state and only *increments* of φ are ever needed.

use nalgebra::SVector;

/// What an invariant relation learned about its unknown w over one step from 0 to h.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Increment<const N: usize> {
    /// ∫ρ w dt: the growth of the measured potential, a known input's share taken out.
    pub potential: SVector<f64, N>,
    /// W = ∫ρ dt, never negative. Zero: the step tells nothing about w.
    pub weight: f64,
    /// G(h) = ∫g dt: how far w drifted by what is known.
    pub drift: SVector<f64, N>,
    /// ∫ρ G dt: the part of the potential that the drift explains.
    pub drift_moment: SVector<f64, N>,
    /// Variance of the potential at the end of the step, from the variances of what is measured; 0 without noise.
    pub variance: SVector<f64, N>,
}

/// First-order filter of an unknown w in R^N: the error decays as e^{−rate·W}, at any step size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InvariantFilter<const N: usize> {
    rate: SVector<f64, N>,
    estimate: SVector<f64, N>,
    /// The decay e^{−rate·W} for the weight it was computed for: an equal tick pays for no exponential.
    decay: (f64, SVector<f64, N>),
}

impl<const N: usize> InvariantFilter<N> {
    /// A filter with decay rates −λ (positive; per second where ρ = 1) and an initial guess in the unit of w.
    pub fn new(rate: SVector<f64, N>, guess: SVector<f64, N>) -> Self {
        Self { rate, estimate: guess, decay: (0.0, SVector::repeat(1.0)) }
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
            let start = (increment.potential - increment.drift_moment) / increment.weight;
            let decay = self.decay(increment.weight);
            self.estimate = start + increment.drift + decay.component_mul(&(self.estimate - start));
        } else {
            self.predict(&increment.drift);
        }
    }

    /// Moves the estimate by its known drift alone, over a step that tells nothing about w.
    #[inline]
    pub fn predict(&mut self, drift: &SVector<f64, N>) {
        self.estimate += drift;
    }

    #[inline]
    fn decay(&mut self, weight: f64) -> SVector<f64, N> {
        if self.decay.0 != weight {
            self.decay = (weight, self.rate.map(|rate| libm::exp(-rate * weight)));
        }
        self.decay.1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Vector1, Vector2};

    /// w = 2 + 3s over a step of `h`, ρ = 1: the increment that a perfect relation reports.
    fn ramp(w0: f64, h: f64) -> Increment<1> {
        Increment {
            potential: Vector1::new(w0 * h + 1.5 * h * h),
            weight: h,
            drift: Vector1::new(3.0 * h),
            drift_moment: Vector1::new(1.5 * h * h),
            variance: Vector1::zeros(),
        }
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
        filter.step(&Increment {
            potential: nothing,
            weight: 0.0,
            drift: Vector2::new(1.0, 2.0),
            drift_moment: nothing,
            variance: nothing,
        });
        assert_eq!(*filter.estimate(), Vector2::new(1.5, 2.25));
    }
}
