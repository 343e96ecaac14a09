//! The relay of a run over several hosts, seen from the launcher: started beside the roles, and what other hosts have told.
//!
//! Must not carry anything, nor decide when a run ends; [`super::processes`] does.

use super::LaunchError;
use super::children::{RoleProcess, program};
use super::supervision::{Action, Incident};
use crate::bus::domain::Domain;
use crate::config::Scenario;
use crate::hosts::{HostReport, HostSeat, RELAY, far_end_path, ready_path, relay_report_path};
use crate::runtime::RoleId;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// What the launcher of a host that joined leaves for the one of the run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct FarEnd {
    /// Why the host gave up, if it did.
    pub failed: Option<String>,
    /// Roles that failed there, as incidents.
    pub incidents: Vec<Incident>,
    /// External roles that keep no counters, and what is wrong with accounts that were left.
    pub problems: Vec<String>,
}

/// A run's relay, if it has several hosts.
pub(super) struct RelayWatch {
    process: Option<RoleProcess>,
    root: PathBuf,
    ready: bool,
    /// All hosts, and whether it is known how each of the others ended.
    hosts: Vec<(String, bool)>,
    failed: bool,
    /// Whether this is the host that launched.
    leads: bool,
}

impl RelayWatch {
    /// Starts the relay of a host, if there is a `seat`, in a run that `hub` launched.
    pub fn start(
        seat: Option<&HostSeat>,
        hub: &str,
        scenario: &Scenario,
        domain: &Domain,
    ) -> Result<Self, LaunchError> {
        let start = |seat: &HostSeat| {
            let mut command = program(RELAY)?;
            command.arg(RELAY).arg("--domain").arg(domain.root()).args(["--host", &seat.host, "--hub", hub]);
            command.args(seat.endpoint.options());
            RoleProcess::spawn(command, RELAY.to_owned())
        };
        let hosts = scenario.hosts.hosts.iter().map(|host| (host.name.clone(), false));
        Ok(Self {
            process: seat.map(start).transpose()?,
            root: domain.root().to_owned(),
            ready: seat.is_none(),
            // Only the host that launched is told of others.
            hosts: if seat.is_some_and(|seat| seat.host == hub) { hosts.collect() } else { Vec::new() },
            failed: false,
            leads: seat.is_some_and(|seat| seat.host == hub),
        })
    }

    /// Its process.
    pub fn process(&mut self) -> Option<&mut RoleProcess> {
        self.process.as_mut()
    }

    /// Whether this is the host that launched: its relay ends with the run, that of another once it has told how the host ended.
    pub fn leads(&self) -> bool {
        self.leads
    }

    /// Whether it carries; how it failed if it never will.
    pub fn ready(&mut self) -> Result<bool, LaunchError> {
        if let Some(process) = &mut self.process {
            process.require_alive(RELAY)?;
        }
        self.ready |= ready_path(&self.root).exists();
        Ok(self.ready)
    }

    /// What ends the run: the relay has failed, or a host has ended while ticks were to run. `tick` is the one at hand.
    pub fn supervise(&mut self, scenario: &Scenario, tick: u64) -> Vec<Incident> {
        let mut incidents = Vec::new();
        if let Some(status) = self.process.as_mut().and_then(RoleProcess::ended).filter(|_| !self.failed) {
            self.failed = true;
            let failure = self.process.as_mut().map(|process| process.failure(status));
            let (cause, last_words) =
                failure.map_or_else(Default::default, |failure| (failure.cause, failure.last_words));
            incidents.push(incident(RELAY.to_owned(), Vec::new(), tick, cause, last_words));
        }
        for (host, known) in self.hosts.iter_mut().filter(|(_, known)| !known) {
            let Some(end) = far_end(&self.root, host) else { continue };
            *known = true;
            let stopped = end.incidents.iter().find(|incident| incident.action == Action::Stopped);
            let roles = RoleId::all(scenario).into_iter().map(|role| role.name(scenario).to_owned());
            let mut roles = roles.filter(|role| scenario.hosts.of(role) == Some(host));
            incidents.push(stopped.cloned().unwrap_or_else(|| {
                let cause = end.failed.unwrap_or_else(|| "it ended before the run did".to_owned());
                let cause = format!("the host {host} left: {cause}");
                incident(roles.next().unwrap_or_default(), roles.collect(), tick, cause, String::new())
            }));
        }
        incidents
    }

    /// Whether it has not ended yet.
    pub fn lingers(&mut self) -> bool {
        self.process.as_mut().is_some_and(|process| process.ended().is_none())
    }

    /// What the hosts tell at the end: their accounts, what went wrong there, and incidents that are not in `known`.
    pub fn finish(&mut self, known: &[Incident]) -> (Vec<HostReport>, Vec<String>, Vec<Incident>) {
        self.process = None;
        let (mut reports, mut problems, mut incidents) = (Vec::new(), Vec::new(), Vec::new());
        for (host, _) in &self.hosts {
            let report = std::fs::read(relay_report_path(&self.root, host)).ok();
            reports.extend(report.and_then(|bytes| serde_json::from_slice::<HostReport>(&bytes).ok()));
            if let Some(end) = far_end(&self.root, host) {
                problems.extend(end.problems.iter().map(|problem| format!("{host}: {problem}")));
                incidents.extend(end.incidents.into_iter().filter(|incident| !known.contains(incident)));
            }
        }
        (reports, problems, incidents)
    }
}

fn far_end(root: &std::path::Path, host: &str) -> Option<FarEnd> {
    serde_json::from_slice(&std::fs::read(far_end_path(root, host)).ok()?).ok()
}

/// What ends a run for more than a role.
fn incident(role: String, with: Vec<String>, tick: u64, cause: String, last_words: String) -> Incident {
    Incident {
        role,
        external: true,
        with,
        generation: 1,
        tick,
        cause,
        last_words,
        panic: None,
        repeated: false,
        time_s: 0.0,
        begins_anew: false,
        replaced_by: None,
        action: Action::Stopped,
        outage_s: None,
        recovery_s: None,
    }
}
