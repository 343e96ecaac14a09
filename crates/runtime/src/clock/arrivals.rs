//! Estimates a sender's clock from the arrivals of frames that it sends at known times of its own. Pure arithmetic.
//!
//! A frame arrives late by an unknown delay, and never early. So the least delayed frame of each window is kept, and the
//! line through these is the sender's clock less the shortest delay. Must not read a clock.

use super::minimum::{MinimumFilter, Observation, OffsetLine};

/// Shortest window of which the least delayed frame is kept, ns, and the least number of frames in it.
const WINDOW_NS: u64 = 250_000_000;
const WINDOW_FRAMES: u64 = 16;
/// Largest drift between the clocks, ns per ns: each quartz is within 100 ppm.
const DRIFT_MAX: f64 = 300e-6;
/// Number of fits: each lowers the weight of windows that the one before found delayed.
const FITS: usize = 4;
/// Least delay of a window against the others at which its weight is halved, ns.
const SIMILAR_NS: f64 = 10_000.0;
/// Number of windows that must contradict the line before all earlier ones are forgotten.
const CONTRADICTIONS: usize = 3;

/// A sender's clock at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArrivalEstimate {
    /// The sender's clock less the local one, ns.
    pub offset_ns: f64,
    /// Change of the offset, ns per ns.
    pub drift: f64,
}

/// An estimator of the clock of one sender.
#[derive(Debug)]
pub struct ArrivalEstimator {
    window_ns: u64,
    /// Delay against the line from which on a window contradicts it, ns.
    contradiction_ns: f64,
    contradictions: usize,
    /// The last measured drift, if there is one. It holds while the kept windows do not tell it: after a change of the phase or of the way the quartz
    /// is the same.
    drift: Option<f64>,
    /// Time and offset of the first frame; all others are relative to it.
    origin: Option<(u64, i64)>,
    filter: MinimumFilter,
    /// The line through the windows before the current one: it does not change within a window, so that the delays
    /// in it can be compared.
    line: OffsetLine,
}

impl ArrivalEstimator {
    /// Creates an estimator of a sender with this period, ns. Three windows in a row that are delayed by more than
    /// `contradiction_ns` against all earlier ones replace these.
    pub fn new(period_ns: u64, contradiction_ns: f64) -> Self {
        Self {
            window_ns: WINDOW_NS.max(WINDOW_FRAMES.saturating_mul(period_ns)),
            contradiction_ns,
            contradictions: 0,
            drift: None,
            origin: None,
            filter: MinimumFilter::default(),
            line: OffsetLine::default(),
        }
    }

    /// Forgets all frames.
    pub fn reset(&mut self) {
        self.filter.keep_last(0);
        (self.origin, self.contradictions, self.line, self.drift) = (None, 0, OffsetLine::default(), None);
    }

    /// Returns the length of a window, ns.
    pub fn window_ns(&self) -> u64 {
        self.window_ns
    }

    /// Returns the number of windows with frames.
    pub fn windows(&self) -> usize {
        self.filter.kept().len()
    }

    /// Returns true once the drift is known.
    pub fn knows_drift(&self) -> bool {
        self.filter.knows_drift()
    }

    /// Takes a frame that was due at `sent_ns` on the sender's clock and arrived at `arrived_ns` on the local one.
    pub fn take(&mut self, sent_ns: u64, arrived_ns: u64) {
        let offset_ns = sent_ns.wrapping_sub(arrived_ns) as i64;
        let (origin_ns, origin_offset_ns) = *self.origin.get_or_insert((arrived_ns, offset_ns));
        let at_ns = arrived_ns.wrapping_sub(origin_ns) as i64 as f64;
        let offset_ns = offset_ns.wrapping_sub(origin_offset_ns) as f64;
        let window = arrived_ns / self.window_ns;
        if self.filter.kept().back().is_some_and(|last| last.window != window) {
            self.close_window();
        }
        self.filter.take(Observation { window, at_ns, offset_ns, delay_ns: self.line.at(at_ns) - offset_ns });
    }

