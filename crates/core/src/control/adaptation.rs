//! Adaptation of the synchronising law to a follower's unknown inertia. Not in the papers, which have identical
//! bodies.
//!
//! The law computes torques with the nominal inertia. The follower's inertia is f times that, axis by axis, so that
//! ṗ_i = a'_i p_j p_k + u_i/f_i. With u = (the law of \[D\](20)) + v, e = p − ω and the gain k > 0 the error obeys
//!
//! f_i ė_i = −k_i e_i + θ1_i p_j p_k + θ2_i ω_j ω_k + v_i,   θ1 = f a' − a,   θ2 = a (1 − f),
//!
//! constants times known quantities. With v = −θ̂1 p_j p_k − θ̂2 ω_j ω_k, θ̂1' = γ e p_j p_k, θ̂2' = γ e ω_j ω_k the
//! function V = ½ Σ f_i e_i² + (1/2γ) Σ (θ − θ̂)² has V̇ = −Σ k_i e_i² ≤ 0; the motions are bounded, hence e → 0
//! (Barbalat). Without adaptation e settles near (θ1 p_j p_k + θ2 ω_j ω_k)/k. In a sampled loop v acts 1.5 ticks late
//! on average (half a tick with prediction). The remaining error is that time times |dv/dt|/k: it decreases with the
//! tick, not with time. The adaptation must not affect the observer of the hidden component: e is computed with ω̂.

use crate::state::persist_fields;
use nalgebra::Vector3;

/// The estimates θ̂1, θ̂2 of one follower.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertiaAdaptation {
    gain: f64,
    own: Vector3<f64>,
    leader: Vector3<f64>,
}

persist_fields!(InertiaAdaptation, own, leader);

/// Returns the products of the other two components, for each axis.
#[inline]
fn products(v: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(v.y * v.z, v.z * v.x, v.x * v.y)
}

impl InertiaAdaptation {
    /// Creates an adaptation at zero. `gain` is γ, dimensionless and not negative; 0 disables it.
    pub fn new(gain: f64) -> Self {
        Self { gain, own: Vector3::zeros(), leader: Vector3::zeros() }
    }

    /// Returns true if the adaptation is enabled.
    #[inline(always)]
    pub fn acts(&self) -> bool {
        self.gain != 0.0
    }

    /// Returns the correction v, rad/s², of the law for the reference ω̂ and the follower's p, rad/s, and adapts for
    /// `dt_s` seconds.
    #[inline]
    pub fn correction(&mut self, reference: &Vector3<f64>, follower: &Vector3<f64>, dt_s: f64) -> Vector3<f64> {
        let (p, w) = (products(follower), products(reference));
        let correction = -self.own.component_mul(&p) - self.leader.component_mul(&w);
        let learned = (follower - reference) * (self.gain * dt_s);
        self.own += learned.component_mul(&p);
        self.leader += learned.component_mul(&w);
        correction
    }
}

#[cfg(test)]
mod tests {
    use super::super::Synchronizer;
    use super::*;
    use crate::model::{Inertia, RigidBody};

    /// Returns the error after `run_s` seconds of a follower whose inertia is off by 10 %, 20 % and −10 %.
    fn error_after(gain: f64, run_s: f64) -> f64 {
        let (nominal, factor) = ([1.0, 2.0, 2.5], Vector3::new(1.1, 1.2, 0.9));
        let leader = RigidBody::new(&Inertia::new(nominal).unwrap());
        let own = RigidBody::new(&Inertia::new([1.1, 2.4, 2.25]).unwrap());
        let law = Synchronizer::new(leader, Vector3::repeat(4.0), 0.0);
        let mut adaptation = InertiaAdaptation::new(gain);
        let (mut w, mut p) = (Vector3::new(0.6, -0.4, 0.8), Vector3::new(-0.3, 0.5, 0.2));
        let h = 1e-3;
        for _ in 0..(run_s / h) as usize {
            let u = law.command(&w, &p) + adaptation.correction(&w, &p, h);
            w = leader.flow(&w, &Vector3::zeros(), h);
            p = own.flow(&p, &u.component_div(&factor), h);
        }
        (p - w).norm()
    }

    #[test]
    fn the_adaptation_removes_the_mismatch() {
        let (without, early, late) = (error_after(0.0, 60.0), error_after(20.0, 20.0), error_after(20.0, 200.0));
        assert!(without > 5e-3, "{without:e}");
        assert!(late < 0.02 * without && late < early, "{early:e} {late:e} against {without:e}");
    }
}
