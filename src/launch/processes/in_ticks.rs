//! A run while its ticks run: scores, credit, changes of inputs, supervision.

use super::super::external::Waiting;
use super::super::incident::{Action, Incident, RoleFailure};
use super::super::overrun::Overran;
use super::super::supervision::Member;
use super::super::{Launch, LaunchError, Progress};
use super::prepare::takes_no_inputs;
use super::stall::Stall;
use super::{SCORE_NS, Supervisor};
use crate::bus::BusError;
use crate::clock::monotonic_ns;
use crate::config::{ClockKind, Overrun};
use crate::inputs::Timing;
use crate::runtime::{Backoff, RoleId, ignored_changes, window_ticks};
use crate::sample::RoleState;
use crate::score::Scorer;
use crate::system::tell;
use std::sync::atomic::Ordering;

/// Interval between two looks at samples in lockstep while no sample comes, ns.
const LULL_NS: u64 = 50_000;
/// Time from the receipt of a change to the first tick at which it may act, ns: longer than a role takes for a tick, and than this
/// process is usually held up.
const CHANGE_LEAD_NS: u64 = 3_000_000;
/// The same for a run over several hosts: the change crosses their network, on which relays repeat a lost message after 20 ms.
const CHANGE_LEAD_HOSTS_NS: u64 = 300_000_000;

