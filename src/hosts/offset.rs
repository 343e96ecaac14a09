//! How far two clocks are apart, from messages there and back with four time stamps: pure arithmetic, and bounds that hold whatever the
//! network does.
//!
//! Of one exchange the offset is known to half its round trip, and no better: the ways there and back may differ by all of it. So the
//! fastest exchange of each window is kept, and a line through these is the offset with its drift. Must not read a clock.

use std::collections::VecDeque;

/// A window of which the fastest exchange is kept, ns.
const WINDOW_NS: u64 = 500_000_000;
/// Windows that are kept: long enough for the drift, short enough for a drift that changes with temperature.
const WINDOWS: usize = 24;
/// Over less than this a drift is not told from jitter, ns.
const DRIFT_SPAN_NS: f64 = 1e9;
/// What two clocks of computers drift apart at the most, ns per ns: quartz is within 100 ppm.
const DRIFT_MAX: f64 = 200e-6;
/// Exchanges before anything is said.
const ENOUGH: usize = 20;
/// A part of the least round trip by which exchanges count as equally fast.
const SIMILAR: f64 = 0.15;

/// The time stamps of a message and its answer, ns: sent here, received there, answered there, received here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exchange {
    /// When the message was sent, on the clock here.
    pub sent_ns: u64,
    /// When it came, on the clock there.
    pub received_ns: u64,
    /// When the answer was sent, on the clock there.
    pub answered_ns: u64,
    /// When the answer came, on the clock here.
    pub returned_ns: u64,
}

impl Exchange {
    /// The time on the way, ns; none of stamps that cannot be.
    pub fn round_trip_ns(&self) -> Option<u64> {
        let [away, there] =
            [self.returned_ns.checked_sub(self.sent_ns)?, self.answered_ns.checked_sub(self.received_ns)?];
        away.checked_sub(there)
    }

    /// The clock there less the clock here, ns, if both ways take as long.
    fn offset_ns(&self) -> i64 {
        let [there, back] = [
            self.received_ns.wrapping_sub(self.sent_ns) as i64,
            self.answered_ns.wrapping_sub(self.returned_ns) as i64,
        ];
        // Halved first: the sum of two offsets to the year 1970 has no room.
        there / 2 + back / 2
    }
}

/// What is known of the other clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// It less the clock here, ns.
    pub offset_ns: i64,
    /// By how much that changes, ns per ns.
    pub drift: f64,
    /// The offset is wrong by no more than this, ns.
    pub error_ns: f64,
    /// The fastest exchange of late, ns.
    pub round_trip_ns: u64,
}

/// The fastest exchange of a window.
#[derive(Debug, Clone, Copy)]
struct Fastest {
    window: u64,
    /// In the middle of the exchange, on the clock here, since the first one, ns.
    at_ns: f64,
    /// Beyond the offset of the first one, ns.
    offset_ns: f64,
    round_trip_ns: f64,
}

impl Fastest {
    /// What it leaves open of the offset in its middle, ns: half the way, and what clocks drift on it.
    fn open_ns(&self) -> f64 {
        self.round_trip_ns * (0.5 + DRIFT_MAX)
    }
}

/// Estimates the offset of one clock.
#[derive(Debug, Default)]
pub struct OffsetEstimator {
    /// The first exchange: what all others are told relative to.
    origin: Option<(u64, i64)>,
    fastest: VecDeque<Fastest>,
    taken: usize,
}

impl OffsetEstimator {
    /// Takes an exchange; of one that cannot be, nothing.
    pub fn take(&mut self, exchange: Exchange) {
        let Some(round_trip_ns) = exchange.round_trip_ns() else { return };
        let (origin_ns, origin_offset_ns) = *self.origin.get_or_insert((exchange.sent_ns, exchange.offset_ns()));
        let since_ns = |time_ns: u64| time_ns.wrapping_sub(origin_ns) as i64 as f64;
        let found = Fastest {
            window: exchange.returned_ns / WINDOW_NS,
            at_ns: (since_ns(exchange.sent_ns) + since_ns(exchange.returned_ns)) / 2.0,
            offset_ns: exchange.offset_ns().wrapping_sub(origin_offset_ns) as f64,
            round_trip_ns: round_trip_ns as f64,
        };
        self.taken += 1;
        match self.fastest.back_mut().filter(|last| last.window == found.window) {
            Some(last) if last.round_trip_ns <= found.round_trip_ns => {}
            Some(last) => *last = found,
            None => self.fastest.push_back(found),
        }
        if self.fastest.len() > WINDOWS {
            self.fastest.pop_front();
        }
    }

