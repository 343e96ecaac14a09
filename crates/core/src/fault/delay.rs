//! How late a sample is sent: by a constant, or by another number of ticks each time, drawn within a bound.
//!
//! Must not have a tail: room for what is under way is taken before the first tick.

use super::{mix, unit};
use crate::model::Noise;

/// By how many ticks samples are late.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Delay {
    /// At least so many.
    pub ticks: u64,
    /// At most so many more.
    pub jitter_ticks: u64,
    /// How these are distributed over 0 to `jitter_ticks`.
    pub distribution: Distribution,
    /// A sample that is late by no more than this is in time all the same: nobody needs it sooner.
    pub slack_ticks: u64,
}

/// A distribution over 0, 1, … up to a bound.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Distribution {
    /// All alike.
    Uniform,
    /// Each by a constant factor less likely than the one before, as waiting times are: its mean would be this if it had no
    /// bound. What lies beyond is none of it, so the mean is less.
    Geometric(f64),
    /// Normal about the middle with this standard deviation, rounded. What lies beyond the bound is drawn again.
    Normal(f64),
}

/// So often a normal number beyond the bound is drawn again; a deviation of at most the bound needs more once in 10¹³ times.
const REDRAWS: usize = 64;

impl Delay {
    /// Always so many ticks.
    pub fn constant(ticks: u64) -> Self {
        Self { ticks, jitter_ticks: 0, distribution: Distribution::Uniform, slack_ticks: 0 }
    }

    /// The most.
    pub fn bound(&self) -> u64 {
        self.ticks + self.jitter_ticks
    }

    /// That of one sample, which follows from this number.
    pub fn draw(&self, draw: u64) -> u64 {
        let bound = self.jitter_ticks as f64;
        let jitter = match self.distribution {
            _ if self.jitter_ticks == 0 => 0.0,
            Distribution::Uniform => libm::floor(unit(draw) * (bound + 1.0)),
            Distribution::Geometric(mean) => {
                // The inverse of the distribution function, cut off at the bound.
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
    fn every_distribution_is_what_its_name_says() {
        let delay = |distribution| Delay { jitter_ticks: 8, distribution, ..Delay::constant(2) };
        let uniform = histogram(delay(Distribution::Uniform), 90_000);
        assert!(uniform[2..].iter().all(|share| (share - 1.0 / 9.0).abs() < 0.01), "{uniform:?}");
        let geometric = histogram(delay(Distribution::Geometric(1.0)), 90_000);
        // Of halves there are 511/512 within the bound.
        let expected = (0..9).map(|jitter| 0.5_f64.powi(jitter + 1) * 512.0 / 511.0);
        assert!(geometric[2..].iter().zip(expected).all(|(is, should)| (is - should).abs() < 0.01), "{geometric:?}");
        let normal = histogram(delay(Distribution::Normal(1.0)), 90_000);
        let expected = [0.0, 0.0062, 0.0606, 0.2417, 0.3829, 0.2417, 0.0606, 0.0062, 0.0];
        assert!(normal[3..].iter().zip(&expected[1..]).all(|(is, should)| (is - should).abs() < 0.01), "{normal:?}");
        for shares in [uniform, geometric, normal] {
            assert_eq!(&shares[..2], [0.0; 2], "never sooner");
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
