//! A run as processes: start, warm up, run, stop, collect. One thread, which also scores.
//!
//! On every path the destructors of this file end every role, remove the domain and end the janitor, in that order.

#[cfg(feature = "hosts")]
mod joined;

use super::change_signal::ChangeSignal;
use super::children::{END_LIMIT, RoleProcess};
use super::companion::Companion;
use super::external::{ExternalWatch, Waiting};
use super::foxglove;
use super::incident::{Action, Incident, Incidents, RoleFailure};
use super::janitor::Janitor;
use super::overrun::{Overran, OverrunWatch};
use super::recorder::RecorderWatch;
use super::relay::RelayWatch;
use super::remains::Remains;
use super::standstill::attach_remedy;
use super::supervision::Member;
use super::tracer::TracerWatch;
use super::{Launch, LaunchError, Outcome, Progress};
use crate::bus::domain::{Domain, OwnedDomain, require_files};
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Signal, Write};
use crate::changes::ReceivedChanges;
use crate::clock::{self, Grid, RunClock, monotonic_ns};
use crate::config::{ClockKind, Overrun};
use crate::hosts::{NetworkStatistics, RELAY};
use crate::input::Change;
use crate::inputs::{InputServer, Timing};
use crate::late::TRACER;
use crate::record::RECORDER;
use crate::runtime::{
    Backoff, PaceBoard, RoleId, depths, hold_low_latency_idle, ignored_changes, report, request_short_slices,
    shared_memory_bytes, topic, window_ticks,
};
use crate::sample::{Phase, RoleState, Schedule, Stamp};
use crate::scenario::Scenario;
use crate::scenario::scorer as open_scorer;
use crate::score::Scorer;
use crate::seat::{
    changes_path, describe_seat, listening_process, report_path, results_path, scenario_path, seat_path, write_whole,
};
use crate::system::tell;
use crate::telemetry::{Grant, Ledger, Outage, RoleReport};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::os::fd::AsFd;
use std::os::unix::ffi::OsStrExt;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Interval between two looks at the roles, ns.
const LOOK_NS: u64 = 1_000_000;
/// Interval between two looks at the samples to be scored, in real time, ns.
const SCORE_NS: u64 = 10_000_000;
/// Time from the published start to the first tick, ns: every role, here and on other hosts, must receive it before.
const EPOCH_LEAD_NS: u64 = 20_000_000;
const EPOCH_LEAD_HOSTS_NS: u64 = 300_000_000;
/// Interval between two looks at samples in lockstep while no sample comes, ns.
const LULL_NS: u64 = 50_000;
/// Upper bounds on the number of open files of the launcher, which opens more than any other process.
const DESCRIPTORS: u64 = 32;
const DESCRIPTORS_PER_ROLE: u64 = 24;
/// Upper bounds on the number of files that a run creates in shared memory and beside it: signals, connections, process tags.
const FILES: u64 = 32;
const FILES_PER_ROLE: u64 = 32;
/// Time for which a role must run in its debugger before the ticks begin, ns: a debugger attaches a moment before it stops it.
const DEBUGGED_NS: u64 = 500_000_000;
/// Interval between two checks if a role that is to end is stopped, ns.
const RELEASE_NS: u64 = 50_000_000;
/// Time that an external role of this host has to end after a signal ended the run: it may hang.
const SIGNALLED_END_LIMIT: Duration = Duration::from_millis(300);
/// Time from the receipt of a change to the first tick at which it may act, ns: longer than a role takes for a tick, and than this
/// process is usually held up.
const CHANGE_LEAD_NS: u64 = 3_000_000;
/// The same for a run over several hosts, whose network the change must cross: relays repeat a lost message after 20 ms.
const CHANGE_LEAD_HOSTS_NS: u64 = 300_000_000;
/// Time without progress after which the run counts as hung, ns and periods.
const HUNG_NS: u64 = 30_000_000_000;
const HUNG_PERIODS: u64 = 10;

