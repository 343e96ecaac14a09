//! The invariant relation for a component of a rigid body's angular velocity that no sensor measures, \[D\] section 3.
//!
//! For the hidden axis k and the measured axes i, j (cyclic) there is a function φ(ω_i, ω_j) with φ̇ = ω_k along the free
//! motion. Its level curves depend on the signs of a_i and a_j: three conics, three functions, of which only the increment
//! between two samples is ever formed. Must not choose a branch, unwrap an angle, or divide by what may vanish unasked.

use super::{Increment, Span, series};
use nalgebra::{Vector1, Vector3};

/// How the measured components move in their plane, and thereby φ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Conic {
    /// a_i·a_j < 0, the hidden axis has the largest or the smallest moment: φ = atan2(Ω ω_i, a_i ω_j)/Ω, \[D\](11).
    Elliptic {
        /// Ω = √(−a_i a_j), dimensionless.
        omega: f64,
    },
    /// a_i·a_j > 0, the hidden axis has the intermediate moment: φ = ±ln|Ω ω_i ± a_i ω_j|/Ω, \[D\](12).
    Hyperbolic {
        /// Ω = √(a_i a_j), dimensionless.
        omega: f64,
    },
    /// a_j = 0 ≠ a_i, an axisymmetric body with a transverse axis hidden: φ = ω_i/(a_i ω_j). Not in the paper.
    ParabolicFirst,
    /// a_i = 0 ≠ a_j, the same with the measured axes exchanged: φ = ω_j/(a_j ω_i). Not in the paper.
    ParabolicSecond,
}

/// Why a component of the angular velocity cannot be observed from the other two.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum HiddenRateError {
    /// No axis with this number.
    #[error("axis {axis} does not exist; the axes are 1, 2 and 3")]
    NoSuchAxis {
        /// The axis as given.
        axis: usize,
    },
    /// The measured components do not depend on the hidden one.
    #[error(
        "axis {axis} cannot be observed: the body turns like a sphere (a1 = a2 = a3 = 0), so the measured components do \
         not feel the hidden one; give moments of inertia that differ"
    )]
    Sphere {
        /// The hidden axis, 1 to 3.
        axis: usize,
    },
}

/// Moments closer than this (relative) count as equal: the conic degenerates to a parabola or the body to a sphere.
const SYMMETRY_TOLERANCE: f64 = 1e-15;

/// The longest turn of (Ω ω_i, a_i ω_j) in one step that is safely told from its complement, rad (π is ambiguous).
const MAX_TURN_RAD: f64 = 3.0;

/// A branch of a hyperbola smaller than this part of the other is left out of φ.
const WEAKEST_BRANCH: f64 = 1.0 / 16.0;

/// What the relation sees at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateSample {
    /// Angular velocity, rad/s; the hidden component is not read.
    pub rate_rad_s: Vector3<f64>,
    /// Known torque over inertia held from this instant to the next, rad/s².
    pub torque_rad_s2: Vector3<f64>,
}

/// What one step tells about the hidden component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Observation {
    /// The relation held over the step.
    Seen(Increment<1>),
    /// The measured components were too small to carry information: move by this drift (rad/s) and say so.
    Unobservable {
        /// ∫g dt by the model, rad/s.
        drift: Vector1<f64>,
    },
}

/// The relation for one hidden axis of one body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HiddenRate {
    axes: [usize; 3],
    a: [f64; 3],
    conic: Conic,
    floor_rad_s: f64,
    /// Variances of the two measured components, (rad/s)².
    variance: [f64; 2],
    constants: Constants,
}

/// What is the same at every step: for the conics with an Ω.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Constants {
    inverse_omega: f64,
    /// Ω a_i.
    cross: f64,
    /// Ω² and a_i².
    square: [f64; 2],
    /// The least Ω²ω_i² + a_i²ω_j² that carries information.
    floor: f64,
}

