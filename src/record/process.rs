//! The recorder as a process beside a loop.
//!
//! In real time it has the lowest real-time priority if that is granted and is below the roles', else ordinary priority. It
//! avoids the cores that the scenario names for roles. Must not keep a role waiting: a sample that it cannot take in time is
//! lost, and reported. In lockstep the launcher gives no credit beyond the ticks that the recorder has taken.

use super::error::RecordError;
use super::recorder::{JOINING, RECORDER, Recorder, RecordingReport};
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal, Write};
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::ClockKind;
use crate::late::{self, LateReport, await_findings};
use crate::runtime::{
    Backoff, RoleId, depths, join_at_low_priority, report, take_lowest_realtime_priority, topic, window_ticks,
    with_realtime_priority,
};
use crate::sample::{Health, Phase, RoleState, Schedule, Stamp};
use crate::scenario::Scenario;
use crate::seat::{RoleError, join_complete, open_ledger, report_path, write_whole};
use crate::telemetry::RoleReport;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Interval between polls in real time, ns.
const POLL_NS: u64 = 5_000_000;
/// Sleep between polls in lockstep once no sample has arrived for a while, ns.
const IDLE_NS: u64 = 50_000;
/// Interval between heartbeats, ns, unless a credit is due.
const HEARTBEAT_NS: u64 = 20_000_000;
/// Ticks per credit in lockstep, at most.
const CREDIT_TICKS: u64 = 8;
/// Silence after the stop that ends the recording, ns.
const QUIET_NS: u64 = 100_000_000;
/// Longest time that samples are taken after the stop, ns.
const DRAIN_NS: u64 = 3_000_000_000;

/// Source and destination of a recording.
#[derive(Debug, Clone)]
pub struct RecorderOptions {
    /// The domain's directory.
    pub domain: PathBuf,
    /// The file.
    pub file: PathBuf,
}

/// Records a run to its end, or until `terminated`. Returns the report, and writes it to the domain too.
///
/// # Errors
/// [`RecordError`] if nothing could be recorded. If a recording ended early, its report has the reason.
pub fn run_recorder(options: &RecorderOptions, terminated: &AtomicBool) -> Result<RecordingReport, RecordError> {
    let (domain, scenario) = join_complete(&options.domain)?;
    let (bus, mut launcher, mut recorder) =
        join_at_low_priority(&scenario, 0, || open(&options.file, &domain, &scenario))?;
    let lockstep = scenario.clock != ClockKind::Realtime;
    // Other load must not cost samples, and the recorder must not preempt a role.
    if !lockstep && scenario.realtime.priority > 1 {
        take_lowest_realtime_priority();
    }
    let credit_ticks = lockstep.then(|| CREDIT_TICKS.min(window_ticks(&scenario) / 4).max(1));
    let ended =
        follow(&mut recorder, &mut launcher, credit_ticks, &|| terminated.load(Ordering::Relaxed) || !domain.exists());
    with_realtime_priority(|| recorder.close_links());
    let stopped = launcher.schedule().is_ok_and(|schedule| Phase::from_number(schedule.phase) == Phase::Stop);
    let late = if stopped { late_ticks(&domain, &scenario, terminated) } else { None };
    late.iter().for_each(|late| recorder.add_late_ticks(late));
    let report = recorder.finish(&role_reports(&domain, &scenario), ended.as_ref().err());
    let path = report_path(domain.root(), RECORDER);
    let text = serde_json::to_vec(&report).expect("a report of plain values is JSON");
    // Fails only if the launcher has removed its domain. The caller prints the report anyway.
    let _ = write_whole(&path, &text);
    let _ = launcher.publish(RoleState::Done, u64::MAX);
    drop((launcher, bus));
    domain.remove_if_over();
    Ok(report)
}

/// Opens the links and the file. The bus comes first because it must be dropped last.
fn open(file: &Path, domain: &Domain, scenario: &Scenario) -> Result<(IoxBus, LauncherLink, Recorder), RecordError> {
    let bus = IoxBus::enter(domain, RECORDER, depths(scenario)).map_err(RoleError::from)?;
    let launcher = LauncherLink::open(scenario, &bus)?;
    let recorder = Recorder::open(scenario, &bus, file)?;
    Ok((bus, launcher, recorder))
}

