//! The identifier of the coefficients a of \[D\](2) from a body's motion: all three, or the one of an axisymmetric
//! body.

use crate::observe::{AxisymmetricRelation, Filter, Identification, InertiaRelation, RateSample};
use crate::sample::status;
use crate::state::{Persist, Words};
use crate::vector::zeros;
use nalgebra::{Vector1, Vector3};

/// An identifier with its estimate.
#[derive(Debug, Clone)]
pub struct Identifier {
    kind: Kind,
    /// The slowest decay rate of the error, per unit of excitation.
    slowest_decay: f64,
    /// ∫ρ dt so far: rad³/s², or rad for an axisymmetric body.
    excitation: f64,
}

#[derive(Debug, Clone)]
enum Kind {
    Asymmetric { relation: InertiaRelation, filter: Filter<3> },
    Axisymmetric { relation: AxisymmetricRelation, filter: Filter<1>, axis: usize },
}

impl Identifier {
    /// Creates an identifier for any body; `filter` is at the initial guess.
    pub fn asymmetric(relation: InertiaRelation, filter: Filter<3>, slowest_decay: f64) -> Self {
        Self { kind: Kind::Asymmetric { relation, filter }, slowest_decay, excitation: 0.0 }
    }

    /// Creates an identifier for a body with the symmetry axis `axis`, 1 to 3; `filter` is at the initial guess of a.
    pub fn axisymmetric(relation: AxisymmetricRelation, axis: usize, filter: Filter<1>, slowest_decay: f64) -> Self {
        Self { kind: Kind::Axisymmetric { relation, filter, axis }, slowest_decay, excitation: 0.0 }
    }

    /// Returns the same identifier with other initial coefficients.
    pub fn with_guess(self, a: &Vector3<f64>) -> Self {
        let kind = match self.kind {
            Kind::Asymmetric { relation, filter } => Kind::Asymmetric { relation, filter: filter.with_guess(*a) },
            Kind::Axisymmetric { relation, filter, axis } => {
                Kind::Axisymmetric { relation, filter: filter.with_guess(Vector1::new(a[axis % 3])), axis }
            }
        };
        Self { kind, ..self }
    }

    /// Updates the estimate with one step. Returns the status bits that explain an unused step, or 0.
    pub fn learn(&mut self, from: &RateSample, to: &RateSample, dt_s: f64) -> u64 {
        match &mut self.kind {
            Kind::Asymmetric { relation, filter } => {
                let seen = relation.observe(from, to, dt_s, filter.estimate());
                apply(seen, filter, &mut self.excitation)
            }
            Kind::Axisymmetric { relation, filter, .. } => {
                apply(relation.observe(from, to, dt_s), filter, &mut self.excitation)
            }
        }
    }

    /// Returns the coefficients learned so far.
    pub fn coefficients(&self) -> Vector3<f64> {
        match &self.kind {
            Kind::Asymmetric { filter, .. } => *filter.estimate(),
            Kind::Axisymmetric { filter, axis, .. } => {
                let mut a = Vector3::zeros();
                (a[axis % 3], a[(axis + 1) % 3]) = (filter.estimate().x, -filter.estimate().x);
                a
            }
        }
    }

    /// Returns the excitation ∫ρ dt so far.
    pub fn excitation(&self) -> f64 {
        self.excitation
    }

    /// Returns the number of decay times by which the initial error has decayed.
    pub fn decay_times(&self) -> f64 {
        self.excitation * self.slowest_decay
    }
}

impl Persist for Identifier {
    fn persist<W: Words>(&mut self, words: &mut W) {
        match &mut self.kind {
            Kind::Asymmetric { filter, .. } => filter.persist(words),
            Kind::Axisymmetric { filter, .. } => filter.persist(words),
        }
        self.excitation.persist(words);
    }
}

fn apply<const N: usize>(seen: Identification<N>, filter: &mut Filter<N>, excitation: &mut f64) -> u64 {
    *excitation += seen.excitation();
    let blind = match seen {
        Identification::Excited(increment) => {
            filter.step(&increment);
            return 0;
        }
        Identification::Unexcited => status::NOT_EXCITED,
        Identification::Ambiguous => status::UNOBSERVABLE,
    };
    // The unknown does not drift, but a second-order filter must not continue from the potential before the gap.
    filter.predict(&zeros(), 0.0);
    blind
}
