//! A role as a process: enters the domain, takes privileges, opens links, warms up, runs, reports.
//!
//! Must not start or end another process; the launcher's schedule starts and stops the role.

use super::error::RoleError;
use super::paths::{
    changes_path, clock_path, failure_path, listener_path, panic_path, report_path, scenario_path, take_ledger,
    write_whole,
};
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Reader, Signal};
use crate::changes::ReceivedChanges;
use crate::clock::{self, Grid, RunClock, monotonic_ns, sleep_until};
use crate::config::{ClockKind, Realtime, Settings, Wake};
use crate::panics;
use crate::runtime::drive::{Driver, Ended, Heartbeat, LauncherLink, WaitPolicy};
use crate::runtime::hooks::{self, Failpoint};
use crate::runtime::{
    LateWatch, NodeError, Privileges, ReadyNode, RoleFunction, RoleId, RoleImpl, depths, ports, release_priority,
    report, request_short_slices, take_privileges, topic, window_ticks,
};
use crate::sample::{Phase, RoleState, Schedule};
use crate::scenario::{self, Scenario};
use crate::system::name_thread;
use crate::telemetry::{Latency, Ledger, LedgerError, RoleReport, StageReport};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Interval at which a role polls the schedule before its ticks, ns.
const LOOK_NS: u64 = 1_000_000;
/// Number of warm-up samples on every link before the first tick.
pub(super) const WARM_UP_SAMPLES: usize = 100;
/// Interval of warm-up samples, ns.
pub(super) const WARM_UP_PAUSE_NS: u64 = 50_000;
/// Number and interval (ns) of wakes that measure the machine's own lateness before the first tick.
const BASELINE_WAKES: usize = 100;
const BASELINE_PERIOD_NS: u64 = 300_000;
/// Upper bound on the launcher silence that one poll adds, ns.
const LOOK_MAX_NS: u64 = 100_000_000;
/// Time that a finished role waits for a silent launcher, ns: longer than a launcher is ever delayed.
const LEAVE_NS: u64 = 120_000_000_000;

/// A role and the domain of its run.
#[derive(Debug, Clone)]
pub struct RoleAddress {
    /// The domain's directory.
    pub domain: PathBuf,
    /// The role's name.
    pub role: String,
}

/// Runs a role until the end of the run. `terminated` is set by a signal that asks the process to end.
///
/// # Errors
/// [`RoleError`].
pub fn run_role(address: &RoleAddress, terminated: &AtomicBool) -> Result<(), RoleError> {
    let (domain, scenario) = join(&address.domain)?;
    let role = find_role(&scenario, &address.role)?;
    require_process(&scenario, role)?;
    name_thread(&address.role);
    panics::keep_in(panic_path(domain.root(), &address.role));
    let companions = role.process_members(&scenario).into_iter().filter(|member| *member != role);
    let companions = companions.map(|member| Ok((member, take_ledger(&domain, &scenario, member)?)));
    let role_impl = RoleImpl::Role(role, companions.collect::<Result<_, LedgerError>>()?);
    in_domain(&domain, &scenario, role_impl, terminated, |_| {})
}

/// Runs a role whose samples a function computes. The process takes no privileges.
///
/// # Errors
/// [`RoleError`]; [`RoleError::Fleet`] for a role that serves a fleet.
pub fn run_function(
    address: &RoleAddress,
    compute: Box<dyn RoleFunction>,
    terminated: &AtomicBool,
) -> Result<(), RoleError> {
    run_function_with(address, terminated, |_, _, _| Ok(compute))
}

/// Runs a role whose samples a function computes, which `function` creates in the joined run.
pub(super) fn run_function_with(
    address: &RoleAddress,
    terminated: &AtomicBool,
    function: impl FnOnce(&Domain, &Scenario, RoleId) -> Result<Box<dyn RoleFunction>, RoleError>,
) -> Result<(), RoleError> {
    let (domain, scenario) = join(&address.domain)?;
    let role = find_role(&scenario, &address.role)?;
    require_process(&scenario, role)?;
    let ports = ports(&scenario, role);
    if ports.reads.iter().chain(&ports.writes).any(|port| port.fleet) {
        return Err(RoleError::Fleet { role: address.role.clone() });
    }
    let compute = function(&domain, &scenario, role)?;
    let served = in_domain(&domain, &scenario, RoleImpl::Function(role, compute), terminated, |_| {});
    if let Err(RoleError::Node(NodeError::Computed { reason })) = &served {
        // For the launcher, which has no other connection to this process. The caller gets the error in any case.
        let _ = write_whole(&failure_path(domain.root(), &address.role), reason.as_bytes());
    }
    served
}

