//! Starts a run, supervises it, ends it, and tells how it went.
//!
//! Never leaves a process or a shared-memory file behind, however it ends. Must not compute what roles compute.

mod children;
mod companion;
mod criteria;
mod external;
mod foxglove;
mod in_process;
mod incident;
mod janitor;
#[cfg(feature = "hosts")]
mod join;
mod junit;
mod outcome;
mod processes;
mod recorder;
mod relay;
mod replay;
mod results;
mod standstill;
mod steps;
mod supervision;
mod table;
mod trace;

pub use crate::score::{CertificateScore, MetricScore, Score, Scorer};
pub use criteria::{Criterion, Unjudged, tick_words};
pub use incident::{Action, Incident};
pub use janitor::janitor;
#[cfg(feature = "hosts")]
pub use join::{FarOutcome, join};
pub use junit::junit;
pub(crate) use outcome::{Judged, State, state_hash};
pub use outcome::{LinkCounters, Outcome, StageFigures, Summary, write_run};
#[cfg(feature = "hosts")]
pub(crate) use processes::new_domain;
pub use replay::replay_as_process;
pub use results::{Claim, LATEST, RUNS, ResultsError, claim, make_directory, make_latest, new_run};
pub(crate) use results::{GENERATOR, LATENCY, RECORDING, SCENARIO, SUMMARY};
pub use steps::{BodyState, Steps};
pub use table::{line_words, table};
pub(crate) use table::{plain, reasons};

use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::config::ClockKind;
use crate::hosts::HostSeat;
pub use crate::panics::Panic;
use crate::record::RecordError;
use crate::runtime::{NodeError, unavailable_cores};
use crate::scenario::Scenario;
use crate::system::remedy;
use crate::telemetry::{Grant, LedgerError};
use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::AtomicUsize;

/// What a run needs besides its scenario.
pub struct Launch<'a> {
    /// Roles that somebody else starts, besides the scenario's own.
    pub external: Vec<String>,
    /// The file to record every sample to.
    pub record: Option<PathBuf>,
    /// The directory that its results will be written to, by its whole path: whoever looks for the run finds it by that.
    pub results: Option<PathBuf>,
    /// Where to show the run on a Foxglove WebSocket; not in one thread, and only by a program that was built with it.
    pub foxglove: Option<SocketAddr>,
    /// This host's part in a run over several, which others join; without it all roles run here.
    pub host: Option<HostSeat>,
    /// Refuse to run without every privilege that was asked for.
    pub require_realtime: bool,
    /// Whether the hash is kept of the ticks on the way too, by which two runs are compared; a run in one thread may do without.
    pub checkpoints: bool,
    /// The signal that asked the run to end; 0 while none has.
    pub signal: &'a AtomicUsize,
    /// Called now and then.
    pub progress: &'a mut dyn FnMut(&Progress<'_>),
}

