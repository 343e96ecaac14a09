//! A terminal view of a running loop, in a separate process that only reads.
//!
//! | file | duty |
//! |---|---|
//! | `model` | the content of the screen, without bus and terminal |
//! | `feed` | reads every signal and updates the model |
//! | `session` | finds a run, joins it, detects its end |
//! | `screen` | draws the model |
//! | `input` | maps keys to actions |
//! | `tune` | shows and changes inputs |
//! | `terminal` | sets up the terminal, and restores it however the program ends |
//!
//! Must not delay a role, create a signal, or publish a sample.

mod feed;
mod input;
mod model;
mod screen;
mod session;
mod terminal;
mod tune;

pub use input::{Action, action};
pub use model::{Event, History, Model, RoleLine, Series, SignalLine, Window};
pub use screen::{draw, text};
pub use session::Session;
pub use terminal::show;
pub use tune::TuneView;

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
