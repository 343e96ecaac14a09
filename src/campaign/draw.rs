//! Numbers in (0, 1) that follow from a seed, an axis and a number, and from nothing else: independent, in a latin hypercube, or
//! of Sobol's sequence.
//!
//! Draws have no state, so any case can be drawn alone. Must not depend on the machine: no function
//! of its mathematical library is called.

use crate::fault::{mix, unit};

/// Upper bound on the dimensions of Sobol's sequence.
pub(super) const SOBOL_AXES: usize = 16;
/// Upper bound on its points.
pub(super) const SOBOL_POINTS: u64 = 1 << 32;
/// Bits of a coordinate.
const BITS: usize = 32;

/// Primitive polynomials and initial direction numbers of dimensions 2 to 16 (degree, coefficients, m_i): S. Joe, F. Y. Kuo,
/// Constructing Sobol sequences with better two-dimensional projections, SIAM J. Sci. Comput. 30 (2008), their file
/// new-joe-kuo-6.21201.
const DIRECTIONS: [(usize, u32, [u32; 6]); SOBOL_AXES - 1] = [
    (1, 0, [1, 0, 0, 0, 0, 0]),
    (2, 1, [1, 3, 0, 0, 0, 0]),
    (3, 1, [1, 3, 1, 0, 0, 0]),
    (3, 2, [1, 1, 1, 0, 0, 0]),
    (4, 1, [1, 1, 3, 3, 0, 0]),
    (4, 4, [1, 3, 5, 13, 0, 0]),
    (5, 2, [1, 1, 5, 5, 17, 0]),
    (5, 4, [1, 1, 5, 5, 5, 0]),
    (5, 7, [1, 1, 7, 11, 19, 0]),
    (5, 11, [1, 1, 5, 1, 1, 0]),
    (5, 13, [1, 1, 1, 3, 11, 0]),
    (5, 14, [1, 3, 5, 5, 31, 0]),
    (6, 1, [1, 3, 3, 9, 7, 49]),
    (6, 13, [1, 1, 1, 15, 21, 21]),
    (6, 16, [1, 3, 1, 13, 27, 49]),
];

/// Returns the seed of the draws of one axis.
fn stream(seed: u64, axis: usize) -> u64 {
    mix(seed ^ (axis as u64 + 1).rotate_left(48))
}

/// Returns an independent number in (0, 1).
pub(super) fn independent(seed: u64, axis: usize, number: u64) -> f64 {
    inside(unit(mix(stream(seed, axis) ^ number)))
}

/// Returns the number of one of `count` samples in a latin hypercube: each axis has one sample in each of `count` equal parts.
pub(super) fn latin_hypercube(seed: u64, axis: usize, sample: u64, count: u64) -> f64 {
    let part = permuted(mix(stream(seed, axis)), sample, count);
    inside((part as f64 + independent(seed, axis, sample)) / count as f64)
}

/// Returns one point of Sobol's sequence with a digital shift by the seed, which keeps its evenness and moves it away from the
/// corner at which it begins.
pub(super) fn sobol(seed: u64, axis: usize, sample: u64) -> f64 {
    let shift = (stream(seed, axis) >> BITS) as u32;
    inside((f64::from(coordinate(axis, sample as u32) ^ shift) + 0.5) / SOBOL_POINTS as f64)
}

/// Keeps a number away from 0 and 1, where a quantile may be infinite.
fn inside(number: f64) -> f64 {
    number.clamp(f64::EPSILON / 4.0, 1.0 - f64::EPSILON / 2.0)
}

/// Returns a coordinate of a point of Sobol's sequence, times 2³², in Gray-code order.
fn coordinate(axis: usize, point: u32) -> u32 {
    let code = point ^ point >> 1;
    let numbers = directions(axis);
    (0..BITS).filter(|bit| code >> bit & 1 == 1).fold(0, |sum, bit| sum ^ numbers[bit])
}

/// Returns the direction numbers of an axis.
fn directions(axis: usize) -> [u32; BITS] {
    let mut numbers = [0; BITS];
    let Some(&(degree, coefficients, first)) = axis.checked_sub(1).and_then(|row| DIRECTIONS.get(row)) else {
        return std::array::from_fn(|bit| 1 << (BITS - 1 - bit));
    };
    for bit in 0..BITS {
        numbers[bit] = if bit < degree {
            first[bit] << (BITS - 1 - bit)
        } else {
            let before = numbers[bit - degree];
            (1..degree).fold(before ^ before >> degree, |sum, back| {
                if coefficients >> (degree - 1 - back) & 1 == 1 { sum ^ numbers[bit - back] } else { sum }
            })
        };
    }
    numbers
}

/// Returns the image of a number below `count` in a permutation: a Feistel network on the next even number of bits, repeated
/// until the result is in the range.
fn permuted(key: u64, number: u64, count: u64) -> u64 {
    let half = (u64::BITS - count.saturating_sub(1).leading_zeros()).div_ceil(2).max(1);
    let mask = (1 << half) - 1;
    let mut walked = number;
    loop {
        let (mut left, mut right) = (walked >> half, walked & mask);
        for round in 0..4 {
            (left, right) = (right, left ^ mix(mix(key ^ round) ^ right) & mask);
        }
        walked = left << half | right;
        if walked < count {
            return walked;
        }
    }
}

