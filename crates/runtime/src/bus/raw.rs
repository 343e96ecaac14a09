//! Bare iceoryx2 as in its documentation: the reference that the bus is measured against. Not part of the product.
//!
//! Like `iox.rs` it may know iceoryx2. Must be neither better nor worse than plain use of the library.

use super::domain::Domain;
use super::error::BusError;
use super::iox::Ipc;
use super::iox::enter;
use crate::files::Directory;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use std::fmt::Debug;
use std::rc::Rc;
use std::time::Duration;

/// A bare node, and the domain's directory, which keeps paths short enough for the sockets of bare events. It stays
/// open until the last socket is removed.
pub struct RawNode(Node<Ipc>, Rc<Directory>);

/// A bare publisher of samples of `WORDS` words.
pub struct RawPublisher<const WORDS: usize>(Publisher<Ipc, [u64; WORDS], ()>);
/// A bare subscriber to the newest sample.
pub struct RawSubscriber<const WORDS: usize>(Subscriber<Ipc, [u64; WORDS], ()>);
/// The notifying end of a bare event.
pub struct RawNotifier(Notifier<Ipc>, #[expect(dead_code, reason = "held open")] Rc<Directory>);
/// The waiting end of a bare event.
pub struct RawListener(Listener<Ipc>, #[expect(dead_code, reason = "held open")] Rc<Directory>);

/// Wraps an error of a service builder.
fn refused(service: &str, end: &'static str, reason: impl Debug) -> BusError {
    BusError::Open { service: service.to_owned(), end, reason: format!("{reason:?}") }
}

fn send_failed(reason: impl Debug) -> BusError {
    BusError::Send { service: "a bare service".to_owned(), reason: format!("{reason:?}") }
}

fn receive_failed(reason: impl Debug) -> BusError {
    BusError::Receive { service: "a bare service".to_owned(), reason: format!("{reason:?}") }
}

type PublishSubscribe<const WORDS: usize> =
    iceoryx2::service::port_factory::publish_subscribe::PortFactory<Ipc, [u64; WORDS], ()>;
type Event = iceoryx2::service::port_factory::event::PortFactory<Ipc>;

impl RawNode {
    /// Enters a domain.
    pub fn enter(domain: &Domain, name: &str) -> Result<Self, BusError> {
        set_log_level(LogLevel::Fatal);
        let failed = |reason| BusError::Domain { domain: domain.root().display().to_string(), reason };
        let root = Directory::open(domain.root()).map_err(|error| failed(error.to_string()))?;
        let node = enter(&root.path(), domain, name).map_err(failed)?;
        Ok(Self(node, Rc::new(root)))
    }

    /// Opens a service with one publisher and queues for the newest sample only.
    fn publish_subscribe<const WORDS: usize>(
        &self,
        name: &str,
        end: &'static str,
    ) -> Result<PublishSubscribe<WORDS>, BusError> {
        self.0
            .service_builder(&name.try_into().map_err(|error| refused(name, end, error))?)
            .publish_subscribe::<[u64; WORDS]>()
            .max_publishers(1)
            .subscriber_max_buffer_size(1)
            .enable_safe_overflow(true)
            .open_or_create()
            .map_err(|error| refused(name, end, error))
    }

    /// Opens the writing end of publish-subscribe.
    pub fn publisher<const WORDS: usize>(&self, name: &str) -> Result<RawPublisher<WORDS>, BusError> {
        let service = self.publish_subscribe(name, "publisher")?;
        let publisher = service.publisher_builder().create();
        publisher.map(RawPublisher).map_err(|error| refused(name, "publisher", error))
    }

    /// Opens the reading end of publish-subscribe.
    pub fn subscriber<const WORDS: usize>(&self, name: &str) -> Result<RawSubscriber<WORDS>, BusError> {
        let service = self.publish_subscribe(name, "subscriber")?;
        let subscriber = service.subscriber_builder().buffer_size(1).create();
        subscriber.map(RawSubscriber).map_err(|error| refused(name, "subscriber", error))
    }

    fn event(&self, name: &str, end: &'static str) -> Result<Event, BusError> {
        let name_of = name.try_into().map_err(|error| refused(name, end, error))?;
        self.0.service_builder(&name_of).event().open_or_create().map_err(|error| refused(name, end, error))
    }

    /// Opens the notifying end of an event.
    pub fn notifier(&self, name: &str) -> Result<RawNotifier, BusError> {
        let notifier = self.event(name, "notifier")?.notifier_builder().create();
        notifier.map(|end| RawNotifier(end, self.1.clone())).map_err(|error| refused(name, "notifier", error))
    }

    /// Opens the waiting end of an event.
    pub fn listener(&self, name: &str) -> Result<RawListener, BusError> {
        let listener = self.event(name, "listener")?.listener_builder().create();
        listener.map(|end| RawListener(end, self.1.clone())).map_err(|error| refused(name, "listener", error))
    }
}

impl<const WORDS: usize> RawPublisher<WORDS> {
    /// Loans a sample, writes it in place and sends it.
    #[inline]
    pub fn send(&mut self, words: &[u64]) -> Result<(), BusError> {
        let mut content = [0; WORDS];
        content.copy_from_slice(&words[..WORDS]);
        let sample = self.0.loan_uninit().map_err(send_failed)?.write_payload(content);
        sample.send().map(|_| ()).map_err(send_failed)
    }
}

impl<const WORDS: usize> RawSubscriber<WORDS> {
    /// Reads the newest sample in place; `None` if no sample waits.
    #[inline]
    pub fn receive<T>(&mut self, read: impl FnOnce(&[u64]) -> T) -> Result<Option<T>, BusError> {
        let sample = self.0.receive().map_err(receive_failed)?;
        Ok(sample.map(|sample| read(sample.payload())))
    }
}

impl RawNotifier {
    /// Notifies the listener.
    #[inline]
    pub fn notify(&self) -> Result<(), BusError> {
        self.0.notify().map(|_| ()).map_err(send_failed)
    }
}

impl RawListener {
    /// Waits for the next notification, at most for this time.
    #[inline]
    pub fn wait(&self, at_most: Duration) -> Result<(), BusError> {
        self.0.timed_wait(|_| (), at_most).map(|_| ()).map_err(receive_failed)
    }
}