impl Constants {
    fn new(omega: f64, ai: f64, floor_rad_s: f64) -> Self {
        let floor = floor_rad_s * omega.max(ai.abs());
        Self { inverse_omega: 1.0 / omega, cross: omega * ai, square: [omega * omega, ai * ai], floor: floor * floor }
    }
}

/// The two measured components at one instant, rad/s.
#[derive(Clone, Copy)]
struct Pair {
    i: f64,
    j: f64,
}

impl HiddenRate {
    /// The relation for hidden axis `axis` (1 to 3) of a body with the coefficients a of \[D\](2).
    ///
    /// Below `floor_rad_s` the measured components count as carrying no information.
    ///
    /// # Errors
    /// [`HiddenRateError`] if there is no such axis or the body is a sphere.
    pub fn new(coefficients: &Vector3<f64>, axis: usize, floor_rad_s: f64) -> Result<Self, HiddenRateError> {
        if !(1..=3).contains(&axis) {
            return Err(HiddenRateError::NoSuchAxis { axis });
        }
        let axes = [axis % 3, (axis + 1) % 3, axis - 1];
        let a = axes.map(|index| coefficients[index]);
        let conic = match (a[0].abs() < SYMMETRY_TOLERANCE, a[1].abs() < SYMMETRY_TOLERANCE) {
            (true, true) => return Err(HiddenRateError::Sphere { axis }),
            (false, true) => Conic::ParabolicFirst,
            (true, false) => Conic::ParabolicSecond,
            (false, false) if a[0] * a[1] < 0.0 => Conic::Elliptic { omega: libm::sqrt(-a[0] * a[1]) },
            (false, false) => Conic::Hyperbolic { omega: libm::sqrt(a[0] * a[1]) },
        };
        let omega = match conic {
            Conic::Elliptic { omega } | Conic::Hyperbolic { omega } => omega,
            Conic::ParabolicFirst | Conic::ParabolicSecond => 1.0,
        };
        let constants = Constants::new(omega, a[0], floor_rad_s);
        Ok(Self { axes, a, conic, floor_rad_s, variance: [0.0; 2], constants })
    }

    /// The same relation, telling with every increment how uncertain white measurement noise makes it.
    ///
    /// `sensor_deviation_rad_s` are the standard deviations of one sample's components; the hidden one is not read. An
    /// increment's potential and drift are the same bits with and without.
    #[must_use]
    pub fn with_noise(mut self, sensor_deviation_rad_s: &Vector3<f64>) -> Self {
        self.variance =
            [0, 1].map(|index| sensor_deviation_rad_s[self.axes[index]] * sensor_deviation_rad_s[self.axes[index]]);
        self
    }

    /// Below this, rad/s, the measured components carry no information.
    pub fn floor_rad_s(&self) -> f64 {
        self.floor_rad_s
    }

    /// Which conic the measured components move on.
    pub fn conic(&self) -> Conic {
        self.conic
    }

    /// The longest step, s, over which a hidden component of at most `rate_bound_rad_s` can be followed.
    ///
    /// On an ellipse the phase turns by Ω ω_k dt and is known only up to whole turns; the other conics have no such limit.
    pub fn longest_step_s(&self, rate_bound_rad_s: f64) -> f64 {
        match self.conic {
            Conic::Elliptic { omega } => MAX_TURN_RAD / (omega * rate_bound_rad_s),
            _ => f64::INFINITY,
        }
    }

