//! The bus over shared memory. Only this file, its parts and `raw.rs` know iceoryx2.
//!
//! Publish-subscribe with overflow: a slow or dead reader never delays a writer. Lockstep bounds the number of waiting
//! samples by its window, not by a waiting writer.

mod cause;
mod fleet;
mod latest;
mod opening;
mod service;
mod single;

pub use fleet::{IoxFleetReader, IoxFleetWriter};
pub use opening::IoxBus;
pub use service::{COMMON_BYTES, Qos, VERSION, buffer_size, footprint};
pub(super) use service::{Ipc, enter};
pub use single::{IoxReader, IoxWriter};

use self::latest::LatestWriter;
use self::opening::{Connections, OpenFailure};
use self::service::{Wire, config};
use self::single::{Current, LatestChannel, NO_KEY};
use super::domain::Domain;
use super::error::BusError;
use super::link::{Bus, Depths, Reader};
use super::names::{Signal, Topic};
use super::notifier::Notifiers;
use crate::sample::{FleetLayout, Sample};
use crate::system::remedy;
use iceoryx2::node::NodeState;
use iceoryx2::prelude::*;
use iceoryx2::service::builder::publish_subscribe::Builder;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use std::fmt;
use std::io;
use std::rc::Rc;
use std::time::Duration;

/// Default time limit of an opening, ns.
const OPENING_NS: u64 = 10_000_000_000;

impl IoxBus {
    /// Enters a domain under this name.
    ///
    /// # Errors
    /// [`BusError::Domain`].
    pub fn enter(domain: &Domain, name: &str, depths: Depths) -> Result<Self, BusError> {
        Self::with_notifiers(domain, name, depths, Notifiers::open(domain), true)
    }

    /// Enters a domain without creating signals: opening a signal that does not exist is an error.
    ///
    /// # Errors
    /// [`BusError::Domain`].
    pub fn join(domain: &Domain, name: &str, depths: Depths) -> Result<Self, BusError> {
        Self::with_notifiers(domain, name, depths, Notifiers::join(domain), false)
    }

    fn with_notifiers(
        domain: &Domain,
        name: &str,
        depths: Depths,
        notifiers: io::Result<Notifiers>,
        creates: bool,
    ) -> Result<Self, BusError> {
        cause::capture_errors();
        let failed = |reason| BusError::Domain { domain: domain.root().display().to_string(), reason };
        let notifiers = notifiers.map_err(|error| failed(format!("{error}; {}", remedy(&error))))?;
        let node = Rc::new(enter(domain.root(), domain, name).map_err(failed)?);
        Ok(Self { node, notifiers, depths, creates, domain: domain.clone(), opening_ns: OPENING_NS })
    }

    /// Sets the time limit of an opening.
    pub fn with_opening_limit(self, limit: Duration) -> Self {
        Self { opening_ns: limit.as_nanos() as u64, ..self }
    }

    /// Returns true if a signal has a latest-value channel: only the newest sample counts.
    fn has_latest_channel(&self, topic: &Topic) -> bool {
        let for_roles = matches!(topic.signal, Signal::Measurement | Signal::Estimate | Signal::Command);
        for_roles && self.depths.role == 1
    }

    fn service<S: Sample>(&self, topic: &Topic, end: &'static str) -> Result<PortFactory<Ipc, Wire<S>, ()>, BusError> {
        self.open(topic, end, || {
            let builder = self.builder::<Wire<S>>(topic, &Qos::for_signal(topic.signal, self.depths))?;
            let opened = if self.creates {
                builder.open_or_create().map_err(OpenFailure::from)
            } else {
                builder.open().map_err(OpenFailure::from)
            };
            opened.map_err(|failure| self.explain(failure, topic, S::LAYOUT))
        })
    }

