//! A role as a process: enters the domain, takes privileges, opens links, warms up, runs, reports.
//!
//! Must not start or end another process; the launcher's schedule starts and stops the role.

use crate::bus::domain::{Domain, DomainError, domains};
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Reader, Signal};
use crate::changes::ReceivedChanges;
use crate::clock::{self, Grid, RunClock, monotonic_ns, sleep_until};
use crate::config::{ClockKind, ConfigError, Realtime, Settings, Wake};
use crate::files;
use crate::panics;
use crate::runtime::drive::{Driver, Ended, Heartbeat, LauncherLink, WaitPolicy};
use crate::runtime::hooks::{self, Failpoint};
use crate::runtime::{
    DeviceError, LateWatch, NodeError, Privileges, ReadyNode, RoleFunction, RoleId, RoleImpl, depths, ledger_file,
    ledger_words, ports, release_priority, report, request_short_slices, take_privileges, topic, window_ticks,
};
use crate::sample::{Phase, RoleState, Schedule};
use crate::scenario::{self, Scenario};
use crate::system::{name_thread, remedy};
use crate::telemetry::{Latency, Ledger, LedgerError, RoleReport, StageReport};
use std::io;
use std::os::unix::ffi::OsStrExt;
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

/// A role ended without a report.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum RoleError {
    /// The directory is not a usable domain.
    #[error(transparent)]
    #[strum(transparent)]
    Domain(#[from] DomainError),
    /// The scenario in the domain was refused.
    #[error(transparent)]
    #[strum(serialize = "refused-scenario")]
    Config(#[from] ConfigError),
    /// Only a part of the run's signals exists on this host.
    #[error("the run in {} was launched on another host, and only a part of its signals exists here; join it on that host", .0.display())]
    #[strum(serialize = "partial-run")]
    Part(PathBuf),
    /// The scenario has no such role.
    #[error("there is no role `{role}` in this scenario; it has: {known}")]
    NoSuchRole {
        /// As given.
        role: String,
        /// The existing roles.
        known: String,
    },
    /// The role shares the process of another role.
    #[error(
        "in this run {role} runs in the process of {host} (launch.processes); start that one, or give each a process of its own"
    )]
    #[strum(serialize = "hosted-role")]
    Hosted {
        /// As given.
        role: String,
        /// The role that the process is named after.
        host: String,
    },
    /// The run uses another scenario.
    #[error("the run in {} uses another scenario or other overrides; give its scenario file, {}", domain.display(), scenario.display())]
    OtherScenario {
        /// The domain's directory.
        domain: PathBuf,
        /// The scenario of its run.
        scenario: PathBuf,
    },
    /// A device cannot have these roles.
    #[error(
        "a device cannot be `{roles}`; name one driven body (here: {driven}), observer, controller, or observer,controller, none of \
         which may serve a fleet"
    )]
    #[strum(serialize = "no-device-role")]
    NoDevice {
        /// As given.
        roles: String,
        /// The driven bodies that are not fleets.
        driven: String,
    },
    /// The controller reads an estimate that the protocol of devices does not carry.
    #[error(
        "a device cannot be the controller here: that reads the own estimate of {body}, which a device does not receive; take {body} \
         out of `observed`, or run the controller as a program"
    )]
    DeviceReadsOwn {
        /// The driven body with an observer of its own.
        body: String,
    },
    /// The device failed or cannot take part.
    #[error(transparent)]
    #[strum(transparent)]
    Device(#[from] DeviceError),
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// The node cannot continue.
    #[error(transparent)]
    #[strum(transparent)]
    Node(#[from] NodeError),
    /// The ledger could not be opened.
    #[error(transparent)]
    #[strum(transparent)]
    Ledger(#[from] LedgerError),
    /// The launcher did not publish the awaited phase in time.
    #[error("the launcher was silent for {waited_s} s; is `corotate run` alive in this domain?")]
    NoLauncher {
        /// Waiting time, s.
        waited_s: f64,
    },
    /// The program that computes the role's samples is gone before the ticks.
    #[error("no program computes this role: {reason}; start it again")]
    #[strum(serialize = "no-seat-program")]
    SeatProgram {
        /// The reason.
        reason: String,
    },
    /// The samples of the role do not fit into a frame.
    #[error("the samples of {role} take {bytes} bytes per tick, and a frame holds {limit}; drive fewer bodies")]
    #[strum(serialize = "frame-too-long")]
    FrameTooLong {
        /// The role.
        role: String,
        /// Length of a frame of the role, bytes.
        bytes: usize,
        /// Longest frame, bytes.
        limit: usize,
    },
    /// The role serves a fleet.
    #[error("a function cannot compute {role}, which serves a fleet; give its bodies roles of their own")]
    #[strum(serialize = "fleet-role")]
    Fleet {
        /// The role's name.
        role: String,
    },
    /// The run no longer exists, and its launcher sent no stop.
    #[error("the run no longer exists: its launcher was killed; start it again")]
    #[strum(serialize = "run-gone")]
    Gone,
    /// The launcher ended the run without waiting for this role.
    #[error(
        "the run ended while this role still ran, because it did not stop in time; the run's incidents give the reason"
    )]
    #[strum(serialize = "run-ended")]
    Late,
    /// The run has a clock of its own, which cannot be read.
    #[error("cannot read the clock of the run in {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "no-run-clock")]
    Clock {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The list of received changes cannot be read.
    #[error("cannot read the changes of inputs in {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "no-changes")]
    Changes {
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

/// Returns the file in a domain with the scenario of its run.
pub fn scenario_path(domain: &Domain) -> PathBuf {
    domain.root().join("scenario.toml")
}

/// Returns the scenario of the run in a domain's directory, without joining the run.
///
/// # Errors
/// [`ConfigError`].
pub fn scenario_of(root: &Path) -> Result<Scenario, ConfigError> {
    Scenario::load(&root.join("scenario.toml"), &[])
}

/// Returns the file in a domain's directory for a role's report.
pub fn report_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.report.json"))
}

/// Returns the file in a domain's directory that shows that a role takes changes of inputs. It contains the number of the process.
fn listener_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.listens"))
}

/// Returns the process that declared that it takes changes of inputs for a role. Bridges of devices do not.
pub fn listening_process(root: &Path, role: &str) -> Option<i32> {
    std::fs::read_to_string(listener_path(root, role)).ok()?.parse().ok()
}

/// Returns the file in a domain's directory for the error that ended an external role.
pub fn failure_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.words"))
}

