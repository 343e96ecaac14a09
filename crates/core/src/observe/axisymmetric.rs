//! The invariant relation for the one coefficient of an axisymmetric body, \[SZ\](12)-(17).
//!
//! For a symmetry axis k and the transverse axes i, j (cyclic), I_i = I_j and a = (I_j − I_k)/I_i: the transverse
//! component rotates in the body by θ = atan2(ω_i, ω_j) at the rate θ̇ = a ω_k. The paper divides by ω_k. Here ρ =
//! |ω_k| is the weight, its sign goes into Δθ, and a body that does not spin counts as not exciting. The relation
//! must not unwrap an angle, nor use a step in which θ may have rotated by π.

use super::filter::Increment;
use super::hidden_rate::RateSample;
use super::inertia::Identification;
use crate::vector::zeros;
use nalgebra::{Vector1, Vector3};

/// The largest rotation of the transverse component in one step, rad, that is distinguished from its complement (π is
/// ambiguous).
const MAX_TURN_RAD: f64 = 3.0;

/// The smallest floor, rad/s: below it a component counts as at rest.
const SMALLEST_FLOOR_RAD_S: f64 = 1e-9;

/// The reason why the relation does not exist.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum AxisymmetricError {
    /// The axis number is invalid.
    #[error("axis {axis} does not exist; the axis of symmetry is 1, 2 or 3")]
    NoSuchAxis {
        /// The axis as given.
        axis: usize,
    },
}

impl From<&AxisymmetricError> for &'static str {
    /// Returns the stable name of the error.
    fn from(error: &AxisymmetricError) -> Self {
        match error {
            AxisymmetricError::NoSuchAxis { .. } => "no-such-axis",
        }
    }
}

/// The relation for a = (I_j − I_k)/I_i of a body that is symmetric about axis k: ρ = |ω_k|, rad/s, g = 0. Its
/// filter's rate is per radian of spin. The ratio of the moments is I_k/I_i = 1 − a.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisymmetricRelation {
    axes: [usize; 3],
    floor_rad_s: f64,
    variance_rad2_s2: Vector3<f64>,
}

/// The transverse components and the spin at one instant, rad/s.
#[derive(Clone, Copy)]
struct Spin {
    i: f64,
    j: f64,
    k: f64,
}

impl Spin {
    #[inline]
    fn transverse(&self) -> f64 {
        libm::sqrt(self.i * self.i + self.j * self.j)
    }
}

impl AxisymmetricRelation {
    /// Creates the relation for the symmetry axis `axis` (1 to 3; 3 in the paper) and noiseless sensors.
    ///
    /// A spin or a transverse component of at most `floor_rad_s` counts as not exciting; a floor below 1e-9 rad/s is
    /// raised to that value.
    ///
    /// # Errors
    /// [`AxisymmetricError`] if there is no such axis.
    pub fn new(axis: usize, floor_rad_s: f64) -> Result<Self, AxisymmetricError> {
        if !(1..=3).contains(&axis) {
            return Err(AxisymmetricError::NoSuchAxis { axis });
        }
        let floor_rad_s = floor_rad_s.max(SMALLEST_FLOOR_RAD_S);
        Ok(Self { axes: [axis % 3, (axis + 1) % 3, axis - 1], floor_rad_s, variance_rad2_s2: Vector3::zeros() })
    }

    /// Returns the relation with the variance of each measured component, (rad/s)².
    #[must_use]
    pub fn with_variance(self, variance_rad2_s2: Vector3<f64>) -> Self {
        Self { variance_rad2_s2, ..self }
    }

    /// Returns the longest step, s, over which a free body with a spin of at most `spin_bound_rad_s` can be followed.
    /// It holds for any a, because |a| ≤ 1 for every axisymmetric body.
    /// |a| ≤ 1 for every axisymmetric body.
    pub fn longest_step_s(&self, spin_bound_rad_s: f64) -> f64 {
        MAX_TURN_RAD / spin_bound_rad_s
    }

