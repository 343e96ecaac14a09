//! An observer for any invariant relation: the papers' method for a body of your own.
//!
//! It must not depend on the meaning of the measured quantities.

use super::observer::Estimator;
use crate::observe::{Increment, InvariantFilter};
use crate::sample::{Sample, status};
use crate::state::{Persist, Words};
use nalgebra::SVector;

/// A relation that ties N unknowns w to measured quantities: ∫ρ w dt = φ(now) − φ(last), \[D\](6)-(10).
pub trait InvariantRelation<const N: usize> {
    /// The measured quantities.
    type Measurement: Sample;
    /// The measured quantities with the unknowns.
    type Estimate: Sample;

    /// Computes the increment of the relation over a step of `dt_s` seconds from one measurement to the next.
    fn increment(&self, last: &Self::Measurement, now: &Self::Measurement, dt_s: f64) -> Increment<N>;
    /// Writes the estimate from the last measurement, the unknowns and the status bits, but not the stamp.
    fn write(&self, last: &Self::Measurement, unknowns: &SVector<f64, N>, status: u64, out: &mut Self::Estimate);
}

/// A first-order observer of a relation's unknowns. The error of each decays at its given rate.
///
/// Without a usable measurement the estimate stays.
#[derive(Debug, Clone)]
pub struct RelationObserver<R: InvariantRelation<N>, const N: usize> {
    relation: R,
    guess: SVector<f64, N>,
    filter: InvariantFilter<N>,
    last: R::Measurement,
    status: u64,
}

impl<R: InvariantRelation<N>, const N: usize> RelationObserver<R, N> {
    /// Creates an observer with its decay rates (positive; 1/s where ρ = 1) and its guess, in the units of the
    /// unknowns.
    pub fn new(relation: R, decay_rates: [f64; N], guess: [f64; N]) -> Self {
        let filter = InvariantFilter::new(decay_rates.into(), guess.into());
        Self { relation, guess: guess.into(), filter, last: R::Measurement::default(), status: status::INITIAL }
    }
}

impl<R: InvariantRelation<N>, const N: usize> Estimator for RelationObserver<R, N> {
    type Measurement = R::Measurement;
    type Estimate = R::Estimate;

    fn start(&mut self, measurement: &R::Measurement) {
        self.filter = self.filter.with_guess(self.guess);
        (self.last, self.status) = (*measurement, status::INITIAL);
    }

    fn update(&mut self, measurement: &R::Measurement, dt_s: f64) {
        let increment = self.relation.increment(&self.last, measurement, dt_s);
        self.filter.step(&increment);
        let blind = if increment.weight > 0.0 { 0 } else { status::UNOBSERVABLE };
        (self.last, self.status) = (*measurement, blind);
    }

    fn write(&self, status: u64, out: &mut R::Estimate) {
        self.relation.write(&self.last, self.filter.estimate(), self.status | status, out);
    }
}

impl<R: InvariantRelation<N, Measurement: Persist>, const N: usize> Persist for RelationObserver<R, N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.filter.persist(words);
        self.last.persist(words);
        self.status.persist(words);
    }
}
