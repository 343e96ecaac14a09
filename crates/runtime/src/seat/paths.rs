//! The files of a run's domain.

use crate::bus::domain::{Domain, DomainError, domains};
use crate::changes::ReceivedChanges;
use crate::config::{ConfigError, Settings};
use crate::files;
use crate::runtime::{RoleId, ledger_file, ledger_words};
use crate::scenario::Scenario;
use crate::telemetry::{Ledger, LedgerError};
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// Returns the file in a domain with the scenario of its run.
pub fn scenario_path(domain: &Domain) -> PathBuf {
    domain.root().join("scenario.toml")
}

/// Returns the scenario of the run in a domain's directory, without joining the run.
///
/// # Errors
/// [`ConfigError`].
pub fn scenario_of(root: &Path) -> Result<Scenario, ConfigError> {
    Scenario::load(&root.join("scenario.toml"), &[])
}

/// Returns the file in a domain's directory for a role's report.
pub fn report_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.report.json"))
}

/// Returns the file in a domain's directory that shows that a role takes changes of inputs. It contains the number of the process.
pub(super) fn listener_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.listens"))
}

/// Returns the process that declared that it takes changes of inputs for a role. Bridges of devices do not.
pub fn listening_process(root: &Path, role: &str) -> Option<i32> {
    std::fs::read_to_string(listener_path(root, role)).ok()?.parse().ok()
}

/// Returns the file in a domain's directory for the error that ended an external role.
pub fn failure_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.words"))
}

/// Returns the file in a domain's directory for the error that ended a bridge in real time. That does not end the run,
/// because another bridge may take over.
pub fn device_failure_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.device.words"))
}

/// Returns the file in a domain's directory for a role's panic.
pub fn panic_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.panic.json"))
}

/// Returns the file in a domain's directory with the path of the run's results.
pub fn results_path(root: &Path) -> PathBuf {
    root.join("results")
}

/// The file of a run's results that is written at the end.
pub const SUMMARY: &str = "summary.json";

/// Returns the domain of a run in progress: the newest, or the one named by its directory, by its results directory, or
/// by its recording.
///
/// # Errors
/// [`DomainError::NoRun`], [`DomainError::Over`], [`DomainError::NotADomain`], [`DomainError::Privacy`].
pub fn find_run(given: Option<&Path>) -> Result<PathBuf, DomainError> {
    // The process that joins the domain reports why it cannot be joined.
    if let Some(given) = given.filter(|given| !matches!(Domain::join(given), Err(DomainError::NotADomain { .. }))) {
        return Ok(given.to_owned());
    }
    let mut running = domains()?.into_iter().filter(|found| found.alive).map(|found| found.root);
    let Some(given) = given else { return running.next().ok_or(DomainError::NoRun) };
    let whole = std::fs::canonicalize(given).unwrap_or_else(|_| given.to_owned());
    let directory = if whole.is_file() { whole.parent().unwrap_or(&whole) } else { &whole };
    let meant = |root: &PathBuf| {
        files::read(&results_path(root)).is_ok_and(|results| results == directory.as_os_str().as_bytes())
    };
    match running.find(meant) {
        Some(root) => Ok(root),
        None if directory.join(SUMMARY).exists() => Err(DomainError::Over { path: given.to_owned() }),
        None => Err(DomainError::NotADomain { path: given.to_owned() }),
    }
}

/// Returns the file with the changes of inputs that a run has received.
pub fn changes_path(domain: &Domain) -> PathBuf {
    domain.shared(ReceivedChanges::FILE)
}

/// Returns the file with the correction of this host's clock, in a run that was launched on another host.
pub fn clock_path(domain: &Domain) -> PathBuf {
    domain.shared("clock")
}

/// Opens a role's ledger in a domain for reading.
pub fn open_ledger(domain: &Domain, scenario: &Settings, role: RoleId) -> Result<Ledger, LedgerError> {
    Ledger::shared(&ledger_path(domain, scenario, role), ledger_words(scenario, role))
}

/// Opens a role's ledger in a domain as its only writer.
pub(super) fn take_ledger(domain: &Domain, scenario: &Settings, role: RoleId) -> Result<Ledger, LedgerError> {
    Ledger::taken(&ledger_path(domain, scenario, role), ledger_words(scenario, role))
}

fn ledger_path(domain: &Domain, scenario: &Settings, role: RoleId) -> PathBuf {
    domain.shared(&ledger_file(scenario, role))
}

/// Writes a file atomically: no reader sees a part of it.
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = path.with_extension("part");
    files::write(&part, bytes)?;
    std::fs::rename(&part, path)
}
