//! The papers' recursive identifiers, \[SZ\](4)-(17), along a log: they need no sums and can forget old samples.
//!
//! Whatever the body's motion, errors decay with the *excitation* W, not with time. With a given rate they decay as
//! e^{−rate·W}, as in the paper. Without a rate all excitation has equal weight and nothing is forgotten. The gains
//! are then those of the Kalman filter for a constant; only the ratio of noise to initial deviation would matter, and
//! the initial guess has no weight.

use super::motion::Sample;
use crate::observe::{
    AxisymmetricError, AxisymmetricRelation, Filter, Identification, InertiaRelation, InvariantFilter, KalmanFilter,
    RateSample,
};
use nalgebra::{SVector, Vector3};

/// The standard deviation of the initial guess of a coefficient, in units of a sensor's noise; no body's coefficient
/// exceeds 1.
const GUESS_DEVIATION: f64 = 1e6;
/// The part of the largest possible |ω1 ω2 ω3|, or spin, at the fastest rate so far, below which a step is not used.
const FLOOR: f64 = 1e-3;

/// The result of a recursive identifier.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecursiveFit<const N: usize> {
    /// The coefficients.
    pub coefficients: SVector<f64, N>,
    /// The filter's standard deviations for a noise of 1 rad/s on every rate; absent with a given rate.
    pub deviation_per_rad_s: Option<SVector<f64, N>>,
    /// The excitation W: (rad/s)³ s, or rad of spin for an axisymmetric body.
    pub excitation: f64,
    /// The number of steps that were used, that did not excite, and that were too long for the motion.
    pub steps: [u64; 3],
}

/// The identifier of the three coefficients of a body with known principal axes.
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::identify::{RecursiveIdentifier, Sample};
/// use corotate::model::{Inertia, RigidBody};
/// use corotate::nalgebra::Vector3;
///
/// let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
/// let (mut rate, mut identifier) = (Vector3::new(1.2, 0.8, 1.6), RecursiveIdentifier::new(None, 0.0));
/// for tick in 0..30_000 {
///     identifier.push(&Sample { time_s: f64::from(tick) * 1e-3, rate_rad_s: rate });
///     rate = body.flow(&rate, &Vector3::zeros(), 1e-3);
/// }
/// assert!((identifier.fit().coefficients - body.coefficients()).amax() < 1e-6);
/// ```
#[derive(Debug, Clone)]
pub struct RecursiveIdentifier {
    filter: Filter<3>,
    path: Path,
}

/// The identifier of the one coefficient of a body that is symmetric about a known axis.
#[derive(Debug, Clone)]
pub struct RecursiveAxisymmetricIdentifier {
    axis: usize,
    filter: Filter<1>,
    path: Path,
}

/// The last sample of a log, and the counters of its steps.
#[derive(Debug, Clone, Default)]
struct Path {
    last: Option<Sample>,
    damping_per_s: f64,
    fastest_rad_s: f64,
    excitation: f64,
    steps: [u64; 3],
}

/// Returns a filter of N constants.
fn filter<const N: usize>(rate: Option<f64>) -> Filter<N> {
    let all = SVector::repeat;
    match rate {
        Some(rate) => Filter::First(InvariantFilter::new(all(rate), all(0.0))),
        None => Filter::Kalman(KalmanFilter::new(all(0.0), all(0.0), all(GUESS_DEVIATION))),
    }
}

impl Path {
    fn new(damping_per_s: f64) -> Self {
        Self { damping_per_s, ..Self::default() }
    }

    /// Returns the ends and the length of the step to the next sample, with the damping removed.
    ///
    /// Under a torque −c I ω, ν = ω e^{c(t − t0)} over τ with dτ = e^{−c(t − t0)} dt moves like ω without torque.
    #[inline]
    fn step(&mut self, sample: &Sample) -> Option<([RateSample; 2], f64)> {
        self.fastest_rad_s = self.fastest_rad_s.max(sample.rate_rad_s.norm());
        let last = self.last.replace(*sample)?;
        let (interval_s, growth) = undamped(sample.time_s - last.time_s, self.damping_per_s);
        let free = |rate_rad_s| RateSample { rate_rad_s, torque_rad_s2: Vector3::zeros() };
        let ends = [free(last.rate_rad_s), free(sample.rate_rad_s * growth)];
        // A pause after which no motion is left carries no information.
        let usable = interval_s > 0.0 && ends[1].rate_rad_s.iter().all(|rate| rate.is_finite());
        usable.then_some((ends, interval_s))
    }

    /// Counts a step and advances the filter over it.
    fn apply<const N: usize>(&mut self, filter: &mut Filter<N>, observed: &Identification<N>) {
        let kind = match observed {
            Identification::Excited(increment) => {
                filter.step(increment);
                self.excitation += increment.weight;
                0
            }
            // A later step does not continue from this one.
            Identification::Unexcited => {
                filter.predict(&SVector::zeros(), 0.0);
                1
            }
            Identification::Ambiguous => {
                filter.predict(&SVector::zeros(), 0.0);
                2
            }
        };
        self.steps[kind] += 1;
    }

    fn fit<const N: usize>(&self, filter: &Filter<N>) -> RecursiveFit<N> {
        RecursiveFit {
            coefficients: *filter.estimate(),
            deviation_per_rad_s: filter.deviation(),
            excitation: self.excitation,
            steps: self.steps,
        }
    }
}