/// Runs all roles of a scenario as processes.
pub(super) fn run(scenario: &Scenario, launch: &mut Launch<'_>) -> Result<Outcome, LaunchError> {
    // Child processes inherit them.
    request_short_slices();
    let owned = new_domain(scenario)?;
    let domain = owned.domain();
    scenario.inputs.receive_in(ReceivedChanges::default());
    prepare(scenario, launch, domain)?;
    let pace = open_pace(scenario, launch, domain)?;
    let _own_clock = pace.as_ref().map(|_| OwnClockAfter);
    let startup_limit = Duration::from_secs_f64(scenario.startup_timeout_s);
    let mut janitor = Janitor::start(domain, startup_limit)?;
    let (_low_latency, grants) = match scenario.clock {
        ClockKind::Realtime => hold_low_latency_idle(&scenario.realtime),
        _ => (None, Vec::new()),
    };
    let bus = IoxBus::enter(domain, "launcher", depths(scenario))?.with_opening_limit(startup_limit);
    let mut supervisor = Supervisor::start(scenario, launch, domain, &bus, &mut janitor)?;
    supervisor.pace = pace;
    let mut scorer = open_scorer(scenario, &bus).map_err(|error| supervisor.blame(error.into()))?;
    let signal = supervisor.run_phases(&mut *scorer, launch, &grants).map_err(|error| supervisor.blame(error))?;
    let mut shutdown = supervisor.shut_down(if signal == 0 { END_LIMIT } else { SIGNALLED_END_LIMIT });
    let role_outages = |report: &RoleReport| {
        let role = report.role.clone();
        report.outages.clone().into_iter().map(move |outage| (role.clone(), outage))
    };
    for report in shutdown.reports.iter().filter(|report| report.late_inputs > 0) {
        let (role, count) = (&report.role, report.late_inputs);
        tell(format_args!(
            "corotate: {role} received {count} changes of inputs after their tick: a replay may differ from there on"
        ));
    }
    let outages: Vec<(String, Outage)> = shutdown.reports.iter().flat_map(role_outages).collect();
    shutdown.leave_out_partial(|role| is_external(scenario, launch, role));
    let ShutdownReport { reports, unbooked, mut problems } = shutdown;
    let (hosts, host_problems, elsewhere) = supervisor.relay.finish(&supervisor.incidents);
    problems.extend(host_problems);
    let mut note = |id, tick| scorer.incident(id, tick);
    for incident in elsewhere {
        supervisor.incidents.add(incident, &mut note);
    }
    for (role, outage) in outages {
        let incident = supervisor.incidents.add(Incident::from_outage(&role, &outage), &mut note);
        tell(format_args!("corotate: {incident}"));
    }
    let score = scorer.finish()?;
    let (incidents, recorder) = (supervisor.incidents.finish(&score.recoveries_s), supervisor.recorder);
    let late = supervisor.tracer.finish(scenario, domain, &reports);
    let recording = recorder.finish(domain, &reports, NetworkStatistics::merge(&hosts).as_ref());
    let domain = Some(domain.root().to_owned());
    let remains = Some(Remains::new(bus, owned, janitor));
    Ok(Outcome {
        reports,
        unbooked,
        problems,
        score,
        incidents,
        hosts,
        grants,
        recording,
        late,
        domain,
        signal,
        remains,
    })
}

/// Makes the clock that a device may set, in a run in real time with an external body, and uses it in this process.
fn open_pace(scenario: &Scenario, launch: &Launch<'_>, domain: &Domain) -> Result<Option<PaceBoard>, LaunchError> {
    let mut bodies = scenario.bodies.iter().filter(|body| body.driven && body.fleet.is_none());
    if scenario.clock != ClockKind::Realtime || !bodies.any(|body| is_external(scenario, launch, &body.name)) {
        return Ok(None);
    }
    let path = domain.shared(RunClock::PACE);
    let failed = |source| LaunchError::Write { path: path.clone(), source };
    let board = PaceBoard::open(domain).map_err(failed)?;
    clock::adopt(&path).map_err(failed)?;
    Ok(Some(board))
}

/// Makes this process use its own clock again when it is dropped.
struct OwnClockAfter;

impl Drop for OwnClockAfter {
    fn drop(&mut self) {
        clock::release();
    }
}

/// Creates a domain with the shared memory that a run of a scenario needs.
pub fn new_domain(scenario: &Scenario) -> Result<OwnedDomain, LaunchError> {
    require_descriptors(scenario)?;
    require_files(FILES + FILES_PER_ROLE * RoleId::all(scenario).len() as u64)?;
    Ok(OwnedDomain::create(shared_memory_bytes(scenario))?)
}

/// Writes the files into a domain that a process needs to join the run.
pub(super) fn prepare(scenario: &Scenario, launch: &Launch<'_>, domain: &Domain) -> Result<(), LaunchError> {
    if let Some(results) = &launch.results {
        let path = results_path(domain.root());
        write_whole(&path, results.as_os_str().as_bytes()).map_err(|source| LaunchError::Write { path, source })?;
    }
    share_changes(scenario, domain)?;
    // After the files that a process looks for once it has the scenario.
    let path = scenario_path(domain);
    write_whole(&path, scenario.to_file().as_bytes()).map_err(|source| LaunchError::Write { path, source })?;
    describe_seats(scenario, launch, domain)
}

/// Moves the list of received changes into a domain; that of a replay has those of the recorded run.
pub(super) fn share_changes(scenario: &Scenario, domain: &Domain) -> Result<(), LaunchError> {
    let path = changes_path(domain);
    let list = ReceivedChanges::open(&path).map_err(|source| LaunchError::Write { path, source })?;
    let before = scenario.inputs.received();
    let before: Vec<Change> = (0..before.count()).filter_map(|number| before.get(number)).collect();
    list.append(&before, || true);
    scenario.inputs.receive_in(list);
    Ok(())
}

fn is_external(scenario: &Scenario, launch: &Launch<'_>, role: &str) -> bool {
    launch.external.iter().chain(&scenario.external).any(|external| external == role)
}

/// Returns true if changes of inputs do not reach a role: the program that runs it does not read them.
fn takes_no_inputs(
    scenario: &Scenario,
    launch: &Launch<'_>,
    domain: &Domain,
    members: &[Member],
    role: RoleId,
) -> bool {
    let name = role.name(scenario);
    let process = || members.iter().find(|member| member.books().any(|(own, _)| own == role))?.pid();
    is_external(scenario, launch, name)
        && listening_process(domain.root(), name).is_none_or(|listener| process().is_some_and(|pid| pid != listener))
}

