//! Estimates the offset between two clocks from messages and answers with four time stamps. Pure arithmetic; the error bounds hold for
//! every network.
//!
//! One exchange gives the offset to half its round trip and no better, because all of it may be spent in one direction. So the fastest
//! exchange of each window is kept, and a line through these gives offset and drift. Must not read a clock.

use crate::clock::{MinimumFilter, Observation};

/// Length of a window, of which the fastest exchange is kept, ns.
const WINDOW_NS: u64 = 500_000_000;
/// Largest drift between two computer clocks, ns per ns: each quartz is within 100 ppm.
const DRIFT_MAX: f64 = 200e-6;
/// Number of exchanges before the first estimate.
const ENOUGH: usize = 20;
/// Fraction of the shortest round trip within which exchanges count as equally fast.
const SIMILAR: f64 = 0.15;

/// The time stamps of a message to the remote host and its answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exchange {
    /// When the message was sent, on the local clock, ns.
    pub sent_ns: u64,
    /// When it arrived, on the remote clock, ns.
    pub received_ns: u64,
    /// When the answer was sent, on the remote clock, ns.
    pub answered_ns: u64,
    /// When the answer arrived, on the local clock, ns.
    pub returned_ns: u64,
}

impl Exchange {
    /// Returns the time spent on the network, ns; `None` if the stamps are impossible.
    pub fn round_trip_ns(&self) -> Option<u64> {
        let [total, remote] =
            [self.returned_ns.checked_sub(self.sent_ns)?, self.answered_ns.checked_sub(self.received_ns)?];
        total.checked_sub(remote)
    }

    /// Returns the remote clock less the local one, ns, if both directions take equally long.
    fn offset_ns(&self) -> i64 {
        let [forward, back] = [
            self.received_ns.wrapping_sub(self.sent_ns) as i64,
            self.answered_ns.wrapping_sub(self.returned_ns) as i64,
        ];
        // Halved first: the sum of two offsets as large as the time since 1970 would overflow.
        forward / 2 + back / 2
    }
}

/// The estimate of the remote clock at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The remote clock less the local one, ns.
    pub offset_ns: i64,
    /// Change of the offset, ns per ns.
    pub drift: f64,
    /// Bound on the offset's error, ns.
    pub error_ns: f64,
    /// The shortest recent round trip, ns.
    pub round_trip_ns: u64,
}

/// Returns the bound on the error of the offset of an exchange, ns: half the round trip, and the largest drift during it.
fn error_ns(exchange: &Observation) -> f64 {
    exchange.delay_ns * (0.5 + DRIFT_MAX)
}

/// An estimator of the offset and drift of one remote clock.
#[derive(Debug, Default)]
pub struct OffsetEstimator {
    /// Time and offset of the first exchange; those in `fastest` are relative to it.
    origin: Option<(u64, i64)>,
    /// The fastest exchange of each window: at its middle on the local clock, delayed by its round trip.
    fastest: MinimumFilter,
    taken: usize,
}

impl OffsetEstimator {
    /// Takes an exchange; ignores one with impossible stamps.
    pub fn take(&mut self, exchange: Exchange) {
        let Some(round_trip_ns) = exchange.round_trip_ns() else { return };
        let (origin_ns, origin_offset_ns) = *self.origin.get_or_insert((exchange.sent_ns, exchange.offset_ns()));
        let since_ns = |time_ns: u64| time_ns.wrapping_sub(origin_ns) as i64 as f64;
        self.taken += 1;
        self.fastest.take(Observation {
            window: exchange.returned_ns / WINDOW_NS,
            at_ns: (since_ns(exchange.sent_ns) + since_ns(exchange.returned_ns)) / 2.0,
            offset_ns: exchange.offset_ns().wrapping_sub(origin_offset_ns) as f64,
            delay_ns: round_trip_ns as f64,
        });
    }

    /// Returns the estimate at a time on the local clock; `None` before enough exchanges.
    pub fn at(&self, now_ns: u64) -> Option<Estimate> {
        let (origin_ns, origin_offset_ns) = self.origin.filter(|_| self.taken >= ENOUGH)?;
        let now = now_ns.wrapping_sub(origin_ns) as i64 as f64;
        let kept = self.fastest.kept();
        let least_ns = kept.iter().map(|exchange| exchange.delay_ns).fold(f64::INFINITY, f64::min);
        let line = self.fastest.line(DRIFT_MAX, |exchange| {
            let excess = (exchange.delay_ns - least_ns) / (SIMILAR * least_ns + 1.0);
            1.0 / (1.0 + excess * excess)
        });
        let drift_error = self.drift_error(line.drift);
        // Each kept exchange bounds the offset at its own time, and with the drift the offset at `now_ns`.
        let bound = |exchange: &Observation| {
            let residual = (line.at(exchange.at_ns) - exchange.offset_ns).abs();
            error_ns(exchange) + residual + drift_error * (now - exchange.at_ns).abs()
        };
        let error_ns = kept.iter().map(bound).fold(f64::INFINITY, f64::min);
        let offset_ns = origin_offset_ns.wrapping_add(line.at(now).round() as i64);
        Some(Estimate { offset_ns, drift: line.drift, error_ns, round_trip_ns: least_ns as u64 })
    }