    /// What the step of `dt_s` seconds from `from` to `to` tells, with `estimate` (rad/s) the estimate at its start.
    ///
    /// `dt_s` is positive and every input finite.
    #[inline]
    pub fn observe(&self, from: &RateSample, to: &RateSample, dt_s: impl Into<Span>, estimate: f64) -> Observation {
        let span = dt_s.into();
        let dt_s = span.length();
        let [i, j, k] = self.axes;
        let torque = [from.torque_rad_s2[i], from.torque_rad_s2[j], from.torque_rad_s2[k]];
        let ends = [self.measured(from), self.measured(to)];
        match self.growth(ends, dt_s, estimate) {
            Some((growth, share)) => {
                let driven = torque[0] != 0.0 || torque[1] != 0.0;
                let potential = if driven { self.undriven(ends, share, torque, span, growth) } else { growth };
                let exact = self.increment(&ends, &torque, span, potential);
                Observation::Seen(if self.variance == [0.0; 2] { exact } else { self.noisy(exact, &ends[1], share) })
            }
            None => {
                let hidden = self.hidden_at_ends(&ends, &torque, dt_s, estimate);
                let (drift, _) = self.drift(&ends, &torque, dt_s, hidden);
                Observation::Unobservable { drift: Vector1::new(drift) }
            }
        }
    }

    #[inline(always)]
    fn measured(&self, sample: &RateSample) -> Pair {
        Pair { i: sample.rate_rad_s[self.axes[0]], j: sample.rate_rad_s[self.axes[1]] }
    }

    /// Δφ between the ends and the share of the hyperbola's branch z₊ in it; `None` where the relation does not hold.
    #[inline(always)]
    fn growth(&self, [from, to]: [Pair; 2], dt_s: f64, estimate: f64) -> Option<(f64, f64)> {
        match self.conic {
            Conic::Elliptic { omega } => {
                let Constants { inverse_omega, cross, square, floor } = self.constants;
                let dot = |p: Pair, q: Pair| square[0] * (p.i * q.i) + square[1] * (p.j * q.j);
                let dark = dot(from, from) <= floor || dot(to, to) <= floor;
                if dark || omega * estimate.abs() * dt_s > MAX_TURN_RAD {
                    return None;
                }
                let cross = cross * (from.j * to.i - from.i * to.j);
                Some((series::atan2(cross, dot(from, to)) * inverse_omega, 1.0))
            }
            Conic::Hyperbolic { omega } => self.logarithmic_growth(from, to, omega),
            Conic::ParabolicFirst => self.quotient_growth(from.j, to.j, from.i, to.i, self.a[0]),
            Conic::ParabolicSecond => self.quotient_growth(from.i, to.i, from.j, to.j, self.a[1]),
        }
    }

    /// The same on a hyperbola.
    #[inline(always)]
    fn logarithmic_growth(&self, from: Pair, to: Pair, omega: f64) -> Option<(f64, f64)> {
        let [ai, aj, _] = self.a;
        let z = |p: Pair, sign: f64| omega * p.i + sign * ai * p.j;
        let [plus, minus] = [1.0, -1.0].map(|sign| z(from, sign).abs().min(z(to, sign).abs()));
        if plus.max(minus) <= self.floor_rad_s * omega.max(ai.abs()) {
            return None;
        }
        // A branch that a torque takes through zero is not to be integrated over: it has no share.
        let share = if minus < plus * WEAKEST_BRANCH {
            1.0
        } else if plus < minus * WEAKEST_BRANCH {
            0.0
        } else {
            branch_share(from, to, omega, ai, aj)
        };
        let log = |share: f64, sign: f64| {
            // From the differences, not as z'/z: the small change is what carries the information.
            let change = (omega * (to.i - from.i) + sign * ai * (to.j - from.j)) / z(from, sign);
            // z never changes its sign along a free motion; if noise made it, there is no logarithm to take.
            if share == 0.0 { Some(0.0) } else { (change > -1.0).then(|| share * sign * series::ln_1p(change)) }
        };
        Some(((log(share, 1.0)? + log(1.0 - share, -1.0)?) * self.constants.inverse_omega, share))
    }

    /// Growth of top/(a·bottom), for the parabola.
    #[inline(always)]
    fn quotient_growth(&self, bottom: f64, bottom_to: f64, top: f64, top_to: f64, a: f64) -> Option<(f64, f64)> {
        let seen = bottom.abs().min(bottom_to.abs()) > self.floor_rad_s && bottom * bottom_to > 0.0;
        seen.then(|| ((top_to * bottom - top * bottom_to) / (a * bottom * bottom_to), 1.0))
    }