/// Returns the other host that runs a role, if one does.
fn elsewhere<'s>(scenario: &'s Scenario, launch: &Launch<'_>, role: &str) -> Option<&'s str> {
    let seat = launch.host.as_ref()?;
    scenario.hosts.host_of(role).filter(|host| *host != seat.host)
}

/// Writes the seat description of every external role into the domain.
fn describe_seats(scenario: &Scenario, launch: &Launch<'_>, domain: &Domain) -> Result<(), LaunchError> {
    let roles = RoleId::all(scenario).into_iter();
    for role in roles.filter(|role| is_external(scenario, launch, role.name(scenario))) {
        let path = seat_path(domain.root(), role.name(scenario));
        let seat = describe_seat(scenario, role, Some(domain)).to_json();
        write_whole(&path, seat.as_bytes()).map_err(|source| LaunchError::Write { path, source })?;
    }
    Ok(())
}

/// The final reports of the roles.
#[derive(Default)]
pub(super) struct ShutdownReport {
    pub reports: Vec<RoleReport>,
    /// External roles that keep no counters.
    pub unbooked: Vec<String>,
    /// Defects of the reports.
    pub problems: Vec<String>,
}

impl ShutdownReport {
    /// Removes the report of an external role that covers fewer ticks than others have read from it: a program that replaced
    /// another one knows nothing of that one's ticks.
    fn leave_out_partial(&mut self, is_external: impl Fn(&str) -> bool) {
        let last_read = |service: &str| {
            let links = self.reports.iter().flat_map(|report| &report.read);
            links.filter(|link| link.service == service).filter_map(|link| link.last_tick).max()
        };
        let covers = |report: &RoleReport| report.written.iter().all(|link| link.last_tick >= last_read(&link.service));
        let partial = |report: &&RoleReport| is_external(&report.role) && !covers(report);
        let names: Vec<String> = self.reports.iter().filter(partial).map(|report| report.role.clone()).collect();
        self.reports.retain(|report| !names.contains(&report.role));
        self.unbooked.extend(names);
    }

    /// Adds a role's report, or its counters.
    fn gather(&mut self, scenario: &Scenario, domain: &Domain, role: RoleId, ledger: &Ledger) {
        let name = role.name(scenario).to_owned();
        let file = std::fs::read(report_path(domain.root(), &name)).ok();
        match file.map(|bytes| serde_json::from_slice(&bytes)) {
            Some(Ok(report)) => self.reports.push(report),
            Some(Err(error)) => self.problems.push(format!("{name}: its report is unreadable: {error}")),
            None if ledger.generation() > 0 => {
                self.reports.push(report(scenario, role, ledger, Vec::new(), Vec::new()));
            }
            None => self.unbooked.push(name),
        }
    }
}

/// Raises the limit on open files as far as allowed, for this process and its children, and checks that it is enough.
fn require_descriptors(scenario: &Scenario) -> Result<(), LaunchError> {
    let limits = getrlimit(Resource::Nofile);
    // If it cannot be raised, the present limit is checked.
    let _ = setrlimit(Resource::Nofile, Rlimit { current: limits.maximum, ..limits });
    let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    let needed = DESCRIPTORS + DESCRIPTORS_PER_ROLE * RoleId::all(scenario).len() as u64;
    if limit < needed { Err(LaunchError::Descriptors { limit, needed }) } else { Ok(()) }
}

/// All roles of a run, and the launcher's link to them.
pub(super) struct Supervisor<'a> {
    scenario: &'a Scenario,
    domain: &'a Domain,
    janitor: &'a mut Janitor,
    members: Vec<Member>,
    externals: ExternalWatch,
    schedule: <IoxBus as Bus>::Writer<Schedule>,
    changes: ChangeSignal,
    word: Schedule,
    incidents: Incidents,
    recorder: RecorderWatch,
    foxglove: Companion,
    relay: RelayWatch,
    tracer: TracerWatch,
    /// Present if a device may set the pace.
    pace: Option<PaceBoard>,
    overrun: OverrunWatch,
    /// True while the safe command is to be applied after an overrun.
    goes_safe: bool,
    /// Absent on a host that joined: the launching host receives the changes.
    inputs: Option<InputServer>,
    received: Arc<ReceivedChanges>,
}

