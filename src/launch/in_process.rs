//! A run in one thread: the same roles over links in memory, or without links where nothing disturbs them. No iceoryx2, no
//! files, no clock.

use super::error::LaunchError;
use super::incident::{Action, Incident, Incidents, RoleFailure};
use super::options::{Launch, Progress};
use super::outcome::Outcome;
use crate::bus::memory::MemoryBus;
use crate::changes::ReceivedChanges;
use crate::clock::Grid;
use crate::config::OnFailure;
use crate::direct::TURN_TICKS;
use crate::panics;
use crate::record::Recorder;
use crate::runtime::{Ended, RoleId, depths, drive_in_turn_tracked, private_ledger, report};
use crate::scenario::Scenario;
use crate::scenario::build;
use crate::scenario::scorer as open_scorer;
use crate::system::tell;
use crate::telemetry::{Ledger, RoleReport};
use std::cell::{Cell, RefCell};
use std::sync::atomic::Ordering;

/// Runs all roles of a scenario in turn.
pub(super) fn run(scenario: &Scenario, launch: &mut Launch<'_>) -> Result<Outcome, LaunchError> {
    scenario.inputs.receive_in(ReceivedChanges::default());
    // After a panic the nodes repeat the run, and the role that panics is known.
    match panics::catch_quietly(|| run_directly(scenario, launch)) {
        Ok(Some(outcome)) => Ok(outcome),
        Ok(None) | Err(_) => run_nodes(scenario, launch),
    }
}

/// Runs all roles without links; `None` if the run needs links.
fn run_directly(scenario: &Scenario, launch: &mut Launch<'_>) -> Option<Outcome> {
    if launch.record.is_some() {
        return None;
    }
    let (mut stopped, checkpoints) = (false, launch.checkpoints);
    let mut go_on = |tick, latest| {
        stopped = !proceed(|| latest, scenario, launch, tick);
        !stopped
    };
    let (reports, score) = scenario.rig.direct(scenario, checkpoints, &mut go_on)?;
    let signal = if stopped { launch.signal.load(Ordering::Relaxed) } else { 0 };
    Some(Outcome { signal, ..Outcome::in_one_thread(reports, score) })
}

/// Runs all roles over links.
fn run_nodes(scenario: &Scenario, launch: &mut Launch<'_>) -> Result<Outcome, LaunchError> {
    let bus = MemoryBus::new(depths(scenario));
    let scorer = RefCell::new(open_scorer(scenario, &bus)?);
    let seats: Vec<(RoleId, Ledger)> =
        RoleId::all(scenario).into_iter().map(|role| (role, private_ledger(scenario, role))).collect();
    let node = |(role, ledger): &(RoleId, Ledger)| build(scenario, *role, &bus, ledger);
    let mut nodes = seats.iter().map(node).collect::<Result<Vec<_>, _>>()?;
    let mut incidents = Incidents::default();
    let revive = |index: usize| {
        let incident = incident(scenario, &seats[index]);
        let incident = incidents.add(incident, &mut |id, tick| scorer.borrow_mut().incident(id, tick));
        let (tick, action) = (incident.tick, incident.action);
        if action == Action::Stopped {
            return Ok(None);
        }
        let mut successor = node(&seats[index])?;
        // Private memory can always be opened.
        if successor.restore().is_ok() {
            successor.start(Grid { epoch_ns: 0, period_ns: scenario.period_ns }, tick)?;
        }
        Ok(Some(successor))
    };
    let mut recorder = launch.record.as_deref().map(|file| Recorder::open(scenario, &bus, file)).transpose()?;
    if let Some(recorder) = &mut recorder {
        recorder.start(0, None)?;
    }
    let (mut failure, mut unrecorded) = (None, None);
    let turn = Cell::new(None);
    let after_tick = |tick| {
        let mut scorer = scorer.borrow_mut();
        if let (Some(recorder), None) = (&mut recorder, &unrecorded) {
            unrecorded = recorder.poll().err();
            unrecorded.iter().for_each(|error| tell(format_args!("corotate: {error}; the run goes on")));
        }
        match scorer.poll(1) {
            Ok(_) => proceed(|| scorer.latest(), scenario, launch, tick),
            Err(error) => {
                failure = Some(error);
                false
            }
        }
    };
    let ended = match panics::catch(|| drive_in_turn_tracked(&mut nodes, scenario.last_tick, &turn, revive, after_tick))
    {
        Ok(ended) => ended?,
        Err(panic) => {
            let Some(index) = turn.get() else { return Err(LaunchError::Panicked { panic }) };
            // All commit their counters. A role that fails at this has panicked in its own turn.
            for node in &mut nodes {
                panics::catch(|| node.finish()).unwrap_or(Ok(()))?;
            }
            let (role, ledger) = &seats[index];
            let incident =
                Incident::without_process(role.name(scenario), ledger, RoleFailure::from_panic(panic), Action::Stopped);
            incidents.add(incident, &mut |id, tick| scorer.borrow_mut().incident(id, tick));
            Ended::Stopped
        }
    };
    if let Some(error) = failure {
        return Err(error.into());
    }
    let score = scorer.borrow_mut().finish()?;
    let incidents = incidents.finish(&score.recoveries_s);
    let reports: Vec<RoleReport> =
        seats.iter().map(|(role, ledger)| report(scenario, *role, ledger, Vec::new(), Vec::new())).collect();
    let recording = recorder.map(|mut recorder| {
        // The samples that were sent after the last look, if the run was stopped during a tick.
        let last = if unrecorded.is_none() { recorder.poll().err() } else { unrecorded };
        recorder.finish(&reports, last.as_ref())
    });
    let signal = if ended == Ended::Stopped { launch.signal.load(Ordering::Relaxed) } else { 0 };
    Ok(Outcome { recording, incidents, signal, ..Outcome::in_one_thread(reports, score) })
}

