//! A light body in the plane about a point mass, in polar coordinates: the restricted two-body problem, \[S\](1).
//!
//! Lengths are in the unit of the gravitational parameter, called du here. Time is in seconds. The model must not
//! continue beyond its limits (the central body's surface, the outer radius, numbers that are not finite): it returns
//! the last valid state.

use super::integrate;
use crate::vector::amax;
use nalgebra::{Vector2, Vector4};

/// The largest change in one integration step, rad or part of the radius. The error of one step is then below
/// rounding.
const MAX_STEP_RAD: f64 = 2e-3;

/// The maximum number of steps per call, enough for several revolutions. A motion that needs more is not resolved.
const MAX_STEPS: usize = 20_000;

/// Position and velocity in polar coordinates about the central body, \[S\](1).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OrbitState {
    /// Distance from the centre, du.
    pub r: f64,
    /// Radial velocity, du/s.
    pub vr: f64,
    /// Angle, rad, counted on over full turns.
    pub theta: f64,
    /// Transverse velocity r·θ̇, du/s.
    pub vtheta: f64,
}

crate::state::persist_fields!(OrbitState, r, vr, theta, vtheta);

impl OrbitState {
    /// Returns true if every component is finite.
    pub fn is_finite(&self) -> bool {
        [self.r, self.vr, self.theta, self.vtheta].iter().all(|value| value.is_finite())
    }

    /// Returns the angular momentum per mass r·Vθ, du²/s; constant without thrust.
    pub fn momentum(&self) -> f64 {
        self.r * self.vtheta
    }
}

impl From<OrbitState> for Vector4<f64> {
    /// Returns (r, Vr, θ, Vθ), the order of \[S\](1).
    fn from(state: OrbitState) -> Self {
        Self::new(state.r, state.vr, state.theta, state.vtheta)
    }
}

impl From<Vector4<f64>> for OrbitState {
    fn from(x: Vector4<f64>) -> Self {
        Self { r: x.x, vr: x.y, theta: x.z, vtheta: x.w }
    }
}

/// The reason why a central field is invalid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum CentralFieldError {
    /// The gravitational parameter is zero, negative, infinite or not a number.
    #[error("a gravitational parameter of {mu} du^3/s^2 attracts nothing; give a finite number above zero")]
    NotAttracting {
        /// The given value, du³/s².
        mu: f64,
    },
    /// The radii do not enclose a region: 0 < inner < outer does not hold.
    #[error(
        "the region from {inner} du to {outer} du is empty; the central body's radius must be above zero and below the \
         escape radius"
    )]
    EmptyRegion {
        /// The central body's radius, du.
        inner: f64,
        /// The escape radius, du.
        outer: f64,
    },
}

impl From<&CentralFieldError> for &'static str {
    /// Returns the stable name of the error.
    fn from(error: &CentralFieldError) -> Self {
        match error {
            CentralFieldError::NotAttracting { .. } => "not-attracting",
            CentralFieldError::EmptyRegion { .. } => "empty-region",
        }
    }
}

/// The limit at which the model of a motion ended.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum OrbitFault {
    /// The body reached the surface of the central body.
    #[error("it hit the central body; last good state {last:?}")]
    Collision {
        /// The last state above the surface.
        last: OrbitState,
    },
    /// The body left the region of interest.
    #[error("it left the region; last good state {last:?}")]
    Escape {
        /// The last state within the region.
        last: OrbitState,
    },
    /// The motion is too fast for the given time, or no longer finite.
    #[error("its motion cannot be resolved; last good state {last:?}")]
    Unresolved {
        /// The last valid state.
        last: OrbitState,
    },
}

impl OrbitFault {
    /// Returns the last valid state.
    pub fn last(&self) -> OrbitState {
        match self {
            Self::Collision { last } | Self::Escape { last } | Self::Unresolved { last } => *last,
        }
    }
}

/// The attraction of a point mass, between the surface of the central body and an outer radius.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CentralField {
    mu: f64,
    inner: f64,
    outer: f64,
}

