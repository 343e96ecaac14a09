//! The run that an orbit's is compared with: the same scenario, undisturbed, its law given the true velocity, \[S\] Fig. 1.
//!
//! It is computed here, in one thread. Must not be told as if it had been measured.

use super::ReportError;
use super::traces::{Traces, trace};
use crate::config::Scenario;
use crate::launch::{Launch, run};
use crate::record::Recording;
use std::sync::atomic::AtomicUsize;

/// Longer runs are not computed again: it would take a while, and an orbit repeats itself.
const TICKS_MAX: u64 = 200_000;

/// The traces of the same motion with full-state feedback; none where the scenario has no such choice, has it already, or is
/// too long.
pub fn counterpart(scenario: &Scenario) -> Result<Option<Traces>, ReportError> {
    let controller = scenario.resolved.get("controller").and_then(|table| table.get("feedback"));
    if controller.and_then(toml::Value::as_str) != Some("estimate") || scenario.last_tick > TICKS_MAX {
        return Ok(None);
    }
    let failed = |error: &dyn std::fmt::Display| ReportError::Counterpart { reason: error.to_string() };
    let overrides =
        ["controller.feedback=full-state", "clock=in-process", "launch.external=[]", "fault=[]", "accept={}"];
    let scenario =
        Scenario::parse(&scenario.to_toml(), "the same scenario with full state", &overrides.map(str::to_owned))?;
    let directory = tempfile::tempdir().map_err(|error| failed(&error))?;
    let file = directory.path().join("run.mcap");
    let launch = &mut Launch {
        program: std::path::PathBuf::new(),
        external: Vec::new(),
        record: Some(file.clone()),
        foxglove: None,
        require_realtime: false,
        signal: &AtomicUsize::new(0),
        progress: &mut |_| {},
    };
    run(&scenario, launch).map_err(|error| failed(&error))?;
    Ok(Some(trace(&Recording::open(&file)?, &scenario)?))
}
