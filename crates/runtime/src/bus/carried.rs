//! What links carry: samples of one body, whose size is known to the compiler, and those of fleets, whose length is not.
//!
//! Whoever is generic over this serves both by the same code, and pays for neither what the other needs. Must not know how
//! a bus carries anything.

use super::{Bus, BusError, Read, Reader, Topic, Write};
use crate::sample::{Field, FleetLayout, FleetSample, Message, Sample};
use std::borrow::{Borrow, BorrowMut};
use std::marker::PhantomData;

/// A kind of sample that links carry. `bodies` is how many bodies a signal tells of: 1, or a fleet's number.
pub trait Carried: Message + 'static {
    /// One of one's own.
    type Owned: BorrowMut<Self>;
    /// The writing end of its links.
    type Writer<B: Bus>: Write<Self>;
    /// The reading end of its links.
    type Reader<B: Bus>: Read<Self>;

    /// Name and version of the layout.
    fn type_name() -> &'static str;
    /// The type name with a hash of the fields.
    fn layout() -> &'static str;
    /// The fields after the stamp, in order.
    fn fields(bodies: usize) -> Vec<Field>;
    /// One of all zeros.
    fn blank(bodies: usize) -> Self::Owned;
    /// How long one is, words.
    fn length(bodies: usize) -> usize;
    /// Becomes as another one.
    fn assign(&mut self, from: &Self);
    /// Opens a signal for writing, in this life of the writer.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn writer<B: Bus>(bus: &B, topic: &Topic, bodies: usize, generation: u64) -> Result<Self::Writer<B>, BusError>;
    /// Opens a signal for reading.
    ///
    /// # Errors
    /// [`BusError::Open`].
    fn reader<B: Bus>(bus: &B, topic: &Topic, reader: Reader, bodies: usize) -> Result<Self::Reader<B>, BusError>;
}

impl<S: Sample> Carried for S {
    type Owned = S;
    type Writer<B: Bus> = B::Writer<S>;
    type Reader<B: Bus> = B::Reader<S>;

    fn type_name() -> &'static str {
        S::TYPE_NAME
    }

    fn layout() -> &'static str {
        S::LAYOUT
    }

    fn fields(_bodies: usize) -> Vec<Field> {
        S::FIELDS.to_vec()
    }

    fn blank(_bodies: usize) -> S {
        S::default()
    }

    fn length(_bodies: usize) -> usize {
        size_of::<S>() / size_of::<u64>()
    }

    #[inline]
    fn assign(&mut self, from: &S) {
        *self = *from;
    }

    fn writer<B: Bus>(bus: &B, topic: &Topic, _bodies: usize, generation: u64) -> Result<B::Writer<S>, BusError> {
        bus.writer(topic, generation)
    }

    fn reader<B: Bus>(bus: &B, topic: &Topic, reader: Reader, _bodies: usize) -> Result<B::Reader<S>, BusError> {
        bus.reader(topic, reader)
    }
}

impl<L: FleetLayout> Carried for FleetSample<L> {
    type Owned = FleetBuffer<L>;
    type Writer<B: Bus> = B::FleetWriter<L>;
    type Reader<B: Bus> = B::FleetReader<L>;

    fn type_name() -> &'static str {
        L::TYPE_NAME
    }

    fn layout() -> &'static str {
        L::LAYOUT
    }

    fn fields(bodies: usize) -> Vec<Field> {
        Self::fields(bodies).collect()
    }

    fn blank(bodies: usize) -> FleetBuffer<L> {
        FleetBuffer::new(bodies)
    }

    fn length(bodies: usize) -> usize {
        Self::length(bodies)
    }

    #[inline]
    fn assign(&mut self, from: &Self) {
        self.words_mut().copy_from_slice(from.words());
    }

    fn writer<B: Bus>(bus: &B, topic: &Topic, bodies: usize, _generation: u64) -> Result<B::FleetWriter<L>, BusError> {
        bus.fleet_writer(topic, bodies)
    }

    fn reader<B: Bus>(bus: &B, topic: &Topic, reader: Reader, bodies: usize) -> Result<B::FleetReader<L>, BusError> {
        bus.fleet_reader(topic, reader, bodies)
    }
}

/// A fleet's sample of one's own.
#[derive(Debug)]
pub struct FleetBuffer<L> {
    words: Box<[u64]>,
    layout: PhantomData<L>,
}

impl<L: FleetLayout> FleetBuffer<L> {
    /// A sample of all zeros for so many bodies.
    pub fn new(bodies: usize) -> Self {
        Self { words: vec![0; FleetSample::<L>::length(bodies)].into(), layout: PhantomData }
    }

    /// The sample.
    #[inline]
    pub fn sample(&self) -> &FleetSample<L> {
        FleetSample::over(&self.words)
    }

    /// The sample, to be written.
    #[inline]
    pub fn sample_mut(&mut self) -> &mut FleetSample<L> {
        FleetSample::over_mut(&mut self.words)
    }
}

impl<L: FleetLayout> Borrow<FleetSample<L>> for FleetBuffer<L> {
    #[inline]
    fn borrow(&self) -> &FleetSample<L> {
        self.sample()
    }
}

impl<L: FleetLayout> BorrowMut<FleetSample<L>> for FleetBuffer<L> {
    #[inline]
    fn borrow_mut(&mut self) -> &mut FleetSample<L> {
        self.sample_mut()
    }
}
