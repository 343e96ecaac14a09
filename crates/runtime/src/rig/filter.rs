//! The filter of a rig's observer, designed from one of three scenario keys.

use crate::config::Checks;
use crate::observe::{Filter, InvariantFilter, KalmanFilter, SecondOrderFilter};
use nalgebra::SVector;

/// The design of a filter: its order and its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum FilterDesign<const N: usize> {
    /// The papers' first-order filter with these decay rates, 1/s.
    First([f64; N]),
    /// A second-order filter with these bandwidths, rad/s.
    Second([f64; N]),
    /// A second-order Kalman filter with this spectral density of the process noise, (unit of the unknown)²/s.
    Kalman(f64),
}

/// The damping of second-order filters: the flattest pass band (Butterworth).
const DAMPING: f64 = core::f64::consts::FRAC_1_SQRT_2;
/// The standard deviation of an uninformed guess, in the unit of the unknown.
pub(super) const UNKNOWN_DEVIATION: f64 = 10.0;
/// The number of standard deviations that white noise never exceeds in practice: once in 10¹⁸ samples.
pub(super) const SURE_DEVIATIONS: f64 = 9.0;

impl<const N: usize> FilterDesign<N> {
    /// Checks that exactly one of the three keys is given, and its values.
    pub fn resolve(
        checks: &mut Checks<'_>,
        decay: Option<[f64; N]>,
        bandwidth: Option<[f64; N]>,
        density: (&str, Option<f64>),
    ) -> Option<Self> {
        let keys = ["observer.decay_rate_per_s", "observer.bandwidth_rad_s", &format!("observer.{}", density.0)];
        for (key, values) in [(keys[0], &decay), (keys[1], &bandwidth)] {
            values.iter().flatten().for_each(|value| checks.positive(key, *value));
        }
        checks.require(density.1.is_none_or(|density| density >= 0.0), keys[2], "negative", || {
            "is negative; give 0 for a perfect model, or more".to_owned()
        });
        match (decay, bandwidth, density.1) {
            (Some(decay), None, None) => Some(Self::First(decay)),
            (None, Some(bandwidth), None) => Some(Self::Second(bandwidth)),
            (None, None, Some(density)) => Some(Self::Kalman(density)),
            (None, None, None) => {
                checks.refuse(
                    keys[0],
                    "missing-key",
                    format!("is missing; add it (first order), or give {} or {} (second)", keys[1], keys[2]),
                );
                None
            }
            _ => {
                let last = if density.1.is_some() { keys[2] } else { keys[1] };
                checks.refuse(
                    last,
                    "conflicting-keys",
                    format!("conflicts with another filter key; give one of {}", keys.join(", ")),
                );
                None
            }
        }
    }

    /// Creates a filter of this design that starts at a guess.
    pub fn filter(&self, guess: SVector<f64, N>) -> Filter<N> {
        match self {
            Self::First(decay) => Filter::First(InvariantFilter::new((*decay).into(), guess)),
            Self::Second(bandwidth) => Filter::Second(SecondOrderFilter::new((*bandwidth).into(), DAMPING, guess)),
            Self::Kalman(density) => {
                let deviation = SVector::repeat(UNKNOWN_DEVIATION);
                Filter::Kalman(KalmanFilter::new(SVector::repeat(*density), guess, deviation))
            }
        }
    }

    /// Returns the exponents of the error's decay, 1/s, if they are constant.
    pub fn decay_rates(&self) -> Option<[f64; N]> {
        match self {
            Self::First(decay) => Some(*decay),
            Self::Second(bandwidth) => Some(bandwidth.map(|bandwidth| DAMPING * bandwidth)),
            Self::Kalman(_) => None,
        }
    }
}