/// Takes samples from the first tick to the last, or until `end` returns true.
///
/// `end` is needed because a run may have stopped before this process joined. A recorder that joins lockstep late takes
/// every sample from the current credit on.
fn follow(
    recorder: &mut Recorder,
    launcher: &mut LauncherLink,
    credit_ticks: Option<u64>,
    end: &dyn Fn() -> bool,
) -> Result<(), RecordError> {
    let (mut backoff, mut whole) = (Backoff::default(), false);
    loop {
        let schedule = launcher.schedule()?;
        // Generation 0: no schedule has arrived.
        let phase = Some(Phase::from_number(schedule.phase)).filter(|_| schedule.stamp.generation > 0);
        if phase == Some(Phase::WarmUp) && !whole {
            // Every writer is open. A short lockstep run may end before the first poll, so connect now.
            recorder.connect();
            whole = true;
        }
        launcher.publish(if whole { RoleState::Ready } else { RoleState::Open }, 0)?;
        match phase {
            Some(Phase::Run) if whole => {
                recorder.start(schedule.epoch_ns, None)?;
                break;
            }
            Some(Phase::Run) => {
                launcher.publish(RoleState::Running, JOINING)?;
                // Read after the heartbeat, which holds the credit: samples that are sent beyond it fit into the links.
                let from_tick = launcher.schedule()?.credit_tick;
                recorder.start(schedule.epoch_ns, Some(from_tick))?;
                break;
            }
            Some(Phase::Stop) => return Ok(()),
            _ if end() => return Ok(()),
            _ => sleep_until(monotonic_ns() + POLL_NS / 5),
        }
    }
    let (mut published_tick, mut next_heartbeat_ns) = (0, 0);
    loop {
        let taken = recorder.poll()?;
        let (now_ns, next_tick) = (monotonic_ns(), recorder.next_tick());
        let heartbeat_due = now_ns >= next_heartbeat_ns;
        if heartbeat_due || credit_ticks.is_some_and(|ticks| next_tick >= published_tick + ticks) {
            launcher.publish(RoleState::Running, if whole || next_tick > 0 { next_tick } else { JOINING })?;
            (published_tick, next_heartbeat_ns) = (next_tick, now_ns + HEARTBEAT_NS);
        }
        if heartbeat_due && end() || Phase::from_number(launcher.schedule()?.phase) == Phase::Stop {
            break;
        }
        match (credit_ticks.is_some(), taken) {
            (false, _) => sleep_until(now_ns + POLL_NS),
            (true, 0) if backoff.brief() => {}
            (true, 0) => sleep_until(monotonic_ns() + IDLE_NS),
            (true, _) => backoff = Backoff::default(),
        }
    }
    drain(recorder, end)
}

/// Takes the last samples of ending roles.
fn drain(recorder: &mut Recorder, end: &dyn Fn() -> bool) -> Result<(), RecordError> {
    let stopped_ns = monotonic_ns();
    let mut quiet_since_ns = stopped_ns;
    while !end() {
        let (taken, now_ns) = (recorder.poll()?, monotonic_ns());
        if taken > 0 {
            quiet_since_ns = now_ns;
        }
        if now_ns - quiet_since_ns > QUIET_NS || now_ns - stopped_ns > DRAIN_NS {
            break;
        }
        sleep_until(now_ns + POLL_NS);
    }
    recorder.poll()?;
    Ok(())
}

/// Returns the current counters of all roles: their final reports, else their persistent state.
///
/// Leaves out roles on other hosts without a report: this host cannot tell losses between hosts from losses of the recording.
fn role_reports(domain: &Domain, scenario: &Scenario) -> Vec<RoleReport> {
    let counters = |role: RoleId| {
        let name = role.name(scenario);
        let ledger = open_ledger(domain, scenario, role).ok().filter(|ledger| ledger.generation() > 0);
        if ledger.is_none() && scenario.hosts.host_of(name).is_some() {
            return None;
        }
        let file = std::fs::read(report_path(domain.root(), name)).ok();
        let final_report = file.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        final_report.or_else(|| Some(report(scenario, role, &ledger?, Vec::new(), Vec::new())))
    };
    RoleId::all(scenario).into_iter().filter_map(counters).collect()
}

/// Returns the late ticks of a stopped run, as the launcher will write them. Waits for the tracing process, but not for roles of other
/// hosts.
fn late_ticks(domain: &Domain, scenario: &Scenario, terminated: &AtomicBool) -> Option<LateReport> {
    if !scenario.keeps_late_ticks() {
        return None;
    }
    let may_wait = || !terminated.load(Ordering::Relaxed) && domain.exists();
    let (findings, note) = match await_findings(domain, scenario, may_wait) {
        Ok(findings) => (Some(findings), None),
        Err(note) => (None, note),
    };
    late::report(scenario, &role_reports(domain, scenario), findings, note)
}

/// The recorder's links to and from the launcher.
struct LauncherLink {
    schedule: <IoxBus as Bus>::Reader<Schedule>,
    health: <IoxBus as Bus>::Writer<Health>,
}

impl LauncherLink {
    fn open(scenario: &Scenario, bus: &IoxBus) -> Result<Self, BusError> {
        Ok(Self {
            health: bus.writer(&topic(scenario, RECORDER, Signal::Health), 1)?,
            schedule: bus.reader(&topic(scenario, "run", Signal::Schedule), Reader::Role)?,
        })
    }

    /// Publishes a heartbeat.
    fn publish(&mut self, state: RoleState, tick: u64) -> Result<(), BusError> {
        self.health.send(|health| {
            let sent_ns = monotonic_ns();
            health.stamp = Stamp { tick, generation: 1, origin_ns: sent_ns, sent_ns };
            health.state = state as u64;
        })
    }

    /// Returns the newest schedule; one of generation 0 if none has arrived.
    fn schedule(&mut self) -> Result<Schedule, BusError> {
        while self.schedule.advance()? {}
        Ok(self.schedule.current().copied().unwrap_or_default())
    }
}
