//! The clock of a joined host: decides when to request the launching host's time, and corrects this host's clock to it.
//!
//! Must not step the clock once ticks may run.

use super::offset::{Estimate, Exchange, OffsetEstimator};
use super::report::ClockStatistics;
use crate::clock::{Correction, RunClock, tai_offset_ns};
use crate::config::{ClockKind, ClockSource};
use crate::scenario::Scenario;

/// Pause between two time requests, ns: until the clock is set, and from then on.
const FIRST_REQUEST_NS: u64 = 4_000_000;
const REQUEST_NS: u64 = 50_000_000;
/// Duration of measurement before the clock is set, ns.
const SETTING_NS: u64 = 600_000_000;
/// Time for which a connection that is too slow is measured before the host is refused, ns: machines are busy during a start.
const REFUSED_NS: u64 = 10_000_000_000;
/// Pause between two corrections, and the time in which one removes the error, ns.
const CORRECT_NS: u64 = 100_000_000;
const CATCH_UP_NS: f64 = 5e8;
/// Interval of the track's entries, ns, and their largest number.
const TRACK_NS: u64 = 1_000_000_000;
const TRACK_ENTRIES: usize = 3600;

/// Reasons to refuse a host because of its clock.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum ClockError {
    /// The connection is too slow for the budget.
    #[error(
        "the connection to the launching host is too slow: a message takes {way_us:.0} us, the clock error is up to {error_us:.0} us, and a \
         budget of {ticks} ticks leaves {available_us:.0} us up to the cutoff; raise the budget in [network], or use a faster network"
    )]
    #[strum(serialize = "clock-budget")]
    Budget {
        /// Half the fastest round trip, µs.
        way_us: f64,
        /// The bound on the error, µs.
        error_us: f64,
        /// The part of the budget up to the cutoff, µs.
        available_us: f64,
        /// The budget, ticks.
        ticks: u64,
    },
    /// CLOCK_TAI is not synchronised.
    #[error(
        "CLOCK_TAI of this host and of the launching host differ by {apart_us:.0} us, measured over the network to {error_us:.0} us; start \
         ptp4l and phc2sys on both, or set network.clock_source = \"estimated\""
    )]
    #[strum(serialize = "clock-tai")]
    Tai {
        /// The difference, µs.
        apart_us: f64,
        /// The bound on the error, µs.
        error_us: f64,
    },
}

/// A host's clock, and the estimate of the run's.
pub struct HostClock {
    clock: RunClock,
    estimator: OffsetEstimator,
    source: ClockSource,
    /// CLOCK_TAI less the monotonic clock on the launching host, from its last answer, ns.
    tai_there_ns: i64,
    /// The part of the budget that a message and the clock's error may use in real time, ns.
    available_ns: f64,
    budget_ticks: u64,
    realtime: bool,
    began_ns: Option<u64>,
    next_request_ns: u64,
    next_correction_ns: u64,
    next_track_ns: u64,
    set: bool,
    report: ClockStatistics,
}

