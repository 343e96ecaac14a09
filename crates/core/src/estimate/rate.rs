//! The choice of a decay rate for a log from the measured components alone.
//!
//! A filter of rate λ amplifies an error δφ of the potential to λ δφ, and reduces an error δg of the drift to δg/λ.
//! Both model errors are assumed to be the same part ε of their quantities, so that without noise the two balance at
//! λ² = g, the motion's own time scale; noise lowers that rate. In short segments the initial estimate of each must
//! decay in time. The choice must not use the hidden component, nor a score.

use crate::identify::Sample;
use nalgebra::Vector3;

/// ε: the relative accuracy of a sensor's scale, of its alignment and of a body's inertia.
const MODEL_ERROR: f64 = 0.01;
/// The part of the initial estimate that may be left after half a segment.
const LEFT: f64 = 0.01;
/// The order of differences, which remove most of a motion, and the part of white noise in them.
const ORDER: usize = 6;
const ORDER_POWER: f64 = 924.0;

/// The statistics of a log for the choice of a rate, as sums over its samples.
#[derive(Debug, Clone)]
pub struct RateSurvey {
    /// The indices i, j and k.
    axes: [usize; 3],
    coefficients: Vector3<f64>,
    last: Option<Sample>,
    /// The newest differences of every order, of ω_i and ω_j.
    differences: [[f64; ORDER + 1]; 2],
    in_row: usize,
    noise: (f64, u64),
    drift: (f64, u64),
    /// Σ ln of the derivative of φ with respect to the measured rates, s.
    gradient: (f64, u64),
    duration_s: f64,
    segments: u64,
    intervals: u64,
    fastest_rad_s: f64,
}

/// The chosen rate, with the quantities that determine it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateChoice {
    /// The rate, 1/s.
    pub decay_per_s: f64,
    /// The rate at which errors of noise and model balance, 1/s.
    pub balance_per_s: f64,
    /// The rate at which the initial estimate decays in half a segment, 1/s.
    pub forgetting_per_s: f64,
    /// The noise of one measured rate, rad/s: the remainder of the log in differences of sixth order.
    pub noise_rad_s: f64,
    /// The root mean square of the hidden rate's known drift, rad/s².
    pub drift_rad_s2: f64,
    /// The mean length of a segment, s.
    pub segment_s: f64,
    /// The mean interval, s.
    pub interval_s: f64,
    /// The fastest measured rate, rad/s.
    pub fastest_rad_s: f64,
    /// The effect of an error of a measured rate on the potential φ, geometric mean, s.
    pub potential_per_rate_s: f64,
}

impl RateChoice {
    /// Returns the density of the unknown drift for a Kalman filter of the given rate and noise, (rad/s)²/s. Its
    /// bandwidth is (q/(σ²h))^(1/4), with the noise σ of the potential and the interval h.
    pub fn density(&self, decay_per_s: f64, noise_rad_s: f64) -> f64 {
        let square = decay_per_s * decay_per_s * self.potential_per_rate_s * noise_rad_s;
        square * square * self.interval_s
    }
}

impl RateSurvey {
    /// Creates the statistics for the hidden axis `axis`, 1 to 3, of a body with the coefficients a of \[D\](2).
    pub fn new(coefficients: &Vector3<f64>, axis: usize) -> Self {
        Self {
            axes: [axis % 3, (axis + 1) % 3, (axis + 2) % 3],
            coefficients: *coefficients,
            last: None,
            differences: [[0.0; ORDER + 1]; 2],
            in_row: 0,
            noise: (0.0, 0),
            drift: (0.0, 0),
            gradient: (0.0, 0),
            duration_s: 0.0,
            segments: 0,
            intervals: 0,
            fastest_rad_s: 0.0,
        }
    }

    /// Adds the next sample of a segment.
    pub fn push(&mut self, sample: &Sample) {
        let [i, j, k] = self.axes;
        let (x, y) = (sample.rate_rad_s[i], sample.rate_rad_s[j]);
        match self.last.replace(*sample) {
            Some(last) => {
                self.duration_s += sample.time_s - last.time_s;
                self.intervals += 1;
            }
            None => {
                self.segments += 1;
                self.in_row = 0;
            }
        }
        for (differences, mut value) in self.differences.iter_mut().zip([x, y]) {
            for difference in differences {
                value -= core::mem::replace(difference, value);
            }
        }
        self.in_row += 1;
        // By then those of the previous segment are gone.
        if self.in_row > ORDER {
            let square = |differences: &[f64; ORDER + 1]| differences[ORDER] * differences[ORDER];
            add(&mut self.noise, 0.5 * (square(&self.differences[0]) + square(&self.differences[1])));
        }
        let a = &self.coefficients;
        let drift = a[k] * x * y;
        add(&mut self.drift, drift * drift);
        // |∂φ/∂ω| for an error of the measured rates.
        let square = (a[i] * a[j]).abs() * x * x + a[i] * a[i] * y * y;
        let gradient = a[i].abs() * libm::sqrt(x * x + y * y) / square;
        if gradient.is_finite() && gradient > 0.0 {
            add(&mut self.gradient, libm::log(gradient));
        }
        self.fastest_rad_s = self.fastest_rad_s.max(x.abs()).max(y.abs());
    }

