//! The clock of a host that joined: asks the host that launched for the time, and keeps the correction of this host's clock.
//!
//! Must not move a clock by a step once ticks may run.

use super::offset::{Estimate, Exchange, OffsetEstimator};
use super::report::ClockReport;
use crate::clock::{Correction, RunClock, tai_offset_ns};
use crate::config::{ClockKind, ClockSource};
use crate::scenario::Scenario;

/// Between two questions for the time, ns: before the ticks, and while they run.
const FIRST_ASK_NS: u64 = 4_000_000;
const ASK_NS: u64 = 50_000_000;
/// How long it asks before the first answer is believed, ns.
const FIRST_NS: u64 = 600_000_000;
/// Time for which a way that takes too long is measured again before the host is refused, ns: a machine is busy at first.
const REFUSED_NS: u64 = 10_000_000_000;
/// Between two corrections, and how long one takes to act, ns.
const CORRECT_NS: u64 = 100_000_000;
const CATCH_UP_NS: f64 = 5e8;
/// A line of the track each, ns, and how many at the most.
const TRACK_NS: u64 = 1_000_000_000;
const TRACK_LINES: usize = 3600;

/// Why a host's clock is of no use to a run.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum ClockRefused {
    /// The way takes too long.
    #[error(
        "a message takes {way_us:.0} us to the host that launched, and its time is known to {error_us:.0} us; together that is more than \
         {part_us:.0} us, the part of a budget of {ticks} ticks up to the cutoff; raise the budget in [network], or take a faster network"
    )]
    #[strum(serialize = "clock-budget")]
    Budget {
        /// Half the fastest way there and back, µs.
        way_us: f64,
        /// The bound on the error, µs.
        error_us: f64,
        /// What there is of the budget, µs.
        part_us: f64,
        /// The budget.
        ticks: u64,
    },
    /// CLOCK_TAI is not kept.
    #[error(
        "CLOCK_TAI of this host and of the one that launched are {apart_us:.0} us apart, as the network shows to {error_us:.0} us; start \
         ptp4l and phc2sys on both, or take network.clock_source = \"estimated\""
    )]
    #[strum(serialize = "clock-tai")]
    Tai {
        /// The difference, µs.
        apart_us: f64,
        /// The bound on the error, µs.
        error_us: f64,
    },
}

/// The host's clock, and what is known of that of the run.
pub struct Timing {
    clock: RunClock,
    estimator: OffsetEstimator,
    source: ClockSource,
    /// From the monotonic clock to CLOCK_TAI where the run was launched, as told last, ns.
    tai_there_ns: i64,
    /// What there is of the budget for a way and the clock's error, ns, in real time.
    part_ns: f64,
    budget_ticks: u64,
    realtime: bool,
    began_ns: Option<u64>,
    next_ask_ns: u64,
    next_correction_ns: u64,
    next_track_ns: u64,
    set: bool,
    report: ClockReport,
}

impl Timing {
    /// That of a host in a run of a scenario.
    pub fn new(scenario: &Scenario, host: &str, clock: RunClock) -> Self {
        let (network, budget_ticks) = (&scenario.hosts.network, scenario.hosts.least_budget(host));
        let ticks = scenario.realtime.cutoff + (budget_ticks - 1) as f64;
        let source = match network.clock_source {
            ClockSource::Estimated => "estimated",
            ClockSource::System => "system",
        };
        Self {
            clock,
            estimator: OffsetEstimator::default(),
            source: network.clock_source,
            tai_there_ns: 0,
            part_ns: ticks * scenario.period_ns as f64,
            budget_ticks,
            realtime: scenario.clock == ClockKind::Realtime,
            began_ns: None,
            next_ask_ns: 0,
            next_correction_ns: 0,
            next_track_ns: 0,
            set: false,
            report: ClockReport { source: source.to_owned(), ..ClockReport::default() },
        }
    }

    /// Whether it is time to ask again.
    pub fn asks(&mut self, now_ns: u64) -> bool {
        let due = now_ns >= self.next_ask_ns;
        if due {
            self.next_ask_ns = now_ns + if self.set { ASK_NS } else { FIRST_ASK_NS };
        }
        due
    }

    /// Takes an answer.
    pub fn take(&mut self, exchange: Exchange, tai_there_ns: i64) {
        self.estimator.take(exchange);
        self.tai_there_ns = tai_there_ns;
    }

    /// Whether the clock of the run is known; sets it once it is.
    ///
    /// # Errors
    /// [`ClockRefused`] if it never will be as well as the run asks for.
    pub fn ready(&mut self, now_ns: u64) -> Result<bool, ClockRefused> {
        let began_ns = *self.began_ns.get_or_insert(now_ns);
        if self.set {
            return Ok(true);
        }
        let Some(estimate) = self.estimator.at(now_ns).filter(|_| now_ns >= began_ns + FIRST_NS) else {
            return Ok(false);
        };
        let (way_ns, error_ns) = (estimate.round_trip_ns as f64 / 2.0, estimate.error_ns);
        if self.realtime && way_ns + error_ns > self.part_ns {
            if now_ns < began_ns + REFUSED_NS {
                return Ok(false);
            }
            return Err(ClockRefused::Budget {
                way_us: way_ns / 1e3,
                error_us: error_ns / 1e3,
                part_us: self.part_ns / 1e3,
                ticks: self.budget_ticks,
            });
        }
        let offset_ns = self.offset_ns(&estimate);
        let apart_ns = (offset_ns - estimate.offset_ns).abs() as f64;
        if apart_ns > error_ns + 1e3 {
            return Err(ClockRefused::Tai { apart_us: apart_ns / 1e3, error_us: error_ns / 1e3 });
        }
        self.clock.set(Correction::new(now_ns, offset_ns, self.drift(&estimate)));
        self.report.offset_ns = offset_ns;
        self.report.error_us = error_ns / 1e3;
        self.note(&estimate);
        (self.set, self.next_correction_ns) = (true, now_ns + CORRECT_NS);
        Ok(true)
    }

