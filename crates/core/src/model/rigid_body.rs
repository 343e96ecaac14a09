//! A rigid body rotating about its centre of mass, in its principal axes: Euler's equations, \[D\](1)-(3), \[SZ\](1).

use super::integrate;
use crate::vector::{amax, product, sum};
use nalgebra::Vector3;

/// The largest rotation in one integration step, rad. The error of one step is then below rounding.
const MAX_STEP_RAD: f64 = 2e-3;
/// The longest integration step, s. It limits slow bodies, whose torque, not rate, determines the error.
const LONGEST_STEP_S: f64 = 0.01;

/// The principal moments of inertia of a physically possible body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Inertia {
    moments_kg_m2: Vector3<f64>,
}

/// The reason why three numbers are not the principal moments of a body. Axes are counted from 1, as in the papers.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum InertiaError {
    /// A moment is zero, negative, infinite or not a number.
    #[error(
        "moment of inertia I{axis} = {value_kg_m2} is not a finite positive number; a body has all three above zero"
    )]
    NotPositive {
        /// The axis, 1 to 3.
        axis: usize,
        /// The given moment, kg m².
        value_kg_m2: f64,
    },
    /// One moment exceeds the sum of the other two.
    #[error(
        "I{axis} = {value_kg_m2} exceeds the sum {sum_kg_m2} of the other two; no mass distribution has that \
         (triangle inequality), so lower I{axis} or raise the others"
    )]
    Triangle {
        /// The axis whose moment is too large, 1 to 3.
        axis: usize,
        /// Its moment, kg m².
        value_kg_m2: f64,
        /// The sum of the other two, kg m².
        sum_kg_m2: f64,
    },
}

impl From<&InertiaError> for &'static str {
    /// Returns the stable name of the error.
    fn from(error: &InertiaError) -> Self {
        match error {
            InertiaError::NotPositive { .. } => "no-such-inertia",
            InertiaError::Triangle { .. } => "triangle-inequality",
        }
    }
}

impl Inertia {
    /// Checks three principal moments, kg m²: each positive and at most the sum of the others (equal for a flat
    /// plate).
    ///
    /// # Errors
    /// [`InertiaError`] with the axis and the reason.
    pub fn new(moments_kg_m2: [f64; 3]) -> Result<Self, InertiaError> {
        for (index, &value_kg_m2) in moments_kg_m2.iter().enumerate() {
            if !(value_kg_m2.is_finite() && value_kg_m2 > 0.0) {
                return Err(InertiaError::NotPositive { axis: index + 1, value_kg_m2 });
            }
        }
        for (index, &value_kg_m2) in moments_kg_m2.iter().enumerate() {
            let sum_kg_m2 = moments_kg_m2[(index + 1) % 3] + moments_kg_m2[(index + 2) % 3];
            // Decimal input of a plate may miss equality by a rounding error.
            if value_kg_m2 > sum_kg_m2 * (1.0 + 1e-12) {
                return Err(InertiaError::Triangle { axis: index + 1, value_kg_m2, sum_kg_m2 });
            }
        }
        Ok(Self { moments_kg_m2: Vector3::from(moments_kg_m2) })
    }

    /// Returns the three moments, kg m².
    pub fn moments_kg_m2(&self) -> Vector3<f64> {
        self.moments_kg_m2
    }

    /// Returns the dimensionless coefficients a of \[D\](2): a1 = (I2 − I3)/I1 and cyclic. They satisfy a1 + a2 + a3
    /// + a1·a2·a3 = 0.
    pub fn coefficients(&self) -> Vector3<f64> {
        let i = &self.moments_kg_m2;
        Vector3::new((i.y - i.z) / i.x, (i.z - i.x) / i.y, (i.x - i.y) / i.z)
    }

    /// Returns the kinetic energy ½ Σ I ω², J; constant without torque. `rate` in rad/s.
    pub fn kinetic_energy_j(&self, rate: &Vector3<f64>) -> f64 {
        0.5 * self.moments_kg_m2.dot(&rate.component_mul(rate))
    }

    /// Returns the magnitude of the angular momentum |I ω|, N m s; constant without torque. `rate` in rad/s.
    pub fn momentum_n_m_s(&self, rate: &Vector3<f64>) -> f64 {
        libm::sqrt(self.moments_kg_m2.component_mul(rate).norm_squared())
    }

    /// Returns the bound M ≥ |ω(t)| for all time of the free motion through `rate`, rad/s: √(2T / I_min).
    pub fn rate_bound_rad_s(&self, rate: &Vector3<f64>) -> f64 {
        libm::sqrt(2.0 * self.kinetic_energy_j(rate) / self.moments_kg_m2.min())
    }
}

/// Computes a1 + a2 + a3 + a1·a2·a3. It is zero for the coefficients a of every body and measures the inconsistency
/// of others.
#[inline]
pub fn closure(a: &Vector3<f64>) -> f64 {
    sum(a) + product(a)
}

