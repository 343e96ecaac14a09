//! The comparison of the estimate with a measured component: root mean squares over the part of each segment in which
//! the initial guess has decayed. Memory is bounded. A segment's score must not be read before it has ended.

use super::reconstruction::Reconstructed;

/// The longest segment, in samples, that is scored over its second half. Longer ones are scored over all but the
/// first half of this number.
const HALVED_SAMPLES: usize = 1 << 16;

/// The score of one segment.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct SegmentScore {
    /// The root mean square of estimate − measured over the second half of the segment, rad/s.
    pub error_rad_s: f64,
    /// The root mean square of the measured component over the same samples, rad/s.
    pub measured_rad_s: f64,
    /// The number of scored samples.
    pub scored: u64,
    /// The number of samples in the segment.
    pub samples: u64,
    /// The number of samples, apart from the first, whose step was not observable.
    pub unobserved: u64,
    /// The number of unobserved samples whose step was too long for the motion.
    pub too_long: u64,
}

/// Sums over a segment.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    error: f64,
    measured: f64,
    count: u64,
}

impl Sums {
    fn add(&mut self, (error, measured): (f64, f64)) {
        // Samples without a known value are not compared.
        if error.is_finite() {
            self.error += error * error;
            self.measured += measured * measured;
            self.count += 1;
        }
    }
}

/// A score being computed, one segment at a time.
#[derive(Debug, Clone, Default)]
pub struct Score {
    /// The error and the measured component of each sample, until it is known in which half they are.
    open: Vec<(f64, f64)>,
    sums: Sums,
    samples: u64,
    unobserved: u64,
    too_long: u64,
}

impl Score {
    /// Adds a sample: the estimate and the measured value, NaN if missing.
    pub fn push(&mut self, estimate: &Reconstructed, measured_rad_s: f64) {
        let pair = (estimate.rate_rad_s - measured_rad_s, measured_rad_s);
        self.samples += 1;
        self.unobserved += u64::from(!estimate.observed && self.samples > 1);
        self.too_long += u64::from(estimate.too_long);
        if self.samples <= HALVED_SAMPLES as u64 {
            self.open.push(pair);
        } else {
            self.close(HALVED_SAMPLES / 2);
            self.sums.add(pair);
        }
    }

    /// Adds the pending samples from an index on to the sums.
    fn close(&mut self, from: usize) {
        self.open.iter().skip(from).for_each(|pair| self.sums.add(*pair));
        self.open.clear();
    }

    /// Ends a segment and returns its score; `None` if it had no sample.
    pub fn end_segment(&mut self) -> Option<SegmentScore> {
        self.close(self.open.len() / 2);
        let Self { sums, samples, unobserved, too_long, .. } = core::mem::take(self);
        let mean = |sum: f64| libm::sqrt(sum / sums.count as f64);
        (samples > 0).then(|| SegmentScore {
            error_rad_s: mean(sums.error),
            measured_rad_s: mean(sums.measured),
            scored: sums.count,
            samples,
            unobserved,
            too_long,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimate(rate_rad_s: f64, observed: bool) -> Reconstructed {
        Reconstructed { rate_rad_s, observed, too_long: false, deviation_rad_s: None }
    }

    #[test]
    fn the_second_half_is_scored_without_unknown_values() {
        let mut score = Score::default();
        for (estimate, measured) in [(9.0, 1.0), (9.0, 1.0), (5.0, 2.0), (f64::NAN, 2.0), (2.0, f64::NAN), (0.0, 3.0)] {
            score.push(&self::estimate(estimate, measured > 1.0), measured);
        }
        let scored = score.end_segment().unwrap();
        assert_eq!((scored.scored, scored.samples, scored.unobserved), (1, 6, 2));
        assert_eq!((scored.error_rad_s, scored.measured_rad_s), (3.0, 3.0));
        assert!(score.end_segment().is_none());
    }

    #[test]
    fn a_long_segment_is_scored_after_its_start() {
        let mut score = Score::default();
        for sample in 0..200_000 {
            score.push(&estimate(if sample < HALVED_SAMPLES / 2 { 100.0 } else { 1.5 }, true), 1.0);
        }
        let scored = score.end_segment().unwrap();
        assert_eq!((scored.error_rad_s, scored.scored), (0.5, 200_000 - HALVED_SAMPLES as u64 / 2));
        assert!(score.open.capacity() <= HALVED_SAMPLES * 2);
    }
}
