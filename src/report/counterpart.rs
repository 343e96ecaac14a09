//! The reference run of a report: the same scenario without faults, with the changes that its rig names.
//!
//! It is computed here, in one thread. Must not present it as measured.

use super::error::ReportError;
use super::traces::{Traces, trace};
use crate::launch::{Launch, run};
use crate::record::Recording;
use crate::scenario::Scenario;
use std::sync::atomic::AtomicUsize;

/// The longest run for which a reference is computed. An orbit repeats, so a longer one would only take longer.
const TICKS_MAX: u64 = 200_000;

/// Returns the traces of the reference run; `None` if the rig has none or the run is too long.
pub fn counterpart(scenario: &Scenario) -> Result<Option<Traces>, ReportError> {
    let changes = scenario.rig.counterpart();
    if changes.is_empty() || scenario.last_tick > TICKS_MAX {
        return Ok(None);
    }
    let failed = |error: &dyn std::fmt::Display| ReportError::Counterpart { reason: error.to_string() };
    let plain = ["clock=in-process", "launch.external=[]", "fault=[]", "accept={}"];
    let overrides: Vec<String> = changes.iter().chain(&plain).map(|change| (*change).to_owned()).collect();
    let changes = scenario.inputs.lists().all().into_iter().map(|(change, _)| change).collect();
    let mut scenario = Scenario::parse(&scenario.to_toml(), "the reference run", &overrides)?;
    // A run in one thread receives no changes, so those that this run received are part of the reference's scenario.
    scenario.inputs.scripted = changes;
    let directory = tempfile::tempdir().map_err(|error| failed(&error))?;
    let file = directory.path().join("run.mcap");
    run(&scenario, &mut Launch { record: Some(file.clone()), ..Launch::new(&AtomicUsize::new(0), &mut |_| {}) })
        .map_err(|error| failed(&error))?;
    Ok(Some(trace(&Recording::open(&file)?, &scenario, &[])?))
}
