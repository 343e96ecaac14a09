//! One role, seen from the launcher: its process, its heartbeat, its starts; and what became of it when it failed.
//!
//! Must not decide when a run ends, nor lead it; [`super::processes`] does.

use super::LaunchError;
use super::children::{END_LIMIT, RoleProcess};
use super::incident::{Action, Failure, Incident, Replacement};
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

/// The most that one look adds to a role's silence, ns. Whoever stops the whole machine, or just the launcher, stops the
/// clock of silence too: a role is only judged for the time in which it was listened to.
const LOOK_MAX_NS: u64 = 100_000_000;

/// After so long a silence `/proc` is asked whether a role is stopped, ns, and so often again.
const STANDSTILL_NS: u64 = 250_000_000;
const STANDSTILL_LOOK_NS: u64 = 50_000_000;

/// A successor that fails sooner than this may have died of the state that it inherited, ns.
const DISTRUSTED_NS: u64 = 1_000_000_000;

/// An external role that is seen by its samples alone may be silent for at least so many periods.
const SILENT_PERIODS: f64 = 10.0;

/// So many starts in a row may end with the same panic: the second of them began without the state of the first.
const PANICS_MAX: u64 = 2;

/// The program in the seat of an external role, by what it sends.
#[derive(Default)]
struct Occupant {
    writer: Option<WriterProcess>,
    /// When it sent its last sample, ns.
    sent_ns: u64,
    last_tick: Option<u64>,
    /// The program that left the seat, until its successor sends; then with the tick of that sample and how long the seat was empty, s.
    left: Option<Left>,
    back: Option<(u64, f64)>,
}

/// A program that left its seat, and the tick that it had not sent.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Left {
    pid: u32,
    tick: u64,
}

impl Occupant {
    /// Looks who writes. `next_tick` is that after the last sample before this look, `run` the first and the last tick of the newest
    /// samples without a gap.
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

    /// Returns the program that left, the process that took its seat, the tick of its first sample, and how long the seat was empty, s:
    /// once.
    fn replaced(&mut self) -> Option<(Left, u32, u64, f64)> {
        let (tick, outage_s) = self.back.take()?;
        Some((self.left.take()?, self.writer?.pid, tick, outage_s))
    }
}

/// One role, seen from the launcher, with what else is in its process.
pub(super) struct Member {
    pub name: String,
    pub role: RoleId,
    /// None for a role that somebody else starts, and between a death and the next start.
    pub process: Option<RoleProcess>,
    pub external: bool,
    /// The other host that has it, if one has.
    host: Option<String>,
    pub last: Health,
    pub ledger: Ledger,
    /// The other roles in its process, all earlier in a tick, with their counters.
    hosted: Vec<(RoleId, Ledger)>,
    /// What an external role sends; all there is to go by where it says nothing of itself.
    trace: Option<Trace>,
    /// The program that sends its samples.
    occupant: Occupant,
    health: <IoxBus as Bus>::Reader<Health>,
    /// True if a stop by a signal or a debugger is waited for without limit, as in lockstep.
    patient: bool,
    /// Since when it is stopped, ns, and when that was looked at last.
    stopped_ns: Option<u64>,
    stop_looked_ns: u64,
    /// True if it was killed because a debugger held it when the run ended.
    released: bool,
    /// Health of an earlier generation is a dead role's.
    generation: u64,
    silent_ns: u64,
    looked_ns: u64,
    /// True once the run's ticks have begun.
    in_ticks: bool,
    /// No more tick will be due.
    over: bool,
    /// True once it has failed for good: nothing more is waited for.
    lost: bool,
    started_ns: u64,
    restarts: u64,
    /// When the successor is due, and when the failure was noticed, ns.
    restart: Option<(u64, u64)>,
    /// The panic that the last start ended with, at which tick, and how many starts in a row ended so.
    panicked: Option<(Panic, u64, u64)>,
}