    /// What is known at a time on the clock here; none before enough has been exchanged.
    pub fn at(&self, now_ns: u64) -> Option<Estimate> {
        let (origin_ns, origin_offset_ns) = self.origin.filter(|_| self.taken >= ENOUGH)?;
        let now = now_ns.wrapping_sub(origin_ns) as i64 as f64;
        let least_ns = self.fastest.iter().map(|point| point.round_trip_ns).fold(f64::INFINITY, f64::min);
        let (offset, drift) = self.line(least_ns);
        let drift_error = self.drift_error(drift);
        // Any of them bounds the offset of its own time, and with the drift that of now.
        let bound = |point: &Fastest| {
            let missed = (offset + drift * point.at_ns - point.offset_ns).abs();
            point.open_ns() + missed + drift_error * (now - point.at_ns).abs()
        };
        let error_ns = self.fastest.iter().map(bound).fold(f64::INFINITY, f64::min);
        let offset_ns = origin_offset_ns.wrapping_add((offset + drift * now).round() as i64);
        Some(Estimate { offset_ns, drift, error_ns, round_trip_ns: least_ns as u64 })
    }

    /// By how much a drift can be wrong: any two exchanges bound it.
    fn drift_error(&self, drift: f64) -> f64 {
        let pairs = self.fastest.iter().enumerate().flat_map(|(n, a)| self.fastest.range(..n).map(move |b| (a, b)));
        let bound = |(a, b): (&Fastest, &Fastest)| {
            let apart_ns = a.at_ns - b.at_ns;
            (drift - (a.offset_ns - b.offset_ns) / apart_ns).abs() + (a.open_ns() + b.open_ns()) / apart_ns
        };
        pairs.filter(|(a, b)| a.at_ns > b.at_ns).map(bound).fold(drift.abs() + DRIFT_MAX, f64::min)
    }

