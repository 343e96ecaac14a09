//! The last late tick of a running loop, for a screen: from the roles' records, with the cause that the tracing process found.
//!
//! Must not delay a role: it only reads shared memory and one small file.

use super::assemble::{late_tick, replace_input};
use super::delay::Delay;
use super::findings::Finding;
use super::model::LateKind;
use crate::bus::domain::Domain;
use crate::runtime::{RoleId, late_log};
use crate::scenario::Scenario;
use crate::seat::open_ledger;
use crate::telemetry::LateLog;
use corotate_trace::CauseKind;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::path::PathBuf;

/// The longest time by which the tracing process may be behind the roles' records, ns.
const BEHIND_NS: u64 = 1_000_000_000;

/// The time for which a late tick with a cause of its own is shown in the place of later ones that lacked an input, ns.
const OWN_NS: u64 = 100_000_000;

/// The last late tick.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LastLate {
    /// The role.
    pub role: String,
    /// The tick; the first one of several.
    pub tick: u64,
    /// The kind.
    pub kind: LateKind,
    /// The delay, µs.
    pub late_us: f64,
    /// The cause of its largest part in words; `None` if that is unknown.
    pub cause: Option<String>,
}

/// The late ticks of a running loop.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct LateStatus {
    /// The number of late ticks; missed ticks in a row count once.
    pub count: u64,
    /// The last one of those that the roles keep.
    pub last: Option<LastLate>,
    /// True if later ones are only counted.
    pub only_counted: bool,
}

/// Returns the file with the last late tick that the tracing process explained.
pub fn last_path(domain: &Domain) -> PathBuf {
    domain.root().join("tracer.last")
}

/// A late tick that a screen may show, and its rank among them.
#[derive(Debug)]
pub(super) struct Candidate {
    pub last: LastLate,
    /// The due time of its last tick, later if it has a cause of its own, and its end, ns.
    rank: (u64, Reverse<u64>),
}

impl Candidate {
    /// Takes the cause that was found, or the kind that the counters of its thread tell.
    pub fn new(scenario: &Scenario, delay: &Delay, found: Option<&Finding>) -> Self {
        let mut late = late_tick(scenario, delay, found);
        if let Some(found) = found {
            replace_input(&mut late.causes, found.input_causes.clone());
        }
        let cause = late.main_cause();
        let due_ns = delay.record.due_ns + (late.ticks - 1) * delay.period_ns;
        let is_own = cause.is_some_and(|cause| cause.kind != CauseKind::Input);
        let rank = (due_ns + if is_own { OWN_NS } else { 0 }, Reverse(delay.record.done_ns));
        let cause = cause.map(ToString::to_string);
        Self {
            last: LastLate { role: late.role, tick: late.tick, kind: late.kind, late_us: late.late_us, cause },
            rank,
        }
    }

    /// Returns true if it is shown in the place of an earlier one: it is newer, or nearer to the first cause.
    pub fn supersedes(&self, shown: Option<&Self>) -> bool {
        shown.is_none_or(|shown| self.rank > shown.rank)
    }
}

/// A reader of the late ticks of a running loop.
pub struct LateFollower {
    domain: Domain,
    roles: Vec<FollowedRole>,
    last: Option<Candidate>,
    status: LateStatus,
}

struct FollowedRole {
    role: RoleId,
    log: LateLog,
    /// The number of records that were read.
    read: usize,
}

impl LateFollower {
    /// Opens the records of the roles; `None` if the scenario keeps none.
    pub fn open(domain: &Domain, scenario: &Scenario) -> Option<Self> {
        let followed = |role: RoleId| {
            let log = late_log(scenario, role, &open_ledger(domain, scenario, role).ok()?)?;
            Some(FollowedRole { role, log, read: 0 })
        };
        let roles: Vec<FollowedRole> = RoleId::all(scenario).into_iter().filter_map(followed).collect();
        let keeps = scenario.keeps_late_ticks();
        keeps.then(|| Self { domain: domain.clone(), roles, last: None, status: LateStatus::default() })
    }

