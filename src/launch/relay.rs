//! The launcher's view of the relay of a run over several hosts: its process, and the reports of the other hosts.
//!
//! Must not carry anything, nor decide when a run ends; [`super::processes`] does.

use super::children::RoleProcess;
use super::companion::Companion;
use super::error::LaunchError;
use super::incident::{Action, Incident, Incidents, RoleFailure};
use crate::bus::domain::Domain;
use crate::hosts::{HostEndpoint, HostStatistics, RELAY, far_end_path, ready_path, relay_report_path};
use crate::runtime::RoleId;
use crate::scenario::Scenario;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::process::Command;

/// The final report of a joined host's launcher for the launcher of the run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct FarEnd {
    /// The reason for which the host gave up, if it did.
    pub failed: Option<String>,
    /// Roles that failed there, as incidents.
    pub incidents: Vec<Incident>,
    /// External roles that keep no counters, and defects of the reports.
    pub problems: Vec<String>,
}

/// A run's relay, if it has several hosts.
pub(super) struct RelayWatch {
    pub companion: Companion,
    root: PathBuf,
    /// All hosts; true for each whose end is known.
    hosts: Vec<(String, bool)>,
    /// True on the host that launched.
    leads: bool,
}

impl RelayWatch {
    /// Starts the relay of a host, if there is a `seat`, in a run that `hub` launched.
    pub fn start(
        seat: Option<&HostEndpoint>,
        hub: &str,
        scenario: &Scenario,
        domain: &Domain,
    ) -> Result<Self, LaunchError> {
        let arguments = seat.map(|seat| {
            move |command: &mut Command| {
                command.arg(RELAY).arg("--domain").arg(domain.root()).args(["--host", &seat.host, "--hub", hub]);
                command.args(seat.endpoint.options());
            }
        });
        let hosts = scenario.hosts.hosts.iter().map(|host| (host.name.clone(), false));
        Ok(Self {
            companion: Companion::start(RELAY, arguments)?,
            root: domain.root().to_owned(),
            // Only the host that launched receives reports of other hosts.
            hosts: if seat.is_some_and(|seat| seat.host == hub) { hosts.collect() } else { Vec::new() },
            leads: seat.is_some_and(|seat| seat.host == hub),
        })
    }

    /// Returns true on the host that launched: its relay ends with the run. Any other relay ends after it has reported its host's end.
    pub fn leads(&self) -> bool {
        self.leads
    }

    /// Returns true once it carries samples, or its failure.
    pub fn ready(&mut self) -> Result<bool, LaunchError> {
        self.companion.ready(&ready_path(&self.root))
    }

    /// Returns the incident that ends the run: the relay failed, or a host ended while ticks were to run. `tick` is the current one.
    pub fn supervise(&mut self, scenario: &Scenario, tick: u64) -> Vec<Incident> {
        let mut incidents = Vec::new();
        if let Some(failure) = self.companion.failure() {
            incidents.push(incident(RELAY.to_owned(), Vec::new(), tick, failure));
        }
        for (host, known) in self.hosts.iter_mut().filter(|(_, known)| !known) {
            let Some(end) = far_end(&self.root, host) else { continue };
            *known = true;
            let stopped = end.incidents.iter().find(|incident| incident.action == Action::Stopped);
            let roles = RoleId::all(scenario).into_iter().map(|role| role.name(scenario).to_owned());
            let mut roles = roles.filter(|role| scenario.hosts.host_of(role) == Some(host));
            incidents.push(stopped.cloned().unwrap_or_else(|| {
                let cause = end.failed.unwrap_or_else(|| "it ended before the run did".to_owned());
                let cause = format!("the host {host} left: {cause}");
                incident(
                    roles.next().unwrap_or_default(),
                    roles.collect(),
                    tick,
                    RoleFailure::new("host-left", cause, String::new()),
                )
            }));
        }
        incidents
    }

    /// Returns the hosts' final reports, their problems, and incidents that are not in `known`.
    pub fn finish(&mut self, known: &Incidents) -> (Vec<HostStatistics>, Vec<String>, Vec<Incident>) {
        self.companion.process().1.map(RoleProcess::kill);
        let (mut reports, mut problems, mut incidents) = (Vec::new(), Vec::new(), Vec::new());
        for (host, _) in &self.hosts {
            let report = std::fs::read(relay_report_path(&self.root, host)).ok();
            reports.extend(report.and_then(|bytes| serde_json::from_slice::<HostStatistics>(&bytes).ok()));
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

/// Creates an incident that ends a run because of more than one role.
fn incident(role: String, with: Vec<String>, tick: u64, failure: RoleFailure) -> Incident {
    Incident { external: true, with, ..Incident::new(role, tick, failure, Action::Stopped) }
}
