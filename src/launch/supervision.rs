//! One role as the launcher sees it: its process, its heartbeat, its starts and failures.
//!
//! Must not decide when a run ends; [`super::processes`] does.

use super::children::{END_LIMIT, RoleProcess};
use super::error::LaunchError;
use super::incident::{Action, Incident, Replacement, RoleFailure};
use super::janitor::Janitor;
use super::standstill::{Standstill, standstill};
use super::trace::Trace;
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal, WriterProcess};
use crate::clock::monotonic_ns;
use crate::config::{ClockKind, OnFailure};
use crate::panics::Panic;
use crate::runtime::{RoleId, topic};
use crate::sample::{Health, RoleState};
use crate::scenario::Scenario;
use crate::seat::{device_failure_path, failure_path, open_ledger, panic_path, report_path};
use crate::system::tell;
use crate::telemetry::Ledger;

/// Longest time that one look adds to a role's silence, ns. If the machine or the launcher is paused, the time of the pause
/// does not count as a role's silence.
const LOOK_MAX_NS: u64 = 100_000_000;

/// Silence after which `/proc` is asked if the role is stopped, and the interval between two such looks, ns.
const STANDSTILL_NS: u64 = 250_000_000;
const STANDSTILL_LOOK_NS: u64 = 50_000_000;

/// A successor that fails sooner than this may have failed because of its inherited state, ns.
const DISTRUSTED_NS: u64 = 1_000_000_000;

/// Shortest timeout of an external role without heartbeat, in periods.
const SILENT_PERIODS: f64 = 10.0;

/// Number of consecutive starts that may end with the same panic; the second one begins without the state of the first.
const PANICS_MAX: u64 = 2;

/// The program that executes an external role, as its samples show it.
#[derive(Default)]
struct Occupant {
    writer: Option<WriterProcess>,
    /// Time of its last sample, ns.
    sent_ns: u64,
    last_tick: Option<u64>,
    /// The program that ended, until its successor sends.
    left: Option<Left>,
    /// The tick of the successor's first sample, and the time without a sample, s.
    back: Option<(u64, f64)>,
}

/// A program that ended, and the first tick that it did not send.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Left {
    pid: u32,
    tick: u64,
}

impl Occupant {
    /// Updates the writer. `next_tick` is the tick after the last sample before this look; `run` holds the first and the last tick
    /// of the newest samples without a gap.
    fn look(&mut self, writer: Option<WriterProcess>, next_tick: u64, run: Option<(u64, u64)>, now_ns: u64) {
        let before = self.writer;
        self.writer = writer.or(before);
        if let Some(before) =
            before.filter(|before| next_tick > 0 && self.left.is_none() && self.writer != Some(*before))
        {
            self.left = Some(Left { pid: before.pid, tick: next_tick });
        }
        if let (Some((first, last)), None) = (run.filter(|(_, last)| Some(*last) > self.last_tick), self.back) {
            if let Some(left) = self.left.filter(|left| last >= left.tick) {
                self.back = Some((first.max(left.tick), now_ns.saturating_sub(self.sent_ns) as f64 / 1e9));
            }
            (self.last_tick, self.sent_ns) = (Some(last), now_ns);
        }
    }

    /// Returns, once, the program that ended, its successor's process, the tick of the successor's first sample, and the time
    /// without a sample, s.
    fn replaced(&mut self) -> Option<(Left, u32, u64, f64)> {
        let (tick, outage_s) = self.back.take()?;
        Some((self.left.take()?, self.writer?.pid, tick, outage_s))
    }
}

