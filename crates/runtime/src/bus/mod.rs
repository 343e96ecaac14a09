//! Links between roles: one writer and several readers per signal. Samples are loaned, written in place and sent.
//!
//! Roles use only these traits. [`iox`] implements them over iceoryx2, [`memory`] within one thread; `raw` measures
//! bare iceoryx2.

mod carried;
pub mod domain;
mod error;
pub mod iox;
mod link;
pub mod memory;
mod names;
mod notifier;
mod port;
pub mod raw;
mod unfinished;
mod words;

pub use carried::{Carried, FleetBuffer};
pub use error::BusError;
pub use link::{Bus, Depths, Read, Reader, Write, WriterProcess};
pub use names::{Signal, Topic};
pub use port::Port;
pub use words::{AnyBus, EndOpeners, ReadWords, WordReader, WordWriter, WriteWords};
