//! The unit of two measured rates, from the third one of a known body.
//!
//! By \[D\](11), (12) the measured rates give the hidden one, whatever their unit; its course is ∫a_k ω_i ω_j dt. With rates of 1/f
//! of their size, or times of f, that integral is 1/f² of its size. So f² is the slope of a line, fitted by least squares.

use crate::identify::{SCALES, Sample};
use crate::observe::{HiddenRate, Observation, RateSample, Regressor};
use nalgebra::{Vector2, Vector3};

/// The least part of the hidden rate's course that the line explains, and the largest error of its slope, as a part of it.
const EXPLAINED: f64 = 0.5;
const UNCERTAIN: f64 = 0.03;
/// The largest ratio of the factor to that of a unit.
const ALIKE: f64 = 1.1;

/// Sums over the segments of a log with two rates.
#[derive(Debug, Clone)]
pub struct ScaleSurvey {
    relation: HiddenRate,
    last: Option<(f64, Regressor)>,
    /// ∫a_k ω_i ω_j dt and ω_k: the integral at the last sample, and over the segment the count, means, and sums about them.
    integral: f64,
    count: f64,
    mean: Vector2<f64>,
    segment: [f64; 3],
    sums: [f64; 3],
    samples: f64,
}

impl ScaleSurvey {
    /// Creates the sums for the hidden axis, 1 to 3, of a body; `None` if it cannot be observed.
    pub fn new(coefficients: &Vector3<f64>, axis: usize) -> Option<Self> {
        let relation = HiddenRate::new(coefficients, axis, f64::MIN_POSITIVE).ok()?;
        let (mean, sums) = (Vector2::zeros(), [0.0; 3]);
        Some(Self { relation, last: None, integral: 0.0, count: 0.0, mean, segment: sums, sums, samples: 0.0 })
    }

    /// Adds the next sample of a segment.
    pub fn push(&mut self, sample: &Sample) {
        let rates = RateSample { rate_rad_s: sample.rate_rad_s, torque_rad_s2: Vector3::zeros() };
        let to = self.relation.regressor(&rates);
        let Some((last_s, from)) = self.last.replace((sample.time_s, to)) else { return };
        let interval_s = sample.time_s - last_s;
        let drift = 0.5 * interval_s * (from.drift() + to.drift());
        if let Observation::Seen(increment) = self.relation.observe(&from, &to, interval_s, 0.0) {
            let value = Vector2::new(self.integral + 0.5 * drift, increment.potential.x * increment.inverse_weight);
            self.count += 1.0;
            let apart = value - self.mean;
            self.mean += apart / self.count;
            let rest = value - self.mean;
            let products = [apart.x * rest.x, apart.x * rest.y, apart.y * rest.y];
            self.segment.iter_mut().zip(products).for_each(|(sum, product)| *sum += product);
        }
        self.integral += drift;
    }

    /// Ends a segment.
    pub fn end_segment(&mut self) {
        self.sums.iter_mut().zip(self.segment).for_each(|(sum, own)| *sum += own);
        self.samples += self.count;
        (self.last, self.integral, self.count) = (None, 0.0, 0.0);
        (self.mean, self.segment) = (Vector2::zeros(), [0.0; 3]);
    }

    /// Returns the factor of a unit by which all rates are too small, or all times too large, if the log shows one.
    pub fn wrong_scale(&self) -> Option<f64> {
        let [xx, xy, yy] = self.sums;
        let factor = libm::sqrt(xy / xx);
        let explained = xy * xy / (xx * yy);
        let clear = explained > EXPLAINED && 1.0 - explained < UNCERTAIN * UNCERTAIN * explained * self.samples;
        let apart = |unit: &f64| libm::log(factor / unit).abs();
        let nearest = SCALES.into_iter().min_by(|first, second| apart(first).total_cmp(&apart(second)))?;
        (clear && apart(&nearest) < libm::log(ALIKE)).then_some(nearest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Inertia, Noise, RigidBody};

    /// Returns the factor that is found in a log at 100 Hz whose rates and times are these times their size.
    fn found(moments: [f64; 3], rates: f64, times: f64, noise_rad_s: f64) -> Option<f64> {
        let body = RigidBody::new(&Inertia::new(moments).unwrap());
        let mut noise = Noise::new(5, 0, [noise_rad_s; 3], [0.0; 3]);
        let mut survey = ScaleSurvey::new(body.coefficients(), 3).unwrap();
        for start in [[2.0, -3.0, 2.5], [1.0, 2.0, -1.5]] {
            let mut rate = Vector3::from(start);
            for tick in 0..400 {
                let mut measured = (rate + noise.sample()) * rates;
                measured.z = f64::NAN;
                survey.push(&Sample { time_s: f64::from(tick) * 0.01 * times, rate_rad_s: measured });
                rate = body.flow(&rate, &Vector3::zeros(), 0.01);
            }
            survey.end_segment();
        }
        survey.wrong_scale()
    }

    #[test]
    fn wrong_units_of_two_rates_are_found_and_right_ones_are_not() {
        let deg = 180.0 / core::f64::consts::PI;
        for moments in [[1.0, 2.0, 2.5], [1.0, 2.5, 2.0], [2.0, 2.5, 1.0]] {
            for noise_rad_s in [0.0, 2e-3] {
                assert_eq!(found(moments, 1.0, 1.0, noise_rad_s), None);
                for (rates, times, factor) in
                    [(deg, 1.0, 1.0 / deg), (1e3, 1.0, 1e-3), (1.0, 1e3, 1e-3), (1.0, 1e6, 1e-6), (10.0, 1.0, 0.1)]
                {
                    assert_eq!(found(moments, rates, times, noise_rad_s), Some(factor), "{moments:?} {rates} {times}");
                }
                // No unit has this factor; the body may be another one.
                assert_eq!(found(moments, 1.7, 1.0, noise_rad_s), None);
            }
        }
        // Its hidden rate is constant in every unit.
        assert_eq!(found([1.0, 1.0, 1.6], deg, 1.0, 1e-3), None);
        assert!(ScaleSurvey::new(&Vector3::zeros(), 3).is_none());
    }
}
