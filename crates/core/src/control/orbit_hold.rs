//! The law that steers a body to a reference motion in a central field: a circular orbit, or another body's orbit.
//!
//! \[S\] takes its law (2) from an earlier paper and does not reproduce it; this law is our own. With e_r = r − R,
//! e_v = Vr − V_R and e_θ = Vθ − V_Θ against a freely moving reference (R, V_R, V_Θ),
//!
//! U_r = (V_Θ²/R − μ/R²) − (Vθ²/r − μ/r²) − k_r e_r − k_v e_v,  U_θ = Vr Vθ/r − V_R V_Θ/R − k_θ e_θ
//!
//! gives the error dynamics ė_r = e_v, ė_v = −k_r e_r − k_v e_v, ė_θ = −k_θ e_θ, as long as no limit acts. V = ½(k_r
//! e_r² + e_v² + e_θ²) has V̇ = −k_v e_v² − k_θ e_θ² ≤ 0, which vanishes along a motion only at e = 0 (LaSalle), so
//! the law converges for all positive gains. The angles keep an offset: θ̇ − Θ̇ = Vθ/r − V_Θ/R decays with the error
//! and is integrable. With an estimate in place of a velocity, the observer's error enters as a disturbance that
//! decays on its own.
//!
//! The law must not command more than the thrusters' limit, nor a value that is not finite.

use super::certificate::Condition;
use crate::model::{CentralField, OrbitState};
use crate::vector::zeros;
use nalgebra::Vector2;

/// The gains of the law, all positive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrbitGains {
    /// k_r on the radius, 1/s².
    pub radius_per_s2: f64,
    /// k_v on the radial velocity, 1/s.
    pub radial_per_s: f64,
    /// k_θ on the transverse velocity, 1/s.
    pub transverse_per_s: f64,
}

impl OrbitGains {
    /// Returns the slowest exponent of the error, 1/s: of the roots of s² + k_v s + k_r and of −k_θ.
    pub fn rate_per_s(&self) -> f64 {
        let half = 0.5 * self.radial_per_s;
        let discriminant = half * half - self.radius_per_s2;
        // The small root from the product of both, because its digits would be lost next to a large k_v.
        let radial = if discriminant > 0.0 { self.radius_per_s2 / (half + libm::sqrt(discriminant)) } else { half };
        radial.min(self.transverse_per_s)
    }
}

/// The law for one body. Orbit hold and rendezvous differ only in the reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrbitHold {
    field: CentralField,
    gains: OrbitGains,
    thrust_max: f64,
    lead_s: f64,
}

impl OrbitHold {
    /// Creates a law in `field` whose thrust components are within ±`thrust_max` (du/s², positive).
    ///
    /// `lead_s` is the time over which all motions are predicted before the law is applied: the delay of the loop, or
    /// 0.
    pub fn new(field: CentralField, gains: OrbitGains, thrust_max: f64, lead_s: f64) -> Self {
        Self { field, gains, thrust_max, lead_s }
    }

    /// Returns the gains, to change them.
    pub fn gains_mut(&mut self) -> &mut OrbitGains {
        &mut self.gains
    }

    /// Computes the thrust, du/s², that steers `body` to the circular orbit of radius `target` (du).
    ///
    /// `applied` is the thrust that acts on the body now; only the prediction uses it.
    #[inline]
    pub fn to_circle(&self, target: f64, body: &OrbitState, applied: &Vector2<f64>) -> Vector2<f64> {
        self.limited(self.law(&self.field.circular(target), &self.ahead(body, applied)))
    }

    /// Computes the thrust, du/s², that steers `body` to the motion of the free `leader`: same r, Vr and Vθ, at any
    /// angle.
    #[inline]
    pub fn to_leader(&self, leader: &OrbitState, body: &OrbitState, applied: &Vector2<f64>) -> Vector2<f64> {
        self.limited(self.law(&self.ahead(leader, &zeros()), &self.ahead(body, applied)))
    }

    /// Returns the thrust limit against the thrust that the law computes for `body`, without thrust so far, and the
    /// free reference `to`, du/s². The proof covers thrusts within the limit.
    pub fn margin(&self, to: &OrbitState, body: &OrbitState) -> Condition {
        let coasting = Vector2::zeros();
        let asked = self.law(&self.ahead(to, &coasting), &self.ahead(body, &coasting));
        Condition { value: self.thrust_max, required: asked.amax() }
    }

    /// Returns the state after the lead, du and du/s, under a thrust, du/s²; the current state where the model fails.
    #[inline]
    pub fn ahead(&self, state: &OrbitState, thrust: &Vector2<f64>) -> OrbitState {
        if self.lead_s > 0.0 { self.field.flow(state, thrust, self.lead_s).unwrap_or(*state) } else { *state }
    }