    fn fleet_service<L: FleetLayout>(
        &self,
        topic: &Topic,
        end: &'static str,
    ) -> Result<PortFactory<Ipc, [fleet::Word<L>], ()>, BusError> {
        self.open(topic, end, || {
            let builder = self.builder::<[fleet::Word<L>]>(topic, &Qos::for_fleet(topic.signal, self.depths))?;
            let opened = if self.creates {
                builder.open_or_create().map_err(OpenFailure::from)
            } else {
                builder.open().map_err(OpenFailure::from)
            };
            opened.map_err(|failure| self.explain(failure, topic, L::LAYOUT))
        })
    }

    fn builder<P: IceoryxSend + fmt::Debug + ?Sized>(
        &self,
        topic: &Topic,
        qos: &Qos,
    ) -> Result<Builder<P, (), Ipc>, OpenFailure> {
        let name: ServiceName = topic.to_string().as_str().try_into().map_err(OpenFailure::never)?;
        Ok(self
            .node
            .service_builder(&name)
            .publish_subscribe::<P>()
            .max_publishers(qos.max_publishers)
            .max_subscribers(qos.max_subscribers)
            .max_nodes(qos.max_nodes)
            .history_size(qos.history_size)
            .subscriber_max_buffer_size(qos.subscriber_max_buffer_size)
            .subscriber_max_borrowed_samples(qos.subscriber_max_borrowed_samples)
            .enable_safe_overflow(qos.enable_safe_overflow))
    }
}

/// Removes the remains of a domain's dead processes. For the janitor only: it may block for a long time, or forever
/// while a process is stopped.
pub fn clear_dead(domain: &Domain) -> Result<(), BusError> {
    set_log_level(LogLevel::Fatal);
    let failed = |reason| BusError::Domain { domain: domain.root().display().to_string(), reason };
    let clear = |node: NodeState<Ipc>| {
        if let NodeState::Dead(dead) = node {
            // A failure is repeated at the next call.
            let _ = dead.try_remove_stale_resources();
        }
        CallbackProgression::Continue
    };
    Node::<Ipc>::list(&config(domain.root(), domain).map_err(failed)?, clear)
        .map_err(|error| failed(format!("{error:?}")))
}

impl Bus for IoxBus {
    const REPEATS: bool = true;

    fn is_gone(&self) -> bool {
        !self.domain.exists()
    }
    type Writer<S: Sample> = IoxWriter<S>;
    type Reader<S: Sample> = IoxReader<S>;
    type FleetWriter<L: FleetLayout> = IoxFleetWriter<L>;
    type FleetReader<L: FleetLayout> = IoxFleetReader<L>;

    fn writer<S: Sample>(&self, topic: &Topic, generation: u64) -> Result<IoxWriter<S>, BusError> {
        let channel = || self.open(topic, "writer", || LatestWriter::create(&self.node, topic, generation));
        let latest = self.has_latest_channel(topic).then(channel).transpose()?;
        let service = self.service::<S>(topic, "writer")?;
        let publisher = self.open(topic, "writer", || {
            let connections = Connections::default();
            let builder = service.publisher_builder().max_loaned_samples(1);
            let builder = builder.backpressure_strategy(BackpressureStrategy::DiscardData);
            connections.check(builder.set_degradation_handler(connections.failure_handler()).create()?)
        })?;
        Ok(IoxWriter {
            publisher,
            latest,
            loan: None,
            unpublished: None,
            notifier: self.notifiers.notifier_for(topic),
            topic: topic.clone(),
        })
    }

    fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<IoxReader<S>, BusError> {
        let depth = buffer_size(topic.signal, reader, self.depths);
        let service = self.service::<S>(topic, "reader")?;
        let subscriber = self.open(topic, "reader", || {
            let connections = Connections::default();
            let builder = service.subscriber_builder().buffer_size(depth);
            connections.check(builder.set_degradation_handler(connections.failure_handler()).create()?)
        })?;
        // A reader of every sample does not need the latest-value channel.
        let latest_channel = match reader {
            Reader::Role if self.has_latest_channel(topic) => LatestChannel::Wanted { generation: 1 },
            _ => LatestChannel::None,
        };
        let (node, notifier, topic) = (self.node.clone(), self.notifiers.notifier_for(topic), topic.clone());
        let (current, channel_keys, pending, newest) = (Current::None, [NO_KEY; 2], None, (0, 0));
        Ok(IoxReader {
            node,
            service,
            subscriber,
            current,
            channel_keys,
            pending,
            newest,
            latest_channel,
            idle: 0,
            notifier,
            topic,
        })
    }

    fn fleet_writer<L: FleetLayout>(&self, topic: &Topic, bodies: usize) -> Result<IoxFleetWriter<L>, BusError> {
        IoxFleetWriter::open(self, &self.fleet_service::<L>(topic, "writer")?, topic, bodies)
    }

    fn fleet_reader<L: FleetLayout>(
        &self,
        topic: &Topic,
        reader: Reader,
        bodies: usize,
    ) -> Result<IoxFleetReader<L>, BusError> {
        IoxFleetReader::open(self, self.fleet_service(topic, "reader")?, topic, reader, bodies)
    }
}

#[cfg(test)]
mod tests {
    use super::super::domain::OwnedDomain;
    use super::super::{Read, Write};
    use super::*;
    use crate::sample::{RateCommand, RateTruth};
    use std::os::unix::fs::MetadataExt;

