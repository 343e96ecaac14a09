//! The phases of a run before its ticks.

use super::super::foxglove;
use super::super::incident::RoleFailure;
use super::super::standstill::attach_remedy;
use super::super::supervision::Member;
use super::super::{Launch, LaunchError, Progress};
use super::{LOOK_NS, SCORE_NS, Supervisor};
use crate::clock::monotonic_ns;
use crate::config::ClockKind;
use crate::hosts::RELAY;
use crate::late::TRACER;
use crate::record::RECORDER;
use crate::runtime::RoleId;
use crate::sample::RoleState;
use crate::score::Scorer;
use std::sync::atomic::Ordering;

/// Time for which a role must run in its debugger before the ticks begin, ns: a debugger attaches a moment before it stops it.
const DEBUGGED_NS: u64 = 500_000_000;

impl Supervisor<'_> {
    /// Waits until each role of `launch.debug` runs in a debugger; false if a signal came first.
    pub(super) fn await_debuggers(
        &mut self,
        scorer: &mut dyn Scorer,
        launch: &mut Launch<'_>,
    ) -> Result<bool, LaunchError> {
        let scenario = self.scenario;
        let named = |role: RoleId| scenario.debug.iter().any(|name| name == role.name(scenario));
        let debugged = |member: &&mut Member| member.process.is_some() && member.books().any(|(role, _)| named(role));
        for member in self.members.iter_mut().filter(debugged) {
            member.set_patient(true);
            let (name, pid) = (&member.name, member.pid().unwrap_or_default());
            let remedy = attach_remedy().map_or(String::new(), |remedy| format!("\n  {remedy}"));
            (launch.progress)(&Progress::External(&format!(
                "the {name} waits for a debugger: attach it, set breakpoints, and continue\n  gdb -p {pid}\n  lldb -p {pid}{remedy}"
            )));
        }
        let mut alone_ns = monotonic_ns();
        while !scenario.debug.is_empty() && monotonic_ns() - alone_ns < DEBUGGED_NS {
            self.announce()?;
            self.listen()?;
            scorer.poll(u64::MAX)?;
            self.look_at_standstills(launch);
            self.require_all_alive()?;
            if launch.signal.load(Ordering::Relaxed) != 0 {
                return Ok(false);
            }
            if self.members.iter_mut().filter(debugged).any(|member| !member.runs_in_debugger()) {
                alone_ns = monotonic_ns();
            }
            self.pause(monotonic_ns() + SCORE_NS);
        }
        let patient = scenario.clock != ClockKind::Realtime;
        self.members.iter_mut().for_each(|member| member.set_patient(patient));
        Ok(true)
    }

    /// Returns an error if a role has failed before the ticks run.
    fn require_all_alive(&mut self) -> Result<(), LaunchError> {
        for member in &mut self.members {
            if let Some(RoleFailure { cause, last_words, .. }) = member.failure(self.scenario, self.janitor) {
                return Err(LaunchError::Died { role: member.name.clone(), cause, last_words });
            }
        }
        Ok(())
    }

    /// Waits until every role has reached a state; returns false if a signal came first. A role that fails before is not
    /// restarted, because the failure would only repeat.
    pub(super) fn await_state(
        &mut self,
        state: RoleState,
        scorer: &mut dyn Scorer,
        launch: &mut Launch<'_>,
    ) -> Result<bool, LaunchError> {
        let limit_s = self.scenario.startup_timeout_s;
        let mut looked_ns = monotonic_ns();
        let mut end_ns = looked_ns + (limit_s * 1e9) as u64;
        loop {
            self.announce()?;
            self.listen()?;
            // The time for which a role is stopped does not count.
            let stopped = self.look_at_standstills(launch);
            end_ns += if stopped { monotonic_ns() - looked_ns } else { 0 };
            looked_ns = monotonic_ns();
            // Its links take part in the warm-up.
            scorer.poll(u64::MAX)?;
            self.require_all_alive()?;
            let waiting = self.externals.before_ticks(self.scenario, &self.members, state, monotonic_ns());
            if !self.tell(waiting, scorer, launch) {
                return Ok(false);
            }
            let recorder = self.recorder.has_reached(state)?;
            let foxglove = self.foxglove.ready(&foxglove::address_path(self.domain))?;
            let watchers = [
                (RECORDER, recorder),
                ("foxglove", foxglove),
                (RELAY, self.relay.ready()?),
                (TRACER, self.tracer.ready(self.domain)?),
            ];
            if let Some(incident) = self.relay.supervise(self.scenario, 0).into_iter().next() {
                return Err(LaunchError::Died {
                    role: incident.role,
                    cause: incident.cause,
                    last_words: incident.last_words,
                });
            }
            let absent = watchers.into_iter().filter(|(_, ready)| !ready).map(|(name, _)| name);
            let missing: Vec<&Member> = self.members.iter().filter(|member| member.state() < state).collect();
            if missing.is_empty() && absent.clone().count() == 0 {
                return Ok(true);
            }
            if launch.signal.load(Ordering::Relaxed) != 0 {
                return Ok(false);
            }
            let mut roles: Vec<&str> = missing.iter().map(|member| &*member.name).collect();
            let by_hand = missing.iter().filter(|member| member.external && member.host().is_none());
            let external: Vec<&str> = by_hand.map(|member| &*member.name).collect();
            let mut hosts: Vec<&str> = missing.iter().filter_map(|member| member.host()).collect();
            hosts.sort_unstable();
            hosts.dedup();
            roles.extend(absent);
            // Roles that are started by hand, and hosts that join, have no timeout.
            if monotonic_ns() > end_ns && external.is_empty() && hosts.is_empty() {
                return Err(LaunchError::StartUp { limit_s, roles: roles.join(", ") });
            }
            // The address for them is known once the relay listens.
            let hosts = if self.relay.ready()? { hosts } else { Vec::new() };
            (launch.progress)(&Progress::Waiting { roles, external, hosts, domain: self.domain.root().to_owned() });
            self.pause(monotonic_ns() + LOOK_NS);
        }
    }
}