impl<'a> Launch<'a> {
    /// What a run needs at the least, to be added to by whoever wants more. Roles are processes of this program: its `main` is
    /// [`Program::main`](crate::Program::main).
    pub fn new(signal: &'a AtomicUsize, progress: &'a mut dyn FnMut(&Progress<'_>)) -> Self {
        Self {
            external: Vec::new(),
            record: None,
            results: None,
            foxglove: None,
            host: None,
            require_realtime: false,
            checkpoints: true,
            signal,
            progress,
        }
    }
}

/// How far a run is.
#[derive(Debug, Clone, PartialEq)]
pub enum Progress<'a> {
    /// Waits for roles; these are started by somebody else, in this domain.
    Waiting {
        /// Roles that are not ready.
        roles: Vec<&'a str>,
        /// External roles among them.
        external: Vec<&'a str>,
        /// Other hosts among whose roles some of them are, once these can be joined with.
        hosts: Vec<&'a str>,
        /// The domain's directory; it holds a file with the seat of each external role.
        domain: PathBuf,
    },
    /// A role keeps the run waiting, or goes on: a line to print, now and then.
    External(&'a str),
    /// Ticks run.
    Running {
        /// The last tick scored.
        tick: u64,
        /// The last tick of the run.
        last_tick: u64,
        /// The latest value of the rig's first metric.
        metric: f64,
    },
}

/// Why a run failed. Whatever had been started is gone.
#[derive(Debug, thiserror::Error)]
pub enum LaunchError {
    /// The run cannot be stepped.
    #[error("the scenario cannot be stepped: {reason}; run it")]
    NotStepped {
        /// Why.
        reason: &'static str,
    },
    /// The scenario names cores that this process cannot be bound to.
    #[error("realtime.cores: this run cannot be bound to {}: not online, or not in its cpuset; name other cores, or \"auto\"", cores.iter().map(|core| format!("core {core}")).collect::<Vec<_>>().join(", "))]
    Cores {
        /// The cores.
        cores: Vec<usize>,
    },
    /// The domain could not be made.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// A link failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A role cannot go on.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// The roles' counters could not be opened.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// There are too few descriptors. Found out later it would fail in the midst of the transport.
    #[error("the limit on open files is {limit} and this run may need {needed}; raise it with `ulimit -n {needed}`")]
    Descriptors {
        /// The limit.
        limit: u64,
        /// What each process of the run may open.
        needed: u64,
    },
    /// A file of the domain could not be written.
    #[error("cannot write {}: {source}; {}", path.display(), remedy(source))]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A process could not be started.
    #[error("cannot start {role}: {source}; {}", remedy(source))]
    Spawn {
        /// The role.
        role: String,
        /// The system's reason.
        source: io::Error,
    },
    /// A role failed before the ticks ran.
    #[error("{role} died: {cause}{}", if last_words.is_empty() { String::new() } else { format!("; it said: {last_words}") })]
    Died {
        /// The role.
        role: String,
        /// Exit status or signal.
        cause: String,
        /// The end of its error output.
        last_words: String,
    },
    /// The rig's score, or its other parts in the launcher, panicked.
    #[error("the rig failed outside of its roles: {panic}")]
    Panicked {
        /// The panic.
        panic: Panic,
    },
    /// Roles were not ready in time.
    #[error("not ready within {limit_s} s: {roles}; on a slow machine raise launch.startup_timeout_s")]
    StartUp {
        /// The limit.
        limit_s: f64,
        /// The roles.
        roles: String,
    },
    /// Roles stopped making progress.
    #[error("no progress for {limit_s} s; furthest behind: {roles}")]
    Hung {
        /// The limit.
        limit_s: f64,
        /// The roles.
        roles: String,
    },
    /// The recording could not be begun, or not be written where nobody else does.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A privilege was required and not granted.
    #[error("required and not granted: {}", denied.iter().map(|(role, grant)| format!("{role}: {} {} ({})", grant.privilege, grant.asked, grant.reason)).collect::<Vec<_>>().join("; "))]
    Privileges {
        /// Role and privilege.
        denied: Vec<(String, Grant)>,
    },
}

/// Runs a scenario to its end.
///
/// # Errors
/// [`LaunchError`] if the run could not be started, or a role failed.
pub fn run(scenario: &Scenario, launch: &mut Launch<'_>) -> Result<Outcome, LaunchError> {
    check_cores(scenario)?;
    match scenario.clock {
        ClockKind::InProcess => in_process::run(scenario, launch),
        ClockKind::Realtime | ClockKind::Lockstep => processes::run(scenario, launch),
    }
}

/// Refuses cores that no process of a run in real time can be bound to.
///
/// # Errors
/// [`LaunchError::Cores`].
pub fn check_cores(scenario: &Scenario) -> Result<(), LaunchError> {
    let realtime = scenario.clock == ClockKind::Realtime;
    let cores = if realtime { unavailable_cores(&scenario.realtime) } else { Vec::new() };
    if cores.is_empty() { Ok(()) } else { Err(LaunchError::Cores { cores }) }
}
