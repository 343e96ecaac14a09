//! Samples of the rig `rigid-body`. Axes are the body's principal axes; arrays are indexed by axis.

use super::sample;

sample! {
    /// The state of a body as it really is. For recording and scoring only: no observer and no controller opens it.
    RateTruth = "corotate/rigid-body/truth/v1" {
        /// Angular velocity, rad/s.
        omega_rad_s: [f64; 3],
        /// Control acceleration held from this tick on, rad/s².
        applied_rad_s2: [f64; 3],
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// What a body's sensors and actuators report at a tick.
    RateMeasurement = "corotate/rigid-body/measurement/v1" {
        /// Angular velocity, rad/s; 0 where not valid.
        omega_rad_s: [f64; 3],
        /// Control acceleration held from this tick on, rad/s².
        applied_rad_s2: [f64; 3],
        /// Bit i set: component i of the angular velocity was measured.
        valid: u64,
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// What the observer makes of a leader's measurements.
    RateEstimate = "corotate/rigid-body/estimate/v1" {
        /// Angular velocity, rad/s: measured components as measured, the hidden one estimated.
        omega_rad_s: [f64; 3],
        /// Bit i set: component i is measured or observed, not merely guessed.
        valid: u64,
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// What a follower's actuators are to apply from the next tick on.
    RateCommand = "corotate/rigid-body/command/v1" {
        /// Control acceleration (torque over inertia), rad/s².
        acceleration_rad_s2: [f64; 3],
    }
}
