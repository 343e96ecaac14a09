//! One role as a process: enter the domain, take privileges, open links, warm up, run, report.
//!
//! Must not start or end any other process; the launcher's schedule says when to go and when to stop.

use crate::bus::domain::{Domain, DomainError, domains};
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Reader, Signal};
use crate::clock::{self, Grid, monotonic_ns, sleep_until};
use crate::config::{ClockKind, ConfigError, Realtime, Settings, Wake};
use crate::files;
use crate::panics;
use crate::runtime::drive::{Driver, Ended, Heartbeat, LauncherLink, WaitPolicy};
use crate::runtime::hooks::{self, Failpoint};
use crate::runtime::{
    DeviceError, NodeError, Privileges, ReadyNode, RoleFunction, RoleId, RoleImpl, depths, ledger_file, ledger_words,
    ports, release_priority, report, request_short_slices, take_privileges, topic, window_ticks,
};
use crate::sample::{Phase, RoleState, Schedule};
use crate::scenario::{self, Scenario};
use crate::system::remedy;
use crate::telemetry::{Latency, Ledger, LedgerError, RoleReport, StageReport};
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// How often a role looks for the next phase before its ticks, ns.
const LOOK_NS: u64 = 1_000_000;
/// Samples that every link carries before the first tick.
pub(super) const WARM_UP_SAMPLES: usize = 100;
/// The pause between them, ns.
pub(super) const WARM_UP_PAUSE_NS: u64 = 50_000;
/// Wakes by which the machine's own lateness is measured before the first tick, and the time between them, ns.
const BASELINE_WAKES: usize = 100;
const BASELINE_PERIOD_NS: u64 = 300_000;
/// The most that one look adds to the launcher's silence, ns.
const LOOK_MAX_NS: u64 = 100_000_000;
/// How long a role that is done waits for a launcher that says nothing, ns: longer than any machine keeps a launcher waiting.
const LEAVE_NS: u64 = 120_000_000_000;

/// Which role to take, where.
#[derive(Debug, Clone)]
pub struct RoleAddress {
    /// The domain's directory.
    pub domain: PathBuf,
    /// The role's name.
    pub role: String,
}

