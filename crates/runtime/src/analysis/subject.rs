//! The loop that is analysed: one driven body of a rig, and the limits within which it is looked at.

use crate::config::Settings;
use crate::rig::Rig;

/// Ticks that are looked at, at the least and at the most.
pub(super) const TICKS_MIN: u64 = 2_000;
pub(super) const TICKS_MAX: u64 = 256_000;
/// A loop that was settled, and says so many times what it said then, does not stay settled.
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

/// Whether a size is beyond a limit, or no number.
pub(super) fn exceeds(size: f64, limit: f64) -> bool {
    size.is_nan() || size > limit.max(f64::MIN_POSITIVE)
}

pub(super) fn norm(values: &[f64]) -> f64 {
    values.iter().map(|value| value * value).sum::<f64>().sqrt()
}
