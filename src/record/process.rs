//! The recorder as a process beside a loop: in real time of the least real-time priority, where granted and below that of the
//! roles, else of none; and on no core that the scenario names for roles.
//!
//! Must not keep a role waiting: what it cannot take in time is lost and told. In lockstep the launcher gives no credit
//! beyond what it has taken.

use super::RecordError;
use super::recorder::{JOINING, RECORDER, Recorder, RecordingReport};
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal, Write};
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::ClockKind;
use crate::runtime::{
    Backoff, RoleId, depths, join_at_low_priority, report, take_lowest_realtime_priority, topic, window_ticks,
    with_realtime_priority,
};
use crate::sample::{Health, Phase, RoleState, Schedule, Stamp};
use crate::scenario::Scenario;
use crate::seat::{RoleError, join_complete, open_ledger, report_path, write_whole};
use crate::telemetry::RoleReport;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

/// In real time, between two looks at the samples, ns.
const LOOK_NS: u64 = 5_000_000;
/// In lockstep, the same when nothing has come for a while, ns.
const LULL_NS: u64 = 50_000;
/// Between two words to the launcher, ns, unless a credit is due.
const WORD_NS: u64 = 20_000_000;
/// In lockstep: a word after so many ticks.
const CREDIT_TICKS: u64 = 8;
/// The run is over when nothing has come for so long after its stop, ns; and for so long it may still come.
const QUIET_NS: u64 = 100_000_000;
const LEAVE_NS: u64 = 3_000_000_000;

/// What to record, and where to.
#[derive(Debug, Clone)]
pub struct RecorderSeat {
    /// The domain's directory.
    pub domain: PathBuf,
    /// The file.
    pub file: PathBuf,
}

/// Records a run to its end, or until `terminated`, and leaves the report in the domain too.
///
/// # Errors
/// [`RecordError`] if nothing could be recorded. What ended a recording before its time is in the report.
pub fn run_recorder(seat: &RecorderSeat, terminated: &AtomicBool) -> Result<RecordingReport, RecordError> {
    let (domain, scenario) = join_complete(&seat.domain)?;
    let (bus, mut line, mut recorder) = join_at_low_priority(&scenario, 0, || open(seat, &domain, &scenario))?;
    let lockstep = scenario.clock != ClockKind::Realtime;
    // It must not lose samples because something is being compiled, and must stay behind the roles.
    if !lockstep && scenario.realtime.priority > 1 {
        take_lowest_realtime_priority();
    }
    let credit_ticks = lockstep.then(|| CREDIT_TICKS.min(window_ticks(&scenario) / 4).max(1));
    let ended =
        follow(&mut recorder, &mut line, credit_ticks, &|| terminated.load(Ordering::Relaxed) || !domain.exists());
    with_realtime_priority(|| recorder.leave());
    let report = recorder.finish(&books(&domain, &scenario), ended.as_ref().err());
    let path = report_path(domain.root(), RECORDER);
    let text = serde_json::to_vec(&report).expect("a report of plain values is JSON");
    // The launcher is gone, and its domain with it, if this fails: the report is printed as well.
    let _ = write_whole(&path, &text);
    let _ = line.say(RoleState::Done, u64::MAX);
    drop((line, bus));
    domain.remove_if_over();
    Ok(report)
}

/// Opens all links, and the file. The node is told first because it goes last.
fn open(seat: &RecorderSeat, domain: &Domain, scenario: &Scenario) -> Result<(IoxBus, Line, Recorder), RecordError> {
    let bus = IoxBus::enter(domain, RECORDER, depths(scenario)).map_err(RoleError::from)?;
    let line = Line::open(scenario, &bus)?;
    let recorder = Recorder::open(scenario, &bus, &seat.file)?;
    Ok((bus, line, recorder))
}

