//! The process that records the kernel's trace beside a run, seen from the launcher.
//!
//! The ticks wait for it once, until it records. Its end is not the run's.

use super::companion::Companion;
use super::error::LaunchError;
use super::janitor::Janitor;
use crate::bus::domain::Domain;
use crate::late::{Findings, LateReport, Steal, TRACER, findings, ready_path, report, trace_refusal, wants_trace};
use crate::scenario::Scenario;
use crate::telemetry::RoleReport;
use std::process::Command;

/// The tracing process of a run, if it has one.
pub(super) struct TracerWatch {
    pub companion: Companion,
    /// The reason for which the run is not traced.
    note: Option<String>,
    /// The time that the hypervisor had taken before the run.
    steal: Steal,
}

impl TracerWatch {
    /// Starts the process if the scenario asks for the kernel's trace and the machine permits it.
    pub fn start(scenario: &Scenario, domain: &Domain) -> Result<Self, LaunchError> {
        let note = trace_refusal(scenario);
        let arguments = (wants_trace(scenario) && note.is_none()).then_some(|command: &mut Command| {
            command.arg(TRACER).arg("--domain").arg(domain.root());
        });
        Ok(Self { companion: Companion::start(TRACER, arguments)?, note, steal: Steal::read() })
    }

    /// Returns the companion of a run that another host traces, or none does.
    #[cfg(feature = "hosts")]
    pub fn none() -> Result<Self, LaunchError> {
        Ok(Self { companion: Companion::start(TRACER, None::<fn(&mut Command)>)?, note: None, steal: Steal::default() })
    }

    /// Returns true once the process records, or cannot.
    pub fn ready(&mut self, domain: &Domain) -> Result<bool, LaunchError> {
        self.companion.ready(&ready_path(domain))
    }

    /// Checks if it has failed: then the run goes on without it.
    pub fn supervise(&mut self, janitor: &mut Janitor) {
        if let Some(cause) = self.companion.loss(false, janitor) {
            self.note = Some(format!("the tracing process failed: {cause}"));
        }
    }

    /// Returns the late ticks of the run with their causes. The process has ended, or is ended now.
    pub fn finish(self, scenario: &Scenario, domain: &Domain, reports: &[RoleReport]) -> Option<LateReport> {
        let found: Option<Findings> = findings(domain);
        let lost = || self.companion.is_started().then(|| "the tracing process left no report".to_owned());
        let note = self.note.or_else(|| if found.is_none() { lost() } else { None });
        drop(self.companion);
        let steal_ms = Steal::read().since_ms(&self.steal);
        report(scenario, reports, found, note).map(|report| LateReport { steal_ms, ..report })
    }
}
