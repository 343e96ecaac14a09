//! Ends of links whose samples are words, for those who pass samples on and know their layout as data alone: recorder, watcher,
//! replay, the launcher's look at external roles.
//!
//! Must not know what a sample means. Roles open ends of their samples' own types, which are read without a call by a table.

use super::iox::IoxBus;
use super::memory::MemoryBus;
use super::{BusError, Carried, Read, Reader, Topic, Write, WriterProcess};
use std::marker::PhantomData;

/// A bus, whichever it is.
#[derive(Clone, Copy)]
pub enum AnyBus<'a> {
    /// Within this thread.
    Memory(&'a MemoryBus),
    /// Over shared memory.
    Shared(&'a IoxBus),
}

impl<'a> From<&'a MemoryBus> for AnyBus<'a> {
    fn from(bus: &'a MemoryBus) -> Self {
        Self::Memory(bus)
    }
}

impl<'a> From<&'a IoxBus> for AnyBus<'a> {
    fn from(bus: &'a IoxBus) -> Self {
        Self::Shared(bus)
    }
}

/// A reading end.
pub trait ReadWords {
    /// The next sample, stamp first; none if none has come. Never waits.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn next(&mut self) -> Result<Option<&[u64]>, BusError>;
    /// Whether somebody has the writing end open, as [`Read::has_writer`].
    fn has_writer(&self) -> bool;
    /// The process that has it open, as [`Read::writer`].
    fn writer(&self) -> Option<WriterProcess>;
    /// Sleeps until there may be a next sample, at most until `until_ns`, as [`Read::sleep`].
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn sleep(&mut self, until_ns: u64) -> Result<(), BusError>;
    /// Connects to the writer that there is now, as [`Read::refresh`].
    fn refresh(&mut self);
}

/// A writing end.
pub trait WriteWords {
    /// Sends a sample, given as its bytes.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError>;
    /// Lets a reader that has come later know of this end.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn refresh(&mut self) -> Result<(), BusError>;
}

/// A reading end of any signal.
pub type WordReader = Box<dyn ReadWords>;
/// A writing end of any signal.
pub type WordWriter = Box<dyn WriteWords>;

/// Opens the ends of signals that carry one kind of sample.
#[derive(Debug, Clone, Copy)]
pub struct EndOpeners {
    read: fn(AnyBus<'_>, &Topic, usize, Reader) -> Result<WordReader, BusError>,
    write: fn(AnyBus<'_>, &Topic, usize) -> Result<WordWriter, BusError>,
}

impl EndOpeners {
    /// Those of a kind of sample.
    pub fn for_sample<S: Carried + ?Sized>() -> Self {
        let read = |bus: AnyBus<'_>, topic: &Topic, bodies, reader| -> Result<WordReader, BusError> {
            Ok(match bus {
                AnyBus::Memory(bus) => Box::new(End::<_, S>(S::reader(bus, topic, reader, bodies)?, PhantomData)),
                AnyBus::Shared(bus) => Box::new(End::<_, S>(S::reader(bus, topic, reader, bodies)?, PhantomData)),
            })
        };
        let write = |bus: AnyBus<'_>, topic: &Topic, bodies| -> Result<WordWriter, BusError> {
            Ok(match bus {
                AnyBus::Memory(bus) => Box::new(End::<_, S>(S::writer(bus, topic, bodies, 1)?, PhantomData)),
                AnyBus::Shared(bus) => Box::new(End::<_, S>(S::writer(bus, topic, bodies, 1)?, PhantomData)),
            })
        };
        Self { read, write }
    }

    /// Opens a signal of so many bodies for reading.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn reader(
        &self,
        bus: AnyBus<'_>,
        topic: &Topic,
        bodies: usize,
        reader: Reader,
    ) -> Result<WordReader, BusError> {
        (self.read)(bus, topic, bodies, reader)
    }

    /// Opens a signal of so many bodies for writing.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn writer(&self, bus: AnyBus<'_>, topic: &Topic, bodies: usize) -> Result<WordWriter, BusError> {
        (self.write)(bus, topic, bodies)
    }
}

/// An end of a signal that carries `S`.
struct End<T, S: ?Sized>(T, PhantomData<S>);

impl<T: Read<S>, S: Carried + ?Sized> ReadWords for End<T, S> {
    fn next(&mut self) -> Result<Option<&[u64]>, BusError> {
        Ok(if self.0.advance()? { self.0.current().map(|sample| sample.words()) } else { None })
    }

    fn has_writer(&self) -> bool {
        self.0.has_writer()
    }

    fn writer(&self) -> Option<WriterProcess> {
        self.0.writer()
    }

    fn sleep(&mut self, until_ns: u64) -> Result<(), BusError> {
        self.0.sleep(until_ns)
    }

    fn refresh(&mut self) {
        self.0.refresh();
    }
}

impl<T: Write<S>, S: Carried + ?Sized> WriteWords for End<T, S> {
    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError> {
        self.0.send(|sample| bytemuck::cast_slice_mut(sample.words_mut()).copy_from_slice(bytes))
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        self.0.refresh()
    }
}