    /// The run's clock less this host's, by the source that the scenario names.
    fn offset_ns(&self, estimate: &Estimate) -> i64 {
        match self.source {
            ClockSource::Estimated => estimate.offset_ns,
            ClockSource::System => tai_offset_ns() - self.tai_there_ns,
        }
    }

    fn drift(&self, estimate: &Estimate) -> f64 {
        if self.source == ClockSource::Estimated { estimate.drift } else { 0.0 }
    }

    fn note(&mut self, estimate: &Estimate) {
        self.report.drift_ppm = estimate.drift * 1e6;
        self.report.error_max_us = self.report.error_max_us.max(estimate.error_ns / 1e3);
        self.report.round_trip_us = estimate.round_trip_ns as f64 / 1e3;
    }

    /// Renews the correction now and then: a line from where the clock is to where it should be in a second.
    pub fn track(&mut self, now_ns: u64) {
        if !self.set || now_ns < self.next_correction_ns {
            return;
        }
        self.next_correction_ns = now_ns + CORRECT_NS;
        let Some(estimate) = self.estimator.at(now_ns) else { return };
        let (is_ns, drift) = (self.clock.get().at(now_ns), self.drift(&estimate));
        let lacks_ns = (self.offset_ns(&estimate) - is_ns) as f64;
        self.clock.set(Correction::new(now_ns, is_ns, drift + lacks_ns / CATCH_UP_NS));
        self.report.corrections += 1;
        self.report.largest_correction_us = self.report.largest_correction_us.max(lacks_ns.abs() / 1e3);
        self.note(&estimate);
        if now_ns >= self.next_track_ns && self.report.track.len() < TRACK_LINES {
            self.next_track_ns = now_ns + TRACK_NS;
            let since_s = self.began_ns.map_or(0.0, |began_ns| (now_ns - began_ns) as f64 / 1e9);
            self.report.track.push([since_s, (is_ns - self.report.offset_ns) as f64 / 1e3, estimate.error_ns / 1e3]);
        }
    }

    /// What is known of the clock.
    pub fn report(&self) -> ClockReport {
        self.report.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    /// A clock 1000 s apart that drifts by 50 ppm, seen over a network of 60 to 80 µs, is corrected to within 20 µs, by a time that
    /// never goes back.
    #[test]
    fn a_drifting_clock_is_corrected_without_a_step() {
        let directory = tempfile::tempdir().unwrap();
        let scenario = Scenario::parse(SHIPPED[0].1, "x", &[]).unwrap();
        let path = directory.path().join("clock");
        let mut timing = Timing::new(&scenario, "flight", RunClock::open(&path).unwrap());
        let read = RunClock::open(&path).unwrap();
        let there = |here_ns: u64| here_ns + 1_000_000_000_000 + here_ns / 20_000;
        let (mut last_ns, mut worst_ns) = (0, 0);
        for now_ns in (1_000_000_000..31_000_000_000_u64).step_by(1_000_000) {
            let [away_ns, back_ns] = [60_000 + now_ns / 1_000_000 % 7 * 3_000, 60_000 + now_ns / 1_000_000 % 5 * 4_000];
            if timing.asks(now_ns) {
                let came_ns = there(now_ns + away_ns);
                let exchange = Exchange {
                    sent_ns: now_ns,
                    received_ns: came_ns,
                    answered_ns: came_ns + 2_000,
                    returned_ns: now_ns + away_ns + 2_000 + back_ns,
                };
                timing.take(exchange, 0);
            }
            if !timing.ready(now_ns).unwrap() {
                continue;
            }
            timing.track(now_ns);
            let run_ns = read.get().apply(now_ns);
            assert!(run_ns > last_ns, "the time goes back");
            last_ns = run_ns;
            worst_ns = worst_ns.max(run_ns.abs_diff(there(now_ns)));
        }
        assert!(worst_ns < 60_000, "{worst_ns} ns");
        assert!(last_ns.abs_diff(there(30_999_000_000)) < 20_000);
        let report = timing.report();
        assert!(
            (report.drift_ppm - 50.0).abs() < 2.0 && report.corrections > 200 && report.track.len() > 25,
            "{report:?}"
        );
    }

    #[test]
    fn a_budget_that_no_way_could_keep_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let scenario = Scenario::parse(SHIPPED[0].1, "x", &["tick_hz=1000".to_owned()]).unwrap();
        let mut timing = Timing::new(&scenario, "flight", RunClock::open(&directory.path().join("clock")).unwrap());
        assert!(!timing.ready(0).unwrap());
        let take = |timing: &mut Timing, sent_ns: u64, round_trip_ns: u64| {
            let exchange =
                Exchange { sent_ns, received_ns: sent_ns, answered_ns: sent_ns, returned_ns: sent_ns + round_trip_ns };
            timing.take(exchange, 0);
        };
        for sent_ns in (0..FIRST_NS).step_by(10_000_000) {
            take(&mut timing, sent_ns, 2_000_000);
        }
        assert!(!timing.ready(FIRST_NS).unwrap(), "it may get better");
        let refused = timing.ready(REFUSED_NS).unwrap_err().to_string();
        assert!(refused.contains("takes 1000 us") && refused.contains("raise the budget"), "{refused}");
        take(&mut timing, REFUSED_NS, 200_000);
        assert!(timing.ready(REFUSED_NS + 200_000).unwrap(), "it got better");
    }
}
