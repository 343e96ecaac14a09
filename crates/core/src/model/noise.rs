//! Sensor noise: white Gaussian noise and a constant bias, from a seed.
//!
//! The noise must not use the system's randomness, nor a mathematical library that differs between platforms: equal
//! seeds and streams give equal bits everywhere.

use crate::state::{Persist, Words};
use nalgebra::SVector;
use rand_pcg::Pcg64;
use rand_pcg::rand_core::{Rng, SeedableRng};

/// 2⁻⁵³: scales the upper 53 bits of a draw to \[0, 1).
const UNIT: f64 = 1.0 / (1_u64 << 53) as f64;

/// A source of white Gaussian noise with a constant bias in each of N components.
#[derive(Debug, Clone, PartialEq)]
pub struct Noise<const N: usize> {
    generator: Pcg64,
    deviation: SVector<f64, N>,
    bias: SVector<f64, N>,
    white: bool,
    /// The number of samples drawn so far.
    drawn: u64,
}

impl<const N: usize> Noise<N> {
    /// Creates noise of standard deviation `deviation` (not negative) about `bias`, both finite, in the unit of the
    /// measured quantity.
    ///
    /// Sources with one seed and different `stream`s are independent, so that an additional sensor does not change
    /// the noise of others.
    pub fn new(seed: u64, stream: u64, deviation: [f64; N], bias: [f64; N]) -> Self {
        let white = deviation.iter().any(|&deviation| deviation != 0.0);
        // The generator's own streams are not used: those of one state are correlated.
        let salt = Pcg64::seed_from_u64(stream).next_u64();
        Self {
            generator: Pcg64::seed_from_u64(seed ^ salt),
            deviation: deviation.into(),
            bias: bias.into(),
            white,
            drawn: 0,
        }
    }

    /// Returns the next sample. Without deviation it is exactly the bias, and nothing is drawn.
    #[inline]
    pub fn sample(&mut self) -> SVector<f64, N> {
        if self.white { self.draw() } else { self.bias }
    }

    /// Skips `samples` samples.
    pub fn skip(&mut self, samples: u64) {
        // Each pair of components takes one draw for its radius and one for its angle.
        self.generator.advance(u128::from(samples) * 2 * N.div_ceil(2) as u128);
        self.drawn = self.drawn.wrapping_add(samples);
    }

    /// Draws every component, even one without deviation, so that the noise of one sensor does not depend on that of
    /// another.
    #[inline(never)]
    fn draw(&mut self) -> SVector<f64, N> {
        self.drawn = self.drawn.wrapping_add(1);
        let mut sample = self.bias;
        for pair in 0..N.div_ceil(2) {
            let normals = self.two_normals();
            for (index, normal) in (2 * pair..N.min(2 * pair + 2)).zip(normals) {
                sample[index] += self.deviation[index] * normal;
            }
        }
        sample
    }

    /// Draws two independent standard normals by the Box-Muller transform.
    ///
    /// Not the usual ziggurat, which calls the platform's mathematics wherever a dependency enables it.
    fn two_normals(&mut self) -> [f64; 2] {
        // 1 − u is never zero, so the logarithm is finite.
        let radius = libm::sqrt(-2.0 * libm::log(1.0 - self.uniform()));
        let (sine, cosine) = libm::sincos(core::f64::consts::TAU * self.uniform());
        [radius * cosine, radius * sine]
    }

    /// Draws a uniform number in \[0, 1).
    fn uniform(&mut self) -> f64 {
        (self.generator.next_u64() >> 11) as f64 * UNIT
    }
}

/// Returns an endless source of independent numbers, uniform in \[0, 1), from a seed and a stream.
pub fn uniform(seed: u64, stream: u64) -> impl FnMut() -> f64 {
    let mut noise = Noise::<1>::new(seed, stream, [0.0], [0.0]);
    move || noise.uniform()
}

/// Returns the value that a sensor with this step reports: the nearest multiple of `step`. A step of 0 or less leaves the value.
pub fn quantize(value: f64, step: f64) -> f64 {
    if step > 0.0 { step * libm::round(value / step) } else { value }
}

/// The state is the number of samples drawn.
impl<const N: usize> Persist for Noise<N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        let mut drawn = self.drawn;
        drawn.persist(words);
        if drawn > self.drawn {
            self.skip(drawn - self.drawn);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_deviation_a_sample_is_the_bias_and_draws_nothing() {
        let mut none = Noise::new(1, 2, [0.0; 3], [0.0; 3]);
        let before = none.clone();
        assert_eq!(none.sample(), SVector::from([0.0; 3]));
        assert_eq!(none, before);
        assert_eq!(Noise::new(1, 2, [0.0; 2], [0.5, -1.0]).sample(), SVector::from([0.5, -1.0]));
    }

    #[test]
    fn mean_variance_and_fourth_moment_are_the_normal_ones() {
        let mut noise = Noise::new(7, 0, [2.0, 0.5, 1.0], [1.0, 0.0, -3.0]);
        let count = 200_000;
        let (mut mean, mut square, mut fourth, mut cross) = (0.0, 0.0, 0.0, 0.0);
        for _ in 0..count {
            let x = noise.sample().component_div(&SVector::from([2.0, 0.5, 1.0]));
            let z = x - SVector::from([0.5, 0.0, -3.0]);
            mean += z.sum() / 3.0;
            square += z.norm_squared() / 3.0;
            fourth += z.map(|z| z.powi(4)).sum() / 3.0;
            cross += z.x * z.y;
        }
        let moments = [mean, square, fourth, cross].map(|sum| sum / f64::from(count));
        let expected = [0.0, 1.0, 3.0, 0.0];
        // Five standard errors of each. The seed is fixed, so the result is always the same.
        for ((moment, expected), error) in moments.into_iter().zip(expected).zip([1.3e-3, 1.8e-3, 1.3e-2, 2.2e-3]) {
            assert!((moment - expected).abs() < 5.0 * error, "{moments:?}");
        }
    }

    #[test]
    fn streams_and_seeds_are_distinct_and_reproducible() {
        let first = |seed, stream| Noise::new(seed, stream, [1.0], [0.0]).sample().x;
        assert_eq!(first(1, 1), first(1, 1));
        assert_ne!(first(1, 1), first(1, 2));
        assert_ne!(first(1, 1), first(2, 1));
    }

    #[test]
    fn skipping_equals_drawing() {
        let noise = Noise::new(5, 1, [1.0, 2.0, 3.0], [0.5; 3]);
        let (mut sampled, mut skipped) = (noise.clone(), noise);
        for _ in 0..1000 {
            sampled.sample();
        }
        skipped.skip(1000);
        assert_eq!(sampled.sample(), skipped.sample());
    }

    #[test]
    fn the_bits_are_the_same_everywhere() {
        let mut noise = Noise::new(1, 0, [1.0, 1.0], [0.0; 2]);
        assert_eq!(noise.sample().map(f64::to_bits), SVector::from([4602524065992745759, 13798313710924358754]));
    }

    #[test]
    fn a_component_without_noise_does_not_change_the_others() {
        let both = Noise::new(3, 0, [1.0, 1.0, 1.0], [0.0; 3]).sample();
        let some = Noise::new(3, 0, [1.0, 0.0, 1.0], [0.0; 3]).sample();
        assert_eq!((some.x, some.y, some.z), (both.x, 0.0, both.z));
    }
}