impl Supervisor<'_> {
    /// Follows the ticks to the end: scores, grants credit, supervises the roles.
    pub(super) fn follow(&mut self, scorer: &mut dyn Scorer, launch: &mut Launch<'_>) -> Result<usize, LaunchError> {
        let lockstep = self.scenario.clock != ClockKind::Realtime;
        let credit_ticks = (window_ticks(self.scenario) / 4).max(1);
        let mut stall = Stall::new(self.scenario);
        let mut backoff = Backoff::default();
        let (mut next_look_ns, mut process_ended) = (0, false);
        while self.members.iter().any(|member| member.state() < RoleState::Done) {
            let scored = scorer.poll(credit_ticks)?;
            let credit = if lockstep { self.recorder.credit(scorer.next_tick(), self.word.credit_tick)? } else { 0 };
            if scored > 0 {
                backoff = Backoff::default();
            }
            let idle = scored == 0 && !(lockstep && backoff.brief());
            // Publishing wakes the roles that are far ahead: for several ticks at once, unless there is nothing else to do.
            if credit >= self.word.credit_tick + if idle { 1 } else { credit_ticks } {
                // A change must be there before a role may come to its tick.
                if let Some(inputs) = &mut self.inputs {
                    inputs.append_pending(&self.received, credit + window_ticks(self.scenario));
                }
                self.word.credit_tick = credit;
                self.announce()?;
            }
            let now_ns = monotonic_ns();
            if now_ns >= next_look_ns || process_ended {
                process_ended = false;
                next_look_ns = now_ns + SCORE_NS;
                self.announce()?;
                self.listen()?;
                self.serve_inputs(launch)?;
                let tick = scorer.next_tick();
                if !self.supervise(&mut |id, tick| scorer.incident(id, tick), tick, now_ns)? {
                    return Ok(0);
                }
                let stopped = self.look_at_standstills(launch);
                // While a role is stopped, no other one is blamed for waiting.
                let waiting = match stopped {
                    true => Vec::new(),
                    false => self.externals.in_ticks(self.scenario, &self.members, scorer.next_tick(), now_ns),
                };
                if !self.tell(waiting, scorer, launch) {
                    return Ok(0);
                }
                // The wait for an external role has its own timeout.
                stall.look(&self.members, now_ns, stopped || lockstep && self.externals.waits())?;
                let signal = launch.signal.load(Ordering::Relaxed);
                if signal != 0 {
                    return Ok(signal);
                }
                let (tick, last_tick) = (scorer.next_tick(), self.scenario.last_tick);
                (launch.progress)(&Progress::Running { tick, last_tick, metric: scorer.latest() });
            }
            if idle {
                let until_ns = if lockstep { monotonic_ns() + LULL_NS } else { next_look_ns };
                process_ended = self.pause(until_ns);
            }
        }
        Ok(0)
    }

    /// Serves requests to change inputs.
    fn serve_inputs(&mut self, launch: &Launch<'_>) -> Result<(), BusError> {
        let (scenario, word) = (self.scenario, &self.word);
        let period_ns = scenario.period_ns;
        let timing = || match scenario.clock {
            ClockKind::Realtime => {
                let now_ns = monotonic_ns();
                let tick_at = |ns: u64| ns.saturating_sub(word.epoch_ns).div_ceil(period_ns);
                let lead_ns = if launch.host.is_some() { CHANGE_LEAD_HOSTS_NS } else { CHANGE_LEAD_NS };
                Timing {
                    earliest: tick_at(now_ns + lead_ns),
                    safe: tick_at(now_ns + lead_ns / 3),
                    horizon: tick_at(now_ns + lead_ns + 5 * SCORE_NS),
                    clock: Some((word.epoch_ns, period_ns, now_ns)),
                }
            }
            // No role passes the credit by more than the window.
            ClockKind::Lockstep | ClockKind::InProcess => {
                let earliest = word.credit_tick + window_ticks(scenario) + 1;
                Timing { earliest, safe: earliest, horizon: earliest + window_ticks(scenario), clock: None }
            }
        };
        let (domain, members) = (self.domain, &self.members);
        let ignores = |role: RoleId| takes_no_inputs(scenario, launch, domain, members, role);
        if let Some(inputs) = &mut self.inputs {
            inputs.poll(scenario, &self.received, &timing, &ignores);
            if std::mem::take(&mut self.goes_safe) {
                match inputs.go_safe(scenario, &self.received, &timing, &ignores) {
                    Ok(tick) => tell(format_args!("corotate: the safe command of every body acts from tick {tick} on")),
                    Err(reason) => tell(format_args!("corotate: the safe command cannot be applied: {reason}")),
                }
            }
        }
        self.changes.publish()
    }

    /// Prints which changes of the scenario a role ignores.
    pub(super) fn warn_of_ignored_changes(&self, launch: &Launch<'_>) {
        let (scenario, domain, members) = (self.scenario, self.domain, &self.members);
        let ignores = |role: RoleId| takes_no_inputs(scenario, launch, domain, members, role);
        for reason in ignored_changes(scenario, &ignores) {
            tell(format_args!("corotate: {reason}; the role ignores its changes in the scenario"));
        }
    }

    /// Restarts roles that have failed, and records hosts that left; returns false if the run must end. `note` receives the number
    /// and the tick of each incident; `tick` is the current one.
    pub fn supervise(&mut self, note: &mut dyn FnMut(u64, u64), tick: u64, now_ns: u64) -> Result<bool, LaunchError> {
        let mut go_on = true;
        for incident in self.relay.supervise(self.scenario, tick) {
            tell(format_args!("corotate: {}", self.incidents.add(incident, note)));
            go_on = false;
        }
        if let Some(Overran { role, tick, failure }) = self.overrun.look(self.scenario, &self.members) {
            if self.overrun.policy() == Overrun::Stop {
                let incident = Incident::new(role, tick, failure, Action::Stopped);
                tell(format_args!("corotate: {}", self.incidents.add(incident, note)));
                go_on = false;
            } else {
                tell(format_args!("corotate: {role}: {}", failure.cause));
                self.goes_safe = true;
            }
        }
        let ticks_ns = (self.scenario.last_tick + 1).saturating_mul(self.scenario.period_ns);
        let over = self.scenario.clock == ClockKind::Realtime && now_ns > self.word.epoch_ns.saturating_add(ticks_ns);
        self.recorder.supervise(self.janitor);
        self.tracer.supervise(self.janitor);
        self.foxglove.loss(false, self.janitor);
        for member in &mut self.members {
            member.in_ticks(over);
            let complete = member.ended_complete(self.scenario, self.domain);
            if let Some(failure) = member.failure(self.scenario, self.janitor) {
                let incident = match complete {
                    true => member.note(failure, self.scenario),
                    false => member.fail(failure, self.scenario, now_ns),
                };
                go_on &= incident.action != Action::Stopped;
                tell(format_args!("corotate: {}", self.incidents.add(incident, note)));
                self.janitor.clear_dead();
            }
            if let Some(incident) = member.replaced() {
                tell(format_args!("corotate: {}", self.incidents.add(incident, note)));
            }
            // A successor can open its links once the files of its predecessor are removed.
            if !self.janitor.is_busy() {
                member.restart(self.scenario, self.domain, now_ns)?;
            }
            if let Some(outage_ns) = member.back_after_ns(now_ns) {
                self.incidents.end_outage(&member.name, outage_ns as f64 / 1e9);
            }
        }
        Ok(go_on)
    }

    /// Reports the external roles for which the run waits. Returns false if the run must end for one.
    pub(super) fn tell(&mut self, waiting: Vec<Waiting>, scorer: &mut dyn Scorer, launch: &mut Launch<'_>) -> bool {
        let mut go_on = true;
        for waiting in waiting {
            match waiting {
                Waiting::Print(words) => (launch.progress)(&Progress::External(&words)),
                Waiting::TooLong { member, tick, cause } => {
                    let failure = RoleFailure::new("waited-too-long", cause, String::new());
                    let incident = self.members[member].fail(failure, self.scenario, monotonic_ns());
                    let incident = Incident { tick, ..incident };
                    let incident = self.incidents.add(incident, &mut |id, tick| scorer.incident(id, tick));
                    tell(format_args!("corotate: {incident}"));
                    go_on = false;
                }
            }
        }
        go_on
    }

    /// Reports roles that are stopped or go on. Returns true while the run waits for one.
    pub(super) fn look_at_standstills(&mut self, launch: &mut Launch<'_>) -> bool {
        let now_ns = monotonic_ns();
        for line in self.members.iter_mut().filter_map(|member| member.look_at_standstill(now_ns)) {
            (launch.progress)(&Progress::External(&line));
        }
        self.members.iter().any(Member::is_stopped)
    }
}
