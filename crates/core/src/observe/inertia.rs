//! The invariant relation for the inertia of a rigid body whose angular velocity is fully measured, \[SZ\](1)-(11).
//!
//! The unknown is a = (a1, a2, a3) of \[SZ\](1), the same as \[D\](2): φ_i = ½ s ω_i² with s = sign(ω1 ω2 ω3) obeys
//! φ̇_i = |ω1 ω2 ω3| a_i. The signs printed in (5), (10) and (11) do not fit together; \[SZ\](7) and (8) are what is meant.
//! Condition (У), ω1 ω2 ω3 bounded away from zero, holds for no free asymmetric body: two components change their signs
//! again and again, and φ jumps. So only increments of φ between two samples are formed, none of them across a jump. Must
//! not carry a branch or a sign from one step to the next, nor use a step whose jump it cannot place.
//!
//! Only the ratios of the moments of inertia can be known from a torque-free motion, or from torque over inertia.

use super::{Increment, RateSample};
use crate::model::closure;
use crate::vector::{product, zeros};
use nalgebra::Vector3;

/// Below this mean of |ω1 ω2 ω3| over a step, (rad/s)³, a potential over a weight is rounding only.
const SMALLEST_FLOOR_RAD3_S3: f64 = 1e-12;

/// A step with a change of sign is used if the estimate explains the motion over it up to this part. Else the path
/// between the samples, and on it the place of the change, is not known well enough.
const UNEXPLAINED: f64 = 0.05;

/// Halvings that place a zero of a cubic on [0, 1] to the last bit.
const HALVINGS: u32 = 53;

/// What one step tells about an unknown constant of the body. In any but the first case the estimate is to stay as it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Identification<const N: usize> {
    /// The relation held over the step. The weight is the excitation ∫ρ dt that the step adds.
    Excited(Increment<N>),
    /// The body moved in a way that does not depend on the unknown: a component is at rest, or nearly.
    Unexcited,
    /// The body moved, but what it did between the two samples is not certain: the step is too long for the motion, or
    /// the estimate does not yet explain the motion well enough to place a change of sign.
    Ambiguous,
}

impl<const N: usize> Identification<N> {
    /// The excitation W = ∫ρ dt of the step; zero for a step that is not used. Errors decay as e^{λ ΣW}.
    pub fn excitation(&self) -> f64 {
        match self {
            Self::Excited(increment) => increment.weight,
            Self::Unexcited | Self::Ambiguous => 0.0,
        }
    }
}

/// The relation for (a1, a2, a3): ρ = |ω1 ω2 ω3|, (rad/s)³, g = 0. Its filter's rates are in s²/rad³.
///
/// What a body's own tumbling tells of its moments of inertia:
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::model::{Inertia, RigidBody};
/// use corotate::nalgebra::Vector3;
/// use corotate::observe::{Identification, InertiaRatios, InertiaRelation, InvariantFilter, RateSample};
///
/// let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
/// let (relation, h) = (InertiaRelation::new(1e-6), 1e-3);
/// let mut filter = InvariantFilter::new(Vector3::repeat(10.0), Vector3::zeros());
/// let sample = |rate| RateSample { rate_rad_s: rate, torque_rad_s2: Vector3::zeros() };
/// let mut rate = Vector3::new(1.2, 0.8, 1.6);
/// for _ in 0..60_000 {
///     let next = body.flow(&rate, &Vector3::zeros(), h);
///     if let Identification::Excited(increment) =
///         relation.observe(&sample(rate), &sample(next), h, filter.estimate())
///     {
///         filter.step(&increment);
///     }
///     rate = next;
/// }
/// let ratios = InertiaRatios::new(filter.estimate()).unwrap();
/// assert!((ratios.second - 2.0).abs() < 1e-6 && (ratios.third - 2.5).abs() < 1e-6);
/// ```
///
/// One step of h seconds is good to the fifth order in h, so the settled estimate is to the fourth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertiaRelation {
    floor_rad3_s3: f64,
    variance_rad2_s2: Vector3<f64>,
}

