//! How a service of the transport is made: its configuration, its size, and how a sample is seen by it.

use super::cause;
use crate::bus::domain::Domain;
use crate::bus::notifier::NOTIFIERS_BYTES;
use crate::bus::{Depths, Reader, Signal, WriterProcess};
use crate::sample::Sample;
use iceoryx2::config::Config;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use std::fmt;
use std::time::Duration;

/// The most processes in one run: roles, launcher, recorders, watchers.
pub(super) const MAX_NODES: usize = 128;
/// The most readers of the launcher's schedule: every role.
const MAX_SCHEDULE_READERS: usize = 128;
/// The most readers of any other signal: roles, scorer, recorder, watchers.
pub(super) const MAX_READERS: usize = 8;
/// The most readers of a fleet's signals, of which every sample is large: role, scorer, recorder, a watcher.
const MAX_FLEET_READERS: usize = 4;
/// Samples that a reader holds at once: the one at hand, and the next while they are exchanged.
const MAX_BORROWED: usize = 2;
/// How long the transport waits for what somebody else has begun to make: longer than any machine keeps a maker from going
/// on, because a connection that was given up is not tried again. The wait for a maker that is dead is ended by the janitor.
const CREATION_TIMEOUT: Duration = Duration::from_secs(10);
/// Connections to dead writers that a reader keeps until it has read what they sent. A signal has one writer at a time, and a reader
/// looks at every one of these places each time it finds no new sample.
const EXPIRED_CONNECTIONS: usize = 8;
/// The transport's version, which every process of a run must have: the layout in shared memory changes between them.
pub const VERSION: &str = "0.10.0";
/// An upper bound on what the transport puts before a sample, bytes.
const HEADER_BYTES: usize = 64;
/// An upper bound on what a signal takes besides its samples: queues, lists of members, rounding to pages; bytes.
const SIGNAL_BYTES: usize = 64 << 10;

pub(in crate::bus) type Ipc = ipc::Service;

/// An upper bound on the shared memory that one signal with samples of `size` bytes takes, bytes.
pub fn footprint(qos: &Qos, size: usize) -> usize {
    let waiting = qos.subscriber_max_buffer_size + qos.subscriber_max_borrowed_samples;
    (qos.max_subscribers * waiting + qos.history_size + 2) * (HEADER_BYTES + size) + SIGNAL_BYTES
}

/// What a run takes of shared memory besides its signals, bytes.
pub const COMMON_BYTES: usize = NOTIFIERS_BYTES;

/// What the opener of a signal's service asks for. Whoever comes first makes the service, so all ask for the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Qos {
    /// One writer per signal.
    pub max_publishers: usize,
    /// The most readers.
    pub max_subscribers: usize,
    /// The most processes.
    pub max_nodes: usize,
    /// Samples for readers that come later.
    pub history_size: usize,
    /// The most samples that may wait for one reader.
    pub subscriber_max_buffer_size: usize,
    /// The most samples that one reader may hold.
    pub subscriber_max_borrowed_samples: usize,
    /// Whether the oldest waiting sample gives way to a new one.
    pub enable_safe_overflow: bool,
}

impl Qos {
    /// That of a signal on links of these depths.
    pub fn for_signal(signal: Signal, depths: Depths) -> Self {
        Self {
            max_publishers: 1,
            max_subscribers: if signal == Signal::Schedule { MAX_SCHEDULE_READERS } else { MAX_READERS },
            max_nodes: MAX_NODES,
            history_size: history(signal, depths),
            subscriber_max_buffer_size: deepest(signal, depths),
            subscriber_max_borrowed_samples: MAX_BORROWED,
            enable_safe_overflow: true,
        }
    }

    /// That of a fleet's signal.
    pub fn for_fleet(signal: Signal, depths: Depths) -> Self {
        Self { max_subscribers: MAX_FLEET_READERS, ..Self::for_signal(signal, depths) }
    }
}

/// How many samples of a signal may wait for a reader.
pub fn buffer_size(signal: Signal, reader: Reader, depths: Depths) -> usize {
    depths.for_reader(reader).min(deepest(signal, depths))
}

/// What roles say of themselves and hear from the launcher is said again and again.
fn history(signal: Signal, depths: Depths) -> usize {
    match signal {
        Signal::Health | Signal::Schedule => 0,
        Signal::Truth | Signal::Measurement | Signal::Estimate | Signal::Command => depths.history,
    }
}

/// What is scored or recorded needs room for those who look only now and then.
fn deepest(signal: Signal, depths: Depths) -> usize {
    match signal {
        Signal::Truth | Signal::Measurement | Signal::Estimate | Signal::Command => depths.scorer.max(depths.role),
        Signal::Health | Signal::Schedule => 1,
    }
}

/// A sample as iceoryx2 sees it.
#[repr(transparent)]
#[derive(Debug, Clone, Copy)]
pub(super) struct Wire<S>(pub(super) S);

// SAFETY: `S` is `Pod`: plain bytes of a fixed layout without pointers, valid in every process, and `Wire` is transparent.
#[allow(unsafe_code)]
unsafe impl<S: Sample> ZeroCopySend for Wire<S> {
    // SAFETY: unsafe by the trait's declaration only; a constant asks nothing of its caller.
    unsafe fn type_name() -> &'static str {
        S::LAYOUT
    }
}

/// Whether a service has a writer. One that was killed is one until its remains are cleared.
pub(super) fn has_writer<P: fmt::Debug + IceoryxSend + ?Sized>(service: &PortFactory<Ipc, P, ()>) -> bool {
    service.dynamic_config().number_of_publishers() > 0
}

/// The process that has a service's writing end open, dead or alive.
pub(super) fn writer<P: fmt::Debug + IceoryxSend + ?Sized>(service: &PortFactory<Ipc, P, ()>) -> Option<WriterProcess> {
    let mut found = None;
    service.dynamic_config().list_publishers(|details| {
        let node = details.node_id;
        found = node.pid::<Ipc>().ok().map(|pid| WriterProcess { pid: pid.value() as u32, unique: node.value() });
        CallbackProgression::Continue
    });
    found
}

/// The transport's configuration by which a process enters a domain, whose directory is at `root`.
pub(super) fn config(root: &std::path::Path, domain: &Domain) -> Result<Config, String> {
    let mut config = Config::default();
    let root = root.to_string_lossy();
    let root = Path::new(root.as_bytes()).map_err(|error| format!("{error:?}"))?;
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(domain.prefix().as_bytes()).map_err(|error| format!("{error:?}"))?;
    // The janitor alone puts away what the dead left: it may have to wait for somebody who stands still.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    config.global.creation_timeout = CREATION_TIMEOUT;
    config.defaults.publish_subscribe.subscriber_expired_connection_buffer = EXPIRED_CONNECTIONS;
    Ok(config)
}

pub(in crate::bus) fn enter(root: &std::path::Path, domain: &Domain, name: &str) -> Result<Node<Ipc>, String> {
    let config = config(root, domain)?;
    cause::reset();
    NodeBuilder::new()
        .name(&name.try_into().map_err(|error| format!("{error:?}"))?)
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Ipc>()
        .map_err(|error| cause::reason(|| format!("{error:?}; check that /dev/shm and this directory are writable")))
}
