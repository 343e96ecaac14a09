//! The bus over shared memory, and the only file that knows iceoryx2.
//!
//! Publish-subscribe with overflow: a slow or dead reader never holds a writer up. What a reader must not lose is bounded
//! by the loop itself (lockstep), not by a writer that waits.

use super::domain::Domain;
use super::{Bus, BusError, Depths, Read, Reader, Signal, Topic, Write};
use crate::sample::Sample;
use iceoryx2::config::Config;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample as Received;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

/// The most processes in one run: roles, launcher, recorders, watchers.
const MAX_NODES: usize = 128;
/// The most readers of the launcher's schedule: every role.
const MAX_SCHEDULE_READERS: usize = 128;
/// The most readers of any other signal: roles, scorer, recorder, watchers.
const MAX_READERS: usize = 8;
/// Samples that a reader holds at once: the one at hand, and the next while they are exchanged.
const MAX_BORROWED: usize = 2;

type Ipc = ipc::Service;

/// A sample as iceoryx2 sees it.
#[repr(transparent)]
#[derive(Debug, Clone, Copy)]
struct Wire<S>(S);

// SAFETY: `S` is `Pod`: plain bytes of a fixed layout without pointers, valid in every process, and `Wire` is transparent.
#[allow(unsafe_code)]
unsafe impl<S: Sample> ZeroCopySend for Wire<S> {
    // SAFETY: unsafe by the trait's declaration only; a constant asks nothing of its caller.
    unsafe fn type_name() -> &'static str {
        S::TYPE_NAME
    }
}

/// A node in a run's domain.
pub struct IoxBus {
    node: Node<Ipc>,
    depths: Depths,
}

impl IoxBus {
    /// Enters a domain as `name`.
    ///
    /// # Errors
    /// [`BusError::Domain`].
    pub fn enter(domain: &Domain, name: &str, depths: Depths) -> Result<Self, BusError> {
        // iceoryx2 reports to the console on its own; what matters comes back as an error.
        set_log_level(LogLevel::Fatal);
        let node = enter(domain, name)
            .map_err(|reason| BusError::Domain { domain: domain.root().display().to_string(), reason })?;
        Ok(Self { node, depths })
    }

    fn service<S: Sample>(&self, topic: &Topic, end: &'static str) -> Result<PortFactory<Ipc, Wire<S>, ()>, BusError> {
        let readers = if topic.signal == Signal::Schedule { MAX_SCHEDULE_READERS } else { MAX_READERS };
        let name = topic.to_string();
        let open = |reason: String| BusError::Open { service: topic.to_string(), end, reason };
        let name: ServiceName = name.as_str().try_into().map_err(|error| open(format!("{error:?}")))?;
        self.node
            .service_builder(&name)
            .publish_subscribe::<Wire<S>>()
            .max_publishers(1)
            .max_subscribers(readers)
            .max_nodes(MAX_NODES)
            .history_size(self.history(topic.signal))
            .subscriber_max_buffer_size(self.deepest(topic.signal))
            .subscriber_max_borrowed_samples(MAX_BORROWED)
            .enable_safe_overflow(true)
            .open_or_create()
            .map_err(|error| open(format!("{error:?}")))
    }

    /// Puts away what processes of this domain left behind when they died, so that others can take their seats.
    pub fn clear_dead(&self) {
        // What cannot be put away now is so when the successor enters.
        let _ = self.node.try_cleanup_dead_nodes();
    }

    /// What roles say of themselves and hear from the launcher is said again and again.
    fn history(&self, signal: Signal) -> usize {
        match signal {
            Signal::Health | Signal::Schedule => 0,
            Signal::Truth | Signal::Measurement | Signal::Estimate | Signal::Command => self.depths.history,
        }
    }

    /// Only what is scored needs room for the scorer.
    fn deepest(&self, signal: Signal) -> usize {
        match signal {
            Signal::Truth | Signal::Estimate | Signal::Command => self.depths.scorer.max(self.depths.role),
            Signal::Measurement => self.depths.role,
            Signal::Health | Signal::Schedule => 1,
        }
    }
}

fn enter(domain: &Domain, name: &str) -> Result<Node<Ipc>, String> {
    let mut config = Config::default();
    let root = domain.root().to_string_lossy();
    let root = Path::new(root.as_bytes()).map_err(|error| format!("{error:?}"))?;
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(domain.prefix().as_bytes()).map_err(|error| format!("{error:?}"))?;
    NodeBuilder::new()
        .name(&name.try_into().map_err(|error| format!("{error:?}"))?)
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Ipc>()
        .map_err(|error| format!("{error:?}"))
}

impl Bus for IoxBus {
    type Writer<S: Sample> = IoxWriter<S>;
    type Reader<S: Sample> = IoxReader<S>;

    fn writer<S: Sample>(&self, topic: &Topic) -> Result<IoxWriter<S>, BusError> {
        let publisher = self
            .service::<S>(topic, "writer")?
            .publisher_builder()
            .max_loaned_samples(1)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|error| BusError::Open {
                service: topic.to_string(),
                end: "writer",
                reason: format!("{error:?}"),
            })?;
        Ok(IoxWriter { publisher, loan: None, topic: topic.clone() })
    }

    fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<IoxReader<S>, BusError> {
        let depth = self.depths.of(reader).min(self.deepest(topic.signal));
        let subscriber =
            self.service::<S>(topic, "reader")?.subscriber_builder().buffer_size(depth).create().map_err(|error| {
                BusError::Open { service: topic.to_string(), end: "reader", reason: format!("{error:?}") }
            })?;
        Ok(IoxReader { subscriber, current: None, topic: topic.clone() })
    }
}