/// Reacts to a role that the scenario killed, by the same policy as for processes.
fn incident(scenario: &Scenario, (role, ledger): &(RoleId, Ledger)) -> Incident {
    let (name, supervision) = (role.name(scenario), &scenario.supervision);
    let again = supervision.reaction_to(name) == OnFailure::Restart && ledger.generation() <= supervision.restarts_max;
    let killed = RoleFailure::new("scripted-kill", "it was killed by the scenario".to_owned(), String::new());
    Incident::without_process(name, ledger, killed, if again { Action::Restarted } else { Action::Stopped })
}

/// Reports the progress at intervals. Returns false if a signal asked for the end.
#[inline]
pub(super) fn proceed(latest: impl FnOnce() -> f64, scenario: &Scenario, launch: &mut Launch<'_>, tick: u64) -> bool {
    if !tick.is_multiple_of(TURN_TICKS) {
        return true;
    }
    (launch.progress)(&Progress::Running { tick, last_tick: scenario.last_tick, metric: latest() });
    launch.signal.load(Ordering::Relaxed) == 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use std::sync::atomic::AtomicUsize;

    fn outcome(scenario: &Scenario, direct: bool, signal: usize) -> Option<Outcome> {
        let signal = AtomicUsize::new(signal);
        let mut progress = |_: &Progress<'_>| {};
        let mut launch = Launch::new(&signal, &mut progress);
        match direct {
            true => run_directly(scenario, &mut launch),
            false => Some(run_nodes(scenario, &mut launch).unwrap()),
        }
    }

    /// Reports, hashes, counters and scores are those of the nodes, also of a stopped run. If a guard rejects a sample, there is no
    /// direct run.
    #[test]
    fn a_direct_run_is_what_the_nodes_make_of_it() {
        let mut direct = 0;
        for (name, text) in SHIPPED {
            for (overrides, signal) in [(&[][..], 0), (&["duration_s=0.9", "accept={}"], 0), (&["accept={}"], 15)] {
                let overrides: Vec<String> =
                    ["clock=in-process"].iter().chain(overrides).map(|text| (*text).to_owned()).collect();
                // Some scenarios have faults or limits that a shorter run does not have room for.
                let Ok(scenario) = Scenario::parse(text, name, &overrides) else {
                    continue;
                };
                if let Some(by_roles) = outcome(&scenario, true, signal) {
                    direct += 1;
                    let by_nodes = outcome(&scenario, false, signal).unwrap();
                    assert_eq!(format!("{by_roles:?}"), format!("{by_nodes:?}"), "{name} {overrides:?}");
                }
            }
        }
        assert!(direct >= 15, "{direct} of the shipped scenarios' runs were direct");
    }

    /// A follower whose measurements repeat for too long.
    #[test]
    fn where_a_sample_is_not_believed_the_nodes_run() {
        let still = ["leader.initial_rate_rad_s=[0.0, 0.0, 0.8]", "follower.0.initial_rate_rad_s=[0.0, 0.0, 0.8]"];
        let overrides = [&["clock=in-process", "limits.repeats=5", "accept={}"], &still[..]].concat();
        let overrides: Vec<String> = overrides.into_iter().map(str::to_owned).collect();
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &overrides).unwrap();
        assert!(outcome(&scenario, true, 0).is_none());
        let by_nodes = outcome(&scenario, false, 0).unwrap();
        let rejected: u64 = by_nodes.reports.iter().flat_map(|report| &report.read).map(|link| link.rejected).sum();
        assert!(rejected > 0, "the nodes count them");
    }
}