/// Why a role ended without a report.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum RoleError {
    /// The domain is none.
    #[error(transparent)]
    #[strum(transparent)]
    Domain(#[from] DomainError),
    /// The scenario in the domain was refused.
    #[error(transparent)]
    #[strum(serialize = "refused-scenario")]
    Config(#[from] ConfigError),
    /// Only a part of the run is here.
    #[error("the run in {} was launched on another host, and not all of its signals are here; look at it there", .0.display())]
    #[strum(serialize = "partial-run")]
    Part(PathBuf),
    /// The scenario has no such role.
    #[error("there is no role `{role}` in this scenario; it has: {known}")]
    NoSuchRole {
        /// As given.
        role: String,
        /// The roles there are.
        known: String,
    },
    /// The role is another process's too.
    #[error(
        "in this run the {role} is in the process of the {host} (launch.processes); start that, or give each a process of its own"
    )]
    #[strum(serialize = "hosted-role")]
    Hosted {
        /// As given.
        role: String,
        /// The role in whose process it is.
        host: String,
    },
    /// The domain's run is one of another scenario.
    #[error("the run in {} is not one of this scenario with these overrides; give its own file, {}", domain.display(), scenario.display())]
    OtherScenario {
        /// The domain's directory.
        domain: PathBuf,
        /// The scenario of its run.
        scenario: PathBuf,
    },
    /// No device could have this role.
    #[error(
        "a device can be one driven body (here: {driven}), the observer, the controller, or observer,controller, and none \
         that serves a fleet; `{roles}` is none of these"
    )]
    #[strum(serialize = "no-device-role")]
    NoDevice {
        /// As given.
        roles: String,
        /// The driven bodies that are no fleets.
        driven: String,
    },
    /// There is no device for the seat.
    #[error(transparent)]
    #[strum(transparent)]
    Device(#[from] DeviceError),
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// The role cannot go on.
    #[error(transparent)]
    #[strum(transparent)]
    Node(#[from] NodeError),
    /// The counters could not be opened.
    #[error(transparent)]
    #[strum(transparent)]
    Ledger(#[from] LedgerError),
    /// The launcher did not give the word in time.
    #[error("no word from the launcher for {waited_s} s; is `corotate run` alive in this domain?")]
    NoLauncher {
        /// How long the role waited, s.
        waited_s: f64,
    },
    /// It serves a fleet.
    #[error("{role} serves a fleet, which no function computes; give its bodies roles of their own")]
    #[strum(serialize = "fleet-role")]
    Fleet {
        /// Its name.
        role: String,
    },
    /// The run is gone, and its launcher never told this role to stop.
    #[error("the run is gone: its launcher was killed; start it again")]
    #[strum(serialize = "run-gone")]
    Gone,
    /// The launcher ended the run while this role was busy.
    #[error("the run ended without this role, which did not stop when told to; the run's incidents say why it ended")]
    #[strum(serialize = "run-ended")]
    Late,
    /// The run was launched on another host, and its time is not to be had.
    #[error("cannot read the clock of the run in {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "no-run-clock")]
    Clock {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The report could not be written.
    #[error("cannot write the report {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write")]
    Report {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

/// The file in a domain that holds the scenario of its run.
pub fn scenario_path(domain: &Domain) -> PathBuf {
    domain.root().join("scenario.toml")
}

/// The file in a domain's directory that a role leaves its report in.
pub fn report_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.report.json"))
}

/// The file in a domain's directory that an external role leaves its last words in, if it has any.
pub fn failure_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.words"))
}

/// The file in a domain's directory that a bridge in real time leaves its last words in: another one may take its seat, so they end
/// nothing by themselves.
pub fn device_failure_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.device.words"))
}

/// The file in a domain's directory that a role leaves its panic in, if it panicked.
pub fn panic_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.panic.json"))
}

/// The file in a domain's directory that says where the run's results will be: a path, and nothing else.
pub fn results_path(root: &Path) -> PathBuf {
    root.join("results")
}

/// The file of a run's results that is written once it is over.
pub const SUMMARY: &str = "summary.json";

/// The domain of a run that is under way: of the newest; or of the one whose results go to the directory that is given, or whose
/// recording is the file that is given; or that directory itself.
///
/// # Errors
/// [`DomainError::NoRun`], [`DomainError::Over`], [`DomainError::NotADomain`], [`DomainError::Privacy`].
pub fn find_run(given: Option<&Path>) -> Result<PathBuf, DomainError> {
    // A domain that cannot be joined is told by the process that joins it.
    if let Some(given) = given.filter(|given| !matches!(Domain::join(given), Err(DomainError::NotADomain { .. }))) {
        return Ok(given.to_owned());
    }
    let mut running = domains()?.into_iter().filter(|found| found.alive).map(|found| found.root);
    let Some(given) = given else { return running.next().ok_or(DomainError::NoRun) };
    let whole = std::fs::canonicalize(given).unwrap_or_else(|_| given.to_owned());
    let directory = if whole.is_file() { whole.parent().unwrap_or(&whole) } else { &whole };
    let meant = |root: &PathBuf| {
        files::read(&results_path(root)).is_ok_and(|results| results == directory.as_os_str().as_bytes())
    };
    match running.find(meant) {
        Some(root) => Ok(root),
        None if directory.join(SUMMARY).exists() => Err(DomainError::Over { path: given.to_owned() }),
        None => Err(DomainError::NotADomain { path: given.to_owned() }),
    }
}

/// Takes a role's seat in a run and serves it to the end. `terminated` is set by a signal that asks the process to end.
///
/// # Errors
/// [`RoleError`].
pub fn run_role(seat: &RoleAddress, terminated: &AtomicBool) -> Result<(), RoleError> {
    let (domain, scenario) = join(&seat.domain)?;
    let role = find_role(&scenario, &seat.role)?;
    require_process(&scenario, role)?;
    panics::keep_in(panic_path(domain.root(), &seat.role));
    let others = role.process_members(&scenario).into_iter().filter(|other| *other != role);
    let others = others.map(|other| Ok((other, take_ledger(&domain, &scenario, other)?)));
    let role_impl = RoleImpl::Role(role, others.collect::<Result<_, LedgerError>>()?);
    in_domain(&domain, &scenario, role_impl, terminated, |_| {})
}

/// The same with a function that computes the role's samples. The process takes no privileges for it.
///
/// # Errors
/// [`RoleError`]; [`RoleError::Fleet`] for a role that serves a fleet.
pub fn run_function(
    seat: &RoleAddress,
    compute: Box<dyn RoleFunction>,
    terminated: &AtomicBool,
) -> Result<(), RoleError> {
    let (domain, scenario) = join(&seat.domain)?;
    let role = find_role(&scenario, &seat.role)?;
    require_process(&scenario, role)?;
    let ports = ports(&scenario, role);
    if ports.reads.iter().chain(&ports.writes).any(|port| port.fleet) {
        return Err(RoleError::Fleet { role: seat.role.clone() });
    }
    let served = in_domain(&domain, &scenario, RoleImpl::Function(role, compute), terminated, |_| {});
    if let Err(RoleError::Node(NodeError::Computed { reason })) = &served {
        // For the launcher, which has no line to it. If the run is gone, whoever called it is told all the same.
        let _ = write_whole(&failure_path(domain.root(), &seat.role), reason.as_bytes());
    }
    served
}

/// Refuses a role that has no process of its own.
pub(super) fn require_process(scenario: &Settings, role: RoleId) -> Result<(), RoleError> {
    let host = role.process_role(scenario);
    let name = |role: RoleId| role.name(scenario).to_owned();
    if host == role { Ok(()) } else { Err(RoleError::Hosted { role: name(role), host: name(host) }) }
}

/// The file with the correction of this host's clock, where the run was launched on another.
pub fn clock_path(domain: &Domain) -> PathBuf {
    domain.shared("clock")
}

/// The domain of a run with its scenario. The process has the time of that run from here on.
pub fn join(directory: &Path) -> Result<(Domain, Scenario), RoleError> {
    let domain = Domain::join(directory)?;
    let path = clock_path(&domain);
    clock::adopt(&path).map_err(|source| RoleError::Clock { path, source })?;
    let scenario = Scenario::load(&scenario_path(&domain), &[])?;
    Ok((domain, scenario))
}

/// The same for whoever wants to see the whole run.
pub fn join_complete(directory: &Path) -> Result<(Domain, Scenario), RoleError> {
    let (domain, scenario) = join(directory)?;
    // Only hosts that joined a run have a clock to be corrected.
    if clock_path(&domain).exists() {
        domain.remove_if_over();
        return Err(RoleError::Part(domain.root().to_owned()));
    }
    Ok((domain, scenario))
}

/// The role of this name.
pub(super) fn find_role(scenario: &Settings, name: &str) -> Result<RoleId, RoleError> {
    RoleId::named(scenario, name)
        .ok_or_else(|| RoleError::NoSuchRole { role: name.to_owned(), known: scenario.roles().join(", ") })
}

/// Serves a seat in a domain to the end of the run, and leaves its report there; `reported` sees it too.
pub(super) fn in_domain(
    domain: &Domain,
    scenario: &Scenario,
    role_impl: RoleImpl,
    terminated: &AtomicBool,
    mut reported: impl FnMut(&RoleReport),
) -> Result<(), RoleError> {
    let role = role_impl.role();
    // Before any link is opened, so that the links' memory is locked as it is mapped.
    let realtime = scenario.clock == ClockKind::Realtime;
    request_short_slices();
    // What computes in an interpreter has threads and memory of its own.
    let takes = realtime && !matches!(role_impl, RoleImpl::Function(..));
    let privileges = if takes { take_privileges(scenario, role) } else { Privileges::default() };
    let ledger = take_ledger(domain, scenario, role)?;
    let roles: Vec<&str> = role_impl.ledgers(&ledger).iter().map(|(role, _)| role.name(scenario)).collect();
    if roles.iter().any(|role| scenario.debug.iter().any(|name| name == role)) {
        // Yama restricts debuggers to a process's parent; without it there is nothing to allow.
        let _ = rustix::process::set_ptracer(rustix::process::PTracer::Any);
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

/// A role's ledger in a domain, to be read.
pub fn open_ledger(domain: &Domain, scenario: &Settings, role: RoleId) -> Result<Ledger, LedgerError> {
    Ledger::shared(&ledger_path(domain, scenario, role), ledger_words(scenario, role))
}

/// The same, to be written by this process alone.
pub(super) fn take_ledger(domain: &Domain, scenario: &Settings, role: RoleId) -> Result<Ledger, LedgerError> {
    Ledger::taken(&ledger_path(domain, scenario, role), ledger_words(scenario, role))
}

fn ledger_path(domain: &Domain, scenario: &Settings, role: RoleId) -> PathBuf {
    domain.shared(&ledger_file(scenario, role))
}

fn write_report(domain: &Domain, report: &RoleReport) -> Result<(), RoleError> {
    let path = report_path(domain.root(), &report.role);
    let failed = |source| RoleError::Report { path: path.clone(), source };
    let text = serde_json::to_vec(report).map_err(|error| failed(error.into()))?;
    write_whole(&path, &text).map_err(failed)
}

/// Writes a file so that nobody ever sees a part of it.
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = path.with_extension("part");
    files::write(&part, bytes)?;
    std::fs::rename(&part, path)
}

/// What a seat is served with.
pub struct RoleEnvironment<'a, B> {
    /// The scenario.
    pub scenario: &'a Settings,
    /// The bus.
    pub bus: &'a B,
    /// The counters, new or a predecessor's.
    pub ledger: &'a Ledger,
    /// Whether this process was asked to end.
    pub terminated: &'a AtomicBool,
    /// What the caller has taken.
    pub privileges: Privileges,
}

/// Serves a seat on a bus: the phases of a run, from open links to the report of each of its roles. `build` opens the links of
/// the loop and builds the node.
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
    let (role, books) = (role_impl.role(), role_impl.ledgers(ledger));
    let heartbeat = |(role, ledger): &(RoleId, Ledger)| {
        let (role, generation) = (*role, ledger.generation() + 1);
        let health = bus.writer(&topic(scenario, role.name(scenario), Signal::Health), generation)?;
        Ok(Heartbeat { role, health, generation })
    };
    // Before the links of the loop: a role that has those open and not this one is judged by its samples alone.
    let heartbeats = books.iter().map(heartbeat).collect::<Result<_, BusError>>()?;
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
    let leads = books.iter().any(|(role, _)| *role == RoleId::Plant(0));
    let ended = match begin(scenario, leads, &mut node, &mut launcher, &mut stages)? {
        Some(schedule) => drive(scenario, role, &mut node, &mut launcher, &schedule, &privileges)?,
        None => Ended::Stopped,
    };
    node.finish()?;
    if scenario.clock == ClockKind::Realtime {
        release_priority();
    }
    if bus.is_gone() {
        let told = launcher.schedule().is_ok_and(|word| Phase::from_number(word.phase) == Phase::Stop);
        return Err(if told { RoleError::Late } else { RoleError::Gone });
    }
    for (of, ledger) in &books {
        // What was asked of the machine is the seat's own, and what was measured before the ticks the leader's.
        let mut stages = if *of == RoleId::Plant(0) { std::mem::take(&mut stages) } else { Vec::new() };
        let grants = if *of == role { privileges.grants.clone() } else { Vec::new() };
        let node = node.member(*of).unwrap_or(&*node);
        stages.extend(node.stages());
        let (line, outages) = (node.line(), node.outages());
        deliver(&RoleReport { line, outages, ..report(scenario, *of, ledger, stages, grants) })?;
    }
    // Samples may still wait to be read: the links stay open until everybody is done.
    if ended == Ended::Finished {
        let mut patience = LauncherTimeout::new(LEAVE_NS);
        while patience.lasts(launcher.schedule()?.stamp.tick) && !launcher.stopped()? {
            launcher.announce(RoleState::Done, &*node)?;
            node.refresh()?;
            sleep_until(monotonic_ns() + LOOK_NS);
        }
    }
    Ok(())
}