/// Takes samples from the first tick to the last, or until it is to `end`: a run that ended while this joined it has said its
/// last word to others. Who joins lockstep late takes everything from the credit of that moment on.
fn follow(
    recorder: &mut Recorder,
    line: &mut Line,
    credit_ticks: Option<u64>,
    end: &dyn Fn() -> bool,
) -> Result<(), RecordError> {
    let (mut backoff, mut whole) = (Backoff::default(), false);
    loop {
        let schedule = line.hear()?;
        // Before the first word nothing is known.
        let phase = Some(Phase::from_number(schedule.phase)).filter(|_| schedule.stamp.generation > 0);
        if phase == Some(Phase::WarmUp) && !whole {
            // Every writer is open. In lockstep a short run may be over before the first look at its samples.
            recorder.connect();
            whole = true;
        }
        line.say(if whole { RoleState::Ready } else { RoleState::Open }, 0)?;
        match phase {
            Some(Phase::Run) if whole => {
                recorder.start(schedule.epoch_ns, None)?;
                break;
            }
            Some(Phase::Run) => {
                line.say(RoleState::Running, JOINING)?;
                // Heard after that is said: what is sent beyond it is little enough to be kept.
                let from_tick = line.hear()?.credit_tick;
                recorder.start(schedule.epoch_ns, Some(from_tick))?;
                break;
            }
            Some(Phase::Stop) => return Ok(()),
            _ if end() => return Ok(()),
            _ => sleep_until(monotonic_ns() + LOOK_NS / 5),
        }
    }
    let (mut said, mut next_word_ns) = (0, 0);
    loop {
        let taken = recorder.poll()?;
        let (now_ns, next_tick) = (monotonic_ns(), recorder.next_tick());
        let time_for_a_word = now_ns >= next_word_ns;
        if time_for_a_word || credit_ticks.is_some_and(|ticks| next_tick >= said + ticks) {
            line.say(RoleState::Running, if whole || next_tick > 0 { next_tick } else { JOINING })?;
            (said, next_word_ns) = (next_tick, now_ns + WORD_NS);
        }
        if time_for_a_word && end() || Phase::from_number(line.hear()?.phase) == Phase::Stop {
            break;
        }
        match (credit_ticks.is_some(), taken) {
            (false, _) => sleep_until(now_ns + LOOK_NS),
            (true, 0) if backoff.brief() => {}
            (true, 0) => sleep_until(monotonic_ns() + LULL_NS),
            (true, _) => backoff = Backoff::default(),
        }
    }
    drain(recorder, end)
}

/// Takes what roles that are ending still send.
fn drain(recorder: &mut Recorder, end: &dyn Fn() -> bool) -> Result<(), RecordError> {
    let stopped_ns = monotonic_ns();
    let mut quiet_since_ns = stopped_ns;
    while !end() {
        let (taken, now_ns) = (recorder.poll()?, monotonic_ns());
        if taken > 0 {
            quiet_since_ns = now_ns;
        }
        if now_ns - quiet_since_ns > QUIET_NS || now_ns - stopped_ns > LEAVE_NS {
            break;
        }
        sleep_until(now_ns + LOOK_NS);
    }
    recorder.poll()?;
    Ok(())
}

/// The counters of all roles, as far as they have got: their own account, or what their ledgers say. Not of those on other hosts:
/// what was lost on the way is not known here, and is no fault of the recording.
fn books(domain: &Domain, scenario: &Scenario) -> Vec<RoleReport> {
    let counters = |role: RoleId| {
        let name = role.name(scenario);
        let ledger = open_ledger(domain, scenario, role).ok().filter(|ledger| ledger.generation() > 0);
        if ledger.is_none() && scenario.hosts.host_of(name).is_some() {
            return None;
        }
        let file = std::fs::read(report_path(domain.root(), name)).ok();
        let own = file.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        own.or_else(|| Some(report(scenario, role, &ledger?, Vec::new(), Vec::new())))
    };
    RoleId::all(scenario).into_iter().filter_map(counters).collect()
}

/// The recorder's line to the launcher.
struct Line {
    schedule: <IoxBus as Bus>::Reader<Schedule>,
    health: <IoxBus as Bus>::Writer<Health>,
}

impl Line {
    fn open(scenario: &Scenario, bus: &IoxBus) -> Result<Self, BusError> {
        Ok(Self {
            health: bus.writer(&topic(scenario, RECORDER, Signal::Health), 1)?,
            schedule: bus.reader(&topic(scenario, "run", Signal::Schedule), Reader::Role)?,
        })
    }

    fn say(&mut self, state: RoleState, tick: u64) -> Result<(), BusError> {
        self.health.send(|health| {
            let sent_ns = monotonic_ns();
            health.stamp = Stamp { tick, generation: 1, origin_ns: sent_ns, sent_ns };
            health.state = state as u64;
        })
    }

    fn hear(&mut self) -> Result<Schedule, BusError> {
        while self.schedule.advance()? {}
        Ok(self.schedule.current().copied().unwrap_or_default())
    }
}