impl<'a> Supervisor<'a> {
    fn start(
        scenario: &'a Scenario,
        launch: &Launch<'_>,
        domain: &'a Domain,
        bus: &'a IoxBus,
        janitor: &'a mut Janitor,
    ) -> Result<Self, LaunchError> {
        let schedule = bus.writer(&topic(scenario, "run", Signal::Schedule), 1)?;
        let changes = ChangeSignal::open(scenario, bus)?;
        let mut recorder = RecorderWatch::start(launch.record.as_deref(), scenario, domain, bus)?;
        let foxglove = foxglove::start(launch.foxglove, domain)?;
        let tracer = TracerWatch::start(scenario, domain)?;
        let hub = launch.host.as_ref().map_or("", |seat| &seat.host);
        let relay = RelayWatch::start(launch.host.as_ref(), hub, scenario, domain)?;
        // All roles start first: they prepare while their links are opened here.
        let start = |role: RoleId| {
            let name = role.name(scenario);
            match is_external(scenario, launch, name) || elsewhere(scenario, launch, name).is_some() {
                true => Ok((role, None)),
                false => RoleProcess::start(scenario, role, domain).map(|process| (role, Some(process))),
            }
        };
        let hosts = RoleId::all(scenario).into_iter().filter(|role| role.process_role(scenario) == *role);
        let mut started = hosts.map(start).collect::<Result<Vec<_>, _>>()?;
        let open = |(role, process): &(RoleId, Option<RoleProcess>)| {
            let elsewhere = elsewhere(scenario, launch, role.name(scenario));
            Ok(Member::new(scenario, *role, process.is_none(), domain, bus)?.on_host(elsewhere))
        };
        let mut members = started.iter().map(open).collect::<Result<Vec<_>, _>>().map_err(|error| {
            let roles = started.iter_mut().map(|(role, process)| (role.name(scenario), process.as_mut()));
            blame(error, roles.chain([recorder.companion.process()]))
        })?;
        members.iter_mut().zip(started).for_each(|(member, (_, process))| member.process = process);
        let externals = ExternalWatch::new(members.len());
        let (word, incidents) = (Schedule::default(), Incidents::default());
        let path = domain.root().to_owned();
        let inputs = Some(InputServer::start(domain).map_err(|source| LaunchError::Write { path, source })?);
        Ok(Self {
            scenario,
            domain,
            janitor,
            members,
            externals,
            schedule,
            changes,
            word,
            incidents,
            recorder,
            foxglove,
            relay,
            tracer,
            pace: None,
            overrun: OverrunWatch::new(scenario),
            goes_safe: false,
            inputs,
            received: scenario.inputs.received(),
        })
    }

    /// See [`blame`].
    fn blame(&mut self, error: LaunchError) -> LaunchError {
        let members = self.members.iter_mut().map(|member| (&*member.name, member.process.as_mut()));
        blame(error, members.chain([self.recorder.companion.process(), self.relay.companion.process()]))
    }

    /// Runs the phases of a run with all roles. Returns the signal that ended it, or 0.
    fn run_phases(
        &mut self,
        scorer: &mut dyn Scorer,
        launch: &mut Launch<'_>,
        grants: &[Grant],
    ) -> Result<usize, LaunchError> {
        for (phase, state) in [(Phase::Gather, RoleState::Open), (Phase::WarmUp, RoleState::Ready)] {
            self.word.phase = phase as u64;
            if !self.await_state(state, scorer, launch)? {
                return Ok(launch.signal.load(Ordering::Relaxed));
            }
        }
        if launch.require_realtime
            && (self.members.iter().any(|m| m.last.denied > 0) || grants.iter().any(|g| !g.granted))
        {
            return Err(self.denied(grants));
        }
        if !self.await_debuggers(scorer, launch)? {
            return Ok(launch.signal.load(Ordering::Relaxed));
        }
        self.warn_of_ignored_changes(launch);
        self.word.phase = Phase::Run as u64;
        if self.scenario.clock == ClockKind::Realtime {
            let lead_ns = if launch.host.is_some() { EPOCH_LEAD_HOSTS_NS } else { EPOCH_LEAD_NS };
            self.word.epoch_ns = monotonic_ns() + lead_ns;
            if let Some(pace) = &self.pace {
                // The frames of a device have their phase against the multiples of the period.
                self.word.epoch_ns = self.word.epoch_ns.next_multiple_of(self.scenario.period_ns);
                pace.run();
            }
            scorer.start(Grid { epoch_ns: self.word.epoch_ns, period_ns: self.scenario.period_ns });
        }
        self.announce()?;
        self.follow(scorer, launch)
    }

    /// Waits until each role of `launch.debug` runs in a debugger; false if a signal came first.
    fn await_debuggers(&mut self, scorer: &mut dyn Scorer, launch: &mut Launch<'_>) -> Result<bool, LaunchError> {
        let scenario = self.scenario;
        let named = |role: RoleId| scenario.debug.iter().any(|name| name == role.name(scenario));
        let debugged = |member: &&mut Member| member.process.is_some() && member.books().any(|(role, _)| named(role));
        for member in self.members.iter_mut().filter(debugged) {
            member.set_patient(true);
            let (name, pid) = (&member.name, member.pid().unwrap_or_default());
            let remedy = attach_remedy().map_or(String::new(), |remedy| format!("\n  {remedy}"));
            (launch.progress)(&Progress::External(&format!(
                "the {name} waits for a debugger: attach it, set breakpoints, and continue\n  gdb -p {pid}\n  lldb -p {pid}{remedy}"
            )));
        }
        let mut alone_ns = monotonic_ns();
        while !scenario.debug.is_empty() && monotonic_ns() - alone_ns < DEBUGGED_NS {
            self.announce()?;
            self.listen()?;
            scorer.poll(u64::MAX)?;
            self.look_at_standstills(launch);
            self.require_all_alive()?;
            if launch.signal.load(Ordering::Relaxed) != 0 {
                return Ok(false);
            }
            if self.members.iter_mut().filter(debugged).any(|member| !member.runs_in_debugger()) {
                alone_ns = monotonic_ns();
            }
            self.pause(monotonic_ns() + SCORE_NS);
        }
        let patient = scenario.clock != ClockKind::Realtime;
        self.members.iter_mut().for_each(|member| member.set_patient(patient));
        Ok(true)
    }

