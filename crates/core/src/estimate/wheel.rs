//! A body with a wheel as a body without one under a known torque, for the relation of \[D\] section 3.
//!
//! With the hidden axis k, J_i ω̇_i = (J_j − J_k) ω_j ω_k + h_j ω_k − h_k ω_j, and J_j ω̇_j likewise. In the shifted rates
//! u_i = ω_i + h_i/(J_i − J_k) and u_j = ω_j + h_j/(J_j − J_k) this is u̇_i = a_i u_j ω_k − h_k ω_j/J_i and
//! u̇_j = a_j u_i ω_k + h_k ω_i/J_j: the free motion with torques of the measured rates alone.

use crate::observe::RateSample;
use nalgebra::Vector3;

/// The least difference of two moments, as a part of them.
const APART: f64 = 1e-6;

/// A wheel of constant momentum relative to the body, about the principal axes, and the body's moments in the same scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wheel {
    /// The momentum, N m s.
    pub momentum: Vector3<f64>,
    /// The moments of inertia, kg m².
    pub moments: Vector3<f64>,
}

/// Returns the indices i, j and k of the hidden axis, 1 to 3.
fn indices(axis: usize) -> [usize; 3] {
    [axis % 3, (axis + 1) % 3, (axis + 2) % 3]
}

impl Wheel {
    /// Returns an axis of the wheel, 1 to 3, whose moment equals that of the hidden axis.
    pub(super) fn singular(&self, axis: usize) -> Option<usize> {
        let [i, j, k] = indices(axis);
        let same = |axis: usize| (self.moments[axis] - self.moments[k]).abs() < APART * self.moments[k];
        [i, j].into_iter().find(|axis| self.momentum[*axis] != 0.0 && same(*axis)).map(|axis| axis + 1)
    }

    /// Returns measured rates as those of a body without a wheel, rad/s; `axis` is hidden, 1 to 3.
    pub fn shifted(&self, rate_rad_s: &Vector3<f64>, axis: usize) -> Vector3<f64> {
        let [i, j, k] = indices(axis);
        let mut shifted = *rate_rad_s;
        for index in [i, j].into_iter().filter(|index| self.momentum[*index] != 0.0) {
            shifted[index] += self.momentum[index] / (self.moments[index] - self.moments[k]);
        }
        shifted
    }

    /// Returns measured rates and momentum, both `growth` times as large, as a sample of a body without a wheel. The momentum grows
    /// at `growth_per_s`.
    pub(super) fn as_torque(
        &self,
        rate_rad_s: &Vector3<f64>,
        axis: usize,
        growth: f64,
        growth_per_s: f64,
    ) -> RateSample {
        let ([i, j, k], moments) = (indices(axis), &self.moments);
        let (momentum, rate) = (self.momentum * growth, rate_rad_s);
        let shifted = Self { momentum, ..*self }.shifted(rate, axis);
        let mut torque_rad_s2 = (shifted - rate) * (growth_per_s * growth);
        torque_rad_s2[i] -= momentum[k] * rate[j] / moments[i];
        torque_rad_s2[j] += momentum[k] * rate[i] / moments[j];
        let bent = (moments[i] - moments[j]) * (rate[i] * rate[j] - shifted[i] * shifted[j]);
        torque_rad_s2[k] = (bent - (rate[i] * momentum[j] - rate[j] * momentum[i])) / moments[k];
        RateSample { rate_rad_s: shifted, torque_rad_s2 }
    }
}