    /// The part of Δφ that is not the torque's.
    #[cold]
    fn undriven(&self, ends: [Pair; 2], share: f64, torque: [f64; 3], span: Span, growth: f64) -> f64 {
        let gradients = ends.map(|end| self.gradient(&end, share));
        let rough = growth - span.length() * self.torque_share(gradients, &torque);
        growth - self.torque_growth(&ends, share, &torque, span, rough)
    }

    /// (∂φ/∂ω_i, ∂φ/∂ω_j) at one instant, s.
    #[inline]
    fn gradient(&self, p: &Pair, share: f64) -> [f64; 2] {
        let [ai, aj, _] = self.a;
        match self.conic {
            Conic::Elliptic { omega } => {
                let square = omega * omega * p.i * p.i + ai * ai * p.j * p.j;
                [ai * p.j / square, -ai * p.i / square]
            }
            Conic::Hyperbolic { omega } => {
                // A branch without a share may be zero.
                let over = |share: f64, z: f64| if share == 0.0 { 0.0 } else { share / z };
                let plus = over(share, omega * p.i + ai * p.j);
                let minus = over(1.0 - share, omega * p.i - ai * p.j);
                [plus - minus, (plus + minus) * ai / omega]
            }
            Conic::ParabolicFirst => [1.0 / (ai * p.j), -p.i / (ai * p.j * p.j)],
            Conic::ParabolicSecond => [-p.j / (aj * p.i * p.i), 1.0 / (aj * p.i)],
        }
    }

    /// The mean over the two ends of the rate φ_i u_i + φ_j u_j at which the torque feeds the potential.
    #[inline]
    fn torque_share(&self, gradients: [[f64; 2]; 2], torque: &[f64; 3]) -> f64 {
        let rate = |g: [f64; 2]| g[0] * torque[0] + g[1] * torque[1];
        0.5 * (rate(gradients[0]) + rate(gradients[1]))
    }

    /// ∫(φ_i u_i + φ_j u_j) dt by Simpson's rule, the middle of the path by its cubic Hermite interpolation.
    #[inline]
    fn torque_growth(&self, ends: &[Pair; 2], share: f64, torque: &[f64; 3], span: Span, rough: f64) -> f64 {
        let dt_s = span.length();
        let hidden = self.hidden_at_ends(ends, torque, dt_s, rough * span.inverse());
        let [from, to] = ends;
        let [v0, v1] = [self.velocity(from, torque, hidden[0]), self.velocity(to, torque, hidden[1])];
        let middle = Pair {
            i: 0.5 * (from.i + to.i) + dt_s / 8.0 * (v0.i - v1.i),
            j: 0.5 * (from.j + to.j) + dt_s / 8.0 * (v0.j - v1.j),
        };
        let ends_mean = self.torque_share(ends.map(|end| self.gradient(&end, share)), torque);
        let centre = self.torque_share([self.gradient(&middle, share); 2], torque);
        dt_s * (ends_mean + 2.0 * centre) * (1.0 / 3.0)
    }

    /// (ω̇_i, ω̇_j), rad/s², with the hidden component at `hidden`.
    #[inline(always)]
    fn velocity(&self, p: &Pair, torque: &[f64; 3], hidden: f64) -> Pair {
        Pair { i: self.a[0] * p.j * hidden + torque[0], j: self.a[1] * hidden * p.i + torque[1] }
    }

    /// The hidden component at the two ends from its mean over the step, its drift taken as linear.
    #[inline(always)]
    fn hidden_at_ends(&self, [from, to]: &[Pair; 2], torque: &[f64; 3], dt_s: f64, mean: f64) -> [f64; 2] {
        let g = |p: &Pair| self.a[2] * p.i * p.j + torque[2];
        let (sixth, g) = (dt_s * (1.0 / 6.0), [g(from), g(to)]);
        [mean - sixth * (2.0 * g[0] + g[1]), mean + sixth * (g[0] + 2.0 * g[1])]
    }

