//! The invariant relation for the velocity of a body in a central field whose position alone is measured,
//! \[S\](4)-(16).
//!
//! In inertial axes x = r cos θ, y = r sin θ the unknown is (vx, vy), its potential is the position itself, and its
//! drift is the acceleration γ(r, θ, U) of \[S\](10). The printed (9) has L1 for L2 in Γ22; the auxiliary variables z
//! of (12)-(16) are eliminated here, so that neither appears. The relation must not see a measured velocity.

use super::filter::Increment;
use crate::state::persist_fields;
use nalgebra::Vector2;

/// The inputs of the relation at one instant.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OrbitSample {
    /// Distance from the centre, du; positive.
    pub r: f64,
    /// Angle, rad. Its rounding acts as position noise, which grows if the angle counts full turns.
    pub theta: f64,
    /// Known thrust (Ur, Uθ), du/s². Its polar components are held from this instant to the next and rotate with the
    /// body.
    pub thrust: Vector2<f64>,
}

persist_fields!(OrbitSample, r, theta, thrust);

/// Converts a velocity from polar components `polar` (Vr, Vθ) to inertial axes, \[S\](4), in the same unit.
#[inline]
pub fn to_inertial(theta: f64, polar: &Vector2<f64>) -> Vector2<f64> {
    let (sin, cos) = libm::sincos(theta);
    Vector2::new(polar.x * cos - polar.y * sin, polar.x * sin + polar.y * cos)
}

/// Converts a velocity from inertial axes to polar components (Vr, Vθ), \[S\](5), in the same unit.
#[inline]
pub fn to_polar(theta: f64, inertial: &Vector2<f64>) -> Vector2<f64> {
    let (sin, cos) = libm::sincos(theta);
    Vector2::new(inertial.x * cos + inertial.y * sin, -inertial.x * sin + inertial.y * cos)
}

/// The relation for one field and one pair of position sensors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrbitVelocity {
    mu: f64,
    variance_r: f64,
    variance_theta: f64,
}

/// Position, radial and transverse direction, and acceleration at one end of a step.
#[derive(Clone, Copy)]
struct End {
    r: f64,
    radial: Vector2<f64>,
    transverse: Vector2<f64>,
    acceleration: Vector2<f64>,
}

impl OrbitVelocity {
    /// Creates the relation in a field with the gravitational parameter `mu`, du³/s², for sensors without noise.
    pub fn new(mu: f64) -> Self {
        Self { mu, variance_r: 0.0, variance_theta: 0.0 }
    }

    /// Returns the relation for sensors whose noise has these variances, du² and rad².
    pub fn with_variance(self, variance_r: f64, variance_theta: f64) -> Self {
        Self { variance_r, variance_theta, ..self }
    }

    /// Computes the increment of (vx, vy), du/s, over the step of `dt_s` seconds from `from` to `to`.
    ///
    /// `dt_s` and both distances are positive, every input finite. The drift is interpolated by its cubic Hermite
    /// polynomial, so the error is of fourth order in the step. A thrust that changed within the step (ticks were
    /// missed) disturbs the estimate like any unknown acceleration, and the disturbance decays.
    #[inline]
    pub fn observe(&self, from: &OrbitSample, to: &OrbitSample, dt_s: f64) -> Increment<2> {
        let thrust = &from.thrust;
        let ends = [self.end(from, thrust), self.end(to, thrust)];
        let (g0, g1) = (ends[0].acceleration, ends[1].acceleration);
        let potential = ends[1].radial * ends[1].r - ends[0].radial * ends[0].r;
        // The velocities at the ends for a linear acceleration: the error is of third order and enters the slopes
        // only.
        let mean = potential / dt_s;
        let slope0 = self.slope(&ends[0], &(mean - (g0 * 2.0 + g1) * (dt_s / 6.0)), thrust);
        let slope1 = self.slope(&ends[1], &(mean + (g0 + g1 * 2.0) * (dt_s / 6.0)), thrust);
        let square = dt_s * dt_s;
        let drift = (g0 + g1) * (dt_s / 2.0) + (slope0 - slope1) * (square / 12.0);
        let moment = (g0 * 7.0 + g1 * 3.0) * (square / 20.0) + (slope0 * 3.0 - slope1 * 2.0) * (square * dt_s / 60.0);
        Increment { variance: self.variance(&ends[1]), ..Increment::exact(potential, dt_s, drift, moment) }
    }

