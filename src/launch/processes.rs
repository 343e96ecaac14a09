//! A run as processes: gather, warm up, run, stop, collect. One thread, which also scores.
//!
//! Whatever happens, dropping what this file holds ends every role and removes the domain, in that order.

use super::children::{Janitor, RoleProcess, await_end};
use super::score::{self, Scorer};
use super::{Launch, LaunchError, Outcome, Progress};
use crate::bus::domain::{Domain, OwnedDomain};
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal, Write};
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::{ClockKind, Scenario};
use crate::runtime::{
    Backoff, RoleId, depths, describe_seat, hold_low_latency_idle, report_path, scenario_path, seat_path, topic,
    write_whole,
};
use crate::sample::{Health, Phase, RoleState, Schedule, Stamp};
use crate::telemetry::{Grant, RoleReport};
use std::sync::atomic::Ordering;

/// Between two looks at the roles, ns.
const LOOK_NS: u64 = 1_000_000;
/// In real time, between two looks at the samples to be scored, ns.
const SCORE_NS: u64 = 10_000_000;
/// From the word to run to the first tick, ns: time for every role to hear it.
const EPOCH_LEAD_NS: u64 = 50_000_000;
/// Ticks scored between two credits in lockstep.
const CREDIT_TICKS: u64 = 16;
/// Without any progress for so long the run counts as hung, ns, and periods.
const HUNG_NS: u64 = 30_000_000_000;
const HUNG_PERIODS: u64 = 10;

/// Runs all roles of a scenario as processes.
pub(super) fn run(scenario: &Scenario, launch: &mut Launch<'_>) -> Result<Outcome, LaunchError> {
    let owned = OwnedDomain::create()?;
    let path = scenario_path(owned.domain());
    write_whole(&path, scenario.to_toml().as_bytes()).map_err(|source| LaunchError::Write { path, source })?;
    describe_seats(scenario, launch, owned.domain())?;
    // Declared before the roles, so that it is dropped, and cleans up, after them.
    let _janitor = Janitor::start(&launch.program)?;
    let (_low_latency, grants) = match scenario.clock {
        ClockKind::Realtime => hold_low_latency_idle(&scenario.realtime),
        _ => (None, Vec::new()),
    };
    let bus = IoxBus::enter(owned.domain(), "launcher", depths(scenario))?;
    let mut crew = Crew::start(scenario, launch, &owned, &bus)?;
    let mut scorer = score::open(scenario, &bus)?;
    let signal = crew.conduct(&mut *scorer, launch, &grants)?;
    let reports = crew.dismiss()?;
    Ok(Outcome { reports, score: scorer.finish()?, grants, domain: Some(owned.domain().root().to_owned()), signal })
}

fn is_external(scenario: &Scenario, launch: &Launch<'_>, role: &str) -> bool {
    launch.external.iter().chain(&scenario.external).any(|external| external == role)
}

/// Leaves the seat of every external role in the domain, for the program that is to take it.
fn describe_seats(scenario: &Scenario, launch: &Launch<'_>, domain: &Domain) -> Result<(), LaunchError> {
    let roles = RoleId::all(scenario).into_iter();
    for role in roles.filter(|role| is_external(scenario, launch, role.name(scenario))) {
        let path = seat_path(domain.root(), role.name(scenario));
        let seat = describe_seat(scenario, role, Some(domain)).to_json();
        write_whole(&path, seat.as_bytes()).map_err(|source| LaunchError::Write { path, source })?;
    }
    Ok(())
}

/// One role, seen from the launcher.
struct Member {
    name: String,
    external: bool,
    health: <IoxBus as Bus>::Reader<Health>,
    last: Health,
}

impl Member {
    fn state(&self) -> RoleState {
        RoleState::from_number(self.last.state)
    }
}

/// All roles of a run, and the launcher's line to them.
struct Crew<'a> {
    scenario: &'a Scenario,
    members: Vec<Member>,
    processes: Vec<RoleProcess>,
    schedule: <IoxBus as Bus>::Writer<Schedule>,
    word: Schedule,
    domain: std::path::PathBuf,
}

impl<'a> Crew<'a> {
    fn start(
        scenario: &'a Scenario,
        launch: &Launch<'_>,
        owned: &OwnedDomain,
        bus: &IoxBus,
    ) -> Result<Self, LaunchError> {
        let schedule = bus.writer(&topic(scenario, "run", Signal::Schedule))?;
        let (mut members, mut processes) = (Vec::new(), Vec::new());
        for role in RoleId::all(scenario) {
            let name = role.name(scenario).to_owned();
            let external = is_external(scenario, launch, &name);
            if !external {
                processes.push(RoleProcess::start(&launch.program, scenario, role, owned.domain())?);
            }
            let health = bus.reader(&topic(scenario, &name, Signal::Health), Reader::Role)?;
            members.push(Member { name, external, health, last: Health::default() });
        }
        let domain = owned.domain().root().to_owned();
        Ok(Self { scenario, members, processes, schedule, word: Schedule::default(), domain })
    }

    /// Leads the roles through the phases of a run. Returns the signal that ended it, or 0.
    fn conduct(
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
        self.word.phase = Phase::Run as u64;
        self.word.epoch_ns = match self.scenario.clock {
            ClockKind::Realtime => monotonic_ns() + EPOCH_LEAD_NS,
            _ => 0,
        };
        self.announce()?;
        self.follow(scorer, launch)
    }

