//! The findings of the tracing process: the file in which other processes read them.

use super::{Cause, Slice, TracerCost};
use crate::bus::domain::Domain;
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::{ClockKind, Trace};
use crate::scenario::Scenario;
use crate::seat::report_path;
use corotate_trace::require_tracefs;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// The name of the process.
pub const TRACER: &str = "tracer";
/// The longest wait of another process for the findings, and the interval between two looks at them, ns.
const FINDINGS_NS: u64 = 2_000_000_000;
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
    /// The role, as [`RoleId::number`].
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
/// the run has no such process.
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
        match findings(domain) {
            Some(findings) => return Ok(findings),
            None if monotonic_ns() < end_ns && may_wait() => sleep_until(monotonic_ns() + LOOK_NS),
            None => return Err(Some("the tracing process left no findings in time".to_owned())),
        }
    }
}
