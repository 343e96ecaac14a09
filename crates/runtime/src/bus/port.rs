//! A signal as data: its topic, the layout of its samples, and functions that open its ends without knowing their type.

use super::carried::Carried;
use super::error::BusError;
use super::iox::Qos;
use super::link::{Depths, Reader};
use super::names::Topic;
use super::words::{AnyBus, EndOpeners, WordReader, WordWriter};
use crate::sample::Field;

/// A signal with the layout of its samples.
#[derive(Debug, Clone)]
pub struct Port {
    /// The topic, which names the service.
    pub topic: Topic,
    /// Name and version of the layout.
    pub type_name: &'static str,
    /// The type name with a hash of the fields, which identifies services and device samples.
    pub layout: &'static str,
    /// The length of a sample, bytes.
    pub size: usize,
    /// The fields after the stamp, in order.
    pub fields: Vec<Field>,
    /// True for a fleet, whose samples are slices of words.
    pub fleet: bool,
    bodies: usize,
    ends: EndOpeners,
}

impl Port {
    /// Creates the port of a kind of sample, for a single body or a fleet of this size.
    pub fn new<S: Carried + ?Sized>(topic: Topic, fleet: Option<usize>) -> Self {
        let bodies = fleet.unwrap_or(1);
        let size = S::length(bodies) * size_of::<u64>();
        let (type_name, layout) = (S::type_name(), S::layout());
        let (fields, ends) = (S::fields(bodies), EndOpeners::for_sample::<S>());
        Self { topic, type_name, layout, size, fields, fleet: fleet.is_some(), bodies, ends }
    }

    /// Returns the requirements on its service.
    pub fn qos(&self, depths: Depths) -> Qos {
        let signal = self.topic.signal;
        if self.fleet { Qos::for_fleet(signal, depths) } else { Qos::for_signal(signal, depths) }
    }

    /// Opens the signal for reading as words.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn reader<'a>(&self, bus: impl Into<AnyBus<'a>>, reader: Reader) -> Result<WordReader, BusError> {
        self.ends.reader(bus.into(), &self.topic, self.bodies, reader)
    }

    /// Opens the signal for writing as words.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn writer<'a>(&self, bus: impl Into<AnyBus<'a>>) -> Result<WordWriter, BusError> {
        self.ends.writer(bus.into(), &self.topic, self.bodies)
    }
}