/// Computes the right-hand side of Euler's equations, rad/s²: ω̇1 = a1 ω2 ω3 + u1 and cyclic, \[D\](2), (3).
///
/// `a` are [`Inertia::coefficients`], `rate` in rad/s, `torque` is torque over inertia, rad/s².
#[inline]
pub fn euler(a: &Vector3<f64>, rate: &Vector3<f64>, torque: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(a.x * rate.y * rate.z + torque.x, a.y * rate.z * rate.x + torque.y, a.z * rate.x * rate.y + torque.z)
}

/// The motion of a rigid body of a given inertia.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidBody {
    coefficients: Vector3<f64>,
}

impl RigidBody {
    /// Creates a body with the given inertia.
    pub fn new(inertia: &Inertia) -> Self {
        Self { coefficients: inertia.coefficients() }
    }

    /// Creates a body from the coefficients a of \[D\](2), which determine its motion.
    pub fn with_coefficients(coefficients: Vector3<f64>) -> Self {
        Self { coefficients }
    }

    /// Returns the coefficients a of \[D\](2).
    pub fn coefficients(&self) -> &Vector3<f64> {
        &self.coefficients
    }

    /// Returns the angular velocity `dt_s` seconds after `rate` (rad/s) under a held `torque` (rad/s²).
    ///
    /// The number of integration steps depends on the inputs alone, so equal inputs give equal bits.
    #[inline]
    pub fn flow(&self, rate: &Vector3<f64>, torque: &Vector3<f64>, dt_s: f64) -> Vector3<f64> {
        let fastest_rad_s = fastest_rad_s(rate, torque, dt_s);
        let derivative = |x: &Vector3<f64>| euler(&self.coefficients, x, torque);
        if in_one_step(fastest_rad_s, dt_s) {
            return integrate::rk4_step(derivative, rate, dt_s);
        }
        integrate::flow(derivative, rate, dt_s, max_step_s(fastest_rad_s))
    }
}

/// Returns an approximate bound on the angular velocity within `dt_s` under a held torque, rad/s.
#[inline]
pub(super) fn fastest_rad_s(rate: &Vector3<f64>, torque: &Vector3<f64>, dt_s: f64) -> f64 {
    amax(rate) + amax(torque) * dt_s
}

/// Returns true if one integration step suffices for `dt_s`, the usual case; checked without a division.
#[inline]
pub(super) fn in_one_step(fastest_rad_s: f64, dt_s: f64) -> bool {
    fastest_rad_s * dt_s <= MAX_STEP_RAD && dt_s <= LONGEST_STEP_S
}

/// Returns the longest integration step at this angular velocity, s.
#[inline]
pub(super) fn max_step_s(fastest_rad_s: f64) -> f64 {
    (MAX_STEP_RAD / fastest_rad_s).min(LONGEST_STEP_S)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_moments_are_refused() {
        assert!(matches!(Inertia::new([1.0, 0.0, 1.0]), Err(InertiaError::NotPositive { axis: 2, .. })));
        assert!(matches!(Inertia::new([1.0, 2.0, f64::NAN]), Err(InertiaError::NotPositive { axis: 3, .. })));
        assert!(matches!(Inertia::new([f64::INFINITY, 2.0, 1.0]), Err(InertiaError::NotPositive { axis: 1, .. })));
        assert!(matches!(Inertia::new([1.0, 2.0, 3.1]), Err(InertiaError::Triangle { axis: 3, .. })));
        assert!(Inertia::new([1.0, 2.0, 3.0]).is_ok(), "a flat plate is a body");
        assert!(Inertia::new([0.1, 0.2, 0.1 + 0.2]).is_ok(), "a plate typed in decimals is a body");
    }

    #[test]
    fn the_coefficients_satisfy_their_identity() {
        let a = Inertia::new([1.0, 2.0, 2.5]).unwrap().coefficients();
        assert_eq!(a, Vector3::new(-0.5, 0.75, -0.4));
        assert!(closure(&a).abs() < 1e-16);
    }

    #[test]
    fn free_motion_conserves_energy_and_momentum() {
        let inertia = Inertia::new([1.0, 2.0, 2.5]).unwrap();
        let body = RigidBody::new(&inertia);
        let start = Vector3::new(0.6, -0.4, 0.8);
        let mut rate = start;
        for _ in 0..20_000 {
            rate = body.flow(&rate, &Vector3::zeros(), 1e-3);
        }
        assert!((inertia.kinetic_energy_j(&rate) - inertia.kinetic_energy_j(&start)).abs() < 1e-12);
        assert!((inertia.momentum_n_m_s(&rate) - inertia.momentum_n_m_s(&start)).abs() < 1e-12);
        assert!(rate.norm() <= inertia.rate_bound_rad_s(&start));
    }

    #[test]
    fn a_torque_about_a_principal_axis_spins_it_up_linearly() {
        let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
        let rate = body.flow(&Vector3::zeros(), &Vector3::new(0.0, 0.3, 0.0), 2.0);
        assert!((rate - Vector3::new(0.0, 0.6, 0.0)).amax() < 1e-14, "{rate}");
    }
}
