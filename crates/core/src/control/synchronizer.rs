//! The law that synchronises a follower's rotation with its leader's, \[D\](5) and (20).
//!
//! The printed law has the gain's sign reversed (with k < 0 it gives ė = −k e); this one yields ė = k e.

use crate::model::RigidBody;
use crate::vector::zeros;
use nalgebra::Vector3;

/// The synchronising law for one follower: u_i = a_i(ω_j ω_k − p_j p_k) − gain_i (p_i − ω_i), gain = −k > 0.
///
/// With the measured ω it is the full-state law (5); with an estimate of the hidden component it is the
/// output-feedback law (20).
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::control::Synchronizer;
/// use corotate::model::{Inertia, RigidBody};
/// use corotate::nalgebra::Vector3;
///
/// let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
/// let law = Synchronizer::new(body, Vector3::repeat(4.0), 0.0); // gains in 1/s, no prediction
/// let mut leader = Vector3::new(0.6, -0.4, 0.8);
/// let mut follower = Vector3::new(-0.3, 0.5, 0.2);
/// for _ in 0..5000 {
///     let command = law.command(&leader, &follower); // rad/s²
///     follower = body.flow(&follower, &command, 1e-3);
///     leader = body.flow(&leader, &Vector3::zeros(), 1e-3);
/// }
/// // The command is held over a tick, so the error is that of the leader's rotation in a tick.
/// assert!((follower - leader).norm() < 1e-3);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Synchronizer {
    body: RigidBody,
    gain_per_s: Vector3<f64>,
    lead_s: f64,
    offset: Vector3<f64>,
}

impl Synchronizer {
    /// Creates a law for a follower with the inertia of `body` and positive gains −k, 1/s.
    ///
    /// `lead_s` is the time over which both motions are predicted before the law is applied: the delay of the loop,
    /// or 0.
    pub fn new(body: RigidBody, gain_per_s: Vector3<f64>, lead_s: f64) -> Self {
        Self { body, gain_per_s, lead_s, offset: zeros() }
    }

    /// Replaces the positive gains −k, 1/s.
    pub fn set_gain(&mut self, gain_per_s: Vector3<f64>) {
        self.gain_per_s = gain_per_s;
    }

    /// Sets the rate at which the follower turns relative to the leader, rad/s in the follower's axes: the law then drives
    /// p − ω − δ to zero, at the same rates while δ is constant. \[D\] has δ = 0.
    pub fn set_offset(&mut self, offset_rad_s: Vector3<f64>) {
        self.offset = offset_rad_s;
    }

    /// Returns the rate relative to the leader, rad/s.
    #[inline]
    pub fn offset(&self) -> Vector3<f64> {
        self.offset
    }

    /// Replaces the coefficients a of \[D\](2) by those that an observer has learned.
    pub fn learn(&mut self, coefficients: Vector3<f64>) {
        self.body = RigidBody::with_coefficients(coefficients);
    }

    /// Returns reference and follower, rad/s, at the time when the command acts: predicted over the lead, if there is
    /// one.
    ///
    /// `applied` is the control acceleration that acts on the follower until then, rad/s².
    #[inline(always)]
    pub fn ahead(
        &self,
        reference: Vector3<f64>,
        follower: Vector3<f64>,
        applied: &[f64; 3],
    ) -> (Vector3<f64>, Vector3<f64>) {
        // By value, with the prediction in a function of its own: without prediction no value goes through memory.
        if self.lead_s > 0.0 { self.predicted(reference, follower, applied) } else { (reference, follower) }
    }

    #[inline(never)]
    fn predicted(
        &self,
        reference: Vector3<f64>,
        follower: Vector3<f64>,
        applied: &[f64; 3],
    ) -> (Vector3<f64>, Vector3<f64>) {
        (self.reference_ahead(reference), self.body.flow(&follower, &Vector3::from(*applied), self.lead_s))
    }

    /// Returns the reference at the time when the command acts, rad/s.
    #[inline]
    pub fn reference_ahead(&self, reference: Vector3<f64>) -> Vector3<f64> {
        if self.lead_s > 0.0 { self.body.flow(&reference, &zeros(), self.lead_s) } else { reference }
    }

    /// Returns the body whose inertia reference and follower have.
    pub fn body(&self) -> &RigidBody {
        &self.body
    }

    /// Returns the time over which both motions are predicted, s.
    pub fn lead_s(&self) -> f64 {
        self.lead_s
    }