/// One role, with the other roles of its process.
pub(super) struct Member {
    pub name: String,
    pub role: RoleId,
    /// `None` for an external role, and between a failure and the restart.
    pub process: Option<RoleProcess>,
    pub external: bool,
    /// The other host that runs it, if it is not this one.
    host: Option<String>,
    pub last: Health,
    pub ledger: Ledger,
    /// The other roles of its process, all earlier in a tick, with their ledgers.
    hosted: Vec<(RoleId, Ledger)>,
    /// The samples of an external role: the only source of its state if it publishes no heartbeat.
    trace: Option<Trace>,
    /// The program that sends its samples.
    occupant: Occupant,
    health: <IoxBus as Bus>::Reader<Health>,
    /// True if the run waits without limit for a role that a signal or debugger has stopped, as in lockstep.
    patient: bool,
    /// Time since which it is stopped, and time of the last look, ns.
    stopped_ns: Option<u64>,
    stop_looked_ns: u64,
    /// True if it was killed because a debugger held it when the run ended.
    released: bool,
    /// A heartbeat of an earlier generation belongs to an ended process.
    generation: u64,
    silent_ns: u64,
    looked_ns: u64,
    /// True once the run's ticks have begun.
    in_ticks: bool,
    /// True once no more tick will be due.
    over: bool,
    /// True once it has failed and is not restarted.
    lost: bool,
    started_ns: u64,
    restarts: u64,
    /// Due time of the restart, and time of the failure, ns.
    restart: Option<(u64, u64)>,
    /// The panic that ended the last start, its tick, and the number of consecutive starts that ended with it.
    panicked: Option<(Panic, u64, u64)>,
}

impl Member {
    /// Creates a role without a process.
    pub fn new(
        scenario: &Scenario,
        role: RoleId,
        external: bool,
        domain: &Domain,
        bus: &IoxBus,
    ) -> Result<Self, LaunchError> {
        let now_ns = monotonic_ns();
        let name = role.name(scenario).to_owned();
        let hosted = role.process_members(scenario).into_iter().filter(|member| *member != role);
        let hosted = hosted.map(|member| Ok((member, open_ledger(domain, scenario, member)?)));
        Ok(Self {
            hosted: hosted.collect::<Result<_, LaunchError>>()?,
            health: bus.reader(&topic(scenario, &name, Signal::Health), Reader::Role)?,
            ledger: open_ledger(domain, scenario, role)?,
            trace: external.then(|| Trace::open(scenario, role, bus)).transpose()?,
            occupant: Occupant::default(),
            patient: scenario.clock != ClockKind::Realtime,
            stopped_ns: None,
            stop_looked_ns: 0,
            released: false,
            name,
            role,
            process: None,
            external,
            host: None,
            last: Health::default(),
            generation: 1,
            silent_ns: 0,
            in_ticks: false,
            over: false,
            lost: false,
            looked_ns: now_ns,
            started_ns: now_ns,
            restarts: 0,
            restart: None,
            panicked: None,
        })
    }

    /// Sets the other host that runs it, if any.
    pub fn on_host(self, host: Option<&str>) -> Self {
        Self { host: host.map(str::to_owned), ..self }
    }

    /// Sets its process.
    #[cfg(feature = "hosts")]
    pub fn with_process(self, process: RoleProcess) -> Self {
        Self { process: Some(process), ..self }
    }

    /// Returns the other host that runs it, if it is not this one.
    pub fn host(&self) -> Option<&str> {
        self.host.as_deref()
    }

    /// Returns all roles of its process with their ledgers, in the order of a tick.
    pub fn books(&self) -> impl Iterator<Item = (RoleId, &Ledger)> {
        self.hosted.iter().map(|(role, ledger)| (*role, ledger)).chain([(self.role, &self.ledger)])
    }

    /// Starts its process.
    pub fn start(&mut self, scenario: &Scenario, domain: &Domain, now_ns: u64) -> Result<(), LaunchError> {
        self.process = Some(RoleProcess::start(scenario, self.role, domain)?);
        (self.started_ns, self.looked_ns, self.silent_ns) = (now_ns, now_ns, 0);
        Ok(())
    }

    /// Returns the last state that the role reported.
    pub fn state(&self) -> RoleState {
        RoleState::from_number(self.last.state)
    }