    /// Reports roles that are stopped or go on. Returns true while the run waits for one.
    fn look_at_standstills(&mut self, launch: &mut Launch<'_>) -> bool {
        let now_ns = monotonic_ns();
        for line in self.members.iter_mut().filter_map(|member| member.look_at_standstill(now_ns)) {
            (launch.progress)(&Progress::External(&line));
        }
        self.members.iter().any(Member::is_stopped)
    }

    /// Returns an error if a role has failed before the ticks run.
    fn require_all_alive(&mut self) -> Result<(), LaunchError> {
        for member in &mut self.members {
            if let Some(RoleFailure { cause, last_words, .. }) = member.failure(self.scenario, self.janitor) {
                return Err(LaunchError::Died { role: member.name.clone(), cause, last_words });
            }
        }
        Ok(())
    }

    /// Waits until every role has reached a state; returns false if a signal came first. A role that fails before is not
    /// restarted, because the failure would only repeat.
    fn await_state(
        &mut self,
        state: RoleState,
        scorer: &mut dyn Scorer,
        launch: &mut Launch<'_>,
    ) -> Result<bool, LaunchError> {
        let limit_s = self.scenario.startup_timeout_s;
        let mut looked_ns = monotonic_ns();
        let mut end_ns = looked_ns + (limit_s * 1e9) as u64;
        loop {
            self.announce()?;
            self.listen()?;
            // The time for which a role is stopped does not count.
            let stopped = self.look_at_standstills(launch);
            end_ns += if stopped { monotonic_ns() - looked_ns } else { 0 };
            looked_ns = monotonic_ns();
            // Its links take part in the warm-up.
            scorer.poll(u64::MAX)?;
            self.require_all_alive()?;
            let waiting = self.externals.before_ticks(self.scenario, &self.members, state, monotonic_ns());
            if !self.tell(waiting, scorer, launch) {
                return Ok(false);
            }
            let recorder = self.recorder.has_reached(state)?;
            let foxglove = self.foxglove.ready(&foxglove::address_path(self.domain))?;
            let watchers = [
                (RECORDER, recorder),
                ("foxglove", foxglove),
                (RELAY, self.relay.ready()?),
                (TRACER, self.tracer.ready(self.domain)?),
            ];
            if let Some(incident) = self.relay.supervise(self.scenario, 0).into_iter().next() {
                return Err(LaunchError::Died {
                    role: incident.role,
                    cause: incident.cause,
                    last_words: incident.last_words,
                });
            }
            let absent = watchers.into_iter().filter(|(_, ready)| !ready).map(|(name, _)| name);
            let missing: Vec<&Member> = self.members.iter().filter(|member| member.state() < state).collect();
            if missing.is_empty() && absent.clone().count() == 0 {
                return Ok(true);
            }
            if launch.signal.load(Ordering::Relaxed) != 0 {
                return Ok(false);
            }
            let mut roles: Vec<&str> = missing.iter().map(|member| &*member.name).collect();
            let by_hand = missing.iter().filter(|member| member.external && member.host().is_none());
            let external: Vec<&str> = by_hand.map(|member| &*member.name).collect();
            let mut hosts: Vec<&str> = missing.iter().filter_map(|member| member.host()).collect();
            hosts.sort_unstable();
            hosts.dedup();
            roles.extend(absent);
            // Roles that are started by hand, and hosts that join, have no timeout.
            if monotonic_ns() > end_ns && external.is_empty() && hosts.is_empty() {
                return Err(LaunchError::StartUp { limit_s, roles: roles.join(", ") });
            }
            // The address for them is known once the relay listens.
            let hosts = if self.relay.ready()? { hosts } else { Vec::new() };
            (launch.progress)(&Progress::Waiting { roles, external, hosts, domain: self.domain.root().to_owned() });
            self.pause(monotonic_ns() + LOOK_NS);
        }
    }