/// Returns the quantile of the standard normal distribution: an approximation (M. Abramowitz, I. A. Stegun, 26.2.23), refined
/// by Halley's method to rounding.
pub(super) fn normal(probability: f64) -> f64 {
    let tail = probability.min(1.0 - probability);
    let t = libm::sqrt(-2.0 * libm::log(tail));
    let mut x = (2.515517 + t * (0.802853 + t * 0.010328)) / (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308))) - t;
    for _ in 0..3 {
        let density = libm::exp(-0.5 * x * x) / libm::sqrt(2.0 * core::f64::consts::PI);
        let step = (0.5 * libm::erfc(-x * core::f64::consts::FRAC_1_SQRT_2) - tail) / density;
        x -= step / (1.0 + 0.5 * x * step);
    }
    if probability < 0.5 { x } else { -x }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The first points in ten dimensions, as the authors' page prints them.
    #[test]
    fn sobol_begins_as_published() {
        const PUBLISHED: [[f64; 10]; 9] = [
            [0.5; 10],
            [0.75, 0.25, 0.25, 0.25, 0.75, 0.75, 0.25, 0.75, 0.75, 0.75],
            [0.25, 0.75, 0.75, 0.75, 0.25, 0.25, 0.75, 0.25, 0.25, 0.25],
            [0.375, 0.375, 0.625, 0.875, 0.375, 0.125, 0.375, 0.875, 0.875, 0.625],
            [0.875, 0.875, 0.125, 0.375, 0.875, 0.625, 0.875, 0.375, 0.375, 0.125],
            [0.625, 0.125, 0.875, 0.625, 0.625, 0.875, 0.125, 0.125, 0.125, 0.375],
            [0.125, 0.625, 0.375, 0.125, 0.125, 0.375, 0.625, 0.625, 0.625, 0.875],
            [0.1875, 0.3125, 0.9375, 0.4375, 0.5625, 0.3125, 0.4375, 0.9375, 0.9375, 0.3125],
            [0.6875, 0.8125, 0.4375, 0.9375, 0.0625, 0.8125, 0.9375, 0.4375, 0.4375, 0.8125],
        ];
        for (point, expected) in (1..).zip(PUBLISHED) {
            let found: [f64; 10] = std::array::from_fn(|axis| f64::from(coordinate(axis, point)) / 2_f64.powi(32));
            assert_eq!(found, expected, "point {point}");
        }
    }

    /// With a shift too: of 2ᵏ points each axis has one in each of 2ᵏ equal parts, and two axes one in each of 2ᵏ rectangles.
    #[test]
    fn sobol_fills_every_part_once() {
        for axis in 0..SOBOL_AXES {
            let mut met = [0; 256];
            (0..256).for_each(|point| met[(sobol(9, axis, point) * 256.0) as usize] += 1);
            assert!(met.iter().all(|count| *count == 1), "axis {axis}: {met:?}");
        }
        let mut met = [0; 256];
        let part = |axis, point| (sobol(9, axis, point) * 16.0) as usize;
        (0..256).for_each(|point| met[16 * part(0, point) + part(1, point)] += 1);
        assert!(met.iter().all(|count| *count == 1), "{met:?}");
    }

    #[test]
    fn the_normal_quantile_is_that_of_tables() {
        for (probability, expected) in [
            (0.5, 0.0),
            (0.975, 1.959_963_984_540_054),
            (0.841_344_746_068_543, 1.0),
            (1e-10, -6.361_340_902_404_056),
            (0.25, -0.674_489_750_196_082),
        ] {
            let found = normal(probability);
            assert!((found - expected).abs() < 1e-12 * expected.abs().max(1.0), "{probability}: {found}");
        }
    }

    proptest! {
        #[test]
        fn a_hypercube_has_one_sample_in_every_part(seed: u64, axis in 0..20_usize, count in 1..600_u64) {
            let mut met = vec![0; count as usize];
            for sample in 0..count {
                let number = latin_hypercube(seed, axis, sample, count);
                prop_assert!(0.0 < number && number < 1.0);
                met[((number * count as f64) as usize).min(count as usize - 1)] += 1;
            }
            // A number at the very end of its part may be rounded into the next.
            let missing = met.iter().filter(|count| **count == 0).count();
            prop_assert!(missing <= 1, "{met:?}");
        }

        #[test]
        fn a_permutation_meets_every_number_once(key: u64, count in 1..3000_u64) {
            let mut met = vec![false; count as usize];
            (0..count).for_each(|number| met[permuted(key, number, count) as usize] = true);
            prop_assert!(met.iter().all(|met| *met));
        }

        #[test]
        fn quantile_and_distribution_are_inverse(probability in 1e-12..0.999_999_f64) {
            let back = 0.5 * libm::erfc(-normal(probability) * core::f64::consts::FRAC_1_SQRT_2);
            prop_assert!((back / probability - 1.0).abs() < 1e-11, "{back}");
        }

        #[test]
        fn draws_are_inside_and_differ(seed: u64, axis in 0..SOBOL_AXES, number: u64) {
            for drawn in [independent(seed, axis, number), sobol(seed, axis, number % SOBOL_POINTS)] {
                prop_assert!(0.0 < drawn && drawn < 1.0 && normal(drawn).is_finite());
            }
            prop_assert_ne!(independent(seed, axis, number), independent(seed, axis, number ^ 1));
            prop_assert_ne!(independent(seed, axis, number), independent(seed, axis + 1, number));
        }
    }
}
