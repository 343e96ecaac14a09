//! An observer by the method of invariant relations, of any relation: what the papers do, for a body of your own.
//!
//! Must not know what is measured.

use super::Estimator;
use crate::observe::{Increment, InvariantFilter};
use crate::sample::{Sample, status};
use crate::state::{Persist, Words};
use nalgebra::SVector;

/// A relation that ties N unknowns to what is measured: ∫ρ w dt = φ(now) − φ(last), \[D\](6)-(10).
pub trait InvariantRelation<const N: usize> {
    /// What is measured.
    type Measurement: Sample;
    /// What is known by it.
    type Estimate: Sample;

    /// What the step of `dt_s` seconds from one measurement to the next tells of the unknowns.
    fn increment(&self, last: &Self::Measurement, now: &Self::Measurement, dt_s: f64) -> Increment<N>;
    /// Writes the estimate, everything but the stamp: what was measured last, the unknowns, the status bits.
    fn write(&self, last: &Self::Measurement, unknowns: &SVector<f64, N>, status: u64, out: &mut Self::Estimate);
}

/// The observer of a relation's unknowns, of first order: their error decays at the given rates.
///
/// Without a usable measurement it stays where it is.
#[derive(Debug, Clone)]
pub struct RelationObserver<R: InvariantRelation<N>, const N: usize> {
    relation: R,
    guess: SVector<f64, N>,
    filter: InvariantFilter<N>,
    last: R::Measurement,
    status: u64,
}

impl<R: InvariantRelation<N>, const N: usize> RelationObserver<R, N> {
    /// An observer with its decay rates (positive; 1/s where ρ = 1) and its guess, in the units of the unknowns.
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