impl CentralField {
    /// Creates a field with gravitational parameter `mu` (du³/s², the paper's h²/p) between the radii `inner` and
    /// `outer` (du).
    ///
    /// # Errors
    /// [`CentralFieldError`] if a parameter is invalid.
    pub fn new(mu: f64, inner: f64, outer: f64) -> Result<Self, CentralFieldError> {
        if !(mu.is_finite() && mu > 0.0) {
            return Err(CentralFieldError::NotAttracting { mu });
        }
        if !(inner > 0.0 && inner < outer && outer.is_finite()) {
            return Err(CentralFieldError::EmptyRegion { inner, outer });
        }
        Ok(Self { mu, inner, outer })
    }

    /// Returns the gravitational parameter μ, du³/s².
    pub fn mu(&self) -> f64 {
        self.mu
    }

    /// Returns the radius of the central body, du.
    pub fn inner(&self) -> f64 {
        self.inner
    }

    /// Returns true if a distance from the centre, du, lies within the field.
    pub fn holds(&self, r: f64) -> bool {
        r > self.inner && r < self.outer
    }

    /// Returns the velocity √(μ/r) of a circular orbit, du/s.
    pub fn circular_velocity(&self, r: f64) -> f64 {
        libm::sqrt(self.mu / r)
    }

    /// Returns the state of a body on the circular orbit of radius `r` (du), at angle 0.
    pub fn circular(&self, r: f64) -> OrbitState {
        OrbitState { r, vr: 0.0, theta: 0.0, vtheta: self.circular_velocity(r) }
    }

    /// Returns the energy per mass ½(Vr² + Vθ²) − μ/r, du²/s²; constant without thrust.
    pub fn energy(&self, state: &OrbitState) -> f64 {
        0.5 * (state.vr * state.vr + state.vtheta * state.vtheta) - self.mu / state.r
    }

    /// Returns the least distance from the centre of the free orbit through `state`, past or future, du.
    pub fn pericentre(&self, state: &OrbitState) -> f64 {
        let momentum = state.momentum();
        let parameter = momentum * momentum / self.mu;
        let eccentricity = libm::sqrt((1.0 + 2.0 * self.energy(state) * parameter / self.mu).max(0.0));
        parameter / (1.0 + eccentricity)
    }

    /// Computes the right-hand side of \[S\](1) for (r, Vr, θ, Vθ), with `thrust` (Ur, Uθ) in du/s².
    #[inline]
    pub fn derivative(&self, x: &Vector4<f64>, thrust: &Vector2<f64>) -> Vector4<f64> {
        let (r, vr, vtheta) = (x.x, x.y, x.w);
        Vector4::new(vr, (vtheta * vtheta - self.mu / r) / r + thrust.x, vtheta / r, -vr * vtheta / r + thrust.y)
    }

    /// Returns the state `dt_s` seconds after `state` under a `thrust` (du/s²) whose polar components are held.
    ///
    /// The integration steps depend on the inputs alone, so equal inputs give equal bits. `dt_s` is finite and not
    /// negative.
    ///
    /// # Errors
    /// [`OrbitFault`] with the last valid state if the body reaches a limit of the field.
    #[inline]
    pub fn flow(&self, state: &OrbitState, thrust: &Vector2<f64>, dt_s: f64) -> Result<OrbitState, OrbitFault> {
        let (mut x, mut left_s) = (*state, dt_s);
        for _ in 0..MAX_STEPS {
            // The tolerance keeps a tick that equals the bound up to rounding at one step.
            let steps = libm::ceil(left_s / self.longest_step_s(&x, thrust) - 1e-6);
            if steps <= 1.0 {
                return self.step(&x, thrust, left_s);
            }
            x = self.step(&x, thrust, left_s / steps)?;
            left_s -= left_s / steps;
        }
        Err(OrbitFault::Unresolved { last: x })
    }

    /// Takes one step, if it ends within the field.
    #[inline]
    fn step(&self, last: &OrbitState, thrust: &Vector2<f64>, h: f64) -> Result<OrbitState, OrbitFault> {
        let next: OrbitState = integrate::rk4_step(|x| self.derivative(x, thrust), &(*last).into(), h).into();
        let last = *last;
        if !next.is_finite() {
            Err(OrbitFault::Unresolved { last })
        } else if next.r <= self.inner {
            Err(OrbitFault::Collision { last })
        } else if next.r >= self.outer {
            Err(OrbitFault::Escape { last })
        } else {
            Ok(next)
        }
    }

