//! A run in one thread: the same roles over links in memory. No iceoryx2, no files, no clock.

use super::score::{self, Scorer};
use super::{Launch, LaunchError, Outcome, Progress};
use crate::bus::memory::MemoryBus;
use crate::config::Scenario;
use crate::runtime::{Ended, RoleId, build, depths, in_turn, private_ledger, report};
use crate::telemetry::Ledger;
use crate::with_rig;
use std::sync::atomic::Ordering;

/// Ticks between two looks at signals and progress.
const TURN_TICKS: u64 = 1024;

/// Runs all roles of a scenario in turn.
pub(super) fn run(scenario: &Scenario, launch: &mut Launch<'_>) -> Result<Outcome, LaunchError> {
    let bus = MemoryBus::new(depths(scenario));
    let mut scorer = score::open(scenario, &bus)?;
    let roles = RoleId::all(scenario);
    let ledgers: Vec<Ledger> = roles.iter().map(|role| private_ledger(scenario, *role)).collect();
    let node =
        |(role, ledger): (&RoleId, &Ledger)| with_rig!(&scenario.rig, rig => build(rig, scenario, *role, &bus, ledger));
    let mut nodes = roles.iter().zip(&ledgers).map(node).collect::<Result<Vec<_>, _>>()?;
    let mut failure = None;
    let ended = in_turn(&mut nodes, scenario.last_tick, |tick| match scorer.poll(1) {
        Ok(_) => proceed(&*scorer, scenario, launch, tick),
        Err(error) => {
            failure = Some(error);
            false
        }
    })?;
    if let Some(error) = failure {
        return Err(error.into());
    }
    Ok(Outcome {
        reports: roles
            .iter()
            .zip(&ledgers)
            .map(|(role, ledger)| report(scenario, *role, ledger, Vec::new(), Vec::new()))
            .collect(),
        unbooked: Vec::new(),
        problems: Vec::new(),
        score: scorer.finish()?,
        incidents: Vec::new(),
        grants: Vec::new(),
        domain: None,
        signal: if ended == Ended::Stopped { launch.signal.load(Ordering::Relaxed) } else { 0 },
    })
}

fn proceed(scorer: &dyn Scorer, scenario: &Scenario, launch: &mut Launch<'_>, tick: u64) -> bool {
    if !tick.is_multiple_of(TURN_TICKS) {
        return true;
    }
    (launch.progress)(&Progress::Running { tick, last_tick: scenario.last_tick, metric: scorer.latest() });
    launch.signal.load(Ordering::Relaxed) == 0
}