    pub(super) fn topic() -> Topic {
        Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Truth }
    }

    pub(super) fn bus(domain: &OwnedDomain) -> IoxBus {
        IoxBus::enter(domain.domain(), "test", Depths { role: 1, scorer: 8, history: 0 }).unwrap()
    }

    /// iceoryx2 uses the private file of the domain instead of creating one for all users.
    #[test]
    fn the_transport_creates_only_private_files() {
        let domain = OwnedDomain::create(0).unwrap();
        let shared = || domain.domain().shared_memory_files().map(|path| (path.metadata().unwrap(), path));
        let before: Vec<_> = shared().map(|(_, path)| path).collect();
        let first = enter(domain.domain().root(), domain.domain(), "first").unwrap();
        assert_eq!(shared().map(|(_, path)| path).collect::<Vec<_>>(), before, "a node alone creates no file");
        let count = before.iter().find(|path| path.to_string_lossy().contains("_node.")).unwrap();
        let count = || std::fs::read(count).unwrap()[8];
        let (counted, _second) = (count(), enter(domain.domain().root(), domain.domain(), "second").unwrap());
        assert_eq!((counted, count()), (1, 2), "it counts in the existing file");
        let bus = bus(&domain);
        let _ends =
            (bus.writer::<RateCommand>(&topic(), 1).unwrap(), bus.reader::<RateCommand>(&topic(), Reader::Role));
        assert!(shared().count() > before.len());
        shared().for_each(|(file, path)| assert_eq!(file.mode() & 0o077, 0, "{}", path.display()));
        domain.domain().require_own_mappings().unwrap();
        drop(first);
    }

    #[test]
    fn a_new_process_does_not_clean_up_after_dead_ones() {
        let domain = OwnedDomain::create(0).unwrap();
        let config = config(domain.domain().root(), domain.domain()).unwrap();
        assert!(!config.global.node.cleanup_dead_nodes_on_creation);
        assert!(!config.global.node.cleanup_dead_nodes_on_destruction);
        assert!(!config.global.service.cleanup_dead_nodes_on_open);
    }

    #[test]
    fn a_deep_reader_gets_every_sample_and_a_shallow_one_the_newest() {
        let domain = OwnedDomain::create(0).unwrap();
        let (ours, theirs) = (bus(&domain), bus(&domain));
        let mut newest = theirs.reader::<RateTruth>(&topic(), Reader::Role).unwrap();
        let mut every = theirs.reader::<RateTruth>(&topic(), Reader::Scorer).unwrap();
        assert!(!newest.has_writer());
        let mut writer = ours.writer::<RateTruth>(&topic(), 1).unwrap();
        assert!(newest.has_writer());
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
    fn a_connected_reader_gets_the_samples_of_an_ended_writer() {
        let domain = OwnedDomain::create(0).unwrap();
        let (ours, theirs) = (bus(&domain), bus(&domain));
        let [mut connected, mut other] = [0, 1].map(|_| theirs.reader::<RateTruth>(&topic(), Reader::Scorer).unwrap());
        let mut writer = ours.writer::<RateTruth>(&topic(), 1).unwrap();
        connected.refresh();
        for tick in 0..5 {
            writer.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        drop((writer, ours));
        let mut received = 0;
        while connected.advance().unwrap() {
            received += 1;
        }
        assert_eq!(received, 5);
        // Therefore a recorder connects before the ticks run.
        assert!(!other.advance().unwrap());
    }

    #[test]
    fn refuses_a_second_writer_and_another_type() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let _writer = bus.writer::<RateTruth>(&topic(), 1).unwrap();
        assert!(matches!(bus.writer::<RateTruth>(&topic(), 1), Err(BusError::Open { .. })));
        let error = bus.reader::<RateCommand>(&topic(), Reader::Role).err().unwrap().to_string();
        assert!([RateTruth::LAYOUT, RateCommand::LAYOUT].iter().all(|layout| error.contains(layout)), "{error}");
    }

    crate::sample! {
        /// The first version.
        Built = "test/Sample/v1" {
            /// A field.
            speed_rad_s: f64,
            /// Another field.
            current_a: f64,
        }
    }

    crate::sample! {
        /// A sample with the type name of another and two fields swapped.
        Swapped = "test/Sample/v1" {
            /// Another field.
            current_a: f64,
            /// A field.
            speed_rad_s: f64,
        }
    }

    #[test]
    fn refuses_fields_that_were_swapped_under_the_same_type_name() {
        let domain = OwnedDomain::create(0).unwrap();
        let (ours, theirs) = (bus(&domain), IoxBus::join(domain.domain(), "watcher", bus(&domain).depths).unwrap());
        let _writer = ours.writer::<Built>(&topic(), 1).unwrap();
        let refused = [
            ours.reader::<Swapped>(&topic(), Reader::Role).err().unwrap().to_string(),
            theirs.reader::<Swapped>(&topic(), Reader::Scorer).err().unwrap().to_string(),
        ];
        for error in refused {
            assert!([Built::LAYOUT, Swapped::LAYOUT].iter().all(|layout| error.contains(layout)), "{error}");
            assert!(error.contains(&topic().to_string()), "{error}");
        }
        assert!(ours.reader::<Built>(&topic(), Reader::Role).is_ok());
    }

    /// Foreign programs receive this version, which must be the linked one.
    #[test]
    fn the_version_is_the_transport_s_own() {
        let domain = OwnedDomain::create(0).unwrap();
        let _reader = bus(&domain).reader::<RateTruth>(&topic(), Reader::Role).unwrap();
        let mut versions = Vec::new();
        Ipc::list(&config(domain.domain().root(), domain.domain()).unwrap(), |service| {
            versions.push(service.static_details.iceoryx2_version().to_string());
            CallbackProgression::Continue
        })
        .unwrap();
        assert_eq!(versions, [VERSION]);
    }

    #[test]
    fn two_domains_never_meet() {
        let (first, second) = (OwnedDomain::create(0).unwrap(), OwnedDomain::create(0).unwrap());
        let mut writer = bus(&first).writer::<RateTruth>(&topic(), 1).unwrap();
        let mut reader = bus(&second).reader::<RateTruth>(&topic(), Reader::Scorer).unwrap();
        reader.advance().unwrap();
        writer.send(|sample| sample.stamp.tick = 1).unwrap();
        assert!(!reader.advance().unwrap());
    }
}