    /// ∫g and ∫∫g over the step: g = a_k ω_i ω_j + u_k by its cubic Hermite polynomial through both ends.
    #[inline(always)]
    fn drift(&self, ends: &[Pair; 2], torque: &[f64; 3], h: f64, hidden: [f64; 2]) -> (f64, f64) {
        let value = |p: &Pair| self.a[2] * p.i * p.j + torque[2];
        let slope = |p: &Pair, hidden: f64| {
            let v = self.velocity(p, torque, hidden);
            self.a[2] * (v.i * p.j + p.i * v.j)
        };
        let (g0, g1) = (value(&ends[0]), value(&ends[1]));
        let (s0, s1) = (slope(&ends[0], hidden[0]), slope(&ends[1], hidden[1]));
        let square = h * h;
        let drift = 0.5 * h * (g0 + g1) + square * (1.0 / 12.0) * (s0 - s1);
        let moment = square * (1.0 / 20.0) * (7.0 * g0 + 3.0 * g1) + square * h * (1.0 / 60.0) * (3.0 * s0 - 2.0 * s1);
        (drift, moment)
    }

    #[inline(always)]
    fn increment(&self, ends: &[Pair; 2], torque: &[f64; 3], span: Span, potential: f64) -> Increment<1> {
        let dt_s = span.length();
        let hidden = self.hidden_at_ends(ends, torque, dt_s, potential * span.inverse());
        let (drift, moment) = self.drift(ends, torque, dt_s, hidden);
        Increment::exact(Vector1::new(potential), span, Vector1::new(drift), Vector1::new(moment))
    }

    /// The same increment with the covariance of its potential φ and its drift, from that of the measured pair.
    ///
    /// The drift feels a sample as the end of one step and as the start of the next, half a step's weight each.
    #[inline]
    fn noisy(&self, exact: Increment<1>, to: &Pair, share: f64) -> Increment<1> {
        let step = self.a[2] * exact.weight;
        let (phi, drift) = (self.gradient(to, share), [step * to.j, step * to.i]);
        let covariance =
            |x: [f64; 2], y: [f64; 2]| Vector1::new(x[0] * y[0] * self.variance[0] + x[1] * y[1] * self.variance[1]);
        Increment {
            variance: covariance(phi, phi),
            drift_variance: covariance(drift, drift),
            drift_covariance: covariance(phi, drift),
            ..exact
        }
    }
}

/// The share of the branch z₊ in φ for which a disturbed measurement moves φ least; the branch z₋ has the rest.
///
/// Either branch alone loses all its digits as Ω vanishes, their best mean none.
#[inline(always)]
fn branch_share(from: Pair, to: Pair, omega: f64, ai: f64, aj: f64) -> f64 {
    let (x, y) = (omega * (from.i + to.i), ai * (from.j + to.j));
    let ratio = ai / aj;
    (x + y) * (x + ratio * y) / (2.0 * (x * x + ratio * y * y))
}

#[cfg(test)]
mod tests {
    use super::super::InvariantFilter;
    use super::*;
    use crate::model::{Inertia, RigidBody};

    const RATE: f64 = 5.0;

    struct Run {
        body: RigidBody,
        relation: HiddenRate,
        filter: InvariantFilter<1>,
        axis: usize,
        rate: Vector3<f64>,
        torque: Vector3<f64>,
        unseen: usize,
    }

    impl Run {
        fn new(moments: [f64; 3], axis: usize, rate: [f64; 3]) -> Self {
            let body = RigidBody::new(&Inertia::new(moments).unwrap());
            let relation = HiddenRate::new(body.coefficients(), axis, 1e-6).unwrap();
            let filter = InvariantFilter::new(Vector1::new(RATE), Vector1::zeros());
            Self { body, relation, filter, axis, rate: rate.into(), torque: Vector3::zeros(), unseen: 0 }
        }

        fn error(&self) -> f64 {
            self.rate[self.axis - 1] - self.filter.estimate().x
        }

