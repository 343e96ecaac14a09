//! The errors of recordings.

use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::config::ConfigError;
use crate::runtime::NodeError;
use crate::seat::RoleError;
use crate::system::remedy;
use std::io;
use std::path::PathBuf;

/// A failure to write, read or replay a recording.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum RecordError {
    /// The run could not be joined.
    #[error(transparent)]
    #[strum(transparent)]
    Run(#[from] RoleError),
    /// The domain is invalid.
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
    /// The disk is full.
    #[error("the disk is full: {} ends early but is readable ({source}); free space, or record elsewhere with --out", path.display())]
    #[strum(serialize = "disk-full")]
    Full {
        /// The recording.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The file cannot be written.
    #[error("cannot write {}: {source}; the file ends with its last whole chunk, and is readable without an index", path.display())]
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
    /// The file is not a recording of corotate.
    #[error("{} is not a corotate recording: {reason}; make one with `corotate run --record`", path.display())]
    #[strum(serialize = "not-a-recording")]
    NotARecording {
        /// The file.
        path: PathBuf,
        /// The first deviation from the format.
        reason: String,
    },
    /// The file was changed after it was written.
    #[error(
        "{} is damaged: {reason}; use another copy. --accept-incomplete reads the part before the damage, and still fails",
        path.display()
    )]
    #[strum(serialize = "damaged-recording")]
    Damaged {
        /// The recording.
        path: PathBuf,
        /// The first damage.
        reason: String,
    },
    /// The recording lacks a part of its run.
    #[error("{} is incomplete: {missing}; use the recorded part with --accept-incomplete", path.display())]
    #[strum(serialize = "incomplete-recording")]
    Incomplete {
        /// The recording.
        path: PathBuf,
        /// The missing part.
        missing: String,
    },
    /// The scenario in the recording is invalid in this version.
    #[error("this version refuses the scenario in {}: {source}", path.display())]
    #[strum(serialize = "refused-scenario")]
    Scenario {
        /// The recording.
        path: PathBuf,
        /// The reason.
        source: Box<ConfigError>,
    },
    /// The layouts of a signal differ.
    #[error(
        "{service} was recorded as {recorded}, but this version has {ours}; replay it with the version that recorded it"
    )]
    #[strum(serialize = "other-layout")]
    Layout {
        /// The signal.
        service: String,
        /// The layout in the recording.
        recorded: String,
        /// The layout in this version, or in the second recording.
        ours: String,
    },
    /// The recording lacks a signal of the scenario.
    #[error("{} has no signal {service}; record the run again with this version", path.display())]
    NotRecorded {
        /// The recording.
        path: PathBuf,
        /// The signal.
        service: String,
    },
    /// The recording has no such role.
    #[error("--role {role}: unknown role; choose one of: {known}, all")]
    UnknownRole {
        /// The given name.
        role: String,
        /// The roles in the recording.
        known: String,
    },
}
