//! The errors of a run.

use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::panics::Panic;
use crate::record::RecordError;
use crate::runtime::NodeError;
use crate::system::remedy;
use crate::telemetry::{Grant, LedgerError};
use std::io;
use std::path::PathBuf;

/// The error of a run. All its processes have ended, and its files are removed.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum LaunchError {
    /// The run cannot be stepped.
    #[error("the scenario cannot be stepped: {reason}; run it")]
    NotStepped {
        /// The reason.
        reason: &'static str,
    },
    /// The scenario names cores that this process cannot be bound to.
    #[error("realtime.cores: this run cannot be bound to {}: not online, or not in its cpuset; name other cores, or \"auto\"", cores.iter().map(|core| format!("core {core}")).collect::<Vec<_>>().join(", "))]
    #[strum(serialize = "no-such-core")]
    Cores {
        /// The cores.
        cores: Vec<usize>,
    },
    /// The domain could not be created.
    #[error(transparent)]
    #[strum(transparent)]
    Domain(#[from] DomainError),
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// A role cannot go on.
    #[error(transparent)]
    #[strum(transparent)]
    Node(#[from] NodeError),
    /// The roles' counters could not be opened.
    #[error(transparent)]
    #[strum(transparent)]
    Ledger(#[from] LedgerError),
    /// There are too few descriptors. The transport would fail with it later.
    #[error("the limit on open files is {limit} and this run may need {needed}; raise it with `ulimit -n {needed}`")]
    #[strum(serialize = "too-few-descriptors")]
    Descriptors {
        /// The limit.
        limit: u64,
        /// The largest number of open files of a process of the run.
        needed: u64,
    },
    /// A file of the domain could not be written.
    #[error("cannot write {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A process could not be started.
    #[error("cannot start {role}: {source}; {}", remedy(source))]
    #[strum(serialize = "cannot-start")]
    Spawn {
        /// The role.
        role: String,
        /// The system's reason.
        source: io::Error,
    },
    /// A role failed before the ticks ran.
    #[error("{role} died: {cause}{}", if last_words.is_empty() { String::new() } else { format!("; its output ended with: {last_words}") })]
    #[strum(serialize = "role-died")]
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
    #[strum(serialize = "rig-panicked")]
    Panicked {
        /// The panic.
        panic: Panic,
    },
    /// Roles were not ready in time.
    #[error("not ready within {limit_s} s: {roles}; on a slow machine raise launch.startup_timeout_s")]
    #[strum(serialize = "not-ready")]
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
    /// The recording could not be started; in one thread also: not be written.
    #[error(transparent)]
    #[strum(transparent)]
    Record(#[from] RecordError),
    /// A privilege was required and not granted.
    #[error("required and not granted: {}", denied.iter().map(|(role, grant)| format!("{role}: {} {} ({})", grant.privilege, grant.asked, grant.reason)).collect::<Vec<_>>().join("; "))]
    #[strum(serialize = "privilege-denied")]
    Privileges {
        /// Role and privilege.
        denied: Vec<(String, Grant)>,
    },
}