    /// Follows the ticks to the end: scores, grants credit, supervises the roles.
    fn follow(&mut self, scorer: &mut dyn Scorer, launch: &mut Launch<'_>) -> Result<usize, LaunchError> {
        let lockstep = self.scenario.clock != ClockKind::Realtime;
        let credit_ticks = (window_ticks(self.scenario) / 4).max(1);
        let mut stall = Stall::new(self.scenario);
        let mut backoff = Backoff::default();
        let (mut next_look_ns, mut process_ended) = (0, false);
        while self.members.iter().any(|member| member.state() < RoleState::Done) {
            let scored = scorer.poll(credit_ticks)?;
            let credit = if lockstep { self.recorder.credit(scorer.next_tick(), self.word.credit_tick)? } else { 0 };
            if scored > 0 {
                backoff = Backoff::default();
            }
            let idle = scored == 0 && !(lockstep && backoff.brief());
            // Publishing wakes the roles that are far ahead: for several ticks at once, unless there is nothing else to do.
            if credit >= self.word.credit_tick + if idle { 1 } else { credit_ticks } {
                // A change must be there before a role may come to its tick.
                if let Some(inputs) = &mut self.inputs {
                    inputs.append_pending(&self.received, credit + window_ticks(self.scenario));
                }
                self.word.credit_tick = credit;
                self.announce()?;
            }
            let now_ns = monotonic_ns();
            if now_ns >= next_look_ns || process_ended {
                process_ended = false;
                next_look_ns = now_ns + SCORE_NS;
                self.announce()?;
                self.listen()?;
                self.serve_inputs(launch)?;
                let tick = scorer.next_tick();
                if !self.supervise(&mut |id, tick| scorer.incident(id, tick), tick, now_ns)? {
                    return Ok(0);
                }
                let stopped = self.look_at_standstills(launch);
                // While a role is stopped, no other one is blamed for waiting.
                let waiting = match stopped {
                    true => Vec::new(),
                    false => self.externals.in_ticks(self.scenario, &self.members, scorer.next_tick(), now_ns),
                };
                if !self.tell(waiting, scorer, launch) {
                    return Ok(0);
                }
                // The wait for an external role has its own timeout.
                stall.look(&self.members, now_ns, stopped || lockstep && self.externals.waits())?;
                let signal = launch.signal.load(Ordering::Relaxed);
                if signal != 0 {
                    return Ok(signal);
                }
                let (tick, last_tick) = (scorer.next_tick(), self.scenario.last_tick);
                (launch.progress)(&Progress::Running { tick, last_tick, metric: scorer.latest() });
            }
            if idle {
                let until_ns = if lockstep { monotonic_ns() + LULL_NS } else { next_look_ns };
                process_ended = self.pause(until_ns);
            }
        }
        Ok(0)
    }

    /// Serves requests to change inputs.
    fn serve_inputs(&mut self, launch: &Launch<'_>) -> Result<(), BusError> {
        let (scenario, word) = (self.scenario, &self.word);
        let period_ns = scenario.period_ns;
        let timing = || match scenario.clock {
            ClockKind::Realtime => {
                let now_ns = monotonic_ns();
                let tick_at = |ns: u64| ns.saturating_sub(word.epoch_ns).div_ceil(period_ns);
                let lead_ns = if launch.host.is_some() { CHANGE_LEAD_HOSTS_NS } else { CHANGE_LEAD_NS };
                Timing {
                    earliest: tick_at(now_ns + lead_ns),
                    safe: tick_at(now_ns + lead_ns / 3),
                    horizon: tick_at(now_ns + lead_ns + 5 * SCORE_NS),
                    clock: Some((word.epoch_ns, period_ns, now_ns)),
                }
            }
            // No role passes the credit by more than the window.
            ClockKind::Lockstep | ClockKind::InProcess => {
                let earliest = word.credit_tick + window_ticks(scenario) + 1;
                Timing { earliest, safe: earliest, horizon: earliest + window_ticks(scenario), clock: None }
            }
        };
        let (domain, members) = (self.domain, &self.members);
        let ignores = |role: RoleId| takes_no_inputs(scenario, launch, domain, members, role);
        if let Some(inputs) = &mut self.inputs {
            inputs.poll(scenario, &self.received, &timing, &ignores);
            if std::mem::take(&mut self.goes_safe) {
                match inputs.go_safe(scenario, &self.received, &timing, &ignores) {
                    Ok(tick) => tell(format_args!("corotate: the safe command of every body acts from tick {tick} on")),
                    Err(reason) => tell(format_args!("corotate: the safe command cannot be applied: {reason}")),
                }
            }
        }
        self.changes.publish()
    }

    /// Prints which changes of the scenario a role ignores.
    fn warn_of_ignored_changes(&self, launch: &Launch<'_>) {
        let (scenario, domain, members) = (self.scenario, self.domain, &self.members);
        let ignores = |role: RoleId| takes_no_inputs(scenario, launch, domain, members, role);
        for reason in ignored_changes(scenario, &ignores) {
            tell(format_args!("corotate: {reason}; the role ignores its changes in the scenario"));
        }
    }

    /// Restarts roles that have failed, and records hosts that left; returns false if the run must end. `note` receives the number
    /// and the tick of each incident; `tick` is the current one.
    pub fn supervise(&mut self, note: &mut dyn FnMut(u64, u64), tick: u64, now_ns: u64) -> Result<bool, LaunchError> {
        let mut go_on = true;
        for incident in self.relay.supervise(self.scenario, tick) {
            tell(format_args!("corotate: {}", self.incidents.add(incident, note)));
            go_on = false;
        }
        if let Some(Overran { role, tick, failure }) = self.overrun.look(self.scenario, &self.members) {
            if self.overrun.policy() == Overrun::Stop {
                let incident = Incident::new(role, tick, failure, Action::Stopped);
                tell(format_args!("corotate: {}", self.incidents.add(incident, note)));
                go_on = false;
            } else {
                tell(format_args!("corotate: {role}: {}", failure.cause));
                self.goes_safe = true;
            }
        }
        let ticks_ns = (self.scenario.last_tick + 1).saturating_mul(self.scenario.period_ns);
        let over = self.scenario.clock == ClockKind::Realtime && now_ns > self.word.epoch_ns.saturating_add(ticks_ns);
        self.recorder.supervise(self.janitor);
        self.tracer.supervise(self.janitor);
        self.foxglove.loss(false, self.janitor);
        for member in &mut self.members {
            member.in_ticks(over);
            let complete = member.ended_complete(self.scenario, self.domain);
            if let Some(failure) = member.failure(self.scenario, self.janitor) {
                let incident = match complete {
                    true => member.note(failure, self.scenario),
                    false => member.fail(failure, self.scenario, now_ns),
                };
                go_on &= incident.action != Action::Stopped;
                tell(format_args!("corotate: {}", self.incidents.add(incident, note)));
                self.janitor.clear_dead();
            }
            if let Some(incident) = member.replaced() {
                tell(format_args!("corotate: {}", self.incidents.add(incident, note)));
            }
            // A successor can open its links once the files of its predecessor are removed.
            if !self.janitor.is_busy() {
                member.restart(self.scenario, self.domain, now_ns)?;
            }
            if let Some(outage_ns) = member.back_after_ns(now_ns) {
                self.incidents.end_outage(&member.name, outage_ns as f64 / 1e9);
            }
        }
        Ok(go_on)
    }

