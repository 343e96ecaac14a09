//! Link ends whose samples are words, for processes that pass samples on and know their layout only as data: recorder,
//! watcher, replay, and the launcher's view of external roles.
//!
//! Must not know the meaning of samples. Roles use typed ends instead, which need no dynamic dispatch.

use super::carried::Carried;
use super::error::BusError;
use super::iox::IoxBus;
use super::link::{Read, Reader, Write, WriterProcess};
use super::memory::MemoryBus;
use super::names::Topic;
use std::marker::PhantomData;

/// A bus of either kind.
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

/// A reading end of words.
pub trait ReadWords {
    /// Returns the next sample, stamp first; `None` if no sample waits. Never waits.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn next(&mut self) -> Result<Option<&[u64]>, BusError>;
    /// Returns true while the writing end is open, see [`Read::has_writer`].
    fn has_writer(&self) -> bool;
    /// Returns the process that has the writing end open, see [`Read::writer`].
    fn writer(&self) -> Option<WriterProcess>;
    /// Sleeps until a sample may have arrived, at most until `until_ns`, see [`Read::sleep`].
    ///
    /// # Errors
    /// [`BusError::Receive`].
    fn sleep(&mut self, until_ns: u64) -> Result<(), BusError>;
    /// Connects to the current writer, see [`Read::refresh`].
    fn refresh(&mut self);
}

/// A writing end of words.
pub trait WriteWords {
    /// Sends a sample given as bytes.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn send(&mut self, bytes: &[u8]) -> Result<(), BusError>;
    /// Connects to readers that came later.
    ///
    /// # Errors
    /// [`BusError::Send`].
    fn refresh(&mut self) -> Result<(), BusError>;
}

/// A reading end of any signal.
pub type WordReader = Box<dyn ReadWords>;
/// A writing end of any signal.
pub type WordWriter = Box<dyn WriteWords>;

/// Functions that open the ends of a kind of sample.
#[derive(Debug, Clone, Copy)]
pub struct EndOpeners {
    read: fn(AnyBus<'_>, &Topic, usize, Reader) -> Result<WordReader, BusError>,
    write: fn(AnyBus<'_>, &Topic, usize) -> Result<WordWriter, BusError>,
}

impl EndOpeners {
    /// Returns the functions for a kind of sample.
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

    /// Opens a signal of `bodies` bodies for reading.
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

    /// Opens a signal of `bodies` bodies for writing.
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