/// Returns the file in a domain's directory for the error that ended a bridge in real time. That does not end the run,
/// because another bridge may take over.
pub fn device_failure_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.device.words"))
}

/// Returns the file in a domain's directory for a role's panic.
pub fn panic_path(root: &Path, role: &str) -> PathBuf {
    root.join(format!("{role}.panic.json"))
}

/// Returns the file in a domain's directory with the path of the run's results.
pub fn results_path(root: &Path) -> PathBuf {
    root.join("results")
}

/// The file of a run's results that is written at the end.
pub const SUMMARY: &str = "summary.json";

/// Returns the domain of a run in progress: the newest, or the one named by its directory, by its results directory, or
/// by its recording.
///
/// # Errors
/// [`DomainError::NoRun`], [`DomainError::Over`], [`DomainError::NotADomain`], [`DomainError::Privacy`].
pub fn find_run(given: Option<&Path>) -> Result<PathBuf, DomainError> {
    // The process that joins the domain reports why it cannot be joined.
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

/// Returns the file with the changes of inputs that a run has received.
pub fn changes_path(domain: &Domain) -> PathBuf {
    domain.shared(ReceivedChanges::FILE)
}

/// Returns the file with the correction of this host's clock, in a run that was launched on another host.
pub fn clock_path(domain: &Domain) -> PathBuf {
    domain.shared("clock")
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

/// Opens a role's ledger in a domain for reading.
pub fn open_ledger(domain: &Domain, scenario: &Settings, role: RoleId) -> Result<Ledger, LedgerError> {
    Ledger::shared(&ledger_path(domain, scenario, role), ledger_words(scenario, role))
}

/// Opens a role's ledger in a domain as its only writer.
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

/// Writes a file atomically: no reader sees a part of it.
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = path.with_extension("part");
    files::write(&part, bytes)?;
    std::fs::rename(&part, path)
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