    /// Returns the time in which nothing changes by more than [`MAX_STEP_RAD`]: by velocity, gravity or thrust.
    #[inline]
    fn longest_step_s(&self, x: &OrbitState, thrust: &Vector2<f64>) -> f64 {
        let speed = x.vr.abs().max(x.vtheta.abs()) / x.r;
        let pull = (self.mu / (x.r * x.r)).max(amax(thrust)) / x.r;
        MAX_STEP_RAD / speed.max(libm::sqrt(pull))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field() -> CentralField {
        CentralField::new(1.0, 0.05, 10.0).unwrap()
    }

    const START: OrbitState = OrbitState { r: 1.0, vr: 0.1, theta: 0.0, vtheta: 0.95 };

    #[test]
    fn invalid_fields_are_refused() {
        for mu in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(CentralField::new(mu, 0.1, 1.0), Err(CentralFieldError::NotAttracting { .. })), "{mu}");
        }
        for (inner, outer) in [(0.0, 1.0), (-1.0, 1.0), (1.0, 1.0), (2.0, 1.0), (0.1, f64::INFINITY), (f64::NAN, 1.0)] {
            let field = CentralField::new(1.0, inner, outer);
            assert!(matches!(field, Err(CentralFieldError::EmptyRegion { .. })), "{inner} {outer}");
        }
    }

    #[test]
    fn free_motion_conserves_energy_and_momentum() {
        let mut x = START;
        for _ in 0..20_000 {
            x = field().flow(&x, &Vector2::zeros(), 1e-3).unwrap();
        }
        assert!((field().energy(&x) - field().energy(&START)).abs() < 1e-12);
        assert!((x.momentum() - START.momentum()).abs() < 1e-12);
    }

    #[test]
    fn a_circular_orbit_stays_one_and_its_pericentre_is_its_radius() {
        let start = field().circular(1.3);
        let x = field().flow(&start, &Vector2::zeros(), 5.0).unwrap();
        assert!((x.r - 1.3).abs() < 1e-13 && x.vr.abs() < 1e-13, "{x:?}");
        assert!((x.theta - 5.0 * start.vtheta / 1.3).abs() < 1e-11);
        assert!((field().pericentre(&start) - 1.3).abs() < 1e-7, "accurate to the square root of rounding");
    }

    #[test]
    fn the_pericentre_is_the_least_distance_reached() {
        let (mut x, mut least) = (START, f64::INFINITY);
        for _ in 0..8000 {
            x = field().flow(&x, &Vector2::zeros(), 1e-3).unwrap();
            least = least.min(x.r);
        }
        assert!((least - field().pericentre(&START)).abs() < 1e-6);
    }

    #[test]
    fn transverse_thrust_spins_the_orbit_up() {
        let x = field().flow(&START, &Vector2::new(0.0, 0.01), 1.0).unwrap();
        // The momentum grows by ∫ r Uθ dt, with r between 1 and 1.1.
        assert!((0.01..0.011).contains(&(x.momentum() - START.momentum())), "{x:?}");
    }

    #[test]
    fn a_fall_ends_above_the_surface() {
        let start = OrbitState { r: 1.0, ..OrbitState::default() };
        let Err(OrbitFault::Collision { last }) = field().flow(&start, &Vector2::zeros(), 5.0) else {
            panic!("the body passed through the surface");
        };
        assert!(last.r > 0.05 && last.r < 0.051 && last.vr < -6.0, "{last:?}");
    }

    #[test]
    fn a_hyperbolic_orbit_ends_within_the_region() {
        let start = OrbitState { vr: 2.0, ..START };
        let fault = field().flow(&start, &Vector2::zeros(), 100.0).unwrap_err();
        assert!(matches!(fault, OrbitFault::Escape { .. }) && fault.last().r > 9.9 && fault.last().r < 10.0, "{fault}");
    }

    #[test]
    fn a_state_is_always_finite() {
        for thrust in [f64::NAN, f64::INFINITY, f64::MAX] {
            let fault = field().flow(&START, &Vector2::new(thrust, 0.0), 1e-3).unwrap_err();
            assert!(fault.last().is_finite(), "{fault}");
        }
        let fast = CentralField::new(1e12, 0.05, 10.0).unwrap();
        let fault = fast.flow(&fast.circular(0.1), &Vector2::zeros(), 10.0).unwrap_err();
        assert!(matches!(fault, OrbitFault::Unresolved { .. }), "{fault}");
    }
}
