//! The findings of the tracing process: the file in which other processes read them.

use super::model::{Slice, TracerCost};
use crate::bus::domain::Domain;
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::{ClockKind, Trace};
use crate::scenario::Scenario;
use crate::seat::{report_path, write_whole};
use corotate_trace::{Cause, require_tracefs};
use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io;
use std::path::PathBuf;

/// The name of the process.
pub const TRACER: &str = "tracer";
/// The longest wait of another process for the findings, and the interval between two looks at them, ns. At its end the process decodes
/// many events. Shorter than the launcher's wait for companions, so that a recording is complete even if the process hangs.
const FINDINGS_NS: u64 = 25_000_000_000;
const LOOK_NS: u64 = 5_000_000;

/// Findings of the process.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Findings {
    /// The reason for which there is no trace, with the remedy.
    pub note: Option<String>,
    /// The explained late ticks.
    pub ticks: Vec<Finding>,
    /// The costs of the process.
    pub cost: Option<TracerCost>,
}

/// The causes of one late tick.
#[derive(Debug, Serialize, Deserialize)]
pub struct Finding {
    /// The role, as [`RoleId::number`](crate::runtime::RoleId::number).
    pub role: u64,
    /// The index of its record.
    pub index: usize,
    /// The length of the delay, ns.
    pub delay_ns: u64,
    /// The causes.
    pub causes: Vec<Cause>,
    /// Causes that kept the sender of its last input from sending it, for a sender without a late tick of its own.
    pub input_causes: Vec<Cause>,
    /// The cores around it, if it is one of the worst ticks.
    pub slices: Vec<Slice>,
}

/// Returns the file that the process writes once the trace runs, or cannot run.
pub fn ready_path(domain: &Domain) -> PathBuf {
    domain.root().join("tracer.ready")
}

/// Writes this file. The process holds it locked until it ends, so that others notice its death.
pub(super) fn announce_ready(domain: &Domain) -> io::Result<File> {
    let path = ready_path(domain);
    write_whole(&path, b"")?;
    let file = File::open(path)?;
    flock(&file, FlockOperation::NonBlockingLockExclusive)?;
    Ok(file)
}

/// Returns true while the process holds that file.
fn is_alive(domain: &Domain) -> bool {
    let file = File::open(ready_path(domain));
    file.is_ok_and(|file| flock(&file, FlockOperation::NonBlockingLockShared) == Err(Errno::WOULDBLOCK))
}

/// Returns the findings of the process in a domain.
pub fn findings(domain: &Domain) -> Option<Findings> {
    serde_json::from_slice(&std::fs::read(report_path(domain.root(), TRACER)).ok()?).ok()
}

/// Returns true if a scenario asks for the kernel's trace.
pub fn wants_trace(scenario: &Scenario) -> bool {
    scenario.clock == ClockKind::Realtime && matches!(scenario.realtime.trace, Trace::Auto | Trace::Kernel)
}

/// Returns the reason for which this process could not trace a run of a scenario that asks for it; `None` if it could.
pub fn trace_refusal(scenario: &Scenario) -> Option<String> {
    require_tracefs().err().filter(|_| wants_trace(scenario)).map(|error| error.to_string())
}

/// Waits until the process of a stopped run has written its findings. Returns them, or the reason why they are missing. Does not wait if
/// the run has no such process, or if it died.
pub fn await_findings(
    domain: &Domain,
    scenario: &Scenario,
    may_wait: impl Fn() -> bool,
) -> Result<Findings, Option<String>> {
    if !ready_path(domain).exists() {
        return Err(trace_refusal(scenario));
    }
    let end_ns = monotonic_ns() + FINDINGS_NS;
    loop {
        // Looked at first: it may end after it has written them.
        let may_come = is_alive(domain) && monotonic_ns() < end_ns && may_wait();
        match findings(domain) {
            Some(findings) => return Ok(findings),
            None if may_come => sleep_until(monotonic_ns() + LOOK_NS),
            None => return Err(Some("the tracing process left no report".to_owned())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::config::SHIPPED;

    #[test]
    fn only_a_living_process_is_waited_for() {
        let scenario = Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &["clock=realtime".to_owned()]).unwrap();
        let owned = OwnedDomain::create(1 << 20).unwrap();
        let domain = owned.domain();
        let wait = |may_wait: &dyn Fn() -> bool| await_findings(domain, &scenario, may_wait);
        assert!(wait(&|| unreachable!("without a process")).is_err());
        let held = announce_ready(domain).unwrap();
        let write = || {
            let text = serde_json::to_vec(&Findings::default()).unwrap();
            write_whole(&report_path(domain.root(), TRACER), &text).unwrap();
            true
        };
        assert!(wait(&|| false).unwrap_err().unwrap().contains("no report"));
        assert!(wait(&write).is_ok());
        std::fs::remove_file(report_path(domain.root(), TRACER)).unwrap();
        drop(held);
        assert!(wait(&|| unreachable!("it is dead")).is_err());
    }
}
