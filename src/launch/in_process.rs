//! A run in one thread: the same roles over links in memory. No iceoryx2, no files, no clock.

use super::score::{self, Scorer};
use super::{Action, Incident, Launch, LaunchError, Outcome, Progress};
use crate::bus::memory::MemoryBus;
use crate::clock::Grid;
use crate::config::{OnFailure, Scenario};
use crate::record::Recorder;
use crate::runtime::{Ended, RoleId, build, depths, in_turn, private_ledger, report};
use crate::system::tell;
use crate::telemetry::{Ledger, RoleReport};
use std::cell::RefCell;
use std::sync::atomic::Ordering;

/// Ticks between two looks at signals and progress.
const TURN_TICKS: u64 = 1024;

/// Runs all roles of a scenario in turn.
pub(super) fn run(scenario: &Scenario, launch: &mut Launch<'_>) -> Result<Outcome, LaunchError> {
    let bus = MemoryBus::new(depths(scenario));
    let scorer = RefCell::new(score::open(scenario, &bus)?);
    let seats: Vec<(RoleId, Ledger)> =
        RoleId::all(scenario).into_iter().map(|role| (role, private_ledger(scenario, role))).collect();
    let node = |(role, ledger): &(RoleId, Ledger)| build(scenario, *role, &bus, ledger);
    let mut nodes = seats.iter().map(node).collect::<Result<Vec<_>, _>>()?;
    let mut incidents = Vec::new();
    let revive = |index: usize| {
        let incident = incident(scenario, &seats[index]);
        scorer.borrow_mut().incident(incident.tick);
        let (tick, action) = (incident.tick, incident.action);
        incidents.push(incident);
        if action == Action::Stopped {
            return Ok(None);
        }
        let mut successor = node(&seats[index])?;
        // Memory of one's own is always open.
        if successor.restore().is_ok() {
            successor.start(Grid { epoch_ns: 0, period_ns: scenario.period_ns }, tick)?;
        }
        Ok(Some(successor))
    };
    let mut recorder = launch.record.as_deref().map(|file| Recorder::open(scenario, &bus, file)).transpose()?;
    if let Some(recorder) = &mut recorder {
        recorder.start(0, true)?;
    }
    let (mut failure, mut unrecorded) = (None, None);
    let ended = in_turn(&mut nodes, scenario.last_tick, revive, |tick| {
        let mut scorer = scorer.borrow_mut();
        if let (Some(recorder), None) = (&mut recorder, &unrecorded) {
            unrecorded = recorder.poll().err();
            unrecorded.iter().for_each(|error| tell(format_args!("corotate: {error}; the run goes on")));
        }
        match scorer.poll(1) {
            Ok(_) => proceed(&**scorer, scenario, launch, tick),
            Err(error) => {
                failure = Some(error);
                false
            }
        }
    })?;
    if let Some(error) = failure {
        return Err(error.into());
    }
    let score = scorer.borrow_mut().finish()?;
    for (incident, recovery_s) in incidents.iter_mut().zip(&score.recoveries_s) {
        incident.recovery_s = *recovery_s;
    }
    let reports: Vec<RoleReport> =
        seats.iter().map(|(role, ledger)| report(scenario, *role, ledger, Vec::new(), Vec::new())).collect();
    let recording = recorder.map(|mut recorder| {
        // What was sent after the last look, if the run was stopped in the midst of a tick.
        let last = if unrecorded.is_none() { recorder.poll().err() } else { unrecorded };
        recorder.finish(&reports, last.as_ref())
    });
    Ok(Outcome {
        reports,
        recording,
        unbooked: Vec::new(),
        problems: Vec::new(),
        score,
        incidents,
        grants: Vec::new(),
        domain: None,
        remains: None,
        signal: if ended == Ended::Stopped { launch.signal.load(Ordering::Relaxed) } else { 0 },
    })
}

/// A role was killed by the scenario: what is done about it, by the policy that processes have.
fn incident(scenario: &Scenario, (role, ledger): &(RoleId, Ledger)) -> Incident {
    let (name, supervision) = (role.name(scenario), &scenario.supervision);
    let again = supervision.of(name) == OnFailure::Restart && ledger.generation() <= supervision.restarts_max;
    Incident::without_process(name, ledger, if again { Action::Restarted } else { Action::Stopped })
}

fn proceed(scorer: &dyn Scorer, scenario: &Scenario, launch: &mut Launch<'_>, tick: u64) -> bool {
    if !tick.is_multiple_of(TURN_TICKS) {
        return true;
    }
    (launch.progress)(&Progress::Running { tick, last_tick: scenario.last_tick, metric: scorer.latest() });
    launch.signal.load(Ordering::Relaxed) == 0
}
