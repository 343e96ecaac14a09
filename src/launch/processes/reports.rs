//! The final reports of the roles of a run.

use crate::bus::domain::Domain;
use crate::runtime::{RoleId, report};
use crate::scenario::Scenario;
use crate::seat::report_path;
use crate::telemetry::{Ledger, RoleReport};

/// The final reports of the roles.
#[derive(Default)]
pub struct ShutdownReport {
    pub reports: Vec<RoleReport>,
    /// External roles that keep no counters.
    pub unbooked: Vec<String>,
    /// Defects of the reports.
    pub problems: Vec<String>,
}

impl ShutdownReport {
    /// Removes the report of an external role that covers fewer ticks than others have read from it: a program that replaced
    /// another one knows nothing of that one's ticks.
    pub fn leave_out_partial(&mut self, is_external: impl Fn(&str) -> bool) {
        let last_read = |service: &str| {
            let links = self.reports.iter().flat_map(|report| &report.read);
            links.filter(|link| link.service == service).filter_map(|link| link.last_tick).max()
        };
        let covers = |report: &RoleReport| report.written.iter().all(|link| link.last_tick >= last_read(&link.service));
        let partial = |report: &&RoleReport| is_external(&report.role) && !covers(report);
        let names: Vec<String> = self.reports.iter().filter(partial).map(|report| report.role.clone()).collect();
        self.reports.retain(|report| !names.contains(&report.role));
        self.unbooked.extend(names);
    }

    /// Adds a role's report, or its counters.
    pub fn gather(&mut self, scenario: &Scenario, domain: &Domain, role: RoleId, ledger: &Ledger) {
        let name = role.name(scenario).to_owned();
        let file = std::fs::read(report_path(domain.root(), &name)).ok();
        match file.map(|bytes| serde_json::from_slice(&bytes)) {
            Some(Ok(report)) => self.reports.push(report),
            Some(Err(error)) => self.problems.push(format!("{name}: its report is unreadable: {error}")),
            None if ledger.generation() > 0 => {
                self.reports.push(report(scenario, role, ledger, Vec::new(), Vec::new()));
            }
            None => self.unbooked.push(name),
        }
    }
}
