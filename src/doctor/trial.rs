//! The trial run: a few seconds of the scenario in real time, and the ticks that were missed.
//!
//! Must not start the run, and must judge only what ran.

use super::check::Check;
use crate::telemetry::{Grant, Latency, Percentiles, RoleReport, Ticks};
use serde::Serialize;
use std::collections::BTreeMap;

/// The share of a role's ticks, missed or starved, from which the machine is unfit.
const SHARE_MAX: f64 = 1e-3;

/// The reports of the roles.
#[derive(Debug, Clone, Serialize)]
pub struct Trial {
    /// Ticks per second.
    pub tick_hz: f64,
    /// The ticks of each role.
    pub ticks: u64,
    /// The role with the most missed or starved ticks.
    pub worst_role: String,
    /// The number of these ticks.
    pub missed: u64,
    /// Their share of its ticks.
    pub missed_share: f64,
    /// The tick counts of all roles.
    pub roles: BTreeMap<String, Ticks>,
    /// The lateness of all bodies: wake time − due time.
    pub lateness: Percentiles,
    /// The requested privileges, granted or not.
    pub grants: Vec<Grant>,
}

impl Trial {
    /// Creates the result from the roles' reports of a run of `ticks` ticks.
    pub fn new(tick_hz: f64, ticks: u64, reports: &[RoleReport], launcher: &[Grant]) -> Self {
        // A tick that a role did not reach counts as missed.
        let missed = |role: &Ticks| role.missed + role.starved + ticks.saturating_sub(role.elapsed);
        let worst = reports.iter().rev().max_by_key(|report| missed(&report.ticks));
        let (worst_role, missed) =
            worst.map_or_else(Default::default, |report| (report.role.clone(), missed(&report.ticks)));
        let mut lateness = Latency::default();
        let stages = reports.iter().flat_map(|report| &report.stages);
        stages.filter(|stage| stage.stage == "lateness").for_each(|stage| lateness.absorb(&stage.latency()));
        let mut grants: Vec<Grant> = Vec::new();
        for grant in launcher.iter().chain(reports.iter().flat_map(|report| &report.grants)) {
            if !grants.contains(grant) {
                grants.push(grant.clone());
            }
        }
        Self {
            tick_hz,
            ticks,
            worst_role,
            missed,
            missed_share: missed as f64 / ticks as f64,
            roles: reports.iter().map(|report| (report.role.clone(), report.ticks)).collect(),
            lateness: lateness.percentiles(),
            grants,
        }
    }

    /// Returns the missed ticks in words.
    pub fn words(&self) -> String {
        let Self { tick_hz, ticks, missed, .. } = self;
        let share = if *missed > 0 { format!(" ({:.2} %)", 1e2 * self.missed_share) } else { String::new() };
        let seconds = (*ticks - 1) as f64 / tick_hz;
        format!("{missed} of {ticks} ticks{share} would be missed in {seconds} s at {tick_hz} Hz")
    }

    /// Returns the line of the report.
    pub fn check(&self) -> Check {
        let mut denied: Vec<&str> = self.grants.iter().filter(|g| !g.granted).map(|g| g.privilege.as_str()).collect();
        denied.sort_unstable();
        denied.dedup();
        let with = match denied.as_slice() {
            [] => "all privileges".to_owned(),
            denied => format!("no {}", denied.join(", no ")),
        };
        let at = if self.missed > 0 { format!(", most at {}", self.worst_role) } else { String::new() };
        let safe: u64 = self.roles.values().map(|role| role.safe).sum();
        let safe_words = if safe > 0 { format!("; {safe} with the safe command") } else { String::new() };
        let Percentiles { p50_us, p99_us, max_us, .. } = self.lateness;
        let found = format!(
            "{}{at}{safe_words}; bodies woke late by p50 {p50_us:.0}, p99 {p99_us:.0}, max {max_us:.0} us, with {with}",
            self.words()
        );
        let remedy = "see the lines above, or lower tick_hz";
        if self.missed == 0 && safe == 0 {
            Check::ok(NAME, found)
        } else if self.missed_share < SHARE_MAX && safe == 0 {
            Check::warn(NAME, found, format!("fewer than one tick in 1000: {remedy}"))
        } else {
            Check::bad(NAME, found, remedy)
        }
    }

    /// Returns the line for a run that failed.
    pub fn failed(reason: String) -> Check {
        Check::bad(NAME, reason, "`corotate run` says more of it")
    }
}

/// The name of the line.
const NAME: &str = "ticks";

#[cfg(test)]
mod tests {
    use super::super::Verdict;
    use super::*;

    fn role(role: &str, ticks: Ticks) -> RoleReport {
        let (role, grant) = (role.to_owned(), |granted| Grant {
            privilege: "core".to_owned(),
            asked: "1".to_owned(),
            granted,
            reason: String::new(),
        });
        let (written, read, stages) = (Vec::new(), Vec::new(), Vec::new());
        RoleReport {
            role,
            ticks,
            written,
            read,
            watchdog: None,
            stages,
            grants: vec![grant(false)],
            line: None,
            outages: Vec::new(),
            pace: None,
            late_inputs: 0,
            late_ticks: Vec::new(),
        }
    }

    #[test]
    fn the_verdict_follows_from_the_missed_ticks() {
        let trial = |missed, starved, safe, elapsed| {
            let whole = Ticks { elapsed: 10_000, executed: 10_000, ..Ticks::default() };
            let ticks = Ticks { elapsed, executed: elapsed - missed, missed, starved, safe, ..Ticks::default() };
            Trial::new(1000.0, 10_000, &[role("leader", whole), role("follower", ticks)], &[])
        };
        let verdict = |trial: Trial| (trial.check().verdict, trial.missed);
        assert_eq!(verdict(trial(0, 0, 0, 10_000)), (Verdict::Ok, 0));
        assert_eq!(verdict(trial(4, 5, 0, 10_000)), (Verdict::Warn, 9));
        assert_eq!(verdict(trial(5, 5, 0, 10_000)), (Verdict::Bad, 10));
        assert_eq!(verdict(trial(0, 0, 1, 10_000)), (Verdict::Bad, 0));
        assert_eq!(verdict(trial(0, 0, 0, 5_000)), (Verdict::Bad, 5_000));
        let check = trial(400, 20, 0, 10_000).check();
        assert!(
            check.found.contains("420 of 10000 ticks (4.20 %)") && check.found.contains("at follower"),
            "{check:?}"
        );
        assert!(check.found.contains("with no core"), "{check:?}");
    }
}
