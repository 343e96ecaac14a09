//! Series that replace transcendental functions for short ticks or limited ranges.
//!
//! Each is within 2 units in the last place over its range; outside that range the exact function is called. Not for
//! arguments that are usually large: the range check would only add a comparison.

use core::f64::consts::{FRAC_1_PI, PI};

/// The largest magnitude of y/x, and of the argument of the logarithm, for which a series is used.
const SHORT: f64 = 1.0 / 128.0;

/// Computes atan2(y, x), rad.
///
/// For |y| ≤ x/128 by arctan t = t − t³/3 + t⁵/5 − t⁷/7. The truncation error is below t⁹/9, relative to t less than
/// 2⁻⁵⁹; the rounding of the quotient and of one sum remain.
#[inline]
pub fn atan2(y: f64, x: f64) -> f64 {
    short_atan2(y, x).unwrap_or_else(|| libm::atan2(y, x))
}

/// Computes atan2(y, x) by the series; `None` outside its range.
#[inline(always)]
pub fn short_atan2(y: f64, x: f64) -> Option<f64> {
    (y.abs() <= x * SHORT).then(|| {
        let t = y / x;
        let s = t * t;
        // In this order no product depends on the previous one.
        t + t * s * ((s * (1.0 / 5.0) - 1.0 / 3.0) - s * s * (1.0 / 7.0))
    })
}

/// Computes ln(1 + x), for x > −1.
///
/// For |x| ≤ 1/128 by 2 artanh s = 2 (s + s³/3 + s⁵/5 + s⁷/7) with s = x/(2 + x), |s| < 1/254. The truncation error
/// is 2s⁹/9 plus less than half of that, relative to x less than 2⁻⁶⁶; the rounding of the quotient and of one sum
/// remain.
#[inline]
pub fn ln_1p(x: f64) -> f64 {
    short_ln_1p(x).unwrap_or_else(|| libm::log1p(x))
}

/// Computes ln(1 + x) by the series; `None` outside its range.
#[inline(always)]
pub fn short_ln_1p(x: f64) -> Option<f64> {
    (x.abs() <= SHORT).then(|| {
        // x − x s = 2 s: the leading term is x itself and therefore exact.
        let s = x / (2.0 + x);
        let z = s * s;
        let tail = z * ((z * (1.0 / 5.0) + 1.0 / 3.0) + z * z * (1.0 / 7.0));
        x - s * (x - 2.0 * tail)
    })
}

/// Computes sin² x for any x.
///
/// The period is π. Between −π/2 and π/2 sin x = x − x³/3! + … + x²¹/21!; the truncation error is below x²³/23!, less
/// than 2⁻⁵⁹. The exact function reduces arguments of any size to the last bit, with tables and loops that take a
/// tenth of a whole firmware image. Here each half turn that is removed costs a rounding of x.
pub fn sine_squared(x: f64) -> f64 {
    let turned = x - PI * libm::rint(x * FRAC_1_PI);
    let s = turned * turned;
    // 1 − s/(2·3) (1 − s/(4·5) (1 − …)).
    let series = (1..=10).rev().fold(1.0, |sum, pair| 1.0 - s * sum / f64::from(2 * pair * (2 * pair + 1)));
    s * series * series
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the distance of two numbers of similar magnitude in units of the last place of `exact`.
    fn ulps(value: f64, exact: f64) -> f64 {
        let unit = f64::from_bits(exact.abs().to_bits() + 1) - exact.abs();
        ((value - exact) / unit).abs()
    }

    /// Returns arguments over the range of the series: dense, logarithmic, of either sign, and its ends.
    fn arguments() -> impl Iterator<Item = f64> {
        let dense = (1..=200_000).map(|n| SHORT * f64::from(n) / 200_000.0);
        let small = (0..50_000).map(|n| SHORT * libm::exp2(-f64::from(n) / 1000.0));
        dense.chain(small).flat_map(|x| [x, -x])
    }

    /// The reference functions err by less than one unit themselves, so 2 leaves 1 for the series.
    #[test]
    fn the_series_are_within_two_units_in_the_last_place() {
        let mut worst = [0.0_f64; 2];
        for (index, x) in arguments().enumerate() {
            let scale = 1.0 + 1e-3 * (index % 977) as f64;
            let quotient = (x * scale) / scale;
            worst[0] = worst[0].max(ulps(atan2(x * scale, scale), libm::atan(quotient)));
            worst[1] = worst[1].max(ulps(ln_1p(x), libm::log1p(x)));
        }
        println!("worst difference: atan2 {:.2}, ln_1p {:.2} units in the last place", worst[0], worst[1]);
        assert!(worst.iter().all(|worst| *worst <= 2.0), "{worst:?}");
    }

    #[test]
    fn outside_their_range_the_exact_functions_are_called() {
        for (y, x) in [(1.0, 1.0), (0.1, -1.0), (-0.0, -1.0), (1.0, 0.0), (SHORT * 1.01, 1.0), (f64::NAN, 1.0)] {
            assert_eq!(atan2(y, x).to_bits(), libm::atan2(y, x).to_bits(), "{y} {x}");
        }
        for x in [-0.9, 0.04, 7.0, f64::INFINITY] {
            assert_eq!(ln_1p(x), libm::log1p(x));
        }
        assert_eq!((atan2(0.0, 1.0), ln_1p(0.0)), (0.0, 0.0));
        assert!(ln_1p(f64::NAN).is_nan());
    }

    #[test]
    fn the_squared_sine_is_accurate_at_any_argument() {
        for x in arguments().flat_map(|x| [x, 100.0 * x, 200.0 * x, 1e5 * x]) {
            let (squared, sine) = (sine_squared(x), libm::sin(x));
            let allowed = if x.abs() < 1.57 { 2e-15 * sine * sine } else { 1e-15 * x.abs() };
            assert!((squared - sine * sine).abs() <= allowed, "{x}: {squared} is not {}", sine * sine);
        }
        assert_eq!(sine_squared(0.0), 0.0);
        assert!(sine_squared(f64::INFINITY).is_nan());
    }
}
