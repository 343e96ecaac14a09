//! Every sample of a run in one file, by a process that no role waits for; and what can be done with such a file.
//!
//! | file | duty |
//! |---|---|
//! | `layout` | the layout of a sample as a ROS 2 message definition |
//! | `writer` | the MCAP file: chunks of bounded age, a full disk |
//! | `taps` | takes every sample of a run off a bus, and keeps count |
//! | `recorder` | a recording in the making, and its counters |
//! | `process` | the recorder as a process beside a loop |
//! | `reader` | a recording as data: metadata, signals, samples, columns |
//! | `script` | what a role did, so that it can do it again |
//! | `replay` | recorded inputs through the live roles, outputs compared bit for bit |
//! | `diff` | two recordings beside each other |
//! | `export` | tables for everyone else: CSV and, with the feature of that name, Parquet |
//!
//! Must not change a sample, nor hold a loop up, except by the credit that it gives in lockstep.

mod diff;
mod export;
mod process;
mod reader;
mod recorder;
mod replay;
mod script;
mod taps;
mod writer;

pub use diff::{Comparison, SignalDiff, Tolerances, ValueDiff, diff};
#[cfg(feature = "parquet")]
pub use export::export_parquet;
#[cfg(feature = "parquet")]
pub(crate) use export::{Cell, ColumnKind, RowGroups};
pub use export::{ExportError, export_csv};
pub use process::{RecorderSeat, run_recorder};
pub use reader::{EndInfo, Recording, RunInfo, SignalInfo, Track};
pub(crate) use recorder::{JOINING, RECORDER};
pub use recorder::{Recorder, RecordingReport, SignalReport};
pub use replay::{Comparer, Difference, Inlets, Outlets, RoleReplay, replay_in_process};
pub use script::{InputScript, Item, Limit, Script, Step};
#[cfg(feature = "foxglove")]
pub(crate) use taps::{Channel, MessageSink, Taps};

use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::config::ConfigError;
use crate::runtime::NodeError;
use crate::seat::RoleError;
use crate::system::remedy;
use std::io;
use std::path::PathBuf;

/// What can go wrong with a recording.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum RecordError {
    /// The run could not be joined.
    #[error(transparent)]
    #[strum(transparent)]
    Run(#[from] RoleError),
    /// The domain is none.
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
    /// There is no room for more.
    #[error("the disk is full: {} ends here, readable ({source}); free some room, or record elsewhere with --out", path.display())]
    #[strum(serialize = "disk-full")]
    Full {
        /// The recording.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The file cannot be written.
    #[error("cannot write {}: {source}; it ends with its last whole chunk, readable without an index", path.display())]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The recording.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The file cannot be read.
    #[error("cannot read {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-read")]
    Read {
        /// The recording.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The file is none of ours.
    #[error("{} is no recording of corotate: {reason}; `corotate run --record` makes one", path.display())]
    #[strum(serialize = "not-a-recording")]
    NotOurs {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The file is not what was written.
    #[error(
        "{} is damaged: {reason}; take another copy of it. --accept-incomplete uses what comes before, and still fails",
        path.display()
    )]
    #[strum(serialize = "damaged-recording")]
    Damaged {
        /// The recording.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The file has not all of its run.
    #[error("{} is not complete: {missing}; go on with what there is by --accept-incomplete", path.display())]
    #[strum(serialize = "incomplete-recording")]
    Incomplete {
        /// The recording.
        path: PathBuf,
        /// What is missing.
        missing: String,
    },
    /// The scenario in the recording is refused.
    #[error("the scenario in {} is refused by this version: {source}", path.display())]
    #[strum(serialize = "refused-scenario")]
    Scenario {
        /// The recording.
        path: PathBuf,
        /// Why.
        source: Box<ConfigError>,
    },
    /// The recording was made with samples of another layout.
    #[error(
        "{service} was recorded as {recorded}, and this version has {ours}; replay it with the version that made it"
    )]
    #[strum(serialize = "other-layout")]
    Layout {
        /// The signal.
        service: String,
        /// The layout in the recording.
        recorded: String,
        /// This version's.
        ours: String,
    },
    /// A signal of the scenario is not in the recording.
    #[error("{} has no signal {service}; record the run with this version", path.display())]
    NotRecorded {
        /// The recording.
        path: PathBuf,
        /// The signal.
        service: String,
    },
    /// The recording has no such role.
    #[error("--role {role}: there is no such role; this recording has: {known}, all")]
    UnknownRole {
        /// As given.
        role: String,
        /// The roles that it has.
        known: String,
    },
}
