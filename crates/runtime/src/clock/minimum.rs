//! Finds offset and drift of a remote clock from observations that are delayed by chance: keeps the least delayed one of
//! each window, and fits a line through these. Pure arithmetic. Must not read a clock.

use std::collections::VecDeque;

/// Number of windows: enough to measure the drift, few enough for a drift that changes with temperature.
const WINDOWS: usize = 24;
/// Shortest span over which a drift is distinguished from jitter, ns.
const DRIFT_SPAN_NS: f64 = 1e9;
/// Weight from which on an observation counts as one of the least delayed.
const FAST: f64 = 0.5;

/// An observation of the remote clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Number of the window.
    pub window: u64,
    /// Time on the local clock, ns since any origin.
    pub at_ns: f64,
    /// The remote clock less the local one, ns, as far as the delay allows to tell.
    pub offset_ns: f64,
    /// The delay, or a measure that grows with it, ns.
    pub delay_ns: f64,
}

/// A line: the offset at the origin, and its slope.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OffsetLine {
    /// The offset at time 0, ns.
    pub offset_ns: f64,
    /// Change of the offset, ns per ns.
    pub drift: f64,
}

impl OffsetLine {
    /// Returns the offset at a time, ns.
    pub fn at(&self, at_ns: f64) -> f64 {
        self.offset_ns + self.drift * at_ns
    }
}

/// The least delayed observation of each of the last windows.
#[derive(Debug)]
pub struct MinimumFilter {
    kept: VecDeque<Observation>,
}

impl Default for MinimumFilter {
    fn default() -> Self {
        // One more, because the new window is added before the oldest is removed.
        Self { kept: VecDeque::with_capacity(WINDOWS + 1) }
    }
}

impl MinimumFilter {
    /// Takes an observation. It is kept if it is the least delayed one of its window so far.
    pub fn take(&mut self, found: Observation) {
        match self.kept.back_mut().filter(|last| last.window == found.window) {
            Some(last) if last.delay_ns <= found.delay_ns => {}
            Some(last) => *last = found,
            None => self.kept.push_back(found),
        }
        if self.kept.len() > WINDOWS {
            self.kept.pop_front();
        }
    }

    /// Forgets all windows but the last `count`.
    pub fn keep_last(&mut self, count: usize) {
        self.kept.drain(..self.kept.len().saturating_sub(count));
    }

    /// Returns the kept observations, the oldest first.
    pub fn kept(&self) -> &VecDeque<Observation> {
        &self.kept
    }

    /// Returns true if the kept observations span enough time for a drift.
    pub fn knows_drift(&self) -> bool {
        self.tells_drift(|_| 1.0)
    }

    /// Returns true if those of the least delayed, by these weights, span enough time for a drift.
    pub fn tells_drift(&self, weight: impl Fn(&Observation) -> f64) -> bool {
        let mut fast = self.kept.iter().filter(|kept| weight(kept) >= FAST);
        let first = fast.next();
        let last = fast.next_back().or(first);
        first.zip(last).is_some_and(|(first, last)| last.at_ns - first.at_ns >= DRIFT_SPAN_NS)
    }

    /// Returns the newest of the least delayed observations, by these weights: it has drifted least.
    pub fn newest_fast(&self, weight: impl Fn(&Observation) -> f64) -> Option<&Observation> {
        self.kept.iter().rev().find(|kept| weight(kept) >= FAST)
    }

    /// Returns the least-squares line through the kept observations, with these weights. The drift is at most
    /// `drift_max`, and 0 before it can be distinguished from jitter. The line is flat at 0 without observations.
    pub fn line(&self, drift_max: f64, weight: impl Fn(&Observation) -> f64) -> OffsetLine {
        let sum =
            |value: &dyn Fn(&Observation) -> f64| self.kept.iter().map(|kept| weight(kept) * value(kept)).sum::<f64>();
        let total = sum(&|_| 1.0);
        if total <= 0.0 {
            return OffsetLine::default();
        }
        let (time_ns, offset_ns) = (sum(&|kept| kept.at_ns) / total, sum(&|kept| kept.offset_ns) / total);
        if !self.knows_drift() {
            let newest = self.newest_fast(weight);
            return OffsetLine { offset_ns: newest.map_or(offset_ns, |kept| kept.offset_ns), drift: 0.0 };
        }
        let variance = sum(&|kept| (kept.at_ns - time_ns).powi(2));
        let covariance = sum(&|kept| (kept.at_ns - time_ns) * (kept.offset_ns - offset_ns));
        let drift = if variance > 0.0 { (covariance / variance).clamp(-drift_max, drift_max) } else { 0.0 };
        OffsetLine { offset_ns: offset_ns - drift * time_ns, drift }
    }
}
