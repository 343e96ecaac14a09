//! Links between roles: one writer and some readers per signal, samples loaned, written in place and sent.
//!
//! Roles know these traits alone. [`iox`] is the only file that knows iceoryx2 (and `raw`, which measures it bare); [`memory`] is its twin within one thread.

mod carried;
pub mod domain;
pub mod iox;
pub mod memory;
mod names;
mod notifier;
mod port;
pub mod raw;
mod unfinished;
mod words;

pub use carried::{Carried, FleetBuffer};
pub use names::{Signal, Topic};
pub use port::Port;
pub use words::{AnyBus, EndOpeners, ReadWords, WordReader, WordWriter, WriteWords};

use crate::sample::{FleetLayout, FleetSample, Sample};

/// Why a link failed. The run cannot go on without it.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum BusError {
    /// The shared-memory domain could not be entered.
    #[error("cannot enter the shared-memory domain {domain}: {reason}")]
    #[strum(serialize = "cannot-enter-domain")]
    Domain {
        /// Where.
        domain: String,
        /// Why, and what to do.
        reason: String,
    },
    /// A signal could not be opened.
    #[error("cannot open {service} as {end}: {reason}")]
    #[strum(serialize = "cannot-open-link")]
    Open {
        /// The service's name.
        service: String,
        /// `writer` or `reader`.
        end: &'static str,
        /// The transport's reason.
        reason: String,
    },
    /// A sample could not be sent.
    #[error("cannot send on {service}: {reason}")]
    #[strum(serialize = "cannot-send")]
    Send {
        /// The service's name.
        service: String,
        /// The transport's reason.
        reason: String,
    },
    /// A sample could not be received.
    #[error("cannot receive on {service}: {reason}")]
    #[strum(serialize = "cannot-receive")]
    Receive {
        /// The service's name.
        service: String,
        /// The transport's reason.
        reason: String,
    },
}

/// What reads a signal, and so how many samples may wait for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reader {
    /// A role: the newest sample only in real time, all of them in lockstep.
    Role,
    /// The scorer or the recorder, which look only now and then but want every sample.
    Scorer,
}

/// How many samples may wait for each kind of reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Depths {
    /// For [`Reader::Role`].
    pub role: usize,
    /// For [`Reader::Scorer`].
    pub scorer: usize,
    /// For a reader that comes late: how many of the last samples it still gets. In lockstep, where nobody goes on without
    /// its inputs, a role that is started anew would otherwise wait for ever for what its predecessor had been sent.
    pub history: usize,
}

impl Depths {
    /// For this kind of reader.
    pub fn for_reader(&self, reader: Reader) -> usize {
        match reader {
            Reader::Role => self.role,
            Reader::Scorer => self.scorer,
        }
    }
}

/// Opens links.
pub trait Bus {
    /// Whether a reader that is opened anew may get samples again that its predecessor had.
    const REPEATS: bool;

    /// Whether the run that it belongs to is gone, with all that its signals lay in. Not for every tick: the system is asked.
    fn is_gone(&self) -> bool {
        false
    }

    /// The writing end.
    type Writer<S: Sample>: Write<S>;
    /// The reading end.
    type Reader<S: Sample>: Read<S>;
    /// The writing end of a fleet's signal.
    type FleetWriter<L: FleetLayout>: Write<FleetSample<L>>;
    /// The reading end of a fleet's signal.
    type FleetReader<L: FleetLayout>: Read<FleetSample<L>>;

    /// Opens a signal for writing; there is one writer per signal. `generation` is the one that its stamps will have.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn writer<S: Sample>(&self, topic: &Topic, generation: u64) -> Result<Self::Writer<S>, BusError>;
    /// Opens a signal for reading.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<Self::Reader<S>, BusError>;
    /// Opens the signal of a fleet of so many bodies for writing.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn fleet_writer<L: FleetLayout>(&self, topic: &Topic, bodies: usize) -> Result<Self::FleetWriter<L>, BusError>;
    /// Opens the signal of a fleet of so many bodies for reading.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn fleet_reader<L: FleetLayout>(
        &self,
        topic: &Topic,
        reader: Reader,
        bodies: usize,
    ) -> Result<Self::FleetReader<L>, BusError>;
}

/// The writing end of a link.
pub trait Write<S: ?Sized> {
    /// Fills the next sample in place; nobody sees it before it is delivered.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn fill(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError>;
    /// Sends what was filled. Never waits for a reader.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn deliver(&mut self) -> Result<(), BusError>;
    /// Fills a sample in place and sends it.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    fn send(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        self.fill(fill)?;
        self.deliver()
    }
    /// Delivers, but where readers of the newest sample have a shorter way, only they see it at first;
    /// [`publish`](Self::publish) must follow.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn write_latest(&mut self) -> Result<(), BusError> {
        self.deliver()
    }
    /// Sends what was only shown, if anything was.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn publish(&mut self) -> Result<(), BusError> {
        Ok(())
    }
    /// Gets ready for the next [`send`](Self::send), so that it has less to do then.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn prepare(&mut self) -> Result<(), BusError>;
    /// Lets readers that have come later know of this end; [`send`](Self::send) does so too.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn refresh(&mut self) -> Result<(), BusError>;
}

/// The process that has a writing end open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WriterProcess {
    /// Its number, as it knows it itself: in a container another one than outside.
    pub pid: u32,
    /// Tells it from every other process of that number.
    pub unique: u128,
}

/// The reading end of a link.
pub trait Read<S: ?Sized> {
    /// Moves on to the next sample; false, and nothing changed, if there is none. Never waits.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn advance(&mut self) -> Result<bool, BusError>;
    /// The sample at hand, in place; none before the first.
    fn current(&self) -> Option<&S>;
    /// Whether somebody has the writing end open; one that was killed has until its remains are cleared. Within one thread it
    /// is always open.
    fn has_writer(&self) -> bool {
        true
    }
    /// The process that has the writing end open; none within one thread.
    fn writer(&self) -> Option<WriterProcess> {
        None
    }
    /// Sleeps until there may be a next sample, at most until `until_ns` on the monotonic clock. Where nobody else could
    /// bring one meanwhile it does not sleep.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn sleep(&mut self, until_ns: u64) -> Result<(), BusError>;
    /// Connects to the writer that there is now, by the shortest way. Off the critical path. Who is connected gets what was sent
    /// also when the writer is gone by then.
    fn refresh(&mut self);
}
