//! Failures of a relay.

use super::super::clock::ClockError;
use super::super::net::NetError;
use crate::bus::BusError;
use crate::seat::{RoleError, write_whole};
use crate::system::remedy;
use std::path::{Path, PathBuf};

/// Failures of a relay.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum RelayError {
    /// The domain cannot be joined.
    #[error(transparent)]
    #[strum(transparent)]
    Role(#[from] RoleError),
    /// The scenario lacks a host, or a role's host.
    #[error("the scenario lacks the host `{0}` or `{1}`, or has roles without a host; check its [[host]] tables")]
    #[strum(serialize = "no-such-host")]
    NoHost(String, String),
    /// The other hosts cannot be reached.
    #[error(transparent)]
    #[strum(transparent)]
    Net(#[from] NetError),
    /// The run's time could not be measured.
    #[error("the clock was not synchronised within {0} s; check the connection to the launching host")]
    NoTime(u64),
    /// The clock does not suffice for the run.
    #[error(transparent)]
    #[strum(transparent)]
    Clock(#[from] ClockError),
    /// A host joined and fell silent before the ticks.
    #[error(
        "the host {host} joined and then sent nothing for {limit_s} s; read the output of its `join`, and start both again"
    )]
    #[strum(serialize = "host-lost")]
    Lost {
        /// The host.
        host: String,
        /// The timeout, s.
        limit_s: f64,
    },
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// A file could not be written.
    #[error("cannot write {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
}

pub(super) fn write(path: &Path, bytes: &[u8]) -> Result<(), RelayError> {
    write_whole(path, bytes).map_err(|source| RelayError::Write { path: path.to_owned(), source })
}
