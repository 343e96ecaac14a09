//! The law that makes a follower turn as its leader does, \[D\](5) and (20).
//!
//! The printed law has the gain's sign reversed (with k < 0 it gives ė = −k e); this is the one that yields ė = k e.

use crate::model::RigidBody;
use crate::vector::zeros;
use nalgebra::Vector3;

/// Synchronising law for one follower: u_i = a_i(ω_j ω_k − p_j p_k) − gain_i (p_i − ω_i), gain = −k > 0.
///
/// With the measured ω it is the full-state law (5); with an estimate in place of the hidden component, the
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
/// // Held over a tick, the law leaves what the leader turns in that time.
/// assert!((follower - leader).norm() < 1e-3);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Synchronizer {
    body: RigidBody,
    gain_per_s: Vector3<f64>,
    lead_s: f64,
}

impl Synchronizer {
    /// A law for a follower that is like `body`, with positive gains −k, 1/s.
    ///
    /// `lead_s` is how far both motions are predicted before the law is applied: the delay of the loop, or 0.
    pub fn new(body: RigidBody, gain_per_s: Vector3<f64>, lead_s: f64) -> Self {
        Self { body, gain_per_s, lead_s }
    }

    /// Goes on with other coefficients a of \[D\](2): those that an observer has learned.
    pub fn learn(&mut self, coefficients: Vector3<f64>) {
        self.body = RigidBody::with_coefficients(coefficients);
    }

    /// Reference and follower, rad/s, when the command will begin to act: predicted over the lead, if there is one.
    ///
    /// `applied` is the control acceleration acting on the follower until then, rad/s².
    #[inline(always)]
    pub fn ahead(
        &self,
        reference: Vector3<f64>,
        follower: Vector3<f64>,
        applied: &[f64; 3],
    ) -> (Vector3<f64>, Vector3<f64>) {
        // By value, and the rest apart: without prediction nothing goes through memory.
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

    /// The reference alone, rad/s.
    #[inline]
    pub fn reference_ahead(&self, reference: Vector3<f64>) -> Vector3<f64> {
        if self.lead_s > 0.0 { self.body.flow(&reference, &zeros(), self.lead_s) } else { reference }
    }

    /// The body that reference and follower are like.
    pub fn body(&self) -> &RigidBody {
        &self.body
    }

    /// How far both are predicted, s.
    pub fn lead_s(&self) -> f64 {
        self.lead_s
    }

    /// The control acceleration, rad/s², from the reference ω or ω̂ and the follower's p, rad/s.
    #[inline]
    pub fn command(&self, w: &Vector3<f64>, p: &Vector3<f64>) -> Vector3<f64> {
        let gyroscopic = Vector3::new(w.y * w.z - p.y * p.z, w.z * w.x - p.z * p.x, w.x * w.y - p.x * p.y);
        self.body.coefficients().component_mul(&gyroscopic) - self.gain_per_s.component_mul(&(p - w))
    }
}

/// A command shortened to what the actuators can do in each component, its direction kept; rad/s².
#[inline(always)]
pub fn limited(asked: Vector3<f64>, acceleration_max_rad_s2: f64) -> Vector3<f64> {
    // Nearly always: the sum is, and so is every component.
    let sum = asked.x.abs() + asked.y.abs() + asked.z.abs();
    if sum <= acceleration_max_rad_s2 { asked } else { shortened(asked, acceleration_max_rad_s2) }
}

/// Apart, so that the division is not made where nobody needs it.
#[cold]
fn shortened(asked: Vector3<f64>, limit: f64) -> Vector3<f64> {
    let largest = asked.amax();
    // The product may be rounded up beyond the limit, and an actuator would refuse it for that.
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
    fn the_error_obeys_its_own_linear_equation() {
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

    /// A command that is shortened is one that the actuators' guard believes, to the last bit.
    #[test]
    fn a_shortened_command_is_within_the_limit() {
        let mut draw = crate::model::uniform(1, 0);
        for _ in 0..100_000 {
            let (asked, limit) = (Vector3::from_fn(|_, _| 20.0 * draw() - 10.0), 5.0 * draw());
            let command = limited(asked, limit);
            assert!(command.amax() <= limit.min(asked.amax()), "{asked} {limit} {command}");
            assert!((command.cross(&asked)).norm() <= 1e-14 * asked.norm_squared(), "its direction is kept");
        }
    }

    /// Held input and one tick of delay: the prediction is worth about one tick of the error's decay.
    #[test]
    fn prediction_takes_the_delay_out_of_the_loop() {
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
        // Without delay the held gain gives e(n+1) = (1 - gain h) e(n), once the first command has arrived.
        let ideal = Vector3::new(1.0, 2.0, 3.0).map(|gain: f64| (1.0 - gain * h).powi(19));
        let (predicted, delayed) = (residual(h), residual(0.0));
        assert!(((predicted.abs() - ideal).component_div(&ideal)).amax() < 0.25, "{predicted} {ideal}");
        assert!((delayed.abs() - ideal).amax() > 2.0 * (predicted.abs() - ideal).amax());
    }
}
