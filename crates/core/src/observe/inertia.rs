//! The invariant relation for the inertia of a rigid body whose angular velocity is measured completely,
//! \[SZ\](1)-(11).
//!
//! The unknown is a = (a1, a2, a3) of \[SZ\](1), the same as \[D\](2): φ_i = ½ s ω_i² with s = sign(ω1 ω2 ω3) obeys
//! φ̇_i = |ω1 ω2 ω3| a_i. The signs printed in (5), (10) and (11) are inconsistent; \[SZ\](7) and (8) are correct.
//! Condition (У), ω1 ω2 ω3 bounded away from zero, holds for no free asymmetric body: two components change their
//! signs repeatedly, and φ jumps. So only increments of φ between two samples are computed, none of them across a
//! jump. The relation must not carry a branch or a sign from one step to the next, nor use a step whose jump it
//! cannot locate.
//!
//! A torque-free motion, or torque over inertia, determines only the ratios of the moments of inertia.

use super::filter::Increment;
use super::hidden_rate::RateSample;
use crate::model::closure;
use crate::vector::{product, zeros};
use nalgebra::Vector3;

/// The smallest mean of |ω1 ω2 ω3| over a step, (rad/s)³, at which potential over weight is more than rounding.
const SMALLEST_FLOOR_RAD3_S3: f64 = 1e-12;

/// The largest unexplained part of the motion at which a step with a change of sign is used. Beyond it the path
/// between the samples, and with it the location of the change, is not known well enough.
const UNEXPLAINED: f64 = 0.05;

/// The number of halvings that locate a zero of a cubic on [0, 1] to the last bit.
const HALVINGS: u32 = 53;

/// The information of one step about an unknown constant of the body. Only `Excited` changes the estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Identification<const N: usize> {
    /// The relation held over the step. The weight is the excitation ∫ρ dt of the step.
    Excited(Increment<N>),
    /// The motion does not depend on the unknown: a component is at rest, or nearly.
    Unexcited,
    /// The motion between the two samples is uncertain: the step is too long, or the estimate does not yet explain
    /// the motion well enough to locate a change of sign.
    Ambiguous,
}

impl<const N: usize> Identification<N> {
    /// Returns the excitation W = ∫ρ dt of the step; zero for a step that is not used. Errors decay as e^{λ ΣW}.
    pub fn excitation(&self) -> f64 {
        match self {
            Self::Excited(increment) => increment.weight,
            Self::Unexcited | Self::Ambiguous => 0.0,
        }
    }
}

/// The relation for (a1, a2, a3): ρ = |ω1 ω2 ω3|, (rad/s)³, g = 0. Its filter's rates are in s²/rad³.
///
/// The ratios of a body's moments of inertia from its free tumbling:
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
/// The error of one step of h seconds is of fifth order in h, that of the settled estimate of fourth order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertiaRelation {
    floor_rad3_s3: f64,
    variance_rad2_s2: Vector3<f64>,
}

impl InertiaRelation {
    /// Creates the relation for noiseless sensors.
    ///
    /// A step with a mean |ω1 ω2 ω3| below `floor_rad3_s3` counts as not exciting; a floor below 1e-12 (rad/s)³ is
    /// raised to that value. With noisy sensors choose a floor above the noise of a component at rest.
    pub fn new(floor_rad3_s3: f64) -> Self {
        Self { floor_rad3_s3: floor_rad3_s3.max(SMALLEST_FLOOR_RAD3_S3), variance_rad2_s2: Vector3::zeros() }
    }

    /// Returns the relation with the variance of each measured component, (rad/s)².
    #[must_use]
    pub fn with_variance(self, variance_rad2_s2: Vector3<f64>) -> Self {
        Self { variance_rad2_s2, ..self }
    }