    /// The line of least squares, where a slow exchange weighs less by what it leaves open: offset at the origin, and drift.
    fn line(&self, least_ns: f64) -> (f64, f64) {
        let weight = |point: &Fastest| {
            let open = (point.round_trip_ns - least_ns) / (SIMILAR * least_ns + 1.0);
            1.0 / (1.0 + open * open)
        };
        let sum =
            |of: &dyn Fn(&Fastest) -> f64| self.fastest.iter().map(|point| weight(point) * of(point)).sum::<f64>();
        let total = sum(&|_| 1.0);
        let (time, offset) = (sum(&|point| point.at_ns) / total, sum(&|point| point.offset_ns) / total);
        let spread = sum(&|point| (point.at_ns - time).powi(2));
        let together = sum(&|point| (point.at_ns - time) * (point.offset_ns - offset));
        let span_ns = match (self.fastest.front(), self.fastest.back()) {
            (Some(first), Some(last)) => last.at_ns - first.at_ns,
            _ => 0.0,
        };
        if span_ns < DRIFT_SPAN_NS {
            // The newest of the fast ones has drifted least.
            let fast = |point: &&Fastest| point.round_trip_ns <= (1.0 + SIMILAR) * least_ns;
            return (self.fastest.iter().rev().find(fast).map_or(offset, |point| point.offset_ns), 0.0);
        }
        let drift = (together / spread).clamp(-DRIFT_MAX, DRIFT_MAX);
        (offset - drift * time, drift)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand_pcg::Pcg64;
    use rand_pcg::rand_core::Rng;

    /// Two clocks, and a network with queues: mostly fast, now and then slow, one way or the other.
    struct World {
        offset_ns: i64,
        drift: f64,
        base_ns: f64,
        jitter_ns: f64,
        random: Pcg64,
    }

    impl World {
        fn uniform(&mut self) -> f64 {
            (self.random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
        }

        fn there(&self, here_ns: f64) -> u64 {
            (here_ns + self.drift * here_ns) as u64 + self.offset_ns as u64
        }

        fn way(&mut self) -> f64 {
            let queue = -self.uniform().max(1e-12).ln();
            let held_up = if self.uniform() < 0.05 { 20.0 } else { 1.0 };
            self.base_ns + self.jitter_ns * queue * held_up
        }

        fn exchange(&mut self, at_ns: f64) -> Exchange {
            let (away, held, back) = (self.way(), 5_000.0, self.way());
            Exchange {
                sent_ns: at_ns as u64,
                received_ns: self.there(at_ns + away),
                answered_ns: self.there(at_ns + away + held),
                returned_ns: (at_ns + away + held + back) as u64,
            }
        }
    }

    /// The largest errors after the first second: of the offset, and of the bound that was told, which must cover it.
    fn follow(mut world: World, seconds: u64) -> (f64, f64) {
        let mut estimator = OffsetEstimator::default();
        let (mut worst, mut told) = (0.0_f64, 0.0_f64);
        for step in 0..seconds * 20 {
            let at_ns = 5e12 + step as f64 * 5e7;
            estimator.take(world.exchange(at_ns));
            if step < 20 {
                continue;
            }
            let now_ns = at_ns as u64 + 10_000_000;
            let estimate = estimator.at(now_ns).unwrap();
            let truth = world.there(now_ns as f64).wrapping_sub(now_ns) as i64;
            let error = (estimate.offset_ns - truth).abs() as f64;
            assert!(error <= estimate.error_ns + 2.0, "wrong by {error} ns, told {} ns", estimate.error_ns);
            (worst, told) = (worst.max(error), told.max(estimate.error_ns));
        }
        (worst, told)
    }

    #[test]
    fn clocks_that_drift_by_50_ppm_are_followed() {
        let world = World {
            offset_ns: 1_000_000_000_000,
            drift: 50e-6,
            base_ns: 60_000.0,
            jitter_ns: 20_000.0,
            random: Pcg64::new(1, 1),
        };
        let (worst, told) = follow(world, 60);
        assert!(worst < 60_000.0 && told < 300_000.0, "wrong by at most {worst} ns, told {told} ns");
    }

    #[test]
    fn the_drift_is_found() {
        let mut world =
            World { offset_ns: 7, drift: 50e-6, base_ns: 60_000.0, jitter_ns: 5_000.0, random: Pcg64::new(2, 1) };
        let mut estimator = OffsetEstimator::default();
        (0..400).for_each(|step| estimator.take(world.exchange(5e12 + f64::from(step) * 5e7)));
        let drift = estimator.at(5_020_000_000_000).unwrap().drift;
        assert!((drift - 50e-6).abs() < 1e-6, "{drift}");
    }

    #[test]
    fn stamps_that_cannot_be_are_left_out_and_few_say_nothing() {
        let mut estimator = OffsetEstimator::default();
        let stamps = |sent_ns, received_ns, answered_ns, returned_ns| Exchange {
            sent_ns,
            received_ns,
            answered_ns,
            returned_ns,
        };
        for broken in [stamps(10, 0, 0, 5), stamps(0, 9, 5, 10), stamps(0, 0, 50, 10)] {
            (0..2 * ENOUGH).for_each(|_| estimator.take(broken));
        }
        assert!(estimator.at(0).is_none());
        (1..ENOUGH).for_each(|_| estimator.take(stamps(0, 100, 101, 10)));
        assert!(estimator.at(0).is_none());
        estimator.take(stamps(0, 100, 101, 10));
        let estimate = estimator.at(5).unwrap();
        assert!((estimate.offset_ns - 95).abs() <= 1 && estimate.round_trip_ns == 9, "{estimate:?}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Whatever the clocks and the network: what is told covers what is.
        #[test]
        fn the_bound_holds(
            offset_ns in -4_000_000_000_000_i64..4_000_000_000_000_000,
            drift in -150e-6..150e-6_f64,
            base_ns in 1_000.0..5e6_f64,
            jitter_ns in 0.0..2e6_f64,
            seed: u64,
        ) {
            follow(World { offset_ns, drift, base_ns, jitter_ns, random: Pcg64::new(seed.into(), 1) }, 20);
        }
    }
}
