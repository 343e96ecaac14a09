//! The run that a report compares another with: the same scenario, undisturbed, as its rig would have it.
//!
//! It is computed here, in one thread. Must not be told as if it had been measured.

use super::error::ReportError;
use super::traces::{Traces, trace};
use crate::launch::{Launch, run};
use crate::record::Recording;
use crate::scenario::Scenario;
use std::sync::atomic::AtomicUsize;

/// Longer runs are not computed again: it would take a while, and an orbit repeats itself.
const TICKS_MAX: u64 = 200_000;

/// The traces of that run; none where the rig names none, or this one is too long.
pub fn counterpart(scenario: &Scenario) -> Result<Option<Traces>, ReportError> {
    let changes = scenario.rig.counterpart();
    if changes.is_empty() || scenario.last_tick > TICKS_MAX {
        return Ok(None);
    }
    let failed = |error: &dyn std::fmt::Display| ReportError::Counterpart { reason: error.to_string() };
    let plain = ["clock=in-process", "launch.external=[]", "fault=[]", "accept={}"];
    let overrides: Vec<String> = changes.iter().chain(&plain).map(|change| (*change).to_owned()).collect();
    let scenario = Scenario::parse(&scenario.to_toml(), "the run that this one is compared with", &overrides)?;
    let directory = tempfile::tempdir().map_err(|error| failed(&error))?;
    let file = directory.path().join("run.mcap");
    run(&scenario, &mut Launch { record: Some(file.clone()), ..Launch::new(&AtomicUsize::new(0), &mut |_| {}) })
        .map_err(|error| failed(&error))?;
    Ok(Some(trace(&Recording::open(&file)?, &scenario)?))
}