    /// Computes the increment of a over the step of `dt_s` seconds from `from` to `to`. `estimate` is the estimate of
    /// a at its start.
    ///
    /// The torque of `from` is held over the step. `dt_s` is positive and every input finite.
    #[inline]
    pub fn observe(&self, from: &RateSample, to: &RateSample, dt_s: f64, estimate: &Vector3<f64>) -> Identification<3> {
        let path = Path::new(from, to, dt_s, estimate);
        let whole = path.whole();
        // False also for a NaN weight. Checked before the signs, because the sign of a component at rest is noise.
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

/// The increment over a piece of a step. The potential is valid if no sign changes inside; the weight is approximate
/// otherwise.
struct Piece {
    potential: Vector3<f64>,
    weight: f64,
}

/// The sign changes of the angular velocity's components during a step.
enum SignChanges {
    /// No component changes its sign.
    None,
    /// One component changes its sign once.
    One(usize),
    /// More changes are possible.
    Unclear,
}

/// The motion between two samples: per component the cubic with the measured ends and the slopes given by the
/// estimate.
struct Path {
    /// The four control points, rad/s. The cubic stays in their hull and has at most as many zeros as they have sign
    /// changes.
    control: [Vector3<f64>; 4],
    /// Torque over inertia, rad/s².
    torque: Vector3<f64>,
    estimate: Vector3<f64>,
    dt_s: f64,
}

impl Path {
    #[inline]
    fn new(from: &RateSample, to: &RateSample, dt_s: f64, estimate: &Vector3<f64>) -> Self {
        // No body has |a_i| > 1; the limit keeps the path bounded for any initial guess.
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

    /// Returns the angular velocity at the fraction `t` of the step, rad/s; exactly the measured one at the ends.
    #[inline]
    fn at(&self, t: f64) -> Vector3<f64> {
        let left = 1.0 - t;
        let [b0, b1, b2, b3] = &self.control;
        b0 * (left * left * left) + b1 * (3.0 * left * left * t) + b2 * (3.0 * left * t * t) + b3 * (t * t * t)
    }

    /// Computes potential and weight of the whole step, whose ends are given.
    #[inline]
    fn whole(&self) -> Piece {
        self.between(self.control[0], self.at(0.5), self.control[3], 1.0)
    }

    /// Computes potential and weight between two fractions of the step.
    #[inline]
    fn piece(&self, begin: f64, end: f64) -> Piece {
        self.between(self.at(begin), self.at(0.5 * (begin + end)), self.at(end), end - begin)
    }

    /// Computes potential and weight of a `part` of the step. The potential has the sign of the middle.
    #[inline]
    fn between(&self, from: Vector3<f64>, middle: Vector3<f64>, to: Vector3<f64>, part: f64) -> Piece {
        let sixth = self.dt_s * part * (1.0 / 6.0);
        // Simpson's rule is exact for the cubics.
        let turned = (from + middle * 4.0 + to) * sixth;
        let (first, central, last) = (product(&from), product(&middle), product(&to));
        let weight = (first.abs() + 4.0 * central.abs() + last.abs()) * sixth;
        let sign = 1.0_f64.copysign(central);
        // Computed from the difference, not as a difference of squares: the small change carries the information.
        let energy = (to - from).component_mul(&(to + from)) * 0.5;
        Piece { potential: (energy - self.torque.component_mul(&turned)) * sign, weight }
    }

    /// Returns the sum of the pieces before and after a change of sign.
    #[inline(never)]
    fn split(&self, at: f64) -> Piece {
        let [before, after] = [self.piece(0.0, at), self.piece(at, 1.0)];
        Piece { potential: before.potential + after.potential, weight: before.weight + after.weight }
    }

    /// Returns the sign changes of the components by Descartes' rule for control points: zero or one change is
    /// certain.
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

    /// Counts the sign changes of a component's control points; a zero has no sign.
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

    /// Returns true if the estimate explains the motion from one sample to the other, and therefore in between.
    #[inline(never)]
    fn is_explained(&self) -> bool {
        let [from, middle, to] = [0.0, 0.5, 1.0].map(|t| velocity(&self.estimate, &self.at(t), &self.torque));
        let moved = self.control[3] - self.control[0];
        let unexplained = moved - (from + middle * 4.0 + to) * (self.dt_s / 6.0);
        unexplained.norm_squared() <= UNEXPLAINED * UNEXPLAINED * moved.norm_squared()
    }

    /// Returns the fraction of the step at which a component with exactly one change of sign is zero.
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

/// Computes Euler's equations \[SZ\](1) with torque over inertia, rad/s².
#[inline]
fn velocity(a: &Vector3<f64>, rate: &Vector3<f64>, torque: &Vector3<f64>) -> Vector3<f64> {
    a.component_mul(&rate.yzx()).component_mul(&rate.zxy()) + torque
}

/// Moments of inertia relative to the first one; the absolute values require a known torque in N m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertiaRatios {
    /// I2/I1.
    pub second: f64,
    /// I3/I1.
    pub third: f64,
    /// a1 + a2 + a3 + a1·a2·a3: zero for every body, so it measures the inconsistency of the three estimates.
    pub closure: f64,
}

/// The reason why three coefficients belong to no body.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum InertiaRatioError {
    /// The best-fitting moments are not all positive and finite.
    #[error(
        "a = ({}, {}, {}) belongs to no body: the moments of inertia would be as {} : {} : {}; the estimate has not \
         converged, or nothing excites it", .a.x, .a.y, .a.z, .moments.x, .moments.y, .moments.z
    )]
    NoBody {
        /// The coefficients as given.
        a: Vector3<f64>,
        /// The best-fitting moments, up to a common factor.
        moments: Vector3<f64>,
    },
}