        fn step(&mut self, h: f64) {
            let from = RateSample { rate_rad_s: self.rate, torque_rad_s2: self.torque };
            self.rate = self.body.flow(&self.rate, &self.torque, h);
            let to = RateSample { rate_rad_s: self.rate, torque_rad_s2: self.torque };
            match self.relation.observe(&from, &to, h, self.filter.estimate().x) {
                Observation::Seen(increment) => self.filter.step(&increment),
                Observation::Unobservable { drift } => {
                    self.unseen += 1;
                    self.filter.predict(&drift);
                }
            }
        }

        fn floor(&mut self, h: f64, settle_s: f64, run_s: f64) -> f64 {
            let mut worst = 0.0_f64;
            for tick in 0..(run_s / h).round() as u64 {
                self.step(h);
                if tick as f64 * h > settle_s {
                    worst = worst.max(self.error().abs());
                }
            }
            worst
        }
    }

    #[test]
    fn names_the_conic_of_every_axis() {
        let conic = |moments, axis| {
            HiddenRate::new(&Inertia::new(moments).unwrap().coefficients(), axis, 1e-6).map(|relation| relation.conic())
        };
        assert!(matches!(conic([1.0, 2.0, 2.5], 3), Ok(Conic::Elliptic { .. })));
        assert!(matches!(conic([1.0, 2.0, 2.5], 1), Ok(Conic::Elliptic { .. })));
        assert!(matches!(conic([1.0, 2.0, 2.5], 2), Ok(Conic::Hyperbolic { .. })));
        assert_eq!(conic([2.0, 1.5, 2.0], 3), Ok(Conic::ParabolicFirst));
        assert_eq!(conic([1.5, 2.0, 2.0], 3), Ok(Conic::ParabolicFirst).and(conic([1.5, 2.0, 2.0], 3)));
        assert!(matches!(conic([1.0, 1.0, 1.6], 3), Ok(Conic::Elliptic { .. })), "symmetry axis hidden");
        assert_eq!(conic([1.0; 3], 3), Err(HiddenRateError::Sphere { axis: 3 }));
        assert_eq!(conic([1.0, 2.0, 2.5], 0), Err(HiddenRateError::NoSuchAxis { axis: 0 }));
        assert_eq!(conic([1.0, 2.0, 2.5], 4), Err(HiddenRateError::NoSuchAxis { axis: 4 }));
    }

    #[test]
    fn known_torque_on_the_observed_body_does_not_move_the_floor() {
        for (moments, axis) in [([1.0, 2.0, 2.5], 3), ([1.0, 2.5, 2.0], 3), ([2.0, 1.5, 2.0], 3), ([2.0, 2.0, 1.5], 1)]
        {
            let mut run = Run::new(moments, axis, [0.9, 0.7, 0.8]);
            run.torque = Vector3::new(0.02, 0.05, -0.03);
            let floor = run.floor(1e-3, 8.0, 10.0);
            assert!(floor < 1e-11, "{moments:?} axis {axis}: {floor:e}");
        }
    }

    #[test]
    fn an_unobservable_motion_is_held_and_flagged() {
        let mut run = Run::new([1.0, 2.0, 2.5], 3, [0.0, 0.0, 0.8]);
        run.filter = InvariantFilter::new(Vector1::new(RATE), Vector1::new(0.3));
        run.step(1e-3);
        assert_eq!((run.unseen, run.filter.estimate().x), (1, 0.3));
    }

    #[test]
    fn a_step_too_long_for_the_phase_is_not_used() {
        let mut run = Run::new([1.0, 2.0, 2.5], 3, [0.6, -0.4, 0.8]);
        run.filter = InvariantFilter::new(Vector1::new(RATE), Vector1::new(0.8));
        let limit = run.relation.longest_step_s(0.8);
        run.step(limit * 1.01);
        assert_eq!(run.unseen, 1);
        assert!(run.error().is_finite());
    }
}