/// How long a role waits for its launcher, which announces again and again while it lives. Time in which this process is
/// stopped does not count.
struct LauncherTimeout {
    limit_ns: u64,
    silent_ns: u64,
    looked_ns: u64,
    heard: Option<u64>,
}

impl LauncherTimeout {
    fn new(limit_ns: u64) -> Self {
        Self { limit_ns, silent_ns: 0, looked_ns: monotonic_ns(), heard: None }
    }

    /// Returns true while the launcher's last word, by its number, is recent.
    fn lasts(&mut self, word: u64) -> bool {
        let now_ns = monotonic_ns();
        let news = self.heard.replace(word) != Some(word);
        self.silent_ns = if news { 0 } else { self.silent_ns + (now_ns - self.looked_ns).min(LOOK_MAX_NS) };
        self.looked_ns = now_ns;
        self.silent_ns < self.limit_ns
    }
}

/// From open links to the word to run. The links of a successor carry samples already. Whoever has the leader measures the
/// machine. `None` if the run was stopped before.
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

/// The machine's own lateness on this core at this priority: bare absolute sleeps, nothing else.
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
    let mut patience = LauncherTimeout::new((waited_s * 1e9) as u64);
    let mut schedule = launcher.schedule()?;
    while patience.lasts(schedule.stamp.tick) {
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

/// How a role with these privileges waits. Neither the lead nor the spin takes so much of a short period that others starve.
fn wait_policy<'a>(scenario: &Settings, role: RoleId, privileges: &'a Privileges) -> WaitPolicy<'a> {
    // A way between hosts may take its budget: one tick, less what comes after the cutoff, is there in any case.
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
    role: RoleId,
    node: &mut ReadyNode,
    launcher: &mut LauncherLink<'_, B>,
    schedule: &Schedule,
    privileges: &Privileges,
) -> Result<Ended, RoleError> {
    let grid = Grid { epoch_ns: schedule.epoch_ns, period_ns: scenario.period_ns };
    // A successor begins with the next tick there is: in real time that of the grid, in lockstep the one left undone.
    let late = scenario.clock == ClockKind::Realtime && !launcher.first();
    let first_tick = if late { grid.next_at(monotonic_ns()) } else { node.next_tick() };
    node.start(grid, first_tick.min(scenario.last_tick + 1))?;
    let mut driver = Driver::new(launcher, scenario.last_tick, window_ticks(scenario));
    let ended = match scenario.clock {
        ClockKind::Realtime => driver.realtime(&mut **node, grid, &wait_policy(scenario, role, privileges)),
        ClockKind::Lockstep | ClockKind::InProcess => driver.lockstep(&mut **node),
    };
    Ok(ended?)
}
