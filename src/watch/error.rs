//! Why a run cannot be watched.

use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::seat::RoleError;
use std::io;

/// The reason that a run cannot be watched.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum WatchError {
    /// The directory is not a domain.
    #[error(transparent)]
    #[strum(transparent)]
    Domain(#[from] DomainError),
    /// The run's scenario is missing or refused.
    #[error(transparent)]
    #[strum(transparent)]
    Run(#[from] RoleError),
    /// The run has not opened its signals, or has no free place for a reader.
    #[error(
        "cannot join the run: {source}; start its missing roles, or stop another watcher (a fleet admits only one)"
    )]
    #[strum(serialize = "cannot-join")]
    Join {
        /// The error of the signal.
        source: BusError,
    },
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// The terminal is missing or failed.
    #[error("cannot use the terminal: {source}; `corotate watch --once` prints one screen as text")]
    #[strum(serialize = "no-terminal")]
    Terminal {
        /// The error of the system.
        source: io::Error,
    },
}