/// Refuses a role that shares the process of another role.
pub(super) fn require_process(scenario: &Settings, role: RoleId) -> Result<(), RoleError> {
    let host = role.process_role(scenario);
    let name = |role: RoleId| role.name(scenario).to_owned();
    if host == role { Ok(()) } else { Err(RoleError::Hosted { role: name(role), host: name(host) }) }
}

/// Joins the domain in a directory and loads its scenario. From here on the process uses the clock of that run.
pub fn join(directory: &Path) -> Result<(Domain, Scenario), RoleError> {
    let domain = Domain::join(directory)?;
    let path = clock_path(&domain);
    let path = if path.exists() { path } else { domain.shared(RunClock::PACE) };
    clock::adopt(&path).map_err(|source| RoleError::Clock { path, source })?;
    let scenario = Scenario::load(&scenario_path(&domain), &[])?;
    let path = changes_path(&domain);
    if path.exists() {
        let list = ReceivedChanges::open(&path).map_err(|source| RoleError::Changes { path, source })?;
        scenario.inputs.receive_in(list);
    }
    Ok((domain, scenario))
}

/// Joins a run whose signals must all exist on this host.
pub fn join_complete(directory: &Path) -> Result<(Domain, Scenario), RoleError> {
    let (domain, scenario) = join(directory)?;
    // Only hosts that joined a run have a clock correction.
    if clock_path(&domain).exists() {
        domain.remove_if_over();
        return Err(RoleError::Part(domain.root().to_owned()));
    }
    Ok((domain, scenario))
}

/// Returns the role of this name.
pub(super) fn find_role(scenario: &Settings, name: &str) -> Result<RoleId, RoleError> {
    RoleId::named(scenario, name)
        .ok_or_else(|| RoleError::NoSuchRole { role: name.to_owned(), known: scenario.roles().join(", ") })
}

/// Runs a role in a domain until the end of the run and writes its report; `reported` receives the report too.
pub(super) fn in_domain(
    domain: &Domain,
    scenario: &Scenario,
    role_impl: RoleImpl,
    terminated: &AtomicBool,
    mut reported: impl FnMut(&RoleReport),
) -> Result<(), RoleError> {
    let role = role_impl.role();
    // Before links are opened, so that their memory is locked when it is mapped.
    let realtime = scenario.clock == ClockKind::Realtime;
    request_short_slices();
    // A function in an interpreter has threads and memory of its own.
    let takes = realtime && !matches!(role_impl, RoleImpl::Function(..));
    let privileges = if takes { take_privileges(scenario, role) } else { Privileges::default() };
    let ledger = take_ledger(domain, scenario, role)?;
    let roles: Vec<&str> = role_impl.ledgers(&ledger).iter().map(|(role, _)| role.name(scenario)).collect();
    if roles.iter().any(|role| scenario.debug.iter().any(|name| name == role)) {
        // Yama restricts debuggers to the parent process; without Yama this call fails and is not needed.
        let _ = rustix::process::set_ptracer(rustix::process::PTracer::Any);
    }
    if !matches!(role_impl, RoleImpl::Device(..)) {
        // For the launcher, before it can read a heartbeat.
        for path in roles.iter().map(|role| listener_path(domain.root(), role)) {
            let process = std::process::id().to_string();
            write_whole(&path, process.as_bytes()).map_err(|source| RoleError::Report { path, source })?;
        }
    }
    hooks::enter(&roles, ledger.generation() + 1);
    hooks::at(Failpoint::Opening);
    let bus = IoxBus::enter(domain, role.name(scenario), depths(scenario))?;
    let build = |role_impl| scenario::build(scenario, role_impl, &bus, &ledger);
    let service = RoleEnvironment { scenario, bus: &bus, ledger: &ledger, terminated, privileges };
    let served = serve(service, role_impl, build, |report| {
        reported(report);
        write_report(domain, report)
    });
    drop(bus);
    domain.remove_if_over();
    served
}

fn write_report(domain: &Domain, report: &RoleReport) -> Result<(), RoleError> {
    let path = report_path(domain.root(), &report.role);
    let failed = |source| RoleError::Report { path: path.clone(), source };
    let text = serde_json::to_vec(report).map_err(|error| failed(error.into()))?;
    write_whole(&path, &text).map_err(failed)
}

/// The environment of a role process.
pub struct RoleEnvironment<'a, B> {
    /// The scenario.
    pub scenario: &'a Settings,
    /// The bus.
    pub bus: &'a B,
    /// The ledger, new or of a predecessor.
    pub ledger: &'a Ledger,
    /// Set when a signal asks the process to end.
    pub terminated: &'a AtomicBool,
    /// The privileges that the caller has taken.
    pub privileges: Privileges,
}