impl InertiaRelation {
    /// The relation for noiseless sensors.
    ///
    /// A step over which |ω1 ω2 ω3| is below `floor_rad3_s3` on average counts as not exciting; a floor below 1e-12
    /// (rad/s)³ is raised to that. With noisy sensors choose it above what noise makes of a component at rest.
    pub fn new(floor_rad3_s3: f64) -> Self {
        Self { floor_rad3_s3: floor_rad3_s3.max(SMALLEST_FLOOR_RAD3_S3), variance_rad2_s2: Vector3::zeros() }
    }

    /// The same with the variance of each measured component, (rad/s)².
    #[must_use]
    pub fn with_variance(self, variance_rad2_s2: Vector3<f64>) -> Self {
        Self { variance_rad2_s2, ..self }
    }

    /// What the step of `dt_s` seconds from `from` to `to` tells, with `estimate` the estimate of a at its start.
    ///
    /// The torque of `from` is held over the step. `dt_s` is positive and every input finite.
    #[inline]
    pub fn observe(&self, from: &RateSample, to: &RateSample, dt_s: f64, estimate: &Vector3<f64>) -> Identification<3> {
        let path = Path::new(from, to, dt_s, estimate);
        let whole = path.whole();
        // Also for a weight that is not a number. Before any look at signs: those of a component at rest are noise.
        let excites = |piece: &Piece| piece.weight > self.floor_rad3_s3 * dt_s;
        if !excites(&whole) {
            return Identification::Unexcited;
        }
        let used = match path.sign_changes() {
            SignChanges::None => whole,
            SignChanges::One(axis) if path.is_explained() => path.split(path.zero(axis)),
            SignChanges::One(_) | SignChanges::Unclear => return Identification::Ambiguous,
        };
        if excites(&used) { Identification::Excited(self.increment(&used, to)) } else { Identification::Unexcited }
    }

    #[inline]
    fn increment(&self, piece: &Piece, to: &RateSample) -> Increment<3> {
        let nothing = zeros();
        Increment {
            variance: to.rate_rad_s.map(|rate| rate * rate).component_mul(&self.variance_rad2_s2),
            ..Increment::exact(piece.potential, piece.weight, nothing, nothing)
        }
    }
}

/// What a piece of a step adds. The potential is good if no sign changes inside; the weight is roughly, even otherwise.
struct Piece {
    potential: Vector3<f64>,
    weight: f64,
}

/// How often the components of the angular velocity change their signs during a step.
enum SignChanges {
    /// No component does.
    None,
    /// One component does once.
    One(usize),
    /// More than that may happen.
    Unclear,
}

/// The motion between two samples: per component the cubic with the measured ends and the slopes that the estimate implies.
struct Path {
    /// Its four control points, rad/s. The cubic stays in their hull and has at most as many zeros as they change signs.
    control: [Vector3<f64>; 4],
    /// Torque over inertia, rad/s².
    torque: Vector3<f64>,
    estimate: Vector3<f64>,
    dt_s: f64,
}

impl Path {
    #[inline]
    fn new(from: &RateSample, to: &RateSample, dt_s: f64, estimate: &Vector3<f64>) -> Self {
        // No body has |a_i| > 1: whatever the initial guess, the path stays sensible.
        let estimate = estimate.map(|a| a.clamp(-1.0, 1.0));
        let torque = from.torque_rad_s2;
        let [start, end] = [from.rate_rad_s, to.rate_rad_s];
        let third = dt_s * (1.0 / 3.0);
        let control = [
            start,
            start + velocity(&estimate, &start, &torque) * third,
            end - velocity(&estimate, &end, &torque) * third,
            end,
        ];
        Self { control, torque, estimate, dt_s }
    }

    /// The angular velocity at the part `t` of the step, rad/s; at its ends exactly the measured one.
    #[inline]
    fn at(&self, t: f64) -> Vector3<f64> {
        let left = 1.0 - t;
        let [b0, b1, b2, b3] = &self.control;
        b0 * (left * left * left) + b1 * (3.0 * left * left * t) + b2 * (3.0 * left * t * t) + b3 * (t * t * t)
    }

    /// Potential and weight of the whole step, whose ends need not be computed.
    #[inline]
    fn whole(&self) -> Piece {
        self.between(self.control[0], self.at(0.5), self.control[3], 1.0)
    }

    /// Potential and weight between two parts of the step.
    #[inline]
    fn piece(&self, begin: f64, end: f64) -> Piece {
        self.between(self.at(begin), self.at(0.5 * (begin + end)), self.at(end), end - begin)
    }

