//! How late this machine is: bare absolute sleeps at a run's period, with the privileges that a run's role is granted.
//!
//! Must not hide anything: every wake counts, from when it was due.

use super::Check;
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::Scenario;
use crate::runtime::{RoleId, hold_low_latency_idle, release_priority, take_privileges};
use crate::telemetry::{Grant, Latency, Percentiles};
use serde::Serialize;
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Between two words on how far it is.
const WORD: Duration = Duration::from_millis(100);

/// What was measured.
#[derive(Debug, Clone, Serialize)]
pub struct Lateness {
    /// From one wake to the next, µs.
    pub period_us: f64,
    /// Wakes that came a whole period late or more: ticks that would have been missed.
    pub missed: u64,
    /// Wake − due.
    pub percentiles: Percentiles,
    /// What was asked of the machine for it, and what it granted.
    pub grants: Vec<Grant>,
}

/// Sleeps for so many seconds as the first plant of a scenario would. `progress` hears how far it is, 0 to 1.
///
/// # Errors
/// The system's reason why there is no thread.
pub fn measure(scenario: &Scenario, seconds: f64, progress: &mut dyn FnMut(f64)) -> io::Result<Lateness> {
    let wakes = ((seconds * 1e9 / scenario.period_ns as f64) as u64).max(1);
    let done = AtomicU64::new(0);
    // A thread of its own takes the privileges, so that whoever shows the progress has none.
    std::thread::scope(|scope| {
        let probe = std::thread::Builder::new().spawn_scoped(scope, || probe(scenario, wakes, &done))?;
        while !probe.is_finished() {
            progress(done.load(Ordering::Relaxed) as f64 / wakes as f64);
            std::thread::park_timeout(WORD);
        }
        Ok(probe.join().expect("the probe only sleeps and counts"))
    })
}

fn probe(scenario: &Scenario, wakes: u64, done: &AtomicU64) -> Lateness {
    let (_low_latency, mut grants) = hold_low_latency_idle(&scenario.realtime);
    grants.extend(take_privileges(scenario, RoleId::Plant(0)).grants);
    let (mut latency, mut missed) = (Latency::default(), 0);
    let mut due_ns = monotonic_ns();
    for wake in 0..wakes {
        due_ns += scenario.period_ns;
        sleep_until(due_ns);
        let now_ns = monotonic_ns();
        latency.record(due_ns, now_ns);
        missed += u64::from(now_ns.saturating_sub(due_ns) >= scenario.period_ns);
        done.store(wake + 1, Ordering::Relaxed);
    }
    release_priority();
    Lateness { period_us: scenario.period_ns as f64 / 1e3, missed, percentiles: latency.percentiles(), grants }
}

impl Lateness {
    /// The verdict: a wake that is half a period late leaves too little time for the others of its tick.
    pub fn check(&self) -> Check {
        let name = "lateness";
        let Percentiles { count, p50_us, p99_us, p999_us, max_us, .. } = self.percentiles;
        let denied: Vec<&str> = self.grants.iter().filter(|g| !g.granted).map(|g| g.privilege.as_str()).collect();
        let with = match denied.as_slice() {
            [] => "all privileges".to_owned(),
            denied => format!("no {}", denied.join(", no ")),
        };
        let found = format!(
            "p50 {p50_us:.0}, p99 {p99_us:.0}, p99.9 {p999_us:.0}, max {max_us:.0} us in {count} wakes each {:.0} us, {} missed, with {with}",
            self.period_us, self.missed
        );
        let half_us = self.period_us / 2.0;
        let remedy = "see the lines above, or lower tick_hz";
        if max_us <= half_us {
            Check::ok(name, found)
        } else if p999_us <= half_us {
            Check::warn(
                name,
                found,
                format!("fewer than one tick in 1000 is late by more than {half_us:.0} us: {remedy}"),
            )
        } else {
            Check::bad(
                name,
                found,
                format!("more than one tick in 1000 is late by more than {half_us:.0} us: {remedy}"),
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Verdict;
    use super::*;
    use crate::config::SHIPPED;

    /// A measurement of a thousand wakes per entry.
    fn of(lateness_us: &[u64]) -> Lateness {
        let mut latency = Latency::default();
        for us in lateness_us {
            latency.record(0, us * 1000);
        }
        Lateness { period_us: 1000.0, missed: 0, percentiles: latency.percentiles(), grants: Vec::new() }
    }

    #[test]
    fn the_verdict_is_by_the_tail() {
        let quiet = vec![5; 10_000];
        assert_eq!(of(&quiet).check().verdict, Verdict::Ok);
        let once = [&quiet[..], &[700]].concat();
        assert_eq!(of(&once).check().verdict, Verdict::Warn, "one wake in 10001");
        let often = [&quiet[..], &[700; 20]].concat();
        assert_eq!(of(&often).check().verdict, Verdict::Bad, "two wakes in 1000");
    }

    #[test]
    fn every_wake_is_measured_and_what_was_denied_is_named() {
        let overrides = ["tick_hz=1000", "realtime.cores=[1023]", "realtime.priority=0"].map(str::to_owned);
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &overrides).unwrap();
        let mut last = 0.0;
        let lateness = measure(&scenario, 0.05, &mut |done| last = done).unwrap();
        assert_eq!(lateness.percentiles.count, 50);
        assert!((0.0..=1.0).contains(&last));
        assert!(lateness.check().found.contains("no core"), "{:?}", lateness.check());
    }
}
