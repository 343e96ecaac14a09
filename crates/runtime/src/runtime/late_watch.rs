//! Notices the late ticks of the roles of a process and enters them in their ledgers, with the counters of the thread.
//!
//! An ordinary tick pays for a comparison of two numbers per role; the counters are read at heartbeats and at late ticks. Must not
//! find causes.

use super::node::{Node, late_log};
use super::role_id::RoleId;
use super::usage::{ThreadUsage, take_continued};
use crate::clock::{Grid, SpinGap, monotonic_ns};
use crate::config::Settings;
use crate::telemetry::{LateLog, LateRecord, Ledger, Usage};

/// The part of the usual waiting that is remembered at each heartbeat with less of it.
const FORGET: f64 = 0.9;

/// The late ticks of the roles of one process.
#[derive(Debug)]
pub struct LateWatch {
    usage: ThreadUsage,
    /// The last reading of the counters, and its time, ns.
    baseline: Usage,
    since_ns: u64,
    /// Part of the time for which the thread waits for its core without being late: for roles that share the core.
    usual_delay: f64,
    roles: Vec<WatchedRole>,
}

#[derive(Debug)]
struct WatchedRole {
    role: RoleId,
    log: LateLog,
    /// The numbers of late ticks that are entered.
    missed: u64,
    executed: u64,
}

impl LateWatch {
    /// Opens the records of the roles of this thread; `None` if the scenario asks for none.
    pub fn open(scenario: &Settings, ledgers: &[(RoleId, Ledger)]) -> Option<Self> {
        let usage = ThreadUsage::open();
        let watched = |(role, ledger): &(RoleId, Ledger)| {
            let log = late_log(scenario, *role, ledger)?;
            log.set_thread(usage.tid());
            Some(WatchedRole { role: *role, log, missed: 0, executed: 0 })
        };
        let roles: Vec<WatchedRole> = ledgers.iter().map(watched).collect::<Option<_>>()?;
        Some(Self { usage, baseline: Usage::default(), since_ns: 0, usual_delay: 0.0, roles })
    }

    /// Reads the counters, to which the next late tick is compared. Not while a tick is due: what delays it would be lost.
    pub fn rebase(&mut self) {
        let (usage, now_ns) = (self.usage.read(), monotonic_ns());
        if self.since_ns > 0 && now_ns > self.since_ns {
            let waited_ns = usage.since(&self.baseline).run_delay_ns as f64;
            let part = waited_ns / (now_ns - self.since_ns) as f64;
            self.usual_delay = part.max(FORGET * self.usual_delay).min(1.0);
        }
        (self.baseline, self.since_ns) = (usage, now_ns);
    }

    /// Enters the late ticks of a node since the last call.
    #[inline]
    pub fn look(&mut self, node: &dyn Node, grid: Grid, gap: &SpinGap, slept: bool) {
        for index in 0..self.roles.len() {
            let WatchedRole { role, missed, executed, .. } = self.roles[index];
            let member = node.member(role).unwrap_or(node);
            let news = member.late_ticks().filter(|ticks| (ticks.missed, ticks.executed) != (missed, executed));
            if news.is_some() {
                self.enter(
                    index,
                    member,
                    grid,
                    LateRecord { slept, gap_ns: gap.longest_ns(), gap_end_ns: gap.end_ns(), ..LateRecord::default() },
                );
            }
        }
    }

    #[cold]
    fn enter(&mut self, index: usize, node: &dyn Node, grid: Grid, spin: LateRecord) {
        let Some(ticks) = node.late_ticks() else { return };
        let (usage, now_ns) = (self.usage.read(), monotonic_ns());
        let mut used = usage.since(&self.baseline);
        let usual_ns = self.usual_delay * now_ns.saturating_sub(self.since_ns) as f64;
        used.usual_delay_ns = (usual_ns as u64).min(used.run_delay_ns);
        let common = LateRecord {
            tid: self.usage.tid(),
            continued: take_continued(),
            stalled: ticks.last.stalled,
            usage: used,
            since_ns: self.since_ns,
            ..spin
        };
        let watched = &mut self.roles[index];
        let missed = ticks.missed.saturating_sub(std::mem::replace(&mut watched.missed, ticks.missed));
        if missed > 0 {
            let tick = ticks.missed_end.saturating_sub(missed);
            let (sender, due_ns) = (expected_sender(watched.role), grid.due_ns(tick));
            watched.log.push(LateRecord { tick, missed, sender, due_ns, began_ns: now_ns, done_ns: now_ns, ..common });
        }
        if std::mem::replace(&mut watched.executed, ticks.executed) != ticks.executed {
            let LateRecord { tick, starved, sender, due_ns, input_ns, began_ns, done_ns, .. } = ticks.last;
            let mut record = LateRecord { tick, starved, sender, input_ns, ..common };
            // A starved tick has no instants of its own.
            (record.due_ns, record.began_ns, record.done_ns) =
                if due_ns == 0 { (grid.due_ns(tick), now_ns, now_ns) } else { (due_ns, began_ns, done_ns) };
            watched.log.push(record);
        }
        (self.baseline, self.since_ns) = (usage, now_ns);
    }
}

/// Returns the sender of the input that starts a role's tick, as [`RoleId::number`]; 0 for a body.
fn expected_sender(role: RoleId) -> u64 {
    match role {
        RoleId::Plant(_) => 0,
        RoleId::Observer(index) => RoleId::Plant(index).number(),
        RoleId::Controller => RoleId::Observer(0).number(),
    }
}