/// Runs a role through all phases, from opening its links to the report of each role of its process. `build` opens the
/// loop's links and builds the node.
///
/// # Errors
/// [`RoleError`].
pub fn serve<B: Bus + 'static>(
    service: RoleEnvironment<'_, B>,
    role_impl: impl Into<RoleImpl>,
    build: impl FnOnce(RoleImpl) -> Result<ReadyNode, BusError>,
    mut deliver: impl FnMut(&RoleReport) -> Result<(), RoleError>,
) -> Result<(), RoleError> {
    let RoleEnvironment { scenario, bus, ledger, terminated, privileges } = service;
    let role_impl = role_impl.into();
    let (role, ledgers) = (role_impl.role(), role_impl.ledgers(ledger));
    let heartbeat = |(role, ledger): &(RoleId, Ledger)| {
        let (role, generation) = (*role, ledger.generation() + 1);
        let health = bus.writer(&topic(scenario, role.name(scenario), Signal::Health), generation)?;
        Ok(Heartbeat { role, health, generation })
    };
    // Before the links of the loop: a role without health signal is supervised by its samples only.
    let heartbeats = ledgers.iter().map(heartbeat).collect::<Result<_, BusError>>()?;
    let mut node = build(role_impl)?;
    node.restore()?;
    let mut launcher = LauncherLink::<B>::new(
        bus,
        bus.reader(&topic(scenario, "run", Signal::Schedule), Reader::Role)?,
        heartbeats,
        privileges.grants.iter().filter(|grant| !grant.granted).count() as u64,
        terminated,
    );
    let mut stages = Vec::new();
    let leads = ledgers.iter().any(|(role, _)| *role == RoleId::Plant(0));
    let ended = match begin(scenario, leads, &mut node, &mut launcher, &mut stages)? {
        Some(schedule) => {
            let grid = Grid { epoch_ns: schedule.epoch_ns, period_ns: scenario.period_ns };
            let (policy, late) = (wait_policy(scenario, role, &privileges), LateWatch::open(scenario, &ledgers));
            drive(scenario, &mut node, &mut launcher, grid, &policy, late)?
        }
        None => Ended::Stopped,
    };
    node.finish()?;
    if scenario.clock == ClockKind::Realtime {
        release_priority();
    }
    if bus.is_gone() {
        let stop_sent = launcher.schedule().is_ok_and(|schedule| Phase::from_number(schedule.phase) == Phase::Stop);
        return Err(if stop_sent { RoleError::Late } else { RoleError::Gone });
    }
    for (member, ledger) in &ledgers {
        // Grants belong to the process's role; the baseline belongs to the leader.
        let mut stages = if *member == RoleId::Plant(0) { std::mem::take(&mut stages) } else { Vec::new() };
        let grants = if *member == role { privileges.grants.clone() } else { Vec::new() };
        let node = node.member(*member).unwrap_or(&*node);
        stages.extend(node.stages());
        let (line, outages, pace, late_inputs) = (node.line(), node.outages(), node.pace(), node.late_inputs());
        deliver(&RoleReport { line, outages, pace, late_inputs, ..report(scenario, *member, ledger, stages, grants) })?;
    }
    // Samples may still wait in queues: the links stay open until all readers are done.
    if ended == Ended::Finished {
        let mut timeout = LauncherTimeout::new(LEAVE_NS);
        while timeout.lasts(launcher.schedule()?.stamp.tick) && !launcher.stopped()? {
            launcher.announce(RoleState::Done, &*node)?;
            node.refresh()?;
            sleep_until(monotonic_ns() + LOOK_NS);
        }
    }
    Ok(())
}

/// Limit on the launcher's silence. A living launcher publishes repeatedly. Time in which this process is stopped does
/// not count.
struct LauncherTimeout {
    limit_ns: u64,
    silent_ns: u64,
    looked_ns: u64,
    last_tick: Option<u64>,
}

impl LauncherTimeout {
    fn new(limit_ns: u64) -> Self {
        Self { limit_ns, silent_ns: 0, looked_ns: monotonic_ns(), last_tick: None }
    }

    /// Returns true while the launcher's last schedule, known by its number, is recent.
    fn lasts(&mut self, tick: u64) -> bool {
        let now_ns = monotonic_ns();
        let news = self.last_tick.replace(tick) != Some(tick);
        self.silent_ns = if news { 0 } else { self.silent_ns + (now_ns - self.looked_ns).min(LOOK_MAX_NS) };
        self.looked_ns = now_ns;
        self.silent_ns < self.limit_ns
    }
}