impl Member {
    /// A role whose process, unless somebody else starts it, is still to be given.
    pub fn new(
        scenario: &Scenario,
        role: RoleId,
        external: bool,
        domain: &Domain,
        bus: &IoxBus,
    ) -> Result<Self, LaunchError> {
        let now_ns = monotonic_ns();
        let name = role.name(scenario).to_owned();
        let hosted = role.process_members(scenario).into_iter().filter(|other| *other != role);
        let hosted = hosted.map(|other| Ok((other, open_ledger(domain, scenario, other)?)));
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

    /// The same on another host, if it is on one.
    pub fn on_host(self, host: Option<&str>) -> Self {
        Self { host: host.map(str::to_owned), ..self }
    }

    /// The same with its process.
    #[cfg(feature = "hosts")]
    pub fn with_process(self, process: RoleProcess) -> Self {
        Self { process: Some(process), ..self }
    }

    /// The other host that has it, if one has.
    pub fn host(&self) -> Option<&str> {
        self.host.as_deref()
    }

    /// All roles in its process with their counters, in the order of a tick.
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

    /// Hears how the role is; an external one that does not tell is seen by its samples.
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
            let told = trace.look()?;
            // A host's relay sends for all processes there.
            if self.host.is_none() {
                self.occupant.look(trace.writer(), before, trace.newest().1, now_ns);
            }
            if !self.health.has_writer() && told != self.last && self.state() < RoleState::Done {
                self.last = told;
                self.silent_ns = 0;
            }
        }
        Ok(())
    }

    /// Sets whether a stop is waited for without limit.
    pub fn set_patient(&mut self, patient: bool) {
        self.patient = patient;
    }

    /// The process that has this seat, if it is one of this host.
    pub fn pid(&self) -> Option<i32> {
        let external = || self.occupant.writer.filter(|_| self.external_here()).map(|writer| writer.pid as i32);
        self.process.as_ref().map(RoleProcess::pid).or_else(external)
    }

    /// Looks for a stop of its process, or a debugger.
    fn standstill(&self) -> Option<Standstill> {
        standstill(self.pid()?)
    }

    /// Returns true while the run waits for a stopped role.
    pub fn is_stopped(&self) -> bool {
        self.stopped_ns.is_some()
    }

    /// Returns true if a debugger is attached to it, and it runs and is heard.
    pub fn runs_in_debugger(&self) -> bool {
        let attached = |held: Standstill| held.debugger.is_some() && !held.stopped;
        self.silent_ns < STANDSTILL_NS && self.standstill().is_some_and(attached)
    }

    /// Looks whether a silent role is stopped where that is waited for. Returns the line to print once it is, and once it goes on.
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
                // From here on it has its usual time to speak.
                (self.stopped_ns, self.silent_ns) = (None, 0);
                let stopped_s = now_ns.saturating_sub(since_ns) as f64 / 1e9;
                Some(format!("the {} goes on after {stopped_s:.1} s", self.name))
            }
            _ => None,
        }
    }

    /// Lets a stopped process end with the run: undoes a signal's stop, and kills what a debugger holds.
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

    /// Notes that the ticks run, and whether no more tick will be due.
    pub fn in_ticks(&mut self, over: bool) {
        (self.in_ticks, self.over) = (true, over);
    }

    /// Returns true if the role has counters here: then the launcher sees each tick that it completes.
    pub fn counts(&self) -> bool {
        self.ledger.generation() > 0
    }

    /// Whether nothing more will come of it, though it need not have come to its last tick: it is seen by its samples alone,
    /// and none is due.
    pub fn spent(&self) -> bool {
        self.over && self.trace.is_some() && !self.health.has_writer()
    }

    /// Returns the incident of an external role whose program has been replaced by another: once, when that sends.
    pub fn replaced(&mut self) -> Option<Incident> {
        let (left, pid, tick, outage_s) = self.occupant.replaced()?;
        let cause = format!("its program, process {}, left; process {pid} took its seat at tick {tick}", left.pid);
        Some(Incident {
            external: true,
            generation: self.generation,
            replaced_by: Some(Replacement { pid, tick }),
            outage_s: Some(outage_s),
            ..Incident::new(
                self.name.clone(),
                left.tick,
                Failure::new("seat-taken-over", cause, String::new()),
                Action::Continued,
            )
        })
    }

    /// What it sends, if it is external.
    pub fn trace(&self) -> Option<&Trace> {
        self.trace.as_ref()
    }

    /// Whether it is on its way out: its process has not ended, or, if it is external, it still has its line open.
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

    /// Returns the failure of the role, if any: its process has ended, or it has been silent for too long.
    pub fn failure(&mut self, scenario: &Scenario, janitor: &mut Janitor) -> Option<Failure> {
        if self.external {
            return self.fell_silent(scenario, janitor);
        }
        let done = self.state() == RoleState::Done;
        let process = self.process.as_mut()?;
        if let Some(status) = process.ended() {
            // A role that was done may have left without the word, if this process was kept from giving it.
            return (!(status.success() && done)).then(|| process.failure(status));
        }
        // A successor has as long to come up as the first.
        let heard = self.last.stamp.generation >= self.generation;
        let limit_s = if heard { scenario.supervision.heartbeat_timeout_s } else { scenario.startup_timeout_s };
        if self.silent_ns as f64 <= limit_s * 1e9 {
            return None;
        }
        let held = standstill(process.pid());
        // One that has just gone on is heard before it is judged.
        if self.patient && (held.is_some() || self.stopped_ns.is_some()) {
            return None;
        }
        process.kill();
        // A backtrace may take longer than the limit.
        if let Some(failure) = process.panic() {
            return Some(failure);
        }
        let (code, said, limit) = match heard {
            true => ("silent", "said nothing", "supervision.heartbeat_timeout_s"),
            false => ("not-ready", "was not ready", "launch.startup_timeout_s"),
        };
        let cause = match &held {
            Some(held) => format!("it was {held}, {said} for {limit_s} s and was killed; in lockstep it is waited for"),
            None => format!("it {said} for {limit_s} s and was killed; on a slow machine raise {limit}"),
        };
        Some(Failure::new(if held.is_some() { "stopped" } else { code }, cause, process.last_words()))
    }

    /// Returns how an external role has failed: it left its last words, it is gone, or it is silent in real time. In lockstep a
    /// role that is silent and alive is computing or waits for the others, so it fails only by leaving, or by
    /// `launch.external_timeout_s`, which in real time is the limit of a role that is alive. One that is only seen by its samples
    /// may have missed its last ticks in real time: then it is done, if it is still there once its remains would have been removed.
    fn fell_silent(&mut self, scenario: &Scenario, janitor: &mut Janitor) -> Option<Failure> {
        let (state, tells) = (self.state(), self.health.has_writer());
        let present = tells || self.trace.as_ref().is_some_and(Trace::written);
        let left = || ("left", "it left before its last tick".to_owned());
        let panic = panic_path(janitor.root(), &self.name);
        let fail = |(code, cause): (&str, String), last_words: String| {
            Some(Panic::take(&panic).map_or_else(|| Failure::new(code, cause, last_words), Failure::of))
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
        let limit_s = if tells { timeout_s } else { timeout_s.max(SILENT_PERIODS * scenario.tick_s()) };
        if matches!(state, RoleState::Absent | RoleState::Done) || self.silent_ns as f64 <= limit_s * 1e9 {
            return None;
        }
        // Not before: a program that was started again in its seat is not there for a moment.
        if self.in_ticks && !present {
            return fail(left());
        }
        // One that was killed has left once its remains are put away.
        if !janitor.is_busy() {
            janitor.clear_dead();
        }
        if let (true, Some(host)) = (tells, &self.host) {
            return fail(("host-silent", format!("nothing was heard of it and the host {host} for {limit_s} s")));
        }
        let held = || self.standstill().map_or(String::new(), |held| format!(" and was {held}"));
        match (tells, state, scenario.clock) {
            (true, _, ClockKind::Realtime) => {
                let limit_s = scenario.external_timeout_s.map_or(limit_s, |external_s| external_s.max(limit_s));
                let silent = self.silent_ns as f64 > limit_s * 1e9;
                silent.then(|| fail(("silent", format!("it said nothing for {limit_s} s{}", held())))).flatten()
            }
            (false, RoleState::Running, ClockKind::Realtime) if self.over => {
                if self.silent_ns as f64 > 2.0 * limit_s * 1e9 {
                    self.last.state = RoleState::Done as u64;
                }
                None
            }
            (false, RoleState::Running, ClockKind::Realtime) => {
                fail(("no-samples", format!("it sent nothing for {limit_s} s{}", held())))
            }
            _ => None,
        }
    }

    /// Returns the failure of a role that did not end in order. One that was killed because a debugger held it has none.
    pub fn bad_end(&mut self, reported: bool) -> Option<Failure> {
        let process = self.process.as_mut()?;
        match process.ended() {
            Some(status) if status.success() && reported || self.released => None,
            Some(status) => Some(process.failure(status)),
            None => {
                process.kill();
                let limit_s = END_LIMIT.as_secs();
                let cause = format!("it did not end within {limit_s} s of being told to and was killed");
                Some(Failure::new("did-not-end", cause, process.last_words()))
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

    /// Takes note of a failure by which nothing is lost.
    pub fn note(&mut self, failure: Failure, scenario: &Scenario) -> Incident {
        self.process = None;
        self.last.state = RoleState::Done as u64;
        self.incident(failure, scenario, Action::Noted)
    }

    fn incident(&self, failure: Failure, scenario: &Scenario, action: Action) -> Incident {
        let tick = if self.counts() { crate::runtime::next_tick(&self.ledger) } else { self.last.stamp.tick };
        Incident {
            external: self.external,
            with: self.hosted.iter().map(|(role, _)| role.name(scenario).to_owned()).collect(),
            generation: self.generation,
            ..Incident::new(self.name.clone(), tick, failure, action)
        }
    }

    /// Decides what is done about a failure, and prepares it.
    pub fn fail(&mut self, failure: Failure, scenario: &Scenario, now_ns: u64) -> Incident {
        let supervision = &scenario.supervision;
        let restart = |(role, _): (RoleId, &Ledger)| supervision.reaction_to(role.name(scenario)) == OnFailure::Restart;
        let repeated = self.panics_again(&failure, scenario.clock);
        let again =
            !self.external && self.books().all(restart) && self.restarts < supervision.restarts_max && !repeated;
        // A state that kills must not be inherited for ever.
        let begins_anew = again && self.generation > 1 && now_ns.saturating_sub(self.started_ns) < DISTRUSTED_NS;
        if begins_anew {
            self.books().for_each(|(_, ledger)| ledger.discard_state());
        }
        let action = if again { Action::Restarted } else { Action::Stopped };
        self.lost = !again;
        let incident = Incident { begins_anew, repeated, ..self.incident(failure, scenario, action) };
        // Reaped here, before another process takes the seat.
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

    /// Takes note of a panic, and returns true if another start would only repeat it: at once in lockstep, where the same tick
    /// has the same inputs; in real time after a start that began without the state of the one before.
    fn panics_again(&mut self, failure: &Failure, clock: ClockKind) -> bool {
        let tick = crate::runtime::next_tick(&self.ledger);
        let alike = failure.panic.as_ref().map(|panic| match &self.panicked {
            Some((before, at, starts)) if before.is_like(panic) => (panic.clone(), tick, starts + 1, *at == tick),
            _ => (panic.clone(), tick, 1, false),
        });
        let same_tick = clock != ClockKind::Realtime && alike.as_ref().is_some_and(|(.., same_tick)| *same_tick);
        self.panicked = alike.map(|(panic, tick, starts, _)| (panic, tick, starts));
        same_tick || self.panicked.as_ref().is_some_and(|(.., starts)| *starts > PANICS_MAX)
    }

    /// Starts the successor if it is due.
    pub fn restart(&mut self, scenario: &Scenario, domain: &Domain, now_ns: u64) -> Result<(), LaunchError> {
        match self.restart {
            Some((due_ns, _)) if self.process.is_none() && now_ns >= due_ns => self.start(scenario, domain, now_ns),
            _ => Ok(()),
        }
    }

    /// Returns the outage of the role, ns, once, as soon as its successor runs.
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
    fn a_program_that_takes_a_seat_in_the_midst_is_told_once() {
        let mut occupant = Occupant::default();
        occupant.look(process(1, 1), 0, None, 0);
        occupant.look(process(1, 1), 0, Some((0, 99)), 1_000_000_000);
        assert_eq!(occupant.replaced(), None);
        // Its remains are put away, then another one is there, which sends later.
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
    fn a_seat_that_changes_hands_before_the_run_is_no_incident() {
        let mut occupant = Occupant::default();
        occupant.look(process(1, 1), 0, None, 0);
        occupant.look(process(2, 2), 0, None, 10);
        occupant.look(process(2, 2), 0, Some((0, 5)), 20);
        assert_eq!(occupant.replaced(), None);
    }
}
