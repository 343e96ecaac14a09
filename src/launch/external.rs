//! External roles for which a run waits: the role, the time, the missing sample and the one that came instead.
//!
//! Must not end a run; [`super::processes`] does. Must not blame a role whose own inputs are missing.

use super::supervision::Member;
use super::trace::Lack;
use crate::config::ClockKind;
use crate::runtime::RoleId;
use crate::sample::RoleState;
use crate::scenario::Scenario;

/// First and longest interval between two messages about a role for which the run waits, ns; the interval doubles each time.
const FIRST_WORD_NS: u64 = 5_000_000_000;
const WORD_INTERVAL_NS: u64 = 60_000_000_000;
/// Default timeout of an external role without counters while the ticks run, s: it may send wrong samples.
const TICKS_LIMIT_S: f64 = 30.0;
/// Shortest timeout in real time, periods.
const LIMIT_PERIODS: f64 = 10.0;
/// Longest time that one check adds to a wait, ns: a paused launcher must not blame a role.
const LOOK_MAX_NS: u64 = 100_000_000;

/// The time for which a run has waited for each of its roles.
pub(super) struct ExternalWatch {
    waits: Vec<Wait>,
}

/// A role for which the run waits.
#[derive(Debug, PartialEq)]
pub(super) enum Waiting {
    /// The line to print.
    Print(String),
    /// Its timeout has passed, for this cause.
    TooLong { member: usize, tick: u64, cause: String },
}

#[derive(Debug, Default)]
struct Wait {
    lack: Option<Lack>,
    waited_ns: u64,
    looked_ns: u64,
    next_word_ns: u64,
}

impl Wait {
    /// Continues the wait for the same samples, or begins a new one; returns its duration, ns.
    fn look(&mut self, lack: Lack, now_ns: u64) -> u64 {
        if self.lack.as_ref().is_some_and(|before| before.is_still(&lack)) {
            self.waited_ns += now_ns.saturating_sub(self.looked_ns).min(LOOK_MAX_NS);
        } else {
            (self.waited_ns, self.next_word_ns) = (0, FIRST_WORD_NS);
        }
        (self.lack, self.looked_ns) = (Some(lack), now_ns);
        self.waited_ns
    }

    /// Returns true if it is time to name the role again.
    fn word_due(&mut self) -> bool {
        let due = self.waited_ns >= self.next_word_ns;
        if due {
            self.next_word_ns += self.next_word_ns.min(WORD_INTERVAL_NS);
        }
        due
    }
}

impl ExternalWatch {
    pub fn new(members: usize) -> Self {
        Self { waits: (0..members).map(|_| Wait::default()).collect() }
    }

    /// Checks the external roles that have not reached `state`, before the ticks run.
    pub fn before_ticks(
        &mut self,
        scenario: &Scenario,
        members: &[Member],
        state: RoleState,
        now_ns: u64,
    ) -> Vec<Waiting> {
        let lack = |member: &Member| (member.state() < state).then_some(Lack::State(member.state()));
        let limit_s = |_: &Member| scenario.external_timeout_s.unwrap_or(f64::INFINITY);
        self.look(members, limit_s, lack, now_ns)
    }

    /// Checks the external roles whose samples others wait for; `scored_tick` is the scorer's next.
    pub fn in_ticks(&mut self, scenario: &Scenario, members: &[Member], scored_tick: u64, now_ns: u64) -> Vec<Waiting> {
        let realtime = scenario.clock == ClockKind::Realtime;
        let least_s = if realtime { LIMIT_PERIODS * scenario.tick_s() } else { 0.0 };
        // A role with counters sends the right ticks: while it is alive, it needs time.
        let limit_s = |member: &Member| match scenario.external_timeout_s {
            Some(limit_s) => limit_s.max(least_s),
            None if member.counts() && !realtime => f64::INFINITY,
            None => TICKS_LIMIT_S.max(least_s),
        };
        // The inputs that other external roles wait for are unknown.
        let next_tick = |role: RoleId| {
            let own = members.iter().find(|member| member.books().any(|(member_role, _)| member_role == role))?;
            (!own.external && own.state() == RoleState::Running).then_some(own.last.stamp.tick)
        };
        let scored = (scored_tick <= scenario.last_tick && !realtime).then_some(scored_tick);
        let others_done = members.iter().all(|member| member.external || member.state() == RoleState::Done);
        let lack = |member: &Member| {
            // A role that missed its last ticks has no further sample to send.
            let unfinished = others_done && member.state() < RoleState::Done && !member.spent();
            let state = unfinished.then_some(Lack::State(member.state()));
            member.trace()?.lack(next_tick, scored, realtime).or(state)
        };
        self.look(members, limit_s, lack, now_ns)
    }

    /// Returns true if the last check waited for a role.
    pub fn waits(&self) -> bool {
        self.waits.iter().any(|wait| wait.lack.is_some())
    }

    fn look(
        &mut self,
        members: &[Member],
        limit_s: impl Fn(&Member) -> f64,
        lack: impl Fn(&Member) -> Option<Lack>,
        now_ns: u64,
    ) -> Vec<Waiting> {
        let mut found = Vec::new();
        for (index, (member, wait)) in members.iter().zip(&mut self.waits).enumerate() {
            let Some(lack) = Some(member).filter(|member| member.external).and_then(&lack) else {
                *wait = Wait::default();
                continue;
            };
            let waited_s = wait.look(lack, now_ns) as f64 / 1e9;
            let limit_s = limit_s(member);
            if waited_s >= limit_s {
                let cause = format!("the run waited {limit_s} s for it: {lack}");
                found.push(Waiting::TooLong {
                    member: index,
                    tick: lack.tick().unwrap_or(member.last.stamp.tick),
                    cause,
                });
            } else if wait.word_due() {
                found.push(Waiting::Print(format!(
                    "waiting for {} (external) for {waited_s:.0} s: {lack}",
                    member.name
                )));
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_role_is_named_at_growing_intervals_and_anew_for_another_lack() {
        let (mut wait, mut words) = (Wait::default(), Vec::new());
        for look in 0..4000_u64 {
            let waited_ns = wait.look(Lack::State(RoleState::Absent), look * LOOK_MAX_NS);
            if wait.word_due() {
                words.push(waited_ns / 1_000_000_000);
            }
        }
        assert_eq!(words, [5, 10, 20, 40, 80, 140, 200, 260, 320, 380]);
        assert_eq!(wait.look(Lack::State(RoleState::Open), 0), 0);
        assert!(!wait.word_due());
    }

    /// A pause of the launcher does not count as a wait for the role.
    #[test]
    fn time_in_which_nobody_looked_does_not_count() {
        let mut wait = Wait::default();
        wait.look(Lack::State(RoleState::Absent), 0);
        assert_eq!(wait.look(Lack::State(RoleState::Absent), 3_600_000_000_000), LOOK_MAX_NS);
    }
}