    /// Reads the role's heartbeat, or, if an external role has none, its samples.
    pub fn listen(&mut self, now_ns: u64) -> Result<(), BusError> {
        self.silent_ns += now_ns.saturating_sub(self.looked_ns).min(LOOK_MAX_NS);
        self.looked_ns = now_ns;
        while self.health.advance()? {
            if let Some(health) = self.health.current().filter(|health| health.stamp.generation >= self.generation) {
                self.last = *health;
                self.silent_ns = 0;
            }
        }
        if let Some(trace) = &mut self.trace {
            let (before, _) = trace.newest();
            let seen = trace.look()?;
            // A host's relay sends for all processes of that host.
            if self.host.is_none() {
                self.occupant.look(trace.writer(), before, trace.newest().1, now_ns);
            }
            if !self.health.has_writer() && seen != self.last && self.state() < RoleState::Done {
                self.last = seen;
                self.silent_ns = 0;
            }
        }
        Ok(())
    }

    /// Sets if the run waits for a stopped role without limit.
    pub fn set_patient(&mut self, patient: bool) {
        self.patient = patient;
    }

    /// Returns the process that executes this role, if it is on this host.
    pub fn pid(&self) -> Option<i32> {
        let external = || self.occupant.writer.filter(|_| self.external_here()).map(|writer| writer.pid as i32);
        self.process.as_ref().map(RoleProcess::pid).or_else(external)
    }

    /// Returns how a signal or debugger holds its process, if one does.
    fn standstill(&self) -> Option<Standstill> {
        standstill(self.pid()?)
    }

    /// Returns true while the run waits for a stopped role.
    pub fn is_stopped(&self) -> bool {
        self.stopped_ns.is_some()
    }

    /// Returns true if a debugger is attached to it while it runs and sends heartbeats.
    pub fn runs_in_debugger(&self) -> bool {
        let attached = |held: Standstill| held.debugger.is_some() && !held.stopped;
        self.silent_ns < STANDSTILL_NS && self.standstill().is_some_and(attached)
    }

    /// Checks if a silent role is stopped while the run waits for it. Returns the line to print when it stops, and when it goes on.
    pub fn look_at_standstill(&mut self, now_ns: u64) -> Option<String> {
        let silent = self.silent_ns >= STANDSTILL_NS;
        if !self.patient || !(silent || self.is_stopped()) || now_ns < self.stop_looked_ns + STANDSTILL_LOOK_NS {
            return None;
        }
        self.stop_looked_ns = now_ns;
        match (self.standstill().filter(|_| silent), self.stopped_ns) {
            (Some(held), None) => {
                self.stopped_ns = Some(now_ns);
                Some(format!("the {} is {held}; the run waits for it", self.name))
            }
            (None, Some(since_ns)) => {
                // The usual timeout starts again here.
                (self.stopped_ns, self.silent_ns) = (None, 0);
                let stopped_s = now_ns.saturating_sub(since_ns) as f64 / 1e9;
                Some(format!("the {} goes on after {stopped_s:.1} s", self.name))
            }
            _ => None,
        }
    }

    /// Lets a stopped process end with the run: continues it after a stop by a signal, and kills it if a debugger holds it.
    pub fn release(&mut self) {
        let Some(process) = self.process.as_mut() else { return };
        if process.ended().is_some() {
            return;
        }
        match standstill(process.pid()) {
            Some(Standstill { debugger: None, .. }) => process.resume(),
            Some(held) if held.stopped => {
                tell(format_args!("corotate: the {} is {held}; it is killed, as the run ends", self.name));
                process.kill();
                self.released = true;
            }
            _ => {}
        }
    }

    /// Sets that the ticks run, and if no more tick will be due.
    pub fn in_ticks(&mut self, over: bool) {
        (self.in_ticks, self.over) = (true, over);
    }

    /// Returns true if the role has counters on this host, so that the launcher sees each completed tick.
    pub fn counts(&self) -> bool {
        self.ledger.generation() > 0
    }

    /// Returns true if no more sample is due from a role without heartbeat. It may have missed its last ticks.
    pub fn spent(&self) -> bool {
        self.over && self.trace.is_some() && !self.health.has_writer()
    }

