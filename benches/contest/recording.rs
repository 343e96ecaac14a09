//! A body's motion and its noisy measurement, for every kind of conic; the hidden axis is 3. Not part of the library.

use corotate::model::{Inertia, Noise, RigidBody};
use corotate::observe::{HiddenRate, RateSample};
use nalgebra::Vector3;

/// A body and its initial rates, rad/s.
pub struct Case {
    /// The name of its conic.
    pub name: &'static str,
    /// Principal moments of inertia, kg m².
    pub moments: [f64; 3],
    /// The initial angular velocity, rad/s.
    pub start: [f64; 3],
}

/// One case for every conic, and an ellipse far from a circle.
pub const CASES: [Case; 5] = [
    Case { name: "elliptic", moments: [1.0, 2.0, 3.0], start: [0.6, -0.4, 0.8] },
    Case { name: "hyperbolic", moments: [1.0, 3.0, 2.0], start: [0.9, 0.3, 0.8] },
    Case { name: "parabolic first", moments: [2.0, 1.5, 2.0], start: [0.5, 0.4, 0.7] },
    Case { name: "parabolic second", moments: [1.5, 2.0, 2.0], start: [0.4, 0.5, 0.7] },
    Case { name: "long ellipse", moments: [1.0, 5.0, 5.5], start: [0.6, -0.4, 0.8] },
];

/// A free motion, true and measured, at every tick.
pub struct Recording {
    /// The body's coefficients a of \[D\](2).
    pub coefficients: Vector3<f64>,
    /// The tick, s.
    pub tick_s: f64,
    /// Standard deviation of the measured components, rad/s.
    pub deviation: f64,
    /// Angular velocity at every tick, rad/s.
    pub truth: Vec<Vector3<f64>>,
    /// The angular velocity with the noise of the measured components, rad/s.
    pub measured: Vec<Vector3<f64>>,
}

impl Recording {
    /// Records a case for `duration_s` seconds with white noise of the given standard deviation, rad/s, and seed.
    pub fn new(case: &Case, tick_s: f64, duration_s: f64, deviation: f64, seed: u64) -> Self {
        let body = RigidBody::new(&Inertia::new(case.moments).expect("the cases are bodies"));
        let mut noise = Noise::new(seed, 0, [deviation, deviation, 0.0], [0.0, 0.0, f64::NAN]);
        let mut rate = Vector3::from(case.start);
        let (mut truth, mut measured) = (vec![rate], vec![rate + noise.sample()]);
        for _ in 0..(duration_s / tick_s).round() as usize {
            rate = body.flow(&rate, &Vector3::zeros(), tick_s);
            truth.push(rate);
            measured.push(rate + noise.sample());
        }
        Self { coefficients: *body.coefficients(), tick_s, deviation, truth, measured }
    }

    /// Returns the standard deviations of the sensors, with NaN for the hidden component, which must not be read.
    pub fn sensors(&self) -> Vector3<f64> {
        Vector3::new(self.deviation, self.deviation, f64::NAN)
    }

    /// Returns a measured sample of the freely moving body.
    pub fn sample(&self, index: usize) -> RateSample {
        RateSample { rate_rad_s: self.measured[index], torque_rad_s2: Vector3::zeros() }
    }

    /// Returns the relation for the hidden component, with the noise.
    pub fn relation(&self) -> HiddenRate {
        HiddenRate::new(&self.coefficients, 3, 1e-6).expect("the cases have a relation").with_noise(&self.sensors())
    }
}