    /// Reads the late ticks since the last call.
    pub fn poll(&mut self, scenario: &Scenario) -> &LateStatus {
        self.status.count = self.roles.iter().map(|followed| followed.log.entered()).sum();
        for followed in &mut self.roles {
            for record in followed.log.records(followed.read) {
                followed.read += 1;
                let delay = Delay { role: followed.role, record, period_ns: scenario.period_ns };
                let candidate = Candidate::new(scenario, &delay, None);
                if candidate.supersedes(self.last.as_ref()) {
                    self.last = Some(candidate);
                }
            }
        }
        self.status.only_counted = self.roles.iter().any(|followed| followed.log.entered() > followed.read as u64);
        let behind_ticks = BEHIND_NS / scenario.period_ns;
        self.status.last = self.last.as_ref().map(|Candidate { last, .. }| {
            let recent = |found: &LastLate| found.tick.saturating_add(behind_ticks) >= last.tick;
            self.explained().filter(recent).unwrap_or_else(|| last.clone())
        });
        &self.status
    }

    /// Returns the last late tick that the tracing process explained.
    fn explained(&self) -> Option<LastLate> {
        serde_json::from_slice(&std::fs::read(last_path(&self.domain)).ok()?).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use crate::late::{Cause, CauseKind};
    use crate::telemetry::{LateRecord, Usage};

    fn delay(role: RoleId, tick: u64, done_us: u64) -> Delay {
        let due_ns = tick * 1_000_000;
        let done_ns = due_ns + done_us * 1000;
        let usage = Usage { run_delay_ns: done_us * 900, ..Usage::default() };
        let record =
            LateRecord { tick, due_ns, began_ns: done_ns, done_ns, gap_end_ns: 1, usage, ..LateRecord::default() };
        Delay { role, record, period_ns: 1_000_000 }
    }

    fn scenario() -> Scenario {
        Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &["clock=realtime".to_owned()]).unwrap()
    }

    #[test]
    fn the_newest_late_tick_with_a_cause_of_its_own_is_shown() {
        let scenario = scenario();
        let own = |role, tick, done_us| Candidate::new(&scenario, &delay(role, tick, done_us), None);
        let lacks_input = |tick: u64| {
            let mut late = delay(RoleId::Controller, tick, 310);
            (late.record.sender, late.record.input_ns) = (RoleId::Plant(0).number(), late.record.due_ns + 300_000);
            Candidate::new(&scenario, &late, None)
        };
        let leader = own(RoleId::Plant(0), 7, 300);
        assert!(leader.supersedes(None) && !leader.supersedes(Some(&leader)));
        assert!(leader.supersedes(Some(&own(RoleId::Controller, 7, 310))), "it ended first");
        assert!(own(RoleId::Controller, 8, 310).supersedes(Some(&leader)));
        assert_eq!(lacks_input(8).last.cause.as_deref(), Some("late input from leader"));
        assert!(!lacks_input(8).supersedes(Some(&leader)) && !lacks_input(106).supersedes(Some(&leader)));
        assert!(lacks_input(108).supersedes(Some(&leader)), "of another cause");
    }

    #[test]
    fn the_cause_comes_from_the_trace_or_else_from_the_counters() {
        let scenario = scenario();
        let delay = delay(RoleId::Plant(0), 7, 300);
        let counted = Candidate::new(&scenario, &delay, None).last;
        assert_eq!((&*counted.role, counted.tick, counted.kind, counted.late_us), ("leader", 7, LateKind::Late, 300.0));
        assert_eq!(counted.cause, Some(Cause::new(CauseKind::Task, "", 0).to_string()));
        let hog = Cause::new(CauseKind::Task, "hog", 290_000);
        let found = |causes| Finding {
            role: delay.role.number(),
            index: 0,
            delay_ns: delay.ns(),
            causes,
            input_causes: Vec::new(),
            slices: Vec::new(),
        };
        let named = Candidate::new(&scenario, &delay, Some(&found(vec![hog.clone()]))).last;
        assert_eq!(named.cause, Some(hog.to_string()));
        assert_eq!(Candidate::new(&scenario, &delay, Some(&found(Vec::new()))).last.cause, None);
        let read: LastLate = serde_json::from_slice(&serde_json::to_vec(&named).unwrap()).unwrap();
        assert_eq!(read, named);
    }
}