    /// Computes the increment of a over the step of `dt_s` seconds from `from` to `to`.
    ///
    /// The torque of `from` is held over the step. `dt_s` is positive and every input finite.
    #[inline]
    pub fn observe(&self, from: &RateSample, to: &RateSample, dt_s: f64) -> Identification<1> {
        let ends = [self.spin(&from.rate_rad_s), self.spin(&to.rate_rad_s)];
        let torque = self.spin(&from.torque_rad_s2);
        // Exact: a held torque changes the spin linearly.
        let spun = 0.5 * dt_s * (ends[0].k + ends[1].k);
        let push = libm::sqrt(torque.i * torque.i + torque.j * torque.j) * dt_s;
        // The torque bounds the rate of the transverse magnitude, which therefore never falls below this value.
        let transverse = 0.5 * (ends[0].transverse() + ends[1].transverse() - push);
        let spins = ends[0].k.abs().min(ends[1].k.abs()) > self.floor_rad_s && ends[0].k * ends[1].k > 0.0;
        if !(spins && transverse > self.floor_rad_s) {
            return Identification::Unexcited;
        }
        // Bounds the rotation for any a, because |a| ≤ 1.
        if spun.abs() + push / transverse > MAX_TURN_RAD {
            return Identification::Ambiguous;
        }
        let turn = turn(&ends);
        let free = if push == 0.0 { turn } else { turn - driven(&ends, &torque, dt_s, turn, spun) };
        Identification::Excited(self.increment(&ends[1], free * 1.0_f64.copysign(spun), spun.abs()))
    }

    #[inline]
    fn spin(&self, vector: &Vector3<f64>) -> Spin {
        let [i, j, k] = self.axes.map(|index| vector[index]);
        Spin { i, j, k }
    }

    #[inline]
    fn increment(&self, to: &Spin, potential: f64, weight: f64) -> Increment<1> {
        let [vi, vj, _] = self.axes.map(|index| self.variance_rad2_s2[index]);
        let square = to.i * to.i + to.j * to.j;
        let nothing = zeros();
        Increment {
            variance: Vector1::new((to.j * to.j * vi + to.i * to.i * vj) / (square * square)),
            ..Increment::exact(Vector1::new(potential), weight, nothing, nothing)
        }
    }
}

/// Computes Δθ between the ends, rad, below π in magnitude.
#[inline]
fn turn([from, to]: &[Spin; 2]) -> f64 {
    // Computed from the differences: the small change carries the information.
    let cross = (to.i - from.i) * from.j - (to.j - from.j) * from.i;
    libm::atan2(cross, from.i * to.i + from.j * to.j)
}

