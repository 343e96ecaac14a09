//! The observer for a gyro that fails in flight. It learns the body's inertia while all components are measured, and
//! supplies a lost one from the other two and the learned inertia.
//!
//! Its modes are explicit and published in the status word. The estimate must not jump when an axis is lost or
//! returns, and must stay bounded when an axis is lost too early.

use super::hidden::{ALL, HiddenObserver, KnownBody, filter, seen};
use super::identifier::Identifier;
use crate::model::closure;
use crate::observe::{HiddenRate, RateSample};
use crate::role::Estimator;
use crate::sample::{RateEstimate, RateMeasurement, status};
use crate::state::{Persist, Words};
use crate::vector::amax;
use nalgebra::Vector3;

/// The number of decay times after which the identifier's error is negligible: e^−25 is 1e-11.
const SETTLED_DECAYS: f64 = 25.0;
/// The largest |a1 + a2 + a3 + a1·a2·a3| of settled coefficients; it is 0 for a body.
const SETTLED_CLOSURE: f64 = 1e-6;
/// The bound on a component that is supplied without settled coefficients, in multiples of the fastest rate measured.
const DEGRADED_BOUND: f64 = 2.0;

/// The number of state words of a supplier's observer, whose filter is of first order.
const SUPPLIER_WORDS: usize = 11;

/// The parameters of a [`Learner`].
#[derive(Debug, Clone)]
pub struct LearnerDesign {
    /// The identifier at its initial guess.
    pub identifier: Identifier,
    /// Decay rate of a supplied component, 1/s.
    pub decay_rate_per_s: f64,
    /// The level, rad/s, below which measured components carry no information.
    pub floor_rad_s: f64,
}

/// An observer that learns the inertia and supplies a lost component.
#[derive(Debug)]
pub struct Learner {
    parts: LearnerDesign,
    identifier: Identifier,
    last: RateSample,
    fastest_rad_s: f64,
    /// The supplier of the lost component, while one is lost.
    supplier: Option<Supplier>,
    status: u64,
}

/// The supplier of a lost component.
#[derive(Debug)]
struct Supplier {
    component: usize,
    degraded: bool,
    /// Absent if the learned coefficients do not determine the component, which is then held.
    observer: Option<HiddenObserver>,
    held: Vector3<f64>,
}

impl Learner {
    /// Creates a learner that has learned nothing.
    pub fn new(parts: LearnerDesign) -> Self {
        let nothing = RateSample { rate_rad_s: Vector3::zeros(), torque_rad_s2: Vector3::zeros() };
        Self {
            identifier: parts.identifier.clone(),
            parts,
            last: nothing,
            fastest_rad_s: 0.0,
            supplier: None,
            status: status::INITIAL,
        }
    }

    pub(crate) fn start(&mut self, measurement: &RateMeasurement) {
        *self = Self::new(self.parts.clone());
        self.last = seen(measurement);
    }

    pub(crate) fn update(&mut self, measurement: &RateMeasurement, dt_s: f64) {
        match (0..3).find(|component| measurement.valid >> component & 1 == 0) {
            None => self.learn(measurement, dt_s),
            Some(lost) => self.supply(lost, measurement, dt_s),
        }
    }

    /// Updates the identifier when all components are measured.
    fn learn(&mut self, measurement: &RateMeasurement, dt_s: f64) {
        let to = seen(measurement);
        self.status = status::LEARNING;
        self.fastest_rad_s = self.fastest_rad_s.max(amax(&to.rate_rad_s));
        // The step in which an axis returns has no increment: only one end of it is complete.
        if self.supplier.take().is_none() {
            self.status |= self.identifier.learn(&self.last, &to, dt_s);
        }
        self.last = to;
    }

    /// Supplies the component that is not measured.
    fn supply(&mut self, lost: usize, measurement: &RateMeasurement, dt_s: f64) {
        let rate = self.rate();
        let (degraded, bound) = (!self.settled(), DEGRADED_BOUND * self.fastest_rad_s);
        if self.supplier.as_ref().is_none_or(|supplier| supplier.component != lost) {
            self.supplier = Some(self.supplier(lost, rate, degraded));
        }
        let to = seen(measurement);
        if let Some(supplier) = &mut self.supplier {
            self.status = status::AXIS_LOST | if supplier.degraded { status::DEGRADED } else { 0 };
            supplier.held = to.rate_rad_s;
            supplier.held[lost] = rate[lost];
            if let Some(observer) = &mut supplier.observer {
                observer.update(measurement, dt_s);
                self.status |= observer.status();
                let supplied = observer.rate()[lost];
                if supplier.degraded && supplied.abs() > bound {
                    let within = filter(self.parts.decay_rate_per_s, bound.copysign(supplied));
                    observer.restart(within, to, self.status);
                }
            }
        }
        self.last = to;
    }

    /// Creates a supplier that continues from the last valid value.
    fn supplier(&self, component: usize, rate: Vector3<f64>, degraded: bool) -> Supplier {
        let coefficients = self.identifier.coefficients();
        let relation = HiddenRate::new(&coefficients, component + 1, self.parts.floor_rad_s).ok();
        let observer = relation.map(|relation| {
            let begun = filter(self.parts.decay_rate_per_s, rate[component]);
            let mut observer = HiddenObserver::new(relation, coefficients, begun);
            observer.restart(begun, self.last, 0);
            observer
        });
        Supplier { component, degraded, observer, held: rate }
    }

    /// Returns true if the learned coefficients are reliable.
    fn settled(&self) -> bool {
        let a = self.identifier.coefficients();
        self.identifier.decay_times() >= SETTLED_DECAYS && closure(&a).abs() < SETTLED_CLOSURE
    }

    fn rate(&self) -> Vector3<f64> {
        match &self.supplier {
            Some(Supplier { observer: Some(observer), .. }) => observer.rate(),
            Some(supplier) => supplier.held,
            None => self.last.rate_rad_s,
        }
    }

    pub(crate) fn write(&self, status: u64, out: &mut RateEstimate) {
        let a = self.identifier.coefficients();
        let supplier = self.supplier.as_ref();
        KnownBody::new(a).write(&self.rate(), out);
        out.innovation_rad_s = supplier.and_then(|s| s.observer.as_ref()).map_or(0.0, HiddenObserver::innovation);
        out.excitation = self.identifier.excitation();
        out.status = self.status | status;
        out.valid = supplier.filter(|s| s.degraded).map_or(ALL, |s| ALL & !(1 << s.component));
    }
}

impl Persist for Learner {
    /// The supplier is rebuilt from the coefficients, which do not change while an axis is lost.
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.identifier.persist(words);
        self.last.persist(words);
        self.fastest_rad_s.persist(words);
        self.status.persist(words);
        let mut component = self.supplier.as_ref().map(|supplier| supplier.component as u64);
        component.persist(words);
        self.supplier = component.map(|component| {
            let component = (component % 3) as usize;
            let same = self.supplier.take().filter(|supplier| supplier.component == component);
            same.unwrap_or_else(|| self.supplier(component, self.last.rate_rad_s, false))
        });
        let supplier = &mut self.supplier;
        let (mut degraded, mut held) = supplier.as_ref().map_or(Default::default(), |s| (s.degraded, s.held));
        degraded.persist(words);
        held.persist(words);
        match supplier.as_mut().and_then(|supplier| supplier.observer.as_mut()) {
            Some(observer) => observer.persist(words),
            None => [0_u64; SUPPLIER_WORDS].persist(words),
        }
        supplier.iter_mut().for_each(|supplier| (supplier.degraded, supplier.held) = (degraded, held));
    }
}