impl HostClock {
    /// Creates the clock of a host in a run of a scenario.
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
            available_ns: ticks * scenario.period_ns as f64,
            budget_ticks,
            realtime: scenario.clock == ClockKind::Realtime,
            began_ns: None,
            next_request_ns: 0,
            next_correction_ns: 0,
            next_track_ns: 0,
            set: false,
            report: ClockStatistics { source: source.to_owned(), ..ClockStatistics::default() },
        }
    }

    /// Returns true if a time request is due, and schedules the next one.
    pub fn is_request_due(&mut self, now_ns: u64) -> bool {
        let due = now_ns >= self.next_request_ns;
        if due {
            self.next_request_ns = now_ns + if self.set { REQUEST_NS } else { FIRST_REQUEST_NS };
        }
        due
    }

    /// Takes the answer to a time request.
    pub fn take(&mut self, exchange: Exchange, tai_there_ns: i64) {
        self.estimator.take(exchange);
        self.tai_there_ns = tai_there_ns;
    }

    /// Sets the clock once the run's is known well enough. Returns true from then on.
    ///
    /// # Errors
    /// [`ClockError`] if the connection or CLOCK_TAI does not suffice for the run.
    pub fn try_set(&mut self, now_ns: u64) -> Result<bool, ClockError> {
        let began_ns = *self.began_ns.get_or_insert(now_ns);
        if self.set {
            return Ok(true);
        }
        let Some(estimate) = self.estimator.at(now_ns).filter(|_| now_ns >= began_ns + SETTING_NS) else {
            return Ok(false);
        };
        let (way_ns, error_ns) = (estimate.round_trip_ns as f64 / 2.0, estimate.error_ns);
        if self.realtime && way_ns + error_ns > self.available_ns {
            if now_ns < began_ns + REFUSED_NS {
                return Ok(false);
            }
            return Err(ClockError::Budget {
                way_us: way_ns / 1e3,
                error_us: error_ns / 1e3,
                available_us: self.available_ns / 1e3,
                ticks: self.budget_ticks,
            });
        }
        let offset_ns = self.offset_ns(&estimate);
        let apart_ns = (offset_ns - estimate.offset_ns).abs() as f64;
        if apart_ns > error_ns + 1e3 {
            return Err(ClockError::Tai { apart_us: apart_ns / 1e3, error_us: error_ns / 1e3 });
        }
        self.clock.set(Correction::new(now_ns, offset_ns, self.drift(&estimate)));
        self.report.offset_ns = offset_ns;
        self.report.error_us = error_ns / 1e3;
        self.record(&estimate);
        (self.set, self.next_correction_ns) = (true, now_ns + CORRECT_NS);
        Ok(true)
    }

    /// Returns the run's clock less this host's, by the scenario's clock source.
    fn offset_ns(&self, estimate: &Estimate) -> i64 {
        match self.source {
            ClockSource::Estimated => estimate.offset_ns,
            ClockSource::System => tai_offset_ns() - self.tai_there_ns,
        }
    }

    fn drift(&self, estimate: &Estimate) -> f64 {
        if self.source == ClockSource::Estimated { estimate.drift } else { 0.0 }
    }

    fn record(&mut self, estimate: &Estimate) {
        self.report.drift_ppm = estimate.drift * 1e6;
        self.report.error_max_us = self.report.error_max_us.max(estimate.error_ns / 1e3);
        self.report.round_trip_us = estimate.round_trip_ns as f64 / 1e3;
    }

    /// Renews the correction when it is due: the clock changes its rate so that its error is gone after [`CATCH_UP_NS`].
    pub fn track(&mut self, now_ns: u64) {
        if !self.set || now_ns < self.next_correction_ns {
            return;
        }
        self.next_correction_ns = now_ns + CORRECT_NS;
        let Some(estimate) = self.estimator.at(now_ns) else { return };
        let (is_ns, drift) = (self.clock.get().at(now_ns), self.drift(&estimate));
        let error_ns = (self.offset_ns(&estimate) - is_ns) as f64;
        self.clock.set(Correction::new(now_ns, is_ns, drift + error_ns / CATCH_UP_NS));
        self.report.corrections += 1;
        self.report.largest_correction_us = self.report.largest_correction_us.max(error_ns.abs() / 1e3);
        self.record(&estimate);
        if now_ns >= self.next_track_ns && self.report.track.len() < TRACK_ENTRIES {
            self.next_track_ns = now_ns + TRACK_NS;
            let since_s = self.began_ns.map_or(0.0, |began_ns| (now_ns - began_ns) as f64 / 1e9);
            self.report.track.push([since_s, (is_ns - self.report.offset_ns) as f64 / 1e3, estimate.error_ns / 1e3]);
        }
    }

    /// Returns the statistics.
    pub fn statistics(&self) -> ClockStatistics {
        self.report.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    /// The clocks differ by 1000 s and 50 ppm, and messages take 60 to 80 µs: the corrected clock reaches 20 µs, and never runs
    /// backwards.
    #[test]
    fn a_drifting_clock_is_corrected_without_a_step() {
        let directory = tempfile::tempdir().unwrap();
        let scenario = Scenario::parse(SHIPPED[0].1, "x", &[]).unwrap();
        let path = directory.path().join("clock");
        let mut clock = HostClock::new(&scenario, "flight", RunClock::open(&path).unwrap());
        let reader = RunClock::open(&path).unwrap();
        let there = |here_ns: u64| here_ns + 1_000_000_000_000 + here_ns / 20_000;
        let (mut last_ns, mut worst_ns) = (0, 0);
        for now_ns in (1_000_000_000..31_000_000_000_u64).step_by(1_000_000) {
            let [away_ns, back_ns] = [60_000 + now_ns / 1_000_000 % 7 * 3_000, 60_000 + now_ns / 1_000_000 % 5 * 4_000];
            if clock.is_request_due(now_ns) {
                let received_ns = there(now_ns + away_ns);
                let exchange = Exchange {
                    sent_ns: now_ns,
                    received_ns,
                    answered_ns: received_ns + 2_000,
                    returned_ns: now_ns + away_ns + 2_000 + back_ns,
                };
                clock.take(exchange, 0);
            }
            if !clock.try_set(now_ns).unwrap() {
                continue;
            }
            clock.track(now_ns);
            let run_ns = reader.get().apply(now_ns);
            assert!(run_ns > last_ns, "time runs backwards");
            last_ns = run_ns;
            worst_ns = worst_ns.max(run_ns.abs_diff(there(now_ns)));
        }
        assert!(worst_ns < 60_000, "{worst_ns} ns");
        assert!(last_ns.abs_diff(there(30_999_000_000)) < 20_000);
        let report = clock.statistics();
        assert!(
            (report.drift_ppm - 50.0).abs() < 2.0 && report.corrections > 200 && report.track.len() > 25,
            "{report:?}"
        );
    }

    #[test]
    fn a_connection_too_slow_for_the_budget_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let scenario = Scenario::parse(SHIPPED[0].1, "x", &["tick_hz=1000".to_owned()]).unwrap();
        let mut clock = HostClock::new(&scenario, "flight", RunClock::open(&directory.path().join("clock")).unwrap());
        assert!(!clock.try_set(0).unwrap());
        let take = |clock: &mut HostClock, sent_ns: u64, round_trip_ns: u64| {
            let exchange =
                Exchange { sent_ns, received_ns: sent_ns, answered_ns: sent_ns, returned_ns: sent_ns + round_trip_ns };
            clock.take(exchange, 0);
        };
        for sent_ns in (0..SETTING_NS).step_by(10_000_000) {
            take(&mut clock, sent_ns, 2_000_000);
        }
        assert!(!clock.try_set(SETTING_NS).unwrap(), "it may become faster");
        let refused = clock.try_set(REFUSED_NS).unwrap_err();
        assert!(matches!(refused, ClockError::Budget { way_us, .. } if way_us.round() == 1000.0), "{refused}");
        take(&mut clock, REFUSED_NS, 200_000);
        assert!(clock.try_set(REFUSED_NS + 200_000).unwrap(), "it became faster");
    }
}
