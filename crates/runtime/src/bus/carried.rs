//! The samples that links carry: those of one body, whose size is known at compile time, and those of fleets, whose
//! length is not.
//!
//! Generic code serves both kinds without cost for the simpler one. Must not know how a bus carries samples.

use super::error::BusError;
use super::link::{Bus, Read, Reader, Write};
use super::names::Topic;
use crate::sample::{Field, FleetLayout, FleetSample, Message, Sample};
use std::borrow::{Borrow, BorrowMut};
use std::marker::PhantomData;

/// A kind of sample that links carry. `bodies` is the number of bodies in a sample, 1 except for fleets.
pub trait Carried: Message + 'static {
    /// An owned sample.
    type Owned: BorrowMut<Self>;
    /// The writing end of a link.
    type Writer<B: Bus>: Write<Self>;
    /// The reading end of a link.
    type Reader<B: Bus>: Read<Self>;

    /// Returns name and version of the layout.
    fn type_name() -> &'static str;
    /// Returns the type name with a hash of the fields.
    fn layout() -> &'static str;
    /// Returns the fields after the stamp, in order.
    fn fields(bodies: usize) -> Vec<Field>;
    /// Returns a sample of zeros.
    fn blank(bodies: usize) -> Self::Owned;
    /// Returns the length of a sample, words.
    fn length(bodies: usize) -> usize;
    /// Copies another sample into this one.
    fn assign(&mut self, from: &Self);
    /// Opens a signal for writing, for this generation of the writer.
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

/// An owned sample of a fleet.
#[derive(Debug)]
pub struct FleetBuffer<L> {
    words: Box<[u64]>,
    layout: PhantomData<L>,
}

impl<L: FleetLayout> FleetBuffer<L> {
    /// Creates a sample of zeros for `bodies` bodies.
    pub fn new(bodies: usize) -> Self {
        Self { words: vec![0; FleetSample::<L>::length(bodies)].into(), layout: PhantomData }
    }

    /// Returns the sample.
    #[inline]
    pub fn sample(&self) -> &FleetSample<L> {
        FleetSample::over(&self.words)
    }

    /// Returns the sample for writing.
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
