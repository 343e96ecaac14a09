//! Samples of the rigs `orbit-hold` and `orbit-rendezvous`, in polar coordinates about the central body, \[S\](1). du
//! is the unit of length of the scenario's gravitational parameter.

use crate::sample;

sample! {
    /// The true state of a body. For recording and scoring only: no observer and no controller opens it.
    OrbitTruth = "corotate/orbit/truth/v1" {
        /// Distance from the centre, du.
        radius_du: f64,
        /// Angle, rad, counted on over full turns.
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
    /// The readings of a body's sensors and actuators at a tick.
    OrbitMeasurement = "corotate/orbit/measurement/v1" {
        /// Distance from the centre, du.
        radius_du: f64,
        /// Angle, rad, counted on over full turns.
        angle_rad: f64,
        /// Radial and transverse velocity (Vr, Vθ), du/s; 0 where not valid.
        velocity_du_s: [f64; 2],
        /// Radial and transverse thrust held from this tick on, du/s².
        applied_du_s2: [f64; 2],
        /// Bit i is set if component i of (r, θ, Vr, Vθ) was measured.
        valid: u64,
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// The estimate of the first body's state.
    OrbitEstimate = "corotate/orbit/estimate/v1" {
        /// Distance from the centre as measured, du.
        radius_du: f64,
        /// Angle as measured, rad.
        angle_rad: f64,
        /// Estimated radial and transverse velocity (Vr, Vθ), du/s.
        velocity_du_s: [f64; 2],
        /// Bit i is set if component i of (r, θ, Vr, Vθ) is measured or observed, and not only guessed.
        valid: u64,
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// The command of a body's thrusters from the next tick on.
    OrbitCommand = "corotate/orbit/command/v1" {
        /// Radial and transverse thrust per mass (Ur, Uθ), du/s².
        thrust_du_s2: [f64; 2],
    }
}
