//! What roles use of a link: its two ends, and the bus that opens them.

use super::error::BusError;
use super::names::Topic;
use crate::sample::{FleetLayout, FleetSample, Sample};

/// The kind of a reader, which decides how many samples may wait for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reader {
    /// A role: the newest sample only in real time, all of them in lockstep.
    Role,
    /// The scorer or the recorder: reads rarely and wants every sample.
    Scorer,
}

/// Queue depths for each kind of reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Depths {
    /// For [`Reader::Role`].
    pub role: usize,
    /// For [`Reader::Scorer`].
    pub scorer: usize,
    /// Number of past samples that a new reader gets. In lockstep a restarted role would otherwise wait forever for
    /// samples that its predecessor received.
    pub history: usize,
}

impl Depths {
    /// Returns the depth for this kind of reader.
    pub fn for_reader(&self, reader: Reader) -> usize {
        match reader {
            Reader::Role => self.role,
            Reader::Scorer => self.scorer,
        }
    }
}

/// A factory of links.
pub trait Bus {
    /// True if a new reader may get samples that its predecessor received.
    const REPEATS: bool;

    /// Returns true if the run no longer exists. Makes a system call: not for every tick.
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

    /// Opens a signal for writing, with one writer per signal. `generation` is the one of its stamps.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn writer<S: Sample>(&self, topic: &Topic, generation: u64) -> Result<Self::Writer<S>, BusError>;
    /// Opens a signal for reading.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<Self::Reader<S>, BusError>;
    /// Opens the signal of a fleet of `bodies` bodies for writing.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn fleet_writer<L: FleetLayout>(&self, topic: &Topic, bodies: usize) -> Result<Self::FleetWriter<L>, BusError>;
    /// Opens the signal of a fleet of `bodies` bodies for reading.
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
    /// Fills the next sample in place. It is invisible to readers until it is delivered.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn fill(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError>;
    /// Sends the filled sample. Never waits for a reader.
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
    /// Writes the filled sample to the latest-value channel only, if there is one, else delivers it.
    /// [`publish`](Self::publish) must follow.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn write_latest(&mut self) -> Result<(), BusError> {
        self.deliver()
    }
    /// Publishes a sample that was only written to the latest-value channel.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn publish(&mut self) -> Result<(), BusError> {
        Ok(())
    }
    /// Prepares the next sample, so that [`send`](Self::send) has less to do.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn prepare(&mut self) -> Result<(), BusError>;
    /// Connects to readers that came later; [`send`](Self::send) does so too.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn refresh(&mut self) -> Result<(), BusError>;
}

/// The process that has the writing end open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WriterProcess {
    /// Process ID in the writer's own namespace, which may differ from that of a reader outside its container.
    pub pid: u32,
    /// Distinguishes the process from others with the same ID.
    pub unique: u128,
}

/// The reading end of a link.
pub trait Read<S: ?Sized> {
    /// Moves to the next sample. Returns false and changes nothing if no sample waits. Never waits.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn advance(&mut self) -> Result<bool, BusError>;
    /// Returns the current sample in place; `None` before the first.
    fn current(&self) -> Option<&S>;
    /// Returns true while the writing end is open. That of a killed process counts as open until its remains are
    /// removed. Always true within one thread.
    fn has_writer(&self) -> bool {
        true
    }
    /// Returns the process that has the writing end open; `None` within one thread.
    fn writer(&self) -> Option<WriterProcess> {
        None
    }
    /// Sleeps until a sample may have arrived, at most until `until_ns` on the monotonic clock. Within one thread it
    /// returns at once.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn sleep(&mut self, until_ns: u64) -> Result<(), BusError>;
    /// Connects to the current writer by the fastest path. Off the critical path. A connected reader also gets samples
    /// of a writer that has ended since.
    fn refresh(&mut self);
}