    /// Computes γ of \[S\](10) at one end, with its parts.
    #[inline]
    fn end(&self, sample: &OrbitSample, thrust: &Vector2<f64>) -> End {
        let (sin, cos) = libm::sincos(sample.theta);
        let (r, radial, transverse) = (sample.r, Vector2::new(cos, sin), Vector2::new(-sin, cos));
        let acceleration = radial * (thrust.x - self.mu / (r * r)) + transverse * thrust.y;
        End { r, radial, transverse, acceleration }
    }

    /// Computes γ̇ at one end, for a body there with `velocity` (du/s).
    #[inline]
    fn slope(&self, end: &End, velocity: &Vector2<f64>, thrust: &Vector2<f64>) -> Vector2<f64> {
        let (approach, turn) = (velocity.dot(&end.radial) / end.r, velocity.dot(&end.transverse) / end.r);
        let pull = self.mu / (end.r * end.r);
        end.radial * (2.0 * pull * approach - turn * thrust.y) + end.transverse * (turn * (thrust.x - pull))
    }

    /// Computes the variance of (x, y), du², from x = r cos θ, y = r sin θ to first order.
    #[inline]
    fn variance(&self, end: &End) -> Vector2<f64> {
        let square = |v: &Vector2<f64>| v.component_mul(v);
        square(&end.radial) * self.variance_r + square(&end.transverse) * (end.r * end.r * self.variance_theta)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{CentralField, OrbitState};
    use crate::observe::InvariantFilter;

    fn sample(state: &OrbitState, thrust: Vector2<f64>) -> OrbitSample {
        OrbitSample { r: state.r, theta: state.theta, thrust }
    }

    #[test]
    fn polar_and_inertial_conversions_are_inverse() {
        let v = Vector2::new(0.3, -0.7);
        assert!((to_polar(2.1, &to_inertial(2.1, &v)) - v).amax() < 1e-16);
        assert!(
            (to_inertial(core::f64::consts::FRAC_PI_2, &Vector2::new(1.0, 0.0)) - Vector2::new(0.0, 1.0)).amax()
                < 1e-16
        );
    }

    /// A thrust of a quarter of the gravity: if it did not rotate with the body, the error would stay far above the
    /// floor.
    #[test]
    fn known_thrust_does_not_move_the_floor() {
        let field = CentralField::new(1.0, 0.05, 50.0).unwrap();
        let (relation, thrust) = (OrbitVelocity::new(1.0), Vector2::new(0.2, 0.15));
        let mut state = OrbitState { r: 1.0, vr: 0.1, theta: 0.0, vtheta: 0.95 };
        let mut filter = InvariantFilter::new(Vector2::new(8.0, 5.0), Vector2::zeros());
        for tick in 0..9000 {
            let next = field.flow(&state, &thrust, 1e-3).unwrap();
            filter.step(&relation.observe(&sample(&state, thrust), &sample(&next, thrust), 1e-3));
            state = next;
            let error = to_polar(state.theta, filter.estimate()) - Vector2::new(state.vr, state.vtheta);
            assert!(tick < 7000 || error.amax() < 1e-11, "{tick}: {error}");
        }
    }

    #[test]
    fn the_variance_is_that_of_the_position() {
        let relation = OrbitVelocity::new(1.0).with_variance(4e-6, 1e-6);
        let at = |theta| relation.end(&OrbitSample { r: 3.0, theta, thrust: Vector2::zeros() }, &Vector2::zeros());
        assert_eq!(relation.variance(&at(0.0)), Vector2::new(4e-6, 9e-6));
        assert!((relation.variance(&at(core::f64::consts::FRAC_PI_2)) - Vector2::new(9e-6, 4e-6)).amax() < 1e-20);
        let still = OrbitSample { r: 1.0, theta: 0.0, thrust: Vector2::zeros() };
        assert_eq!(OrbitVelocity::new(1.0).observe(&still, &still, 1e-3).variance, Vector2::zeros());
    }
}