    /// Potential and weight of a `part` of the step, the potential with the sign that holds in the middle.
    #[inline]
    fn between(&self, from: Vector3<f64>, middle: Vector3<f64>, to: Vector3<f64>, part: f64) -> Piece {
        let sixth = self.dt_s * part * (1.0 / 6.0);
        // Simpson's rule, exact for the cubics themselves.
        let turned = (from + middle * 4.0 + to) * sixth;
        let (first, central, last) = (product(&from), product(&middle), product(&to));
        let weight = (first.abs() + 4.0 * central.abs() + last.abs()) * sixth;
        let sign = 1.0_f64.copysign(central);
        // From the difference, not as a difference of squares: the small change is what carries the information.
        let energy = (to - from).component_mul(&(to + from)) * 0.5;
        Piece { potential: (energy - self.torque.component_mul(&turned)) * sign, weight }
    }

    /// The sum of the pieces before and after a change of sign.
    #[inline(never)]
    fn split(&self, at: f64) -> Piece {
        let [before, after] = [self.piece(0.0, at), self.piece(at, 1.0)];
        Piece { potential: before.potential + after.potential, weight: before.weight + after.weight }
    }

    /// Which components change their signs, by Descartes' rule for control points: none or one is certain.
    #[inline]
    fn sign_changes(&self) -> SignChanges {
        let mut found = SignChanges::None;
        for axis in 0..3 {
            found = match (self.control_changes(axis), found) {
                (0, found) => found,
                (1, SignChanges::None) => SignChanges::One(axis),
                _ => return SignChanges::Unclear,
            };
        }
        found
    }

    /// How often the control points of a component change their sign; a zero has none.
    #[inline]
    fn control_changes(&self, axis: usize) -> u32 {
        let (mut changes, mut last) = (0, 0.0);
        for point in &self.control {
            let value = point[axis];
            changes += u32::from(value * last < 0.0);
            last = if value == 0.0 { last } else { value };
        }
        changes
    }

    /// Whether the estimate explains the motion from one sample to the other, and thus also in between.
    #[inline(never)]
    fn is_explained(&self) -> bool {
        let [from, middle, to] = [0.0, 0.5, 1.0].map(|t| velocity(&self.estimate, &self.at(t), &self.torque));
        let moved = self.control[3] - self.control[0];
        let unexplained = moved - (from + middle * 4.0 + to) * (self.dt_s / 6.0);
        unexplained.norm_squared() <= UNEXPLAINED * UNEXPLAINED * moved.norm_squared()
    }

    /// The part of the step at which a component with exactly one change of sign is zero.
    #[inline(never)]
    fn zero(&self, axis: usize) -> f64 {
        let start = self.control.iter().map(|point| point[axis]).find(|value| *value != 0.0).unwrap_or(0.0);
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            if self.at(middle)[axis] * start > 0.0 {
                low = middle;
            } else {
                high = middle;
            }
        }
        0.5 * (low + high)
    }
}

/// Euler's equations \[SZ\](1) with torque over inertia, rad/s².
#[inline]
fn velocity(a: &Vector3<f64>, rate: &Vector3<f64>, torque: &Vector3<f64>) -> Vector3<f64> {
    a.component_mul(&rate.yzx()).component_mul(&rate.zxy()) + torque
}

/// Moments of inertia as parts of the first one; more cannot be known without a known torque in N m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertiaRatios {
    /// I2/I1.
    pub second: f64,
    /// I3/I1.
    pub third: f64,
    /// a1 + a2 + a3 + a1·a2·a3: zero for every body, so the distance from it says how consistent the three estimates are.
    pub closure: f64,
}

/// Why three coefficients are not those of a body.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum InertiaRatioError {
    /// The moments that fit best are not all positive, or not finite.
    #[error(
        "a = ({}, {}, {}) belongs to no body: the moments of inertia would be as {} : {} : {}; the estimate has not \
         converged, or nothing excites it", .a.x, .a.y, .a.z, .moments.x, .moments.y, .moments.z
    )]
    NoBody {
        /// The coefficients as given.
        a: Vector3<f64>,
        /// What fits them best, up to a common factor.
        moments: Vector3<f64>,
    },
}