/// Computes the torque's contribution to θ, rad: ∫(u_i ω_j − ω_i u_j)/(ω_i² + ω_j²) dt by Simpson's rule, with the
/// middle of the path from its cubic Hermite interpolation.
fn driven(ends: &[Spin; 2], torque: &Spin, dt_s: f64, turn: f64, spun: f64) -> f64 {
    let rate = |s: &Spin| (torque.i * s.j - s.i * torque.j) / (s.i * s.i + s.j * s.j);
    let [from, to] = ends;
    let outer = rate(from) + rate(to);
    // Accurate to second order in the step, which is enough for the slopes at the ends.
    let a = (turn - 0.5 * dt_s * outer) / spun;
    let bend = |start: f64, end: f64, slopes: [f64; 2]| 0.5 * (start + end) + dt_s / 8.0 * (slopes[0] - slopes[1]);
    let middle = Spin {
        i: bend(from.i, to.i, ends.map(|s| a * s.j * s.k + torque.i)),
        j: bend(from.j, to.j, ends.map(|s| -a * s.i * s.k + torque.j)),
        k: 0.5 * (from.k + to.k),
    };
    dt_s * (outer + 4.0 * rate(&middle)) / 6.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, RigidBody};

    const STEP_S: f64 = 1e-2;

    /// Returns a body that is symmetric about an axis, with its a.
    fn body(axis: usize, axial: f64) -> (RigidBody, f64) {
        let mut moments = [1.0; 3];
        moments[axis - 1] = axial;
        (RigidBody::new(&Inertia::new(moments).unwrap()), 1.0 - axial)
    }

    fn observe(
        body: &RigidBody,
        axis: usize,
        from: Vector3<f64>,
        torque: Vector3<f64>,
        dt_s: f64,
    ) -> Identification<1> {
        let [from, to] =
            [from, body.flow(&from, &torque, dt_s)].map(|rate_rad_s| RateSample { rate_rad_s, torque_rad_s2: torque });
        AxisymmetricRelation::new(axis, 1e-6).unwrap().observe(&from, &to, dt_s)
    }

    #[test]
    fn a_step_yields_the_coefficient_for_any_axis_and_sign() {
        for axis in 1..=3 {
            for (axial, spin) in [(1.6, 0.8), (1.6, -0.8), (0.3, 0.8), (0.3, -0.8), (1.0, 0.5)] {
                for torque in [Vector3::zeros(), Vector3::new(0.2, -0.3, 0.1)] {
                    let (body, a) = body(axis, axial);
                    let mut from = Vector3::new(0.3, -0.4, 0.5);
                    from[axis - 1] = spin;
                    let seen = observe(&body, axis, from, torque, STEP_S);
                    let Identification::Excited(increment) = seen else { panic!("axis {axis}: {seen:?}") };
                    let error = increment.potential.x / increment.weight - a;
                    let bound = if torque.x == 0.0 { 1e-13 } else { 1e-9 };
                    assert!(error.abs() < bound, "axis {axis}, I {axial}, spin {spin}, {torque}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn a_body_without_spin_or_without_nutation_does_not_excite() {
        let (body, _) = body(3, 1.6);
        for from in [[0.3, 0.4, 0.0], [0.3, 0.4, 1e-7], [0.3, 0.4, -1e-7], [0.0, 0.0, 0.8], [0.0; 3]] {
            let seen = observe(&body, 3, from.into(), Vector3::zeros(), STEP_S);
            assert_eq!(seen, Identification::Unexcited, "{from:?}");
        }
        let reversed = observe(&body, 3, Vector3::new(0.3, 0.4, -1e-3), Vector3::new(0.0, 0.0, 1.0), STEP_S);
        assert_eq!(reversed, Identification::Unexcited, "the spin passes through zero");
        let crossed = observe(&body, 3, Vector3::new(1e-3, 0.0, 0.8), Vector3::new(-1.0, 0.0, 0.0), STEP_S);
        assert_eq!(crossed, Identification::Unexcited, "the transverse component may pass through zero");
    }

    #[test]
    fn a_step_too_long_for_the_angle_is_ambiguous() {
        let (body, a) = body(3, 1.6);
        let limit = AxisymmetricRelation::new(3, 1e-6).unwrap().longest_step_s(0.8);
        let from = Vector3::new(0.3, 0.4, 0.8);
        assert_eq!(observe(&body, 3, from, Vector3::zeros(), limit * 1.01), Identification::Ambiguous);
        let seen = observe(&body, 3, from, Vector3::zeros(), limit * 0.99);
        let Identification::Excited(increment) = seen else { panic!("{seen:?}") };
        assert!((increment.potential.x / increment.weight - a).abs() < 1e-13);
    }

    #[test]
    fn other_axes_than_1_to_3_are_refused() {
        for axis in [0, 4] {
            assert_eq!(AxisymmetricRelation::new(axis, 1e-6), Err(AxisymmetricError::NoSuchAxis { axis }));
        }
    }

    #[test]
    fn the_variance_of_the_angle_is_that_of_its_transverse_components() {
        let relation = AxisymmetricRelation::new(1, 1e-6).unwrap().with_variance(Vector3::new(9.0, 1e-6, 4e-6));
        let at = |rate_rad_s| RateSample { rate_rad_s, torque_rad_s2: Vector3::zeros() };
        let rate = Vector3::new(0.5, 0.3, 0.4);
        let Identification::Excited(increment) = relation.observe(&at(rate), &at(rate), 1e-2) else { panic!() };
        let expected = (0.16 * 1e-6 + 0.09 * 4e-6) / (0.25 * 0.25);
        assert!((increment.variance.x / expected - 1.0).abs() < 1e-14);
    }
}