    /// Reports the external roles for which the run waits. Returns false if the run must end for one.
    fn tell(&mut self, waiting: Vec<Waiting>, scorer: &mut dyn Scorer, launch: &mut Launch<'_>) -> bool {
        let mut go_on = true;
        for waiting in waiting {
            match waiting {
                Waiting::Print(words) => (launch.progress)(&Progress::External(&words)),
                Waiting::TooLong { member, tick, cause } => {
                    let failure = RoleFailure::new("waited-too-long", cause, String::new());
                    let incident = self.members[member].fail(failure, self.scenario, monotonic_ns());
                    let incident = Incident { tick, ..incident };
                    let incident = self.incidents.add(incident, &mut |id, tick| scorer.incident(id, tick));
                    tell(format_args!("corotate: {incident}"));
                    go_on = false;
                }
            }
        }
        go_on
    }

    /// Waits until `until_ns`. Returns true if a role's process ended or the janitor answered before.
    pub fn pause(&self, until_ns: u64) -> bool {
        let handles = self.members.iter().filter_map(|member| member.process.as_ref()?.handle()).map(AsFd::as_fd);
        let handles = handles.chain(self.janitor.answers());
        let mut handles: Vec<PollFd<'_>> =
            handles.map(|handle| PollFd::from_borrowed_fd(handle, PollFlags::IN)).collect();
        let wait_ns = until_ns.saturating_sub(monotonic_ns());
        let timeout = Timespec { tv_sec: (wait_ns / 1_000_000_000) as i64, tv_nsec: (wait_ns % 1_000_000_000) as _ };
        // The caller checks all conditions itself after every wake-up.
        poll(&mut handles, Some(&timeout)).is_ok_and(|ended| ended > 0)
    }

    /// Publishes the schedule again.
    pub fn announce(&mut self) -> Result<(), BusError> {
        self.changes.publish()?;
        self.word.stamp =
            Stamp { tick: self.word.stamp.tick + 1, generation: 1, origin_ns: 0, sent_ns: monotonic_ns() };
        let word = self.word;
        self.schedule.send(|sample| *sample = word)
    }

    /// Reads all heartbeats.
    pub fn listen(&mut self) -> Result<(), BusError> {
        let now_ns = monotonic_ns();
        self.recorder.listen()?;
        self.members.iter_mut().try_for_each(|member| member.listen(now_ns))
    }

    fn denied(&mut self, own: &[Grant]) -> LaunchError {
        let mut denied: Vec<(String, Grant)> = own.iter().map(|grant| ("launcher".to_owned(), grant.clone())).collect();
        for report in self.shut_down(END_LIMIT).reports {
            denied.extend(report.grants.into_iter().map(|grant| (report.role.clone(), grant)));
        }
        denied.retain(|(_, grant)| !grant.granted);
        LaunchError::Privileges { denied }
    }