    /// Computes the control acceleration, rad/s², from the reference ω or ω̂ and the follower's p, rad/s.
    #[inline]
    pub fn command(&self, w: &Vector3<f64>, p: &Vector3<f64>) -> Vector3<f64> {
        let gyroscopic = Vector3::new(w.y * w.z - p.y * p.z, w.z * w.x - p.z * p.x, w.x * w.y - p.x * p.y);
        self.body.coefficients().component_mul(&gyroscopic) - self.gain_per_s.component_mul(&(p - w - self.offset))
    }
}

/// Scales a command, rad/s², to the actuators' limit in each component; its direction stays.
#[inline(always)]
pub fn limited(asked: Vector3<f64>, acceleration_max_rad_s2: f64) -> Vector3<f64> {
    // The usual case: if the sum is within the limit, every component is.
    let sum = asked.x.abs() + asked.y.abs() + asked.z.abs();
    if sum <= acceleration_max_rad_s2 { asked } else { scaled_to_limit(asked, acceleration_max_rad_s2) }
}

/// Not inlined: the division is rarely needed.
#[cold]
fn scaled_to_limit(asked: Vector3<f64>, limit: f64) -> Vector3<f64> {
    let largest = asked.amax();
    // The product may be rounded up beyond the limit, which an actuator would reject.
    let shorten = |component: f64| (component * (limit / largest)).clamp(-limit, limit);
    if largest > limit { asked.map(shorten) } else { asked }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, euler};

    fn law(lead_s: f64) -> Synchronizer {
        let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
        Synchronizer::new(body, Vector3::new(1.0, 2.0, 3.0), lead_s)
    }

    #[test]
    fn the_error_obeys_a_linear_equation() {
        let (w, p) = (Vector3::new(0.6, -0.4, 0.8), Vector3::new(-0.3, 0.5, 0.2));
        let law = law(0.0);
        let u = law.command(&w, &p);
        let a = law.body.coefficients();
        let error_rate = euler(a, &p, &u) - euler(a, &w, &Vector3::zeros());
        let expected = -law.gain_per_s.component_mul(&(p - w));
        assert!((error_rate - expected).amax() < 1e-15, "{error_rate} {expected}");
    }

    #[test]
    fn a_synchronised_follower_needs_no_command() {
        let w = Vector3::new(0.6, -0.4, 0.8);
        assert_eq!(law(0.0).command(&w, &w), Vector3::zeros());
        let (reference, follower) = law(0.01).ahead(w, w, &[0.0; 3]);
        assert_eq!(reference, follower);
    }

    /// The actuators' guard accepts a limited command, to the last bit.
    #[test]
    fn a_limited_command_is_within_the_limit() {
        let mut draw = crate::model::uniform(1, 0);
        for _ in 0..100_000 {
            let (asked, limit) = (Vector3::from_fn(|_, _| 20.0 * draw() - 10.0), 5.0 * draw());
            let command = limited(asked, limit);
            assert!(command.amax() <= limit.min(asked.amax()), "{asked} {limit} {command}");
            assert!((command.cross(&asked)).norm() <= 1e-14 * asked.norm_squared(), "the direction stays");
        }
    }

    /// With a held input and one tick of delay, the prediction saves about one tick of the error's decay.
    #[test]
    fn prediction_compensates_the_delay() {
        let h = 0.05;
        let residual = |lead_s: f64| {
            let law = law(lead_s);
            let (mut w, mut p) = (Vector3::new(0.6, -0.4, 0.8), Vector3::new(-0.3, 0.5, 0.2));
            let mut applied = Vector3::zeros();
            for _ in 0..20 {
                let (reference, follower) = law.ahead(w, p, applied.as_ref());
                let next = law.command(&reference, &follower);
                w = law.body.flow(&w, &Vector3::zeros(), h);
                p = law.body.flow(&p, &applied, h);
                applied = next;
            }
            (p - w).component_div(&Vector3::new(0.9, 0.9, 0.6))
        };
        // Without delay the held gain gives e(n+1) = (1 - gain h) e(n), once the first command acts.
        let ideal = Vector3::new(1.0, 2.0, 3.0).map(|gain: f64| (1.0 - gain * h).powi(19));
        let (predicted, delayed) = (residual(h), residual(0.0));
        assert!(((predicted.abs() - ideal).component_div(&ideal)).amax() < 0.25, "{predicted} {ideal}");
        assert!((delayed.abs() - ideal).amax() > 2.0 * (predicted.abs() - ideal).amax());
    }
}