/// The writing end.
pub struct IoxWriter<S: Sample> {
    publisher: Publisher<Ipc, Wire<S>, ()>,
    loan: Option<SampleMut<Ipc, Wire<S>, ()>>,
    topic: Topic,
}

impl<S: Sample> IoxWriter<S> {
    fn loan(&self) -> Result<SampleMut<Ipc, Wire<S>, ()>, BusError> {
        let chunk = self.publisher.loan_uninit().map_err(|error| self.failed(format!("{error:?}")))?;
        Ok(chunk.write_payload(Wire(S::zeroed())))
    }

    #[cold]
    fn failed(&self, reason: String) -> BusError {
        BusError::Send { service: self.topic.to_string(), reason }
    }
}

impl<S: Sample> Write<S> for IoxWriter<S> {
    #[inline]
    fn send(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        let mut sample = match self.loan.take() {
            Some(sample) => sample,
            None => self.loan()?,
        };
        fill(&mut sample.payload_mut().0);
        sample.send().map(|_| ()).map_err(|error| self.failed(format!("{error:?}")))
    }

    /// Takes the next sample's memory: iceoryx2's one small allocation per sample happens here, off the critical path.
    #[inline]
    fn prepare(&mut self) -> Result<(), BusError> {
        if self.loan.is_none() {
            self.loan = Some(self.loan()?);
        }
        Ok(())
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        self.publisher.update_connections().map_err(|error| self.failed(format!("{error:?}")))
    }
}

/// The reading end.
pub struct IoxReader<S: Sample> {
    subscriber: Subscriber<Ipc, Wire<S>, ()>,
    current: Option<Received<Ipc, Wire<S>, ()>>,
    topic: Topic,
}

impl<S: Sample> Read<S> for IoxReader<S> {
    #[inline]
    fn advance(&mut self) -> Result<bool, BusError> {
        match self.subscriber.receive() {
            Ok(Some(sample)) => {
                self.current = Some(sample);
                Ok(true)
            }
            Ok(None) => Ok(false),
            Err(error) => Err(BusError::Receive { service: self.topic.to_string(), reason: format!("{error:?}") }),
        }
    }

    #[inline]
    fn current(&self) -> Option<&S> {
        self.current.as_ref().map(|sample| &sample.payload().0)
    }
}

#[cfg(test)]
mod tests {
    use super::super::domain::OwnedDomain;
    use super::*;
    use crate::sample::{RateCommand, RateTruth};

    fn topic() -> Topic {
        Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Truth }
    }

    fn bus(domain: &OwnedDomain) -> IoxBus {
        IoxBus::enter(domain.domain(), "test", Depths { role: 1, scorer: 8, history: 0 }).unwrap()
    }

    #[test]
    fn a_deep_reader_gets_every_sample_and_a_shallow_one_the_newest() {
        let domain = OwnedDomain::create().unwrap();
        let (ours, theirs) = (bus(&domain), bus(&domain));
        let mut newest = theirs.reader::<RateTruth>(&topic(), Reader::Role).unwrap();
        let mut every = theirs.reader::<RateTruth>(&topic(), Reader::Scorer).unwrap();
        let mut writer = ours.writer::<RateTruth>(&topic()).unwrap();
        assert!(!newest.advance().unwrap() && !every.advance().unwrap());
        for tick in 0..5 {
            writer.prepare().unwrap();
            writer.send(|sample| (sample.stamp.tick, sample.omega_rad_s[1]) = (tick, 0.5)).unwrap();
        }
        assert!(newest.advance().unwrap());
        assert_eq!(newest.current().unwrap().stamp.tick, 4);
        for tick in 0..5 {
            assert!(every.advance().unwrap());
            let sample = every.current().unwrap();
            assert_eq!((sample.stamp.tick, sample.omega_rad_s[1]), (tick, 0.5));
        }
        assert!(!every.advance().unwrap());
    }

    #[test]
    fn refuses_a_second_writer_and_another_type() {
        let domain = OwnedDomain::create().unwrap();
        let bus = bus(&domain);
        let _writer = bus.writer::<RateTruth>(&topic()).unwrap();
        assert!(matches!(bus.writer::<RateTruth>(&topic()), Err(BusError::Open { .. })));
        let error = bus.reader::<RateCommand>(&topic(), Reader::Role).err().unwrap();
        assert!(error.to_string().contains("IncompatibleTypes"), "{error}");
    }

    #[test]
    fn two_domains_never_meet() {
        let (one, other) = (OwnedDomain::create().unwrap(), OwnedDomain::create().unwrap());
        let mut writer = bus(&one).writer::<RateTruth>(&topic()).unwrap();
        let mut reader = bus(&other).reader::<RateTruth>(&topic(), Reader::Scorer).unwrap();
        reader.advance().unwrap();
        writer.send(|sample| sample.stamp.tick = 1).unwrap();
        assert!(!reader.advance().unwrap());
    }
}
