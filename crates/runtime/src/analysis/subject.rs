//! The analysed loop of one driven body, and the limits of the analysis.

use crate::config::Settings;
use crate::rig::Rig;

/// The least and the most examined ticks.
pub(super) const TICKS_MIN: u64 = 2_000;
pub(super) const TICKS_MAX: u64 = 256_000;
/// A settled loop diverges if its output exceeds this multiple of its first value.
pub(super) const LOST: f64 = 20.0;

/// The analysis of one driven body's loop.
pub(super) struct Analysis<'a, R> {
    pub rig: &'a R,
    pub index: usize,
    pub scenario: &'a Settings,
    pub tick_s: f64,
}

impl<'a, R: Rig> Analysis<'a, R> {
    pub fn new(rig: &'a R, index: usize, scenario: &'a Settings) -> Self {
        Self { rig, index, scenario, tick_s: scenario.tick_s() }
    }
}

/// Returns true if a size exceeds a limit or is not a number.
pub(super) fn exceeds(size: f64, limit: f64) -> bool {
    size.is_nan() || size > limit.max(f64::MIN_POSITIVE)
}

pub(super) fn norm(values: &[f64]) -> f64 {
    values.iter().map(|value| value * value).sum::<f64>().sqrt()
}