    /// Returns, once, the incident of an external role whose program was replaced: as soon as the new program sends.
    pub fn replaced(&mut self) -> Option<Incident> {
        let (left, pid, tick, outage_s) = self.occupant.replaced()?;
        let cause = format!("its program, process {}, ended; process {pid} replaced it at tick {tick}", left.pid);
        Some(Incident {
            external: true,
            generation: self.generation,
            replaced_by: Some(Replacement { pid, tick }),
            outage_s: Some(outage_s),
            ..Incident::new(
                self.name.clone(),
                left.tick,
                RoleFailure::new("seat-taken-over", cause, String::new()),
                Action::Continued,
            )
        })
    }

    /// Returns the samples of an external role.
    pub fn trace(&self) -> Option<&Trace> {
        self.trace.as_ref()
    }

    /// Returns true while its process has not ended, or, if it is external, while it still has a heartbeat writer.
    pub fn lingers(&mut self) -> bool {
        match &mut self.process {
            Some(process) => process.ended().is_none(),
            None => self.external && !self.lost && self.health.has_writer(),
        }
    }

    /// Returns true if the role is an external one of this host.
    pub fn external_here(&self) -> bool {
        self.external && self.host.is_none()
    }

    /// Returns the failure of the role, if its process has ended or its heartbeat has timed out.
    pub fn failure(&mut self, scenario: &Scenario, janitor: &mut Janitor) -> Option<RoleFailure> {
        if self.external {
            return self.external_failure(scenario, janitor);
        }
        let done = self.state() == RoleState::Done;
        let process = self.process.as_mut()?;
        if let Some(status) = process.ended() {
            // A role that was done may end without being asked, if this process was delayed.
            return (!(status.success() && done)).then(|| process.failure(status));
        }
        // A restarted role has the same time to start as the first.
        let started = self.last.stamp.generation >= self.generation;
        let limit_s = if started { scenario.supervision.heartbeat_timeout_s } else { scenario.startup_timeout_s };
        if self.silent_ns as f64 <= limit_s * 1e9 {
            return None;
        }
        let held = standstill(process.pid());
        // A role that has just been continued can send a heartbeat first.
        if self.patient && (held.is_some() || self.stopped_ns.is_some()) {
            return None;
        }
        process.kill();
        // Printing a backtrace may take longer than the timeout.
        if let Some(failure) = process.panic() {
            return Some(failure);
        }
        let (code, state, limit) = match started {
            true => ("silent", "sent no heartbeat", "supervision.heartbeat_timeout_s"),
            false => ("not-ready", "was not ready", "launch.startup_timeout_s"),
        };
        let cause = match &held {
            Some(held) => format!("it was {held}, {state} for {limit_s} s and was killed; lockstep waits for it"),
            None => format!("it {state} for {limit_s} s and was killed; on a slow machine raise {limit}"),
        };
        Some(RoleFailure::new(if held.is_some() { "stopped" } else { code }, cause, process.last_words()))
    }

