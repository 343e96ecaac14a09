//! The delay of a sample: a constant, or a number of ticks drawn within a bound.
//!
//! The delay must be bounded: memory for delayed samples is allocated before the first tick.

use super::{mix, unit};
use crate::model::Noise;

/// A delay in ticks, with its distribution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Delay {
    /// The smallest delay.
    pub ticks: u64,
    /// The largest addition to it.
    pub jitter_ticks: u64,
    /// The distribution of the addition over 0 to `jitter_ticks`.
    pub distribution: Distribution,
    /// The largest delay that has no effect, because no reader needs the sample sooner.
    pub slack_ticks: u64,
}

/// A distribution over 0, 1, … up to a bound.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Distribution {
    /// All values are equally likely.
    Uniform,
    /// Each value is less likely than the one before by a constant factor, as for waiting times. The parameter is the
    /// mean without a bound; values beyond the bound are excluded, so the mean is less.
    Geometric(f64),
    /// A rounded normal distribution about the middle with this standard deviation. Values beyond the bound are drawn
    /// again.
    Normal(f64),
}

/// The maximum number of draws of a normal number. A deviation of at most the bound needs more once in 10¹³ times.
const REDRAWS: usize = 64;

impl Delay {
    /// Creates a constant delay.
    pub fn constant(ticks: u64) -> Self {
        Self { ticks, jitter_ticks: 0, distribution: Distribution::Uniform, slack_ticks: 0 }
    }

    /// Returns the largest delay.
    pub fn bound(&self) -> u64 {
        self.ticks + self.jitter_ticks
    }

    /// Returns the delay of one sample from the random number `draw`.
    pub fn draw(&self, draw: u64) -> u64 {
        let bound = self.jitter_ticks as f64;
        let jitter = match self.distribution {
            _ if self.jitter_ticks == 0 => 0.0,
            Distribution::Uniform => libm::floor(unit(draw) * (bound + 1.0)),
            Distribution::Geometric(mean) => {
                // The inverse of the distribution function, truncated at the bound.
                let ratio = libm::log(mean / (1.0 + mean));
                let within = 1.0 - libm::exp(ratio * (bound + 1.0));
                libm::floor(libm::log(1.0 - unit(draw) * within) / ratio)
            }
            Distribution::Normal(deviation) => {
                let mut noise = Noise::<1>::new(draw, mix(draw), [deviation], [bound / 2.0]);
                let mut rounded = || libm::floor(noise.sample().x + 0.5);
                let mut drawn = core::iter::repeat_with(&mut rounded).take(REDRAWS);
                drawn.find(|drawn| (0.0..=bound).contains(drawn)).unwrap_or(0.0)
            }
        };
        self.ticks + (jitter.max(0.0) as u64).min(self.jitter_ticks)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn histogram(delay: Delay, draws: u64) -> Vec<f64> {
        let mut counts = vec![0.0; delay.bound() as usize + 1];
        (0..draws).for_each(|number| counts[delay.draw(mix(number)) as usize] += 1.0 / draws as f64);
        counts
    }

    #[test]
    fn every_distribution_has_its_probabilities() {
        let delay = |distribution| Delay { jitter_ticks: 8, distribution, ..Delay::constant(2) };
        let uniform = histogram(delay(Distribution::Uniform), 90_000);
        assert!(uniform[2..].iter().all(|share| (share - 1.0 / 9.0).abs() < 0.01), "{uniform:?}");
        let geometric = histogram(delay(Distribution::Geometric(1.0)), 90_000);
        // 511/512 of the halves are within the bound.
        let expected = (0..9).map(|jitter| 0.5_f64.powi(jitter + 1) * 512.0 / 511.0);
        assert!(geometric[2..].iter().zip(expected).all(|(is, should)| (is - should).abs() < 0.01), "{geometric:?}");
        let normal = histogram(delay(Distribution::Normal(1.0)), 90_000);
        let expected = [0.0, 0.0062, 0.0606, 0.2417, 0.3829, 0.2417, 0.0606, 0.0062, 0.0];
        assert!(normal[3..].iter().zip(&expected[1..]).all(|(is, should)| (is - should).abs() < 0.01), "{normal:?}");
        for shares in [uniform, geometric, normal] {
            assert_eq!(&shares[..2], [0.0; 2], "never less than the smallest delay");
        }
    }

    proptest! {
        #[test]
        fn no_delay_is_beyond_its_bound(
            ticks in 0..500_u64,
            jitter_ticks in 0..500_u64,
            spread in 1e-3..500.0_f64,
            draw in any::<u64>(),
        ) {
            for distribution in
                [Distribution::Uniform, Distribution::Geometric(spread), Distribution::Normal(spread)]
            {
                let delay = Delay { jitter_ticks, distribution, ..Delay::constant(ticks) };
                prop_assert!((ticks..=delay.bound()).contains(&delay.draw(draw)));
            }
        }
    }
}