    /// Returns a bound on the error of a drift: any two exchanges give one.
    fn drift_error(&self, drift: f64) -> f64 {
        let kept = self.fastest.kept();
        let pairs = kept.iter().enumerate().flat_map(|(n, a)| kept.range(..n).map(move |b| (a, b)));
        let bound = |(a, b): (&Observation, &Observation)| {
            let apart_ns = a.at_ns - b.at_ns;
            (drift - (a.offset_ns - b.offset_ns) / apart_ns).abs() + (error_ns(a) + error_ns(b)) / apart_ns
        };
        pairs.filter(|(a, b)| a.at_ns > b.at_ns).map(bound).fold(drift.abs() + DRIFT_MAX, f64::min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand_pcg::Pcg64;
    use rand_pcg::rand_core::Rng;

    /// Two clocks, and a network with queues: mostly fast, at times slow, in either direction.
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

        fn remote(&self, here_ns: f64) -> u64 {
            (here_ns + self.drift * here_ns) as u64 + self.offset_ns as u64
        }

        fn one_way(&mut self) -> f64 {
            let queue = -self.uniform().max(1e-12).ln();
            let congestion = if self.uniform() < 0.05 { 20.0 } else { 1.0 };
            self.base_ns + self.jitter_ns * queue * congestion
        }

        fn exchange(&mut self, at_ns: f64) -> Exchange {
            let (away, answering, back) = (self.one_way(), 5_000.0, self.one_way());
            Exchange {
                sent_ns: at_ns as u64,
                received_ns: self.remote(at_ns + away),
                answered_ns: self.remote(at_ns + away + answering),
                returned_ns: (at_ns + away + answering + back) as u64,
            }
        }
    }

    /// Returns the largest error of the offset and the largest bound after the first second. Panics if the bound does not hold.
    fn follow(mut world: World, seconds: u64) -> (f64, f64) {
        let mut estimator = OffsetEstimator::default();
        let (mut worst, mut bound) = (0.0_f64, 0.0_f64);
        for step in 0..seconds * 20 {
            let at_ns = 5e12 + step as f64 * 5e7;
            estimator.take(world.exchange(at_ns));
            if step < 20 {
                continue;
            }
            let now_ns = at_ns as u64 + 10_000_000;
            let estimate = estimator.at(now_ns).unwrap();
            let truth = world.remote(now_ns as f64).wrapping_sub(now_ns) as i64;
            let error = (estimate.offset_ns - truth).abs() as f64;
            assert!(error <= estimate.error_ns + 2.0, "error {error} ns, bound {} ns", estimate.error_ns);
            (worst, bound) = (worst.max(error), bound.max(estimate.error_ns));
        }
        (worst, bound)
    }

    #[test]
    fn error_and_bound_stay_small_at_a_drift_of_50_ppm() {
        let world = World {
            offset_ns: 1_000_000_000_000,
            drift: 50e-6,
            base_ns: 60_000.0,
            jitter_ns: 20_000.0,
            random: Pcg64::new(1, 1),
        };
        let (worst, bound) = follow(world, 60);
        assert!(worst < 60_000.0 && bound < 300_000.0, "error at most {worst} ns, bound {bound} ns");
    }

    #[test]
    fn the_drift_is_estimated_to_1_ppm() {
        let mut world =
            World { offset_ns: 7, drift: 50e-6, base_ns: 60_000.0, jitter_ns: 5_000.0, random: Pcg64::new(2, 1) };
        let mut estimator = OffsetEstimator::default();
        (0..400).for_each(|step| estimator.take(world.exchange(5e12 + f64::from(step) * 5e7)));
        let drift = estimator.at(5_020_000_000_000).unwrap().drift;
        assert!((drift - 50e-6).abs() < 1e-6, "{drift}");
    }

    #[test]
    fn impossible_stamps_are_ignored_and_few_exchanges_give_no_estimate() {
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

        #[test]
        fn the_bound_holds_for_all_clocks_and_networks(
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