    /// Computes the law without the limit, du/s².
    #[inline]
    fn law(&self, to: &OrbitState, body: &OrbitState) -> Vector2<f64> {
        let free = |x: &OrbitState| self.field.derivative(&(*x).into(), &zeros());
        let (wanted, own, gains) = (free(to), free(body), &self.gains);
        Vector2::new(
            wanted.y - own.y - gains.radius_per_s2 * (body.r - to.r) - gains.radial_per_s * (body.vr - to.vr),
            wanted.w - own.w - gains.transverse_per_s * (body.vtheta - to.vtheta),
        )
    }

    /// Computes the law with its prediction and without the limit, for linearising the sampled loop. The thrusts in
    /// flight are given tick by tick.
    pub(super) fn unlimited(
        &self,
        target: f64,
        body: &OrbitState,
        acting: impl Iterator<Item = Vector2<f64>>,
    ) -> Vector2<f64> {
        let body = acting.fold(*body, |body, thrust| self.ahead(&body, &thrust));
        self.law(&self.field.circular(target), &body)
    }

    #[inline]
    fn limited(&self, thrust: Vector2<f64>) -> Vector2<f64> {
        // A radius of zero or an overflow leaves no valid thrust.
        let finite = thrust.x.is_finite() && thrust.y.is_finite();
        if finite { thrust.map(|value| value.clamp(-self.thrust_max, self.thrust_max)) } else { zeros() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GAINS: OrbitGains = OrbitGains { radius_per_s2: 1.0, radial_per_s: 1.8, transverse_per_s: 1.0 };
    const BODY: OrbitState = OrbitState { r: 1.0, vr: 0.1, theta: 0.4, vtheta: 0.95 };
    const LEADER: OrbitState = OrbitState { r: 1.2, vr: -0.05, theta: 2.0, vtheta: 0.9 };

    fn law(thrust_max: f64, lead_s: f64) -> OrbitHold {
        OrbitHold::new(CentralField::new(1.0, 0.05, 10.0).unwrap(), GAINS, thrust_max, lead_s)
    }

    #[test]
    fn the_error_obeys_a_linear_equation() {
        let law = law(10.0, 0.0);
        let thrust = law.to_leader(&LEADER, &BODY, &Vector2::zeros());
        let rates = |x: OrbitState, u: Vector2<f64>| law.field.derivative(&x.into(), &u);
        let error_rate = rates(BODY, thrust) - rates(LEADER, Vector2::zeros());
        assert!((error_rate.y - (0.2 - 1.8 * 0.15)).abs() < 1e-15, "{error_rate}");
        assert!((error_rate.w + 0.05).abs() < 1e-15, "{error_rate}");
    }

    #[test]
    fn a_circular_orbit_equals_a_leader_on_it() {
        let law = law(10.0, 0.0);
        let circle = law.to_circle(1.3, &BODY, &Vector2::zeros());
        let leader = law.to_leader(&law.field.circular(1.3), &BODY, &Vector2::zeros());
        assert_eq!(circle, leader);
        // Section 5 of the theory, written out.
        let expected = Vector2::new(-(0.9025 - 1.0) - (1.0 - 1.3) - 1.8 * 0.1, 0.095 - (0.95 - libm::sqrt(1.0 / 1.3)));
        assert!((circle - expected).amax() < 1e-15, "{circle} {expected}");
    }

    #[test]
    fn a_body_on_the_reference_needs_no_thrust() {
        for lead_s in [0.0, 0.01] {
            assert_eq!(law(1.0, lead_s).to_leader(&LEADER, &LEADER, &Vector2::zeros()), Vector2::zeros());
            let circle = law(1.0, lead_s).field.circular(1.3);
            assert!(law(1.0, lead_s).to_circle(1.3, &circle, &Vector2::zeros()).amax() < 1e-14);
        }
    }

    #[test]
    fn each_component_is_limited_and_invalid_states_give_no_thrust() {
        let still = OrbitState { vtheta: 0.0, ..BODY };
        assert_eq!(law(0.1, 0.0).to_circle(1.3, &still, &Vector2::zeros()), Vector2::new(0.1, 0.1));
        for r in [0.0, f64::NAN] {
            assert_eq!(law(0.1, 0.0).to_circle(1.3, &OrbitState { r, ..BODY }, &Vector2::zeros()), Vector2::zeros());
        }
    }

    #[test]
    fn the_rate_is_that_of_the_slowest_mode() {
        let rate =
            |k_r, k_v, k_t| OrbitGains { radius_per_s2: k_r, radial_per_s: k_v, transverse_per_s: k_t }.rate_per_s();
        assert_eq!(rate(1.0, 1.8, 1.0), 0.9);
        assert_eq!(rate(1.0, 1.8, 0.5), 0.5);
        assert!((rate(6.0, 5.0, 9.0) - 2.0).abs() < 1e-15, "(s + 2)(s + 3)");
    }
}