impl InertiaRatios {
    /// The ratios that belong to estimated coefficients a of \[SZ\](1).
    ///
    /// I2/I1 = (1 + a1)/(1 − a2) and I3/I1 = (1 + a1·a2)/(1 − a2), or what follows from these by renaming the axes: all three
    /// forms agree if the closure is zero, but each is 0/0 for a flat plate across one of the axes. The one farthest from
    /// that is taken.
    ///
    /// # Errors
    /// [`InertiaRatioError`] if the moments are not all positive and finite.
    pub fn new(a: &Vector3<f64>) -> Result<Self, InertiaRatioError> {
        // The definitions of a are three linear equations for I; these are the cross products of any two of them.
        let [first, second, third] = [
            Vector3::new(1.0 - a.y, 1.0 + a.x, 1.0 + a.x * a.y),
            Vector3::new(1.0 + a.y * a.z, 1.0 - a.z, 1.0 + a.y),
            Vector3::new(1.0 + a.z, 1.0 + a.z * a.x, 1.0 - a.x),
        ];
        let longer = |left: Vector3<f64>, right: Vector3<f64>| {
            if right.norm_squared() > left.norm_squared() { right } else { left }
        };
        let moments = longer(longer(first, second), third);
        let (second, third) = (moments.y / moments.x, moments.z / moments.x);
        let closure = closure(a);
        let positive = moments.x > 0.0 && moments.y > 0.0 && moments.z > 0.0;
        if positive && second.is_finite() && third.is_finite() && closure.is_finite() {
            Ok(Self { second, third, closure })
        } else {
            Err(InertiaRatioError::NoBody { a: *a, moments })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::InvariantFilter;
    use super::*;
    use crate::model::{Inertia, RigidBody};

    const RATE: f64 = 20.0;

    fn sample(rate: [f64; 3]) -> RateSample {
        RateSample { rate_rad_s: rate.into(), torque_rad_s2: Vector3::zeros() }
    }

    fn body(moments: [f64; 3]) -> RigidBody {
        RigidBody::new(&Inertia::new(moments).unwrap())
    }

    /// The samples at both ends of a step of a body.
    fn step(body: &RigidBody, from: [f64; 3], torque: [f64; 3], dt_s: f64) -> [RateSample; 2] {
        let [from, torque] = [from, torque].map(Vector3::from);
        [from, body.flow(&from, &torque, dt_s)].map(|rate| RateSample { rate_rad_s: rate, torque_rad_s2: torque })
    }

    /// The greatest |Δφ/W − a|, infinite unless the step was used.
    fn miss(seen: &Identification<3>, body: &RigidBody) -> f64 {
        match seen {
            Identification::Excited(increment) => (increment.potential / increment.weight - body.coefficients()).norm(),
            _ => f64::INFINITY,
        }
    }

    #[test]
    fn a_step_tells_the_coefficients() {
        let body = body([1.0, 2.0, 2.5]);
        let relation = InertiaRelation::new(1e-9);
        for torque in [[0.0; 3], [0.2, -0.3, 0.1]] {
            for signs in [[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0; 3]] {
                let [from, to] = step(&body, [0.6 * signs[0], 0.4 * signs[1], 0.8 * signs[2]], torque, 1e-2);
                let seen = relation.observe(&from, &to, 1e-2, body.coefficients());
                assert!(miss(&seen, &body) < 1e-9, "{signs:?}, {torque:?}: {seen:?}");
            }
        }
    }

    #[test]
    fn a_step_with_a_change_of_sign_tells_the_same_when_split() {
        let body = body([1.0, 2.0, 2.5]);
        let relation = InertiaRelation::new(1e-9);
        for torque in [[0.0; 3], [0.2, -0.3, 0.1]] {
            // ω1 passes through zero at about a third of the step.
            let [from, to] = step(&body, [0.001, 0.5, 0.8], torque, 1e-2);
            assert!(from.rate_rad_s.x > 0.0 && to.rate_rad_s.x < 0.0 || torque[0] != 0.0);
            let seen = relation.observe(&from, &to, 1e-2, body.coefficients());
            assert!(miss(&seen, &body) < 1e-6, "{torque:?}: {seen:?}");
            let unsure = relation.observe(&from, &to, 1e-2, &Vector3::zeros());
            if torque == [0.0; 3] {
                assert_eq!(unsure, Identification::Ambiguous, "the path is not known yet");
            }
        }
    }

    #[test]
    fn a_sign_that_changes_twice_is_not_guessed_at() {
        let relation = InertiaRelation::new(1e-9);
        let twice = relation.observe(&sample([0.1, 0.1, 1.0]), &sample([-0.1, -0.1, 1.0]), 0.1, &Vector3::zeros());
        assert_eq!(twice, Identification::Ambiguous);
        // The cubic of ω1 dips below zero between two positive ends.
        let dip =
            relation.observe(&sample([0.1, -1.0, 1.0]), &sample([0.1, 1.0, 1.0]), 1.0, &Vector3::new(1.0, 0.0, 0.0));
        assert_eq!(dip, Identification::Ambiguous);
    }

    #[test]
    fn a_component_at_rest_does_not_excite() {
        let relation = InertiaRelation::new(1e-9);
        for rate in [[0.0, 0.5, 0.8], [0.5, 0.0, 0.0], [0.0; 3], [1e-10, 0.5, 0.8]] {
            let noisy = [rate[0] * -0.7, rate[1], rate[2]];
            let seen = relation.observe(&sample(rate), &sample(noisy), 1e-2, &Vector3::new(0.0, 0.1, 0.2));
            assert_eq!(seen, Identification::Unexcited, "{rate:?}");
            assert_eq!(seen.excitation(), 0.0);
        }
        let nothing = sample([f64::NAN, 0.5, 0.8]);
        assert_eq!(relation.observe(&nothing, &nothing, 1e-2, &Vector3::zeros()), Identification::Unexcited);
    }

    #[test]
    fn the_variance_of_the_potential_is_that_of_half_a_square() {
        let relation = InertiaRelation::new(1e-9).with_variance(Vector3::new(1e-6, 2e-6, 3e-6));
        let [from, to] = step(&body([1.0, 2.0, 2.5]), [0.6, 0.4, 0.8], [0.0; 3], 1e-2);
        let Identification::Excited(increment) = relation.observe(&from, &to, 1e-2, &Vector3::zeros()) else {
            panic!()
        };
        let [x, y, z]: [f64; 3] = to.rate_rad_s.into();
        assert!((increment.variance - Vector3::new(x * x * 1e-6, y * y * 2e-6, z * z * 3e-6)).norm() < 1e-20);
    }

    #[test]
    fn the_estimate_settles_over_changes_of_sign() {
        let body = body([1.0, 2.0, 2.5]);
        let mut filter = InvariantFilter::new(Vector3::repeat(RATE), Vector3::zeros());
        let relation = InertiaRelation::new(1e-9);
        let mut rate = [1.2, -0.8, 1.6];
        for _ in 0..10_000 {
            let [from, to] = step(&body, rate, [0.0; 3], 1e-2);
            if let Identification::Excited(increment) = relation.observe(&from, &to, 1e-2, filter.estimate()) {
                filter.step(&increment);
            }
            rate = to.rate_rad_s.into();
        }
        let error = (filter.estimate() - body.coefficients()).norm();
        assert!(error < 1e-8, "{error:e}");
    }

    #[test]
    fn the_ratios_are_those_of_the_moments() {
        // Flat plates across each axis too, where one form each is 0/0.
        for moments in
            [[1.0, 2.0, 2.5], [2.5, 1.0, 2.0], [1.0, 1.0, 1.0], [1.0, 2.0, 3.0], [3.0, 1.0, 2.0], [2.0, 3.0, 1.0]]
        {
            let ratios = InertiaRatios::new(&Inertia::new(moments).unwrap().coefficients()).unwrap();
            let wrong =
                (ratios.second - moments[1] / moments[0]).abs() + (ratios.third - moments[2] / moments[0]).abs();
            assert!(wrong < 1e-14 && ratios.closure.abs() < 1e-15, "{moments:?}: {ratios:?}");
        }
    }

    #[test]
    fn coefficients_of_no_body_have_no_ratios() {
        for a in [[5.0, 5.0, 5.0], [-1.0, -1.0, -1.0], [f64::NAN, 0.0, 0.0], [f64::INFINITY, 0.0, 0.0]] {
            let refusal = InertiaRatios::new(&a.into());
            assert!(matches!(refusal, Err(InertiaRatioError::NoBody { .. })), "{a:?}: {refusal:?}");
        }
    }
}
