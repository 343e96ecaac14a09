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

mod error;
mod feed;
mod input;
mod model;
mod screen;
mod session;
mod terminal;
mod tune;

pub use error::WatchError;
pub use input::{Action, action};
pub use model::{Event, History, Model, RoleLine, Series, SignalLine, Window};
pub use screen::{draw, text};
pub use session::Session;
pub use terminal::show;
pub use tune::TuneView;
