//! Samples of the rigs `orbit-hold` and `orbit-rendezvous`. Polar coordinates about the central body, \[S\](1); du is the
//! unit of length that the scenario's gravitational parameter is given in.

use super::sample;

sample! {
    /// The state of a body as it really is. For recording and scoring only: no observer and no controller opens it.
    OrbitTruth = "corotate/orbit/truth/v1" {
        /// Distance from the centre, du.
        radius_du: f64,
        /// Angle, rad; it grows on from turn to turn.
        angle_rad: f64,
        /// Radial and transverse velocity (Vr, Vθ), du/s.
        velocity_du_s: [f64; 2],
        /// Radial and transverse thrust held from this tick on, du/s².
        applied_du_s2: [f64; 2],
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// What a body's sensors and actuators report at a tick.
    OrbitMeasurement = "corotate/orbit/measurement/v1" {
        /// Distance from the centre, du.
        radius_du: f64,
        /// Angle, rad; it grows on from turn to turn.
        angle_rad: f64,
        /// Radial and transverse velocity (Vr, Vθ), du/s; 0 where not valid.
        velocity_du_s: [f64; 2],
        /// Radial and transverse thrust held from this tick on, du/s².
        applied_du_s2: [f64; 2],
        /// Bit i set: of (r, θ, Vr, Vθ), the i-th was measured.
        valid: u64,
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// What the observer makes of the first body's measurements.
    OrbitEstimate = "corotate/orbit/estimate/v1" {
        /// Distance from the centre as measured, du.
        radius_du: f64,
        /// Angle as measured, rad.
        angle_rad: f64,
        /// Radial and transverse velocity (Vr, Vθ) as estimated, du/s.
        velocity_du_s: [f64; 2],
        /// Bit i set: of (r, θ, Vr, Vθ), the i-th is measured or observed, not merely guessed.
        valid: u64,
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// What a body's thrusters are to apply from the next tick on.
    OrbitCommand = "corotate/orbit/command/v1" {
        /// Radial and transverse thrust per mass (Ur, Uθ), du/s².
        thrust_du_s2: [f64; 2],
    }
}
