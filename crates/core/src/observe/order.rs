//! One type for the filters of either order, so that an estimator can hold the one that its scenario selects.
//!
//! It must not compute anything itself: each filter implements its own mathematics.

use super::filter::{Increment, InvariantFilter};
use super::second_order::{KalmanFilter, SecondOrderFilter};
use crate::state::{Persist, Words};
use nalgebra::SVector;

/// A filter of an unknown w in R^N.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Filter<const N: usize> {
    /// The papers' filter: exponential decay, for measurements without noise.
    First(InvariantFilter<N>),
    /// Constant second-order poles: passes little noise, with a chosen bandwidth.
    Second(SecondOrderFilter<N>),
    /// The Kalman filter's gains: the noise is known and determines the bandwidth.
    Kalman(KalmanFilter<N>),
}

impl<const N: usize> Filter<N> {
    /// Advances the estimate over a step in which the relation held.
    #[inline]
    pub fn step(&mut self, increment: &Increment<N>) {
        match self {
            Self::First(filter) => filter.step(increment),
            Self::Second(filter) => filter.step(increment),
            Self::Kalman(filter) => filter.step(increment),
        }
    }

    /// Advances the estimate by its known drift alone (unit of w), over a step of weight `weight` without information
    /// about w.
    #[inline]
    pub fn predict(&mut self, drift: &SVector<f64, N>, weight: f64) {
        match self {
            Self::First(filter) => filter.predict(drift),
            Self::Second(filter) => filter.predict(drift),
            Self::Kalman(filter) => filter.predict(drift, weight),
        }
    }

    /// Returns the same filter with another initial guess.
    pub fn with_guess(self, guess: SVector<f64, N>) -> Self {
        match self {
            Self::First(filter) => Self::First(filter.with_guess(guess)),
            Self::Second(filter) => Self::Second(filter.with_guess(guess)),
            Self::Kalman(filter) => Self::Kalman(filter.with_guess(guess)),
        }
    }

    /// Returns the estimate ŵ at the end of the last step.
    #[inline]
    pub fn estimate(&self) -> &SVector<f64, N> {
        match self {
            Self::First(filter) => filter.estimate(),
            Self::Second(filter) => filter.estimate(),
            Self::Kalman(filter) => filter.estimate(),
        }
    }

    /// Returns the standard deviation of the estimate in the unit of w, if the filter computes it.
    #[inline]
    pub fn deviation(&self) -> Option<SVector<f64, N>> {
        match self {
            Self::Kalman(filter) => Some(filter.deviation()),
            Self::First(_) | Self::Second(_) => None,
        }
    }
}

impl<const N: usize> Persist for Filter<N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        match self {
            Self::First(filter) => filter.persist(words),
            Self::Second(filter) => filter.persist(words),
            Self::Kalman(filter) => filter.persist(words),
        }
    }
}