    /// Returns the failure of an external role: it reported one, it ended, or in real time its timeout has passed.
    ///
    /// In lockstep a silent role may compute or wait for others, so it fails only by ending or by `launch.external_timeout_s`. A role
    /// without heartbeat may miss its last ticks in real time: it is done if it still exists once its files would have been removed.
    fn external_failure(&mut self, scenario: &Scenario, janitor: &mut Janitor) -> Option<RoleFailure> {
        let (state, has_heartbeat) = (self.state(), self.health.has_writer());
        let present = has_heartbeat || self.trace.as_ref().is_some_and(Trace::written);
        let left = || ("left", "it left before its last tick".to_owned());
        let panic = panic_path(janitor.root(), &self.name);
        let fail = |(code, cause): (&str, String), last_words: String| {
            Some(Panic::take(&panic).map_or_else(|| RoleFailure::new(code, cause, last_words), RoleFailure::from_panic))
        };
        if state != RoleState::Done
            && let Ok(last_words) = std::fs::read_to_string(failure_path(janitor.root(), &self.name))
        {
            return fail(left(), last_words);
        }
        let words = device_failure_path(janitor.root(), &self.name);
        let fail = |cause: (&str, String)| fail(cause, std::fs::read_to_string(&words).unwrap_or_default());
        let timeout_s = match &self.host {
            Some(_) => scenario.host_silence_s(state >= RoleState::Running),
            None => scenario.supervision.heartbeat_timeout_s,
        };
        let limit_s = if has_heartbeat { timeout_s } else { timeout_s.max(SILENT_PERIODS * scenario.tick_s()) };
        if matches!(state, RoleState::Absent | RoleState::Done) || self.silent_ns as f64 <= limit_s * 1e9 {
            return None;
        }
        // Not before: a program that is being restarted is absent for a moment.
        if self.in_ticks && !present {
            return fail(left());
        }
        // A killed program counts as ended once its files are removed.
        janitor.clear_silent();
        if let (true, Some(host)) = (has_heartbeat, &self.host) {
            return fail(("host-silent", format!("no heartbeat from it and the host {host} for {limit_s} s")));
        }
        let held = || self.standstill().map_or(String::new(), |held| format!(" and was {held}"));
        match (has_heartbeat, state, scenario.clock) {
            (true, _, ClockKind::Realtime) => {
                let limit_s = scenario.external_timeout_s.map_or(limit_s, |external_s| external_s.max(limit_s));
                let silent = self.silent_ns as f64 > limit_s * 1e9;
                silent.then(|| fail(("silent", format!("it sent no heartbeat for {limit_s} s{}", held())))).flatten()
            }
            (false, RoleState::Running, ClockKind::Realtime) if self.over => {
                if self.silent_ns as f64 > 2.0 * limit_s * 1e9 {
                    self.last.state = RoleState::Done as u64;
                }
                None
            }
            (false, RoleState::Running, ClockKind::Realtime) => {
                fail(("no-samples", format!("it sent no sample for {limit_s} s{}", held())))
            }
            _ => None,
        }
    }

    /// Returns the failure of a role that did not end in order, unless it was killed because a debugger held it.
    pub fn bad_end(&mut self, reported: bool) -> Option<RoleFailure> {
        let process = self.process.as_mut()?;
        match process.ended() {
            Some(status) if status.success() && reported || self.released => None,
            Some(status) => Some(process.failure(status)),
            None => {
                process.kill();
                let limit_s = END_LIMIT.as_secs();
                let cause = format!("it did not end within {limit_s} s after the stop, and was killed");
                Some(RoleFailure::new("did-not-end", cause, process.last_words()))
            }
        }
    }

    /// Returns true if its process has ended and nothing is missing: every tick is done, and every report is there.
    pub fn ended_complete(&mut self, scenario: &Scenario, domain: &Domain) -> bool {
        let ended = self.process.as_mut().is_some_and(|process| process.ended().is_some());
        ended
            && self.books().all(|(role, ledger)| {
                crate::runtime::next_tick(ledger) > scenario.last_tick
                    && report_path(domain.root(), role.name(scenario)).exists()
            })
    }

    /// Records a failure that has no effect on the run.
    pub fn note(&mut self, failure: RoleFailure, scenario: &Scenario) -> Incident {
        self.process = None;
        self.last.state = RoleState::Done as u64;
        self.incident(failure, scenario, Action::Noted)
    }

    fn incident(&self, failure: RoleFailure, scenario: &Scenario, action: Action) -> Incident {
        let tick = if self.counts() { crate::runtime::next_tick(&self.ledger) } else { self.last.stamp.tick };
        Incident {
            external: self.external,
            with: self.hosted.iter().map(|(role, _)| role.name(scenario).to_owned()).collect(),
            generation: self.generation,
            ..Incident::new(self.name.clone(), tick, failure, action)
        }
    }