    /// Ends the roles and collects their reports; a role of ours without a report has its counters. External roles of this host
    /// have `external_limit` to end.
    pub fn shut_down(&mut self, external_limit: Duration) -> ShutdownReport {
        self.word.phase = Phase::Stop as u64;
        let [limit_ns, external_limit_ns] =
            [END_LIMIT, external_limit].map(|limit| monotonic_ns() + limit.as_nanos() as u64);
        let lingers = |member: &mut Member| {
            let limit_ns = if member.external_here() { external_limit_ns } else { limit_ns };
            member.lingers() && monotonic_ns() < limit_ns
        };
        // Published first. Dead roles are not waited for: a killed external role counts as ended once its files are removed.
        let _ = self.announce();
        self.janitor.clear_dead();
        let mut release_ns = monotonic_ns() + RELEASE_NS;
        while self.members.iter_mut().any(lingers) {
            if monotonic_ns() >= release_ns {
                self.members.iter_mut().for_each(Member::release);
                release_ns = monotonic_ns() + RELEASE_NS;
            }
            let _ = self.janitor.is_busy();
            // Published repeatedly, because a role that is starting has not received it yet. A link that fails now changes
            // nothing: a role that does not end is killed.
            let _ = self.announce();
            self.pause(monotonic_ns() + LOOK_NS);
        }
        self.tracer.companion.stop();
        // Readers of samples end after all writers; the recorder once its file is written, which a busy disk may delay; the relay
        // once no other host is missing.
        let begun_ns = monotonic_ns();
        let within = |limit_ns: u64| monotonic_ns() - begun_ns < limit_ns;
        while self.foxglove.lingers() && within(END_LIMIT.as_nanos() as u64)
            || (self.recorder.lingers()
                || self.tracer.companion.lingers()
                || self.relay.leads() && self.relay.companion.lingers())
                && within(HUNG_NS)
        {
            let _ = self.announce();
            self.pause(monotonic_ns() + LOOK_NS);
        }
        let mut shutdown = ShutdownReport::default();
        for member in &mut self.members {
            let reported = report_path(self.domain.root(), &member.name).exists();
            if let Some(failure) = member.bad_end(reported) {
                let incident = match member.ended_complete(self.scenario, self.domain) {
                    true => member.note(failure, self.scenario),
                    false => Incident { action: Action::Stopped, ..member.fail(failure, self.scenario, 0) },
                };
                // All ticks are over, so no recovery is timed.
                tell(format_args!("corotate: {}", self.incidents.add(incident, &mut |_, _| ())));
            }
            for (role, ledger) in member.books() {
                shutdown.gather(self.scenario, self.domain, role, ledger);
            }
        }
        // In the order of a tick, whichever roles share a process.
        let order = RoleId::all(self.scenario);
        let place = |name: &str| order.iter().position(|role| role.name(self.scenario) == name);
        shutdown.reports.sort_by_key(|report| place(&report.role));
        shutdown
    }
}

/// Returns the death of a process as the cause of a link's failure, if one died: a process that dies while it opens its links
/// leaves incomplete ones.
fn blame<'a>(
    error: LaunchError,
    processes: impl Iterator<Item = (&'a str, Option<&'a mut RoleProcess>)>,
) -> LaunchError {
    if !matches!(error, LaunchError::Bus(_) | LaunchError::Ledger(_)) {
        return error;
    }
    let death = |(name, process): (&str, Option<&mut RoleProcess>)| {
        let process = process?;
        process.ended().filter(|status| !status.success())?;
        process.require_alive(name).err()
    };
    processes.filter_map(death).next().unwrap_or(error)
}

/// Detects a run without progress.
struct Stall {
    limit_ns: u64,
    moved_ns: u64,
    ticks: Vec<u64>,
}

impl Stall {
    fn new(scenario: &Scenario) -> Self {
        // A role's own timeout comes first, because it names the role.
        let heartbeat_ns = (2e9 * scenario.supervision.heartbeat_timeout_s) as u64;
        let limit_ns = HUNG_NS.max(HUNG_PERIODS * scenario.period_ns).max(heartbeat_ns);
        Self { limit_ns, moved_ns: monotonic_ns(), ticks: Vec::new() }
    }

    fn look(&mut self, members: &[Member], now_ns: u64, excused: bool) -> Result<(), LaunchError> {
        let moved = excused
            || self.ticks.len() != members.len()
            || members.iter().zip(&self.ticks).any(|(member, tick)| member.last.stamp.tick != *tick);
        if moved {
            self.moved_ns = now_ns;
            self.ticks = members.iter().map(|member| member.last.stamp.tick).collect();
        }
        if now_ns.saturating_sub(self.moved_ns) < self.limit_ns {
            return Ok(());
        }
        let waiting = members.iter().filter(|member| member.state() < RoleState::Done);
        let behind = waiting.clone().map(|member| member.last.stamp.tick).min();
        let roles: Vec<&str> =
            waiting.filter(|member| Some(member.last.stamp.tick) == behind).map(|member| &*member.name).collect();
        Err(LaunchError::Hung { limit_s: self.limit_ns as f64 / 1e9, roles: roles.join(", ") })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use std::process::Command;

    #[test]
    fn the_heartbeat_timeout_comes_before_that_of_a_run_without_progress() {
        let limit_s = |heartbeat_s: f64| {
            let patient = [format!("supervision.heartbeat_timeout_s={heartbeat_s:?}")];
            let scenario = Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &patient).unwrap();
            Stall::new(&scenario).limit_ns as f64 / 1e9
        };
        assert_eq!([2.0, 30.0, 3600.0].map(limit_s), [30.0, 60.0, 7200.0]);
    }

    #[test]
    fn the_cause_of_a_failed_link_is_the_process_that_died() {
        let error = || BusError::Open { service: "s".to_owned(), end: "reader", reason: "HangsInCreation".to_owned() };
        let start = |script: &str| {
            let mut command = Command::new("/bin/sh");
            command.args(["-c", script]);
            let mut process = RoleProcess::spawn(command, "role".to_owned()).unwrap();
            while process.ended().is_none() {
                std::thread::yield_now();
            }
            process
        };
        let (mut well, mut killed) = (start("exit 0"), start("kill -9 $$"));
        let blamed = blame(error().into(), [("well", Some(&mut well)), ("killed", Some(&mut killed))].into_iter());
        assert!(
            matches!(&blamed, LaunchError::Died { role, cause, .. } if role == "killed" && cause.contains("SIGKILL"))
        );
        let blamed = blame(error().into(), [("well", Some(&mut well)), ("external", None)].into_iter());
        assert!(matches!(blamed, LaunchError::Bus(_)));
    }
}