/// Returns the length of a step on the clock τ of a motion without damping, s, and the factor of the rates at its
/// end.
#[inline]
pub(crate) fn undamped(interval_s: f64, damping_per_s: f64) -> (f64, f64) {
    if damping_per_s == 0.0 {
        return (interval_s, 1.0);
    }
    let turn = damping_per_s * interval_s;
    (-libm::expm1(-turn) / damping_per_s, libm::exp(turn))
}

impl RecursiveIdentifier {
    /// Creates an identifier whose error decays as e^{−rate·W}, or one that forgets nothing; `damping_per_s` is the
    /// result of least squares.
    pub fn new(rate: Option<f64>, damping_per_s: f64) -> Self {
        Self { filter: filter(rate), path: Path::new(damping_per_s) }
    }

    /// Adds the next sample of a segment; its time is after that of the last one.
    pub fn push(&mut self, sample: &Sample) {
        let Some(([from, to], interval_s)) = self.path.step(sample) else { return };
        let fastest = self.path.fastest_rad_s;
        let relation = InertiaRelation::new(FLOOR * fastest * fastest * fastest).with_variance(Vector3::repeat(1.0));
        let observed = relation.observe(&from, &to, interval_s, self.filter.estimate());
        self.path.apply(&mut self.filter, &observed);
    }

    /// Ends a segment: the next sample begins another motion.
    pub fn end_segment(&mut self) {
        self.path.last = None;
        self.filter.predict(&SVector::zeros(), 0.0);
    }

    /// Returns the current fit.
    pub fn fit(&self) -> RecursiveFit<3> {
        self.path.fit(&self.filter)
    }
}

impl RecursiveAxisymmetricIdentifier {
    /// Creates the identifier for a body that is symmetric about `axis`, 1 to 3; W is the angle of its spin, rad.
    ///
    /// # Errors
    /// [`AxisymmetricError`] if there is no such axis.
    pub fn new(axis: usize, rate: Option<f64>, damping_per_s: f64) -> Result<Self, AxisymmetricError> {
        AxisymmetricRelation::new(axis, 0.0)?;
        Ok(Self { axis, filter: filter(rate), path: Path::new(damping_per_s) })
    }

    /// Adds the next sample of a segment; its time is after that of the last one.
    pub fn push(&mut self, sample: &Sample) {
        let Some(([from, to], interval_s)) = self.path.step(sample) else { return };
        let Ok(relation) = AxisymmetricRelation::new(self.axis, FLOOR * self.path.fastest_rad_s) else { return };
        let observed = relation.with_variance(Vector3::repeat(1.0)).observe(&from, &to, interval_s);
        self.path.apply(&mut self.filter, &observed);
    }

    /// Ends a segment: the next sample begins another motion.
    pub fn end_segment(&mut self) {
        self.path.last = None;
        self.filter.predict(&SVector::zeros(), 0.0);
    }

    /// Returns the current fit: a = (I_j − I_k)/I_i, so that I_k/I_i = 1 − a.
    pub fn fit(&self) -> RecursiveFit<1> {
        self.path.fit(&self.filter)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, RigidBody};

    fn tumble(moments: [f64; 3], damping_per_s: f64, mut each: impl FnMut(&Sample)) {
        let body = RigidBody::new(&Inertia::new(moments).unwrap());
        let mut rate = Vector3::new(1.2, 0.8, 1.6);
        for tick in 0..20_000 {
            let time_s = f64::from(tick) * 1e-3;
            each(&Sample { time_s, rate_rad_s: rate });
            // A damped motion is a free one that slows down.
            let (interval_s, growth) = undamped(1e-3, damping_per_s);
            rate = body.flow(&rate, &Vector3::zeros(), interval_s) / growth;
        }
    }

    #[test]
    fn a_damped_body_is_identified_like_a_free_one() {
        let expected = Inertia::new([1.0, 2.0, 2.5]).unwrap().coefficients();
        for (damping, rate) in [(0.0, None), (0.1, None), (0.1, Some(20.0))] {
            let mut identifier = RecursiveIdentifier::new(rate, damping);
            tumble([1.0, 2.0, 2.5], damping, |sample| identifier.push(sample));
            let fit = identifier.fit();
            assert!((fit.coefficients - expected).amax() < 1e-5, "{damping} {rate:?}: {fit:?}");
            assert_eq!(fit.deviation_per_rad_s.is_some(), rate.is_none());
        }
    }

    #[test]
    fn an_axisymmetric_body_is_identified_by_one_coefficient() {
        let mut identifier = RecursiveAxisymmetricIdentifier::new(3, None, 0.05).unwrap();
        tumble([2.0, 2.0, 1.5], 0.05, |sample| identifier.push(sample));
        let fit = identifier.fit();
        assert!((1.0 - fit.coefficients.x - 0.75).abs() < 1e-9, "{fit:?}");
        assert!(RecursiveAxisymmetricIdentifier::new(4, None, 0.0).is_err());
    }

    #[test]
    fn a_new_segment_does_not_continue_the_last() {
        let mut identifier = RecursiveIdentifier::new(None, 0.0);
        for start in [[1.2, 0.8, 1.6], [-0.5, 1.9, 0.4]] {
            let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
            let mut rate = Vector3::from(start);
            for tick in 0..10_000 {
                identifier.push(&Sample { time_s: f64::from(tick) * 1e-3, rate_rad_s: rate });
                rate = body.flow(&rate, &Vector3::zeros(), 1e-3);
            }
            identifier.end_segment();
        }
        assert!((identifier.fit().coefficients - Vector3::new(-0.5, 0.75, -0.4)).amax() < 1e-5);
    }
}