    /// Decides how to react to a failure, and prepares the restart.
    pub fn fail(&mut self, failure: RoleFailure, scenario: &Scenario, now_ns: u64) -> Incident {
        let supervision = &scenario.supervision;
        let restart = |(role, _): (RoleId, &Ledger)| supervision.reaction_to(role.name(scenario)) == OnFailure::Restart;
        let repeated = self.panics_again(&failure, scenario.clock);
        let again =
            !self.external && self.books().all(restart) && self.restarts < supervision.restarts_max && !repeated;
        // A state that makes its role fail must not be inherited again and again.
        let begins_anew = again && self.generation > 1 && now_ns.saturating_sub(self.started_ns) < DISTRUSTED_NS;
        if begins_anew {
            self.books().for_each(|(_, ledger)| ledger.discard_state());
        }
        let action = if again { Action::Restarted } else { Action::Stopped };
        self.lost = !again;
        let incident = Incident { begins_anew, repeated, ..self.incident(failure, scenario, action) };
        // Reaped here, before the next process starts.
        self.process = None;
        if again {
            self.restarts += 1;
            self.generation = self.ledger.generation() + 1;
            self.last = Health::default();
            let earliest_ns = self.started_ns + (supervision.restart_interval_s * 1e9) as u64;
            self.restart = Some((earliest_ns.max(now_ns), now_ns));
        }
        incident
    }

    /// Records a panic. Returns true if a restart would only repeat it: in lockstep at once, because the same tick has the same
    /// inputs; in real time after a start without the inherited state.
    fn panics_again(&mut self, failure: &RoleFailure, clock: ClockKind) -> bool {
        let tick = crate::runtime::next_tick(&self.ledger);
        let alike = failure.panic.as_ref().map(|panic| match &self.panicked {
            Some((before, at, starts)) if before.is_like(panic) => (panic.clone(), tick, starts + 1, *at == tick),
            _ => (panic.clone(), tick, 1, false),
        });
        let same_tick = clock != ClockKind::Realtime && alike.as_ref().is_some_and(|(.., same_tick)| *same_tick);
        self.panicked = alike.map(|(panic, tick, starts, _)| (panic, tick, starts));
        same_tick || self.panicked.as_ref().is_some_and(|(.., starts)| *starts > PANICS_MAX)
    }

    /// Restarts the role if that is due.
    pub fn restart(&mut self, scenario: &Scenario, domain: &Domain, now_ns: u64) -> Result<(), LaunchError> {
        match self.restart {
            Some((due_ns, _)) if self.process.is_none() && now_ns >= due_ns => self.start(scenario, domain, now_ns),
            _ => Ok(()),
        }
    }

    /// Returns, once, the outage of the role, ns, as soon as its successor runs.
    pub fn back_after_ns(&mut self, now_ns: u64) -> Option<u64> {
        let (_, noticed_ns) = self.restart.filter(|_| self.state() >= RoleState::Running)?;
        self.restart = None;
        Some(now_ns - noticed_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn process(pid: u32, unique: u128) -> Option<WriterProcess> {
        Some(WriterProcess { pid, unique })
    }

    #[test]
    fn a_program_that_replaces_another_is_reported_once() {
        let mut occupant = Occupant::default();
        occupant.look(process(1, 1), 0, None, 0);
        occupant.look(process(1, 1), 0, Some((0, 99)), 1_000_000_000);
        assert_eq!(occupant.replaced(), None);
        // Its files are removed, then another program exists, which sends later.
        occupant.look(None, 100, Some((0, 99)), 1_500_000_000);
        occupant.look(process(1, 2), 100, Some((0, 99)), 2_000_000_000);
        assert_eq!(occupant.replaced(), None);
        occupant.look(process(1, 2), 100, Some((180, 185)), 3_000_000_000);
        assert_eq!(
            occupant.replaced(),
            Some((Left { pid: 1, tick: 100 }, 1, 180, 2.0)),
            "the same number in another container"
        );
        occupant.look(process(1, 2), 186, Some((180, 190)), 3_100_000_000);
        assert_eq!(occupant.replaced(), None);
        occupant.look(process(7, 3), 191, Some((180, 191)), 3_200_000_000);
        assert!(
            matches!(occupant.replaced(), Some((Left { pid: 1, tick: 191 }, 7, 191, _))),
            "in lockstep no tick is lost"
        );
    }

    #[test]
    fn a_program_that_is_replaced_before_the_run_is_no_incident() {
        let mut occupant = Occupant::default();
        occupant.look(process(1, 1), 0, None, 0);
        occupant.look(process(2, 2), 0, None, 10);
        occupant.look(process(2, 2), 0, Some((0, 5)), 20);
        assert_eq!(occupant.replaced(), None);
    }
}