impl InertiaRatios {
    /// Computes the ratios from estimated coefficients a of \[SZ\](1).
    ///
    /// I2/I1 = (1 + a1)/(1 − a2) and I3/I1 = (1 + a1·a2)/(1 − a2), or the forms that follow by renaming the axes. All
    /// three forms agree if the closure is zero, but each is 0/0 for a flat plate across one of the axes. The form
    /// farthest from 0/0 is used.
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

    /// Returns the samples at both ends of a step of a body.
    fn step(body: &RigidBody, from: [f64; 3], torque: [f64; 3], dt_s: f64) -> [RateSample; 2] {
        let [from, torque] = [from, torque].map(Vector3::from);
        [from, body.flow(&from, &torque, dt_s)].map(|rate| RateSample { rate_rad_s: rate, torque_rad_s2: torque })
    }

    /// Returns the largest |Δφ/W − a|; infinite if the step is not used.
    fn miss(seen: &Identification<3>, body: &RigidBody) -> f64 {
        match seen {
            Identification::Excited(increment) => (increment.potential / increment.weight - body.coefficients()).norm(),
            _ => f64::INFINITY,
        }
    }

    #[test]
    fn a_step_yields_the_coefficients() {
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
    fn a_step_split_at_a_change_of_sign_yields_the_coefficients() {
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
                assert_eq!(unsure, Identification::Ambiguous, "the path is not yet known");
            }
        }
    }

    #[test]
    fn a_double_change_of_sign_is_ambiguous() {
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
    fn the_potential_has_the_variance_of_half_a_square() {
        let relation = InertiaRelation::new(1e-9).with_variance(Vector3::new(1e-6, 2e-6, 3e-6));
        let [from, to] = step(&body([1.0, 2.0, 2.5]), [0.6, 0.4, 0.8], [0.0; 3], 1e-2);
        let Identification::Excited(increment) = relation.observe(&from, &to, 1e-2, &Vector3::zeros()) else {
            panic!()
        };
        let [x, y, z]: [f64; 3] = to.rate_rad_s.into();
        assert!((increment.variance - Vector3::new(x * x * 1e-6, y * y * 2e-6, z * z * 3e-6)).norm() < 1e-20);
    }

    #[test]
    fn the_estimate_converges_over_changes_of_sign() {
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
    fn the_ratios_equal_those_of_the_moments() {
        // Includes flat plates across each axis, where one form each is 0/0.
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
    fn impossible_coefficients_have_no_ratios() {
        for a in [[5.0, 5.0, 5.0], [-1.0, -1.0, -1.0], [f64::NAN, 0.0, 0.0], [f64::INFINITY, 0.0, 0.0]] {
            let refusal = InertiaRatios::new(&a.into());
            assert!(matches!(refusal, Err(InertiaRatioError::NoBody { .. })), "{a:?}: {refusal:?}");
        }
    }
}
