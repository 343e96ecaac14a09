//! A screen on a running loop, in a process of its own that only reads.
//!
//! | file | duty |
//! |---|---|
//! | `model` | what there is to see, without bus and terminal |
//! | `feed` | takes every signal off the bus and makes the model of it |
//! | `session` | finds a run, joins it, notices its end |
//! | `screen` | draws the model |
//! | `input` | what a key means |
//! | `terminal` | the terminal: taken, and given back however the program ends |
//!
//! Must not be waited for by anybody, make a signal, or say anything on the bus.

mod feed;
mod input;
mod model;
mod screen;
mod session;
mod terminal;

pub use input::{Action, action};
pub use model::{Event, History, Model, RoleLine, Series, SignalLine, Window};
pub use screen::{draw, text};
pub use session::Session;
pub use terminal::show;

use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::seat::RoleError;
use std::io;

/// Why there is nothing to watch.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum WatchError {
    /// The domain is none.
    #[error(transparent)]
    #[strum(transparent)]
    Domain(#[from] DomainError),
    /// The run's scenario is missing or refused.
    #[error(transparent)]
    #[strum(transparent)]
    Run(#[from] RoleError),
    /// The run did not open its signals, or its seats for readers are taken.
    #[error("{source}; does it still wait for a role? A run has room for few watchers, and of a fleet for one")]
    #[strum(serialize = "cannot-join")]
    Join {
        /// The signal, and why.
        source: BusError,
    },
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// There is no terminal, or it failed.
    #[error("no terminal to draw on: {source}; `corotate watch --once` prints one screen as text")]
    #[strum(serialize = "no-terminal")]
    Terminal {
        /// The system's reason.
        source: io::Error,
    },
}