    /// Waits until every role has reached a state; false if a signal came first.
    fn await_state(
        &mut self,
        state: RoleState,
        scorer: &mut dyn Scorer,
        launch: &mut Launch<'_>,
    ) -> Result<bool, LaunchError> {
        let limit_s = self.scenario.startup_timeout_s;
        let end_ns = monotonic_ns() + (limit_s * 1e9) as u64;
        loop {
            self.announce()?;
            self.listen()?;
            // Its links take part in the warm-up.
            scorer.poll(u64::MAX)?;
            let missing: Vec<&Member> = self.members.iter().filter(|member| member.state() < state).collect();
            if missing.is_empty() {
                return Ok(true);
            }
            if launch.signal.load(Ordering::Relaxed) != 0 {
                return Ok(false);
            }
            let names = |external: bool| missing.iter().filter(|m| m.external || !external).map(|m| &*m.name).collect();
            let (roles, external): (Vec<&str>, Vec<&str>) = (names(false), names(true));
            // Whoever starts a role by hand may take all the time in the world.
            if monotonic_ns() > end_ns && external.is_empty() {
                return Err(LaunchError::StartUp { limit_s, roles: roles.join(", ") });
            }
            (launch.progress)(&Progress::Waiting { roles, external, domain: self.domain.clone() });
            sleep_until(monotonic_ns() + LOOK_NS);
        }
    }

    /// Follows the ticks to the end: scores, gives credit, watches over the roles.
    fn follow(&mut self, scorer: &mut dyn Scorer, launch: &mut Launch<'_>) -> Result<usize, LaunchError> {
        let lockstep = self.scenario.clock != ClockKind::Realtime;
        let mut watch = Watch::new(self.scenario);
        let mut backoff = Backoff::default();
        let mut next_look_ns = 0;
        while self.members.iter().any(|member| member.state() < RoleState::Done) {
            let scored = scorer.poll(CREDIT_TICKS)?;
            if lockstep && scored > 0 {
                self.word.credit_tick = scorer.next_tick();
                self.announce()?;
                backoff = Backoff::default();
            }
            let now_ns = monotonic_ns();
            if now_ns >= next_look_ns {
                next_look_ns = now_ns + SCORE_NS;
                self.announce()?;
                self.listen()?;
                watch.look(&self.members, now_ns)?;
                let signal = launch.signal.load(Ordering::Relaxed);
                if signal != 0 {
                    return Ok(signal);
                }
                let (tick, last_tick) = (scorer.next_tick(), self.scenario.last_tick);
                (launch.progress)(&Progress::Running { tick, last_tick, metric: scorer.latest() });
            }
            match (scored, lockstep) {
                (0, true) => backoff.wait(),
                (0, false) => sleep_until(next_look_ns),
                _ => {}
            }
        }
        Ok(0)
    }

    /// Says the launcher's word again.
    fn announce(&mut self) -> Result<(), BusError> {
        self.word.stamp =
            Stamp { tick: self.word.stamp.tick + 1, generation: 1, origin_ns: 0, sent_ns: monotonic_ns() };
        let word = self.word;
        self.schedule.send(|sample| *sample = word)
    }

    /// Hears how the roles are, and whether their processes live.
    fn listen(&mut self) -> Result<(), LaunchError> {
        for member in &mut self.members {
            while member.health.advance()? {}
            if let Some(health) = member.health.current() {
                member.last = *health;
            }
        }
        for process in &mut self.processes {
            if let Some(status) = process.ended() {
                // A role that was done may have left without the word, if this process was kept from giving it.
                let done = |member: &Member| member.name == process.name && member.state() == RoleState::Done;
                if !(status.success() && self.members.iter().any(done)) {
                    return Err(process.died(status));
                }
            }
        }
        Ok(())
    }

    fn denied(&mut self, own: &[Grant]) -> LaunchError {
        let mut denied: Vec<(String, Grant)> = own.iter().map(|grant| ("launcher".to_owned(), grant.clone())).collect();
        for report in self.stop_and_collect() {
            denied.extend(report.grants.into_iter().map(|grant| (report.role.clone(), grant)));
        }
        denied.retain(|(_, grant)| !grant.granted);
        LaunchError::Privileges { denied }
    }

    /// Lets the roles go and gathers their reports.
    fn dismiss(&mut self) -> Result<Vec<RoleReport>, LaunchError> {
        let reports = self.stop_and_collect();
        for process in &mut self.processes {
            let reported = reports.iter().any(|report| report.role == process.name);
            match process.ended() {
                Some(status) if !status.success() || !reported => return Err(process.died(status)),
                Some(_) => {}
                None => {
                    let roles = process.name.clone();
                    return Err(LaunchError::Hung { limit_s: 5.0, roles });
                }
            }
        }
        Ok(reports)
    }

    fn stop_and_collect(&mut self) -> Vec<RoleReport> {
        self.word.phase = Phase::Stop as u64;
        // A link that fails now changes nothing: whoever does not end by itself is ended.
        let _ = self.announce();
        await_end(&mut self.processes);
        let read = |member: &Member| {
            let path = report_path(&self.domain, &member.name);
            std::fs::read(path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok())
        };
        self.members.iter().filter_map(read).collect()
    }
}

/// Notices that nothing moves any more.
struct Watch {
    limit_ns: u64,
    moved_ns: u64,
    ticks: Vec<u64>,
}

impl Watch {
    fn new(scenario: &Scenario) -> Self {
        let limit_ns = HUNG_NS.max(HUNG_PERIODS * scenario.period_ns);
        Self { limit_ns, moved_ns: monotonic_ns(), ticks: Vec::new() }
    }

    fn look(&mut self, members: &[Member], now_ns: u64) -> Result<(), LaunchError> {
        let moved = self.ticks.len() != members.len()
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