    /// Returns the estimate at a time on the local clock; `None` before the first frame.
    pub fn at(&self, now_ns: u64) -> Option<ArrivalEstimate> {
        let (origin_ns, origin_offset_ns) = self.origin?;
        let line = self.fit();
        let now = now_ns.wrapping_sub(origin_ns) as i64 as f64;
        Some(ArrivalEstimate { offset_ns: origin_offset_ns as f64 + line.at(now), drift: line.drift })
    }

    fn close_window(&mut self) {
        let contradicts = self.filter.kept().back().is_some_and(|last| last.delay_ns.abs() > self.contradiction_ns);
        self.contradictions = if contradicts && self.windows() > 1 { self.contradictions + 1 } else { 0 };
        if self.contradictions >= CONTRADICTIONS {
            self.filter.keep_last(CONTRADICTIONS);
            self.contradictions = 0;
        }
        self.line = self.fit();
        if self.filter.knows_drift() {
            self.drift = Some(self.line.drift);
        }
    }

    /// Fits a line; windows in which every frame was delayed have a lower weight. The line has the last drift while the windows with a
    /// high weight do not span enough time for one.
    fn fit(&self) -> OffsetLine {
        let mut line = self.filter.line(DRIFT_MAX, |_| 1.0);
        for _ in 1..FITS {
            line = self.filter.line(DRIFT_MAX, self.weight(line));
        }
        let Some(drift) = self.drift.filter(|_| !self.filter.tells_drift(self.weight(line))) else { return line };
        let weight = self.weight(OffsetLine { offset_ns: 0.0, drift });
        let newest = self.filter.newest_fast(weight);
        newest.map_or(line, |kept| OffsetLine { offset_ns: kept.offset_ns - drift * kept.at_ns, drift })
    }