    /// Ends a segment.
    pub fn end_segment(&mut self) {
        self.last = None;
    }

    /// Chooses the rate for the log; `None` if it has no interval, or nothing moves.
    pub fn choose(&self) -> Option<RateChoice> {
        let mean = |(sum, count): (f64, u64)| if count == 0 { 0.0 } else { sum / count as f64 };
        if self.intervals == 0 || self.duration_s <= 0.0 {
            return None;
        }
        let noise_rad_s = libm::sqrt(mean(self.noise) / ORDER_POWER);
        let drift_rad_s2 = libm::sqrt(mean(self.drift));
        let potential_per_rate_s = libm::exp(mean(self.gradient));
        let potential_noise = noise_rad_s * potential_per_rate_s;
        let model = MODEL_ERROR;
        let balance_per_s =
            libm::sqrt(model * drift_rad_s2 / libm::sqrt(model * model + potential_noise * potential_noise));
        let segment_s = self.duration_s / self.segments as f64;
        let forgetting_per_s = -libm::log(LEFT) / (0.5 * segment_s);
        let interval_s = self.duration_s / self.intervals as f64;
        // A faster filter would only repeat the reconstruction of the last step.
        let decay_per_s = balance_per_s.max(forgetting_per_s).min(1.0 / interval_s);
        (decay_per_s > 0.0 && decay_per_s.is_finite()).then_some(RateChoice {
            decay_per_s,
            balance_per_s,
            forgetting_per_s,
            noise_rad_s,
            drift_rad_s2,
            segment_s,
            interval_s,
            fastest_rad_s: self.fastest_rad_s,
            potential_per_rate_s,
        })
    }
}

fn add(mean: &mut (f64, u64), value: f64) {
    mean.0 += value;
    mean.1 += 1;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, Noise, RigidBody};

    /// Returns the choice for segments of `samples` samples at 100 Hz.
    fn choice(noise_rad_s: f64, samples: u32) -> RateChoice {
        let body = RigidBody::new(&Inertia::new([1.0, 2.0, 2.5]).unwrap());
        let mut noise = Noise::new(9, 0, [noise_rad_s; 3], [0.0; 3]);
        let mut survey = RateSurvey::new(body.coefficients(), 3);
        for _ in 0..4000 / samples {
            let mut rate = Vector3::new(2.0, -3.0, 2.5);
            for tick in 0..samples {
                survey.push(&Sample { time_s: f64::from(tick) * 0.01, rate_rad_s: rate + noise.sample() });
                rate = body.flow(&rate, &Vector3::zeros(), 0.01);
            }
            survey.end_segment();
        }
        survey.choose().unwrap()
    }

    #[test]
    fn noise_is_separated_from_motion_and_lowers_the_rate() {
        for noise_rad_s in [1e-3, 1e-2, 0.1] {
            let found = choice(noise_rad_s, 4000).noise_rad_s;
            assert!((found / noise_rad_s - 1.0).abs() < 0.1, "{noise_rad_s}: {found}");
        }
        let [quiet, loud] = [0.0, 0.3].map(|noise_rad_s| choice(noise_rad_s, 4000));
        // Without noise it is the motion's own time scale.
        assert!((quiet.balance_per_s / quiet.drift_rad_s2.sqrt() - 1.0).abs() < 1e-3, "{quiet:?}");
        assert!(loud.balance_per_s < 0.5 * quiet.balance_per_s, "{loud:?}");
    }

    #[test]
    fn short_segments_need_a_faster_rate_up_to_that_of_a_step() {
        let short = choice(1e-3, 80);
        assert!((short.segment_s - 0.79).abs() < 1e-9, "{short:?}");
        assert!((short.decay_per_s - 100.0_f64.ln() / 0.395).abs() < 1e-9, "{short:?}");
        assert_eq!(choice(1e-3, 4).decay_per_s, 1.0 / choice(1e-3, 4).interval_s);
    }

    #[test]
    fn a_log_without_motion_or_time_has_no_rate() {
        let coefficients = Vector3::new(-0.5, 0.75, -0.4);
        assert!(RateSurvey::new(&coefficients, 3).choose().is_none());
        let mut survey = RateSurvey::new(&coefficients, 1);
        survey.push(&Sample { time_s: 0.0, rate_rad_s: Vector3::zeros() });
        assert!(survey.choose().is_none());
    }
}
