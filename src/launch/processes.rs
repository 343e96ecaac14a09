//! A run as processes: start, warm up, run, stop, collect. One thread, which also scores.
//!
//! On every path the destructors of this file end every role, remove the domain and end the janitor, in that order.

mod before_ticks;
mod in_ticks;
#[cfg(feature = "hosts")]
mod joined;
mod prepare;
mod reports;
mod stall;

pub use prepare::new_domain;
pub(super) use prepare::{prepare, share_changes};

use super::change_signal::ChangeSignal;
use super::children::{END_LIMIT, RoleProcess};
use super::companion::Companion;
use super::error::LaunchError;
use super::external::ExternalWatch;
use super::foxglove;
use super::incident::{Action, Incident, Incidents};
use super::janitor::Janitor;
use super::options::Launch;
use super::outcome::Outcome;
use super::overrun::OverrunWatch;
use super::recorder::RecorderWatch;
use super::relay::RelayWatch;
use super::remains::Remains;
use super::supervision::Member;
use super::tracer::TracerWatch;
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Signal, Write};
use crate::changes::ReceivedChanges;
use crate::clock::{Grid, monotonic_ns};
use crate::config::ClockKind;
use crate::hosts::NetworkStatistics;
use crate::inputs::InputServer;
use crate::runtime::{PaceBoard, RoleId, depths, hold_low_latency_idle, request_short_slices, topic};
use crate::sample::{Phase, RoleState, Schedule, Stamp};
use crate::scenario::Scenario;
use crate::scenario::scorer as open_scorer;
use crate::score::Scorer;
use crate::seat::report_path;
use crate::system::tell;
use crate::telemetry::{Grant, Outage, RoleReport};
use prepare::{OwnClockAfter, elsewhere, is_external, open_pace};
use reports::ShutdownReport;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use stall::HUNG_NS;
use std::os::fd::AsFd;
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
/// Interval between two checks if a role that is to end is stopped, ns.
const RELEASE_NS: u64 = 50_000_000;
/// Time that an external role of this host has to end after a signal ended the run: it may hang.
const SIGNALLED_END_LIMIT: Duration = Duration::from_millis(300);

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

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

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