    /// Returns the weights of windows by their delay against a line.
    fn weight(&self, line: OffsetLine) -> impl Fn(&Observation) -> f64 {
        let delay = move |kept: &Observation| line.at(kept.at_ns) - kept.offset_ns;
        let least_ns = self.filter.kept().iter().map(delay).fold(f64::INFINITY, f64::min);
        move |kept| 1.0 / (1.0 + ((delay(kept) - least_ns) / SIMILAR_NS).powi(2))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PERIOD_NS: u64 = 2_000_000;

    /// A sender whose clock is off by `drift`, and a way with a jitter that is uniform up to `jitter_ns`.
    struct World {
        drift: f64,
        offset_ns: f64,
        jitter_ns: f64,
        random: u64,
    }

    impl World {
        fn new(drift: f64, jitter_ns: f64, seed: u64) -> Self {
            Self { drift, offset_ns: 3e9, jitter_ns, random: seed }
        }

        /// The local time at which the sender sends its frame `k`, ns.
        fn sent_at(&self, k: u64) -> f64 {
            self.offset_ns + (k * PERIOD_NS) as f64 / (1.0 + self.drift)
        }

        fn arrival(&mut self, k: u64) -> u64 {
            // The generator of Knuth's MMIX.
            self.random = self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let uniform = (self.random >> 11) as f64 / (1_u64 << 53) as f64;
            (self.sent_at(k) + self.jitter_ns * uniform) as u64
        }

        /// Returns the error of an estimate at the sending of frame `k`, ns.
        fn error_ns(&self, estimator: &ArrivalEstimator, k: u64) -> f64 {
            let now_ns = self.sent_at(k);
            let estimate = estimator.at(now_ns as u64).unwrap();
            now_ns + estimate.offset_ns - (k * PERIOD_NS) as f64
        }
    }

    #[test]
    fn jitter_and_drift_cost_less_than_20_us_from_the_second_second_on() {
        for (seed, drift) in [(1, 100e-6), (2, -100e-6), (3, 0.0)] {
            let (mut world, mut estimator) = (World::new(drift, 300e3, seed), ArrivalEstimator::new(PERIOD_NS, 1e5));
            for k in 0..15_000 {
                estimator.take(k * PERIOD_NS, world.arrival(k));
                let error_ns = world.error_ns(&estimator, k);
                // At first the least delayed frame has a delay too, and the drift is not known.
                let limit_ns = match k {
                    0..250 => 400e3,
                    250..1000 => 120e3,
                    _ => 20e3,
                };
                assert!(error_ns.abs() < limit_ns, "frame {k}: {error_ns} ns at {drift}");
            }
            let found = estimator.at(0).unwrap().drift;
            assert!((found - drift).abs() < 1.5e-6, "{found} is not {drift}");
        }
    }

    #[test]
    fn the_drift_carries_over_a_gap_of_ten_seconds() {
        let (mut world, mut estimator) = (World::new(-80e-6, 300e3, 4), ArrivalEstimator::new(PERIOD_NS, 1e5));
        (0..5000).for_each(|k| estimator.take(k * PERIOD_NS, world.arrival(k)));
        let error_ns = world.error_ns(&estimator, 10_000);
        assert!(error_ns.abs() < 25e3, "{error_ns} ns");
        (10_000..10_250).for_each(|k| estimator.take(k * PERIOD_NS, world.arrival(k)));
        let error_ns = world.error_ns(&estimator, 10_250);
        assert!(error_ns.abs() < 15e3, "{error_ns} ns");
    }

    #[test]
    fn a_congested_window_does_not_move_the_line() {
        let (mut world, mut estimator) = (World::new(50e-6, 20e3, 5), ArrivalEstimator::new(PERIOD_NS, 1e5));
        for k in 0..5000 {
            let congested = if (2000..2250).contains(&k) { 400_000 } else { 0 };
            estimator.take(k * PERIOD_NS, world.arrival(k) + congested);
        }
        let error_ns = world.error_ns(&estimator, 5000);
        assert!(error_ns.abs() < 3e3, "{error_ns} ns");
    }

    /// A way that is congested for longer than the earlier windows are kept, and then is not.
    #[test]
    fn a_change_of_the_way_keeps_the_drift() {
        let (mut world, mut estimator) = (World::new(100e-6, 20e3, 7), ArrivalEstimator::new(PERIOD_NS, 1e5));
        for k in 0..6000 {
            let congested = if (3000..3600).contains(&k) { 400_000 } else { 0 };
            estimator.take(k * PERIOD_NS, world.arrival(k) + congested);
            let drift = estimator.at(world.sent_at(k) as u64).unwrap().drift;
            assert!(k < 2500 || (drift - 100e-6).abs() < 60e-6, "frame {k}: {drift}");
        }
        let error_ns = world.error_ns(&estimator, 5999);
        assert!(error_ns.abs() < 5e3, "{error_ns} ns");
    }

    /// A device that was switched off and on again has another phase.
    #[test]
    fn another_phase_replaces_the_earlier_one() {
        let (mut world, mut estimator) = (World::new(0.0, 50e3, 6), ArrivalEstimator::new(PERIOD_NS, 1e5));
        (0..4000).for_each(|k| estimator.take(k * PERIOD_NS, world.arrival(k)));
        world.offset_ns += 700e3;
        (4000..4750).for_each(|k| estimator.take(k * PERIOD_NS, world.arrival(k)));
        let error_ns = world.error_ns(&estimator, 4750);
        assert!(error_ns.abs() < 10e3, "{error_ns} ns");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn no_arrivals_panic_or_give_a_drift_beyond_its_bound(
            frames in prop::collection::vec((any::<u64>(), any::<u64>()), 0..200),
            now_ns: u64,
        ) {
            let mut estimator = ArrivalEstimator::new(PERIOD_NS, 1e5);
            frames.iter().for_each(|(sent_ns, arrived_ns)| estimator.take(*sent_ns, *arrived_ns));
            if let Some(estimate) = estimator.at(now_ns) {
                prop_assert!(estimate.drift.abs() <= DRIFT_MAX);
            }
        }
    }
}