/// Runs the phases from open links to the run phase; `None` if the run is stopped before. Without warm-up for a
/// successor, whose links already carry samples. The process of the leader measures the baseline.
fn begin<B: Bus>(
    scenario: &Settings,
    leads: bool,
    node: &mut ReadyNode,
    launcher: &mut LauncherLink<'_, B>,
    stages: &mut Vec<StageReport>,
) -> Result<Option<Schedule>, RoleError> {
    if await_phase(scenario, node, launcher, RoleState::Open, Phase::WarmUp)?.is_none() {
        return Ok(None);
    }
    if launcher.first() {
        for _ in 0..WARM_UP_SAMPLES {
            node.warm_up()?;
            sleep_until(monotonic_ns() + WARM_UP_PAUSE_NS);
        }
    }
    if scenario.clock == ClockKind::Realtime && leads && launcher.first() {
        stages.extend(StageReport::all(&[("baseline", &baseline())]));
    }
    hooks::at(Failpoint::Ready);
    await_phase(scenario, node, launcher, RoleState::Ready, Phase::Run)
}

/// Measures the machine's own lateness on this core at this priority, with bare absolute sleeps.
fn baseline() -> Latency {
    let mut latency = Latency::default();
    let mut due_ns = monotonic_ns();
    for _ in 0..BASELINE_WAKES {
        due_ns += BASELINE_PERIOD_NS;
        sleep_until(due_ns);
        latency.record(due_ns, monotonic_ns());
    }
    latency
}

fn await_phase<B: Bus>(
    scenario: &Settings,
    node: &mut ReadyNode,
    launcher: &mut LauncherLink<'_, B>,
    state: RoleState,
    phase: Phase,
) -> Result<Option<Schedule>, RoleError> {
    let waited_s = 2.0 * scenario.startup_timeout_s;
    let mut timeout = LauncherTimeout::new((waited_s * 1e9) as u64);
    let mut schedule = launcher.schedule()?;
    while timeout.lasts(schedule.stamp.tick) {
        launcher.announce(state, &**node)?;
        if launcher.stopped()? {
            return Ok(None);
        }
        schedule = launcher.schedule()?;
        if Phase::from_number(schedule.phase) >= phase {
            return Ok(Some(schedule));
        }
        sleep_until(monotonic_ns() + LOOK_NS);
    }
    Err(RoleError::NoLauncher { waited_s })
}

/// Returns the waiting behaviour of a role with these privileges. Lead and spin are limited to a quarter of the period,
/// so that other processes get time.
fn wait_policy<'a>(scenario: &Settings, role: RoleId, privileges: &'a Privileges) -> WaitPolicy<'a> {
    // Samples between hosts may use their delay budget. One tick of it, less the time after the cutoff, is available
    // anyway.
    let lag_ticks = scenario.lag_ticks(role.name(scenario)).saturating_sub(1);
    let Realtime { wake, wake_lead_us, spin_us, cutoff, .. } = scenario.realtime;
    let [lead_ns, spin_ns] = [wake_lead_us, spin_us].map(|us| ((us * 1e3) as u64).min(scenario.period_ns / 4));
    let (spin_ns, yields_to) = match wake {
        Wake::Auto if privileges.has_realtime => (spin_ns, &privileges.co_located[..]),
        Wake::Spin => (spin_ns, &[][..]),
        Wake::Auto | Wake::Event => (0, &[][..]),
    };
    WaitPolicy { lead_ns, spin_ns, yields_to, cutoff: cutoff + lag_ticks as f64 }
}

fn drive<B: Bus>(
    scenario: &Settings,
    node: &mut ReadyNode,
    launcher: &mut LauncherLink<'_, B>,
    grid: Grid,
    policy: &WaitPolicy<'_>,
    late: Option<LateWatch>,
) -> Result<Ended, RoleError> {
    // A successor begins with the next tick of the grid in real time, with the first unexecuted tick in lockstep.
    let succeeds = scenario.clock == ClockKind::Realtime && !launcher.first();
    let first_tick = if succeeds { grid.next_at(monotonic_ns()) } else { node.next_tick() };
    node.start(grid, first_tick.min(scenario.last_tick + 1))?;
    let driver = Driver::new(launcher, scenario.last_tick, window_ticks(scenario)).with_late(late);
    // A successor begins after them.
    let grace_ticks = scenario.realtime.start_grace_ticks;
    let mut driver = driver.with_grace(if first_tick < grace_ticks { grace_ticks } else { 0 });
    let ended = match scenario.clock {
        ClockKind::Realtime => driver.realtime(&mut **node, grid, policy),
        ClockKind::Lockstep | ClockKind::InProcess => driver.lockstep(&mut **node),
    };
    Ok(ended?)
}
