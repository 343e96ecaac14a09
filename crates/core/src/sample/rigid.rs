//! Samples of the rig `rigid-body`. Axes are the body's principal axes; arrays are indexed by axis.

use crate::sample;

sample! {
    /// The true state of a body. For recording and scoring only: no observer and no controller opens it.
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
    /// The readings of a body's sensors and actuators at a tick.
    RateMeasurement = "corotate/rigid-body/measurement/v1" {
        /// Angular velocity, rad/s; 0 where not valid.
        omega_rad_s: [f64; 3],
        /// Control acceleration held from this tick on, rad/s².
        applied_rad_s2: [f64; 3],
        /// Bit i is set if component i of the angular velocity was measured.
        valid: u64,
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// The estimate of the leader's state.
    RateEstimate = "corotate/rigid-body/estimate/v2" {
        /// Angular velocity, rad/s: the measured components, and the estimate of the hidden one.
        omega_rad_s: [f64; 3],
        /// The hidden component as the last step reconstructs it, less the estimate: the estimate's error, rad/s.
        innovation_rad_s: f64,
        /// The coefficients a of \[D\](2) used by the observer, learned or configured.
        coefficients: [f64; 3],
        /// a1 + a2 + a3 + a1·a2·a3; 0 for the coefficients of a body.
        closure: f64,
        /// I2/I1 and I3/I1, which are all that a free motion determines of the inertia; 0 if the coefficients belong
        /// to no body.
        inertia_ratios: [f64; 2],
        /// The excitation of the identifier, ∫|ω1 ω2 ω3| dt in rad³/s² (asymmetric) or ∫|ω3| dt in rad
        /// (axisymmetric).
        excitation: f64,
        /// Bit i is set if component i is measured or observed, and not only guessed.
        valid: u64,
        /// Bits of [`status`](super::status).
        status: u64,
    }
}

sample! {
    /// The command of a follower's actuators from the next tick on.
    RateCommand = "corotate/rigid-body/command/v2" {
        /// Control acceleration (torque over the nominal inertia), rad/s².
        acceleration_rad_s2: [f64; 3],
        /// V = ½(|e|² + ε²) of \[D\](15) at this tick, rad²/s².
        lyapunov_rad2_s2: f64,
        /// The bound on V̇ of \[D\](18) at this tick, rad²/s³.
        lyapunov_rate_bound_rad2_s3: f64,
    }
}
