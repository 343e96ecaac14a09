//! Links of fleets over shared memory: slices of words with the length of the fleet's samples.

use super::cause;
use super::opening::{Connections, IoxBus};
use super::service::{Ipc, buffer_size, has_writer, writer};
use crate::bus::error::BusError;
use crate::bus::link::{Read, Reader, Write, WriterProcess};
use crate::bus::names::Topic;
use crate::bus::notifier::Notifier;
use crate::sample::{FleetLayout, FleetSample};
use bytemuck::TransparentWrapper;
use core::marker::PhantomData;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample as Received;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

/// A word of a fleet's sample for iceoryx2; its type names the layout of the whole sample.
#[repr(transparent)]
#[derive(Debug, TransparentWrapper)]
#[transparent(u64)]
pub(super) struct Word<L: FleetLayout> {
    word: u64,
    layout: PhantomData<L>,
}

// SAFETY: `Word` is transparent over a `u64`: plain bytes without pointers, valid in every process.
#[allow(unsafe_code)]
unsafe impl<L: FleetLayout> ZeroCopySend for Word<L> {
    // SAFETY: unsafe by the trait's declaration only; a constant asks nothing of its caller.
    unsafe fn type_name() -> &'static str {
        L::LAYOUT
    }
}

type Service<L> = PortFactory<Ipc, [Word<L>], ()>;

/// The writing end of a fleet's signal.
pub struct IoxFleetWriter<L: FleetLayout> {
    publisher: Publisher<Ipc, [Word<L>], ()>,
    loan: Option<SampleMut<Ipc, [Word<L>], ()>>,
    length: usize,
    notifier: Notifier,
    topic: Topic,
}

impl<L: FleetLayout> IoxFleetWriter<L> {
    pub(super) fn open(bus: &IoxBus, service: &Service<L>, topic: &Topic, bodies: usize) -> Result<Self, BusError> {
        let length = FleetSample::<L>::length(bodies);
        let publisher = bus.open(topic, "writer", || {
            let connections = Connections::default();
            let builder = service.publisher_builder().initial_max_slice_len(length).max_loaned_samples(1);
            let builder = builder.backpressure_strategy(BackpressureStrategy::DiscardData);
            connections.check(builder.set_degradation_handler(connections.failure_handler()).create()?)
        })?;
        Ok(Self { publisher, loan: None, length, notifier: bus.notifiers.notifier_for(topic), topic: topic.clone() })
    }

    fn loan(&self) -> Result<SampleMut<Ipc, [Word<L>], ()>, BusError> {
        let chunk = self
            .publisher
            .loan_slice_uninit(self.length)
            .map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))?;
        Ok(chunk.write_from_fn(|_| Word::wrap(0)))
    }

    #[cold]
    fn failed(&self, reason: String) -> BusError {
        BusError::Send { service: self.topic.to_string(), reason }
    }
}

impl<L: FleetLayout> Write<FleetSample<L>> for IoxFleetWriter<L> {
    #[inline]
    fn fill(&mut self, fill: impl FnOnce(&mut FleetSample<L>)) -> Result<(), BusError> {
        let mut sample = match self.loan.take() {
            Some(sample) => sample,
            None => self.loan()?,
        };
        fill(FleetSample::over_mut(Word::peel_slice_mut(sample.payload_mut())));
        self.loan = Some(sample);
        Ok(())
    }

    #[inline]
    fn deliver(&mut self) -> Result<(), BusError> {
        let Some(sample) = self.loan.take() else { return Ok(()) };
        sample.send().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))?;
        self.notifier.notify();
        Ok(())
    }

    /// Loans and clears the memory of the next sample, off the critical path.
    #[inline]
    fn prepare(&mut self) -> Result<(), BusError> {
        if self.loan.is_none() {
            self.loan = Some(self.loan()?);
        }
        Ok(())
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        self.publisher.update_connections().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))
    }
}

/// The reading end of a fleet's signal. Slices of another length are ignored.
pub struct IoxFleetReader<L: FleetLayout> {
    service: Service<L>,
    subscriber: Subscriber<Ipc, [Word<L>], ()>,
    current: Option<Received<Ipc, [Word<L>], ()>>,
    length: usize,
    notifier: Notifier,
    topic: Topic,
}

impl<L: FleetLayout> IoxFleetReader<L> {
    pub(super) fn open(
        bus: &IoxBus,
        service: Service<L>,
        topic: &Topic,
        reader: Reader,
        bodies: usize,
    ) -> Result<Self, BusError> {
        let depth = buffer_size(topic.signal, reader, bus.depths);
        let subscriber = bus.open(topic, "reader", || {
            let connections = Connections::default();
            let builder = service.subscriber_builder().buffer_size(depth);
            connections.check(builder.set_degradation_handler(connections.failure_handler()).create()?)
        })?;
        let length = FleetSample::<L>::length(bodies);
        Ok(Self {
            service,
            subscriber,
            current: None,
            length,
            notifier: bus.notifiers.notifier_for(topic),
            topic: topic.clone(),
        })
    }

    #[cold]
    fn failed(&self, reason: String) -> BusError {
        BusError::Receive { service: self.topic.to_string(), reason }
    }
}

impl<L: FleetLayout> Read<FleetSample<L>> for IoxFleetReader<L> {
    #[inline]
    fn advance(&mut self) -> Result<bool, BusError> {
        loop {
            match self.subscriber.receive() {
                Ok(Some(sample)) if sample.payload().len() == self.length => {
                    self.current = Some(sample);
                    return Ok(true);
                }
                Ok(Some(_)) => {}
                Ok(None) => return Ok(false),
                Err(error) => return Err(self.failed(cause::reason(|| format!("{error:?}")))),
            }
        }
    }

    #[inline]
    fn current(&self) -> Option<&FleetSample<L>> {
        self.current.as_ref().map(|sample| FleetSample::over(Word::peel_slice(sample.payload())))
    }

    fn has_writer(&self) -> bool {
        has_writer(&self.service)
    }

    fn writer(&self) -> Option<WriterProcess> {
        writer(&self.service)
    }

    fn sleep(&mut self, until_ns: u64) -> Result<(), BusError> {
        let news =
            || self.subscriber.has_samples().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))));
        self.notifier.sleep(until_ns, news)
    }

    fn refresh(&mut self) {
        // The next poll reports an error of the writer.
        let _ = self.subscriber.update_connections();
    }
}
