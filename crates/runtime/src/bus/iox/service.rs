//! Properties of the transport's services: configuration, size, quality of service, sample types.

use super::cause;
use crate::bus::domain::Domain;
use crate::bus::link::{Depths, Reader, WriterProcess};
use crate::bus::names::Signal;
use crate::bus::notifier::NOTIFIERS_BYTES;
use crate::changes::{CHANGES_MAX, SCRIPTED_MAX};
use crate::sample::Sample;
use iceoryx2::config::Config;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use std::fmt;
use std::time::Duration;

/// Upper bound on the processes of a run: roles, launcher, recorders, watchers.
pub(super) const MAX_NODES: usize = 128;
/// Upper bound on the readers of the schedule: every role.
const MAX_SCHEDULE_READERS: usize = 128;
/// Upper bound on the readers of any other signal: roles, scorer, recorder, watchers.
pub(super) const MAX_READERS: usize = 8;
/// Upper bound on the readers of a fleet's signal, whose samples are large: role, scorer, recorder, one watcher.
const MAX_FLEET_READERS: usize = 4;
/// Upper bound on the readers of the changes of inputs: foreign programs. All changes of a run wait for a new one.
const MAX_INPUT_READERS: usize = 4;
/// Samples that a reader holds at once: the current one, and the next during the exchange.
const MAX_BORROWED: usize = 2;
/// Time limit of the transport for a file that another process creates. Longer than any maker is delayed, because the
/// transport never retries a connection. The janitor ends the wait for a dead maker.
const CREATION_TIMEOUT: Duration = Duration::from_secs(10);
/// Connections to ended writers that a reader keeps until it has read their samples; the transport discards the samples of
/// further ones. More than a role's default restarts. A reader checks all these places whenever it finds no new sample.
const EXPIRED_CONNECTIONS: usize = 8;
/// The transport's version, which every process of a run must use, because the layout in shared memory depends on it.
pub const VERSION: &str = "0.10.0";
/// Upper bound on the header of a sample, bytes.
const HEADER_BYTES: usize = 64;
/// Upper bound on a signal's memory besides samples: queues, member lists, rounding to pages, bytes.
const SIGNAL_BYTES: usize = 64 << 10;

pub(in crate::bus) type Ipc = ipc::Service;

/// Returns an upper bound on the shared memory of one signal with samples of `size` bytes, bytes.
pub fn footprint(qos: &Qos, size: usize) -> usize {
    let waiting = qos.subscriber_max_buffer_size + qos.subscriber_max_borrowed_samples;
    (qos.max_subscribers * waiting + qos.history_size + 2) * (HEADER_BYTES + size) + SIGNAL_BYTES
}

/// Shared memory of a run besides its signals, bytes.
pub const COMMON_BYTES: usize = NOTIFIERS_BYTES;

/// Quality of service of a signal. The first opener creates the service, so all openers request the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Qos {
    /// Writers: one.
    pub max_publishers: usize,
    /// Upper bound on the readers.
    pub max_subscribers: usize,
    /// Upper bound on the processes.
    pub max_nodes: usize,
    /// Number of past samples for new readers.
    pub history_size: usize,
    /// Upper bound on the samples that wait for one reader.
    pub subscriber_max_buffer_size: usize,
    /// Upper bound on the samples that one reader holds.
    pub subscriber_max_borrowed_samples: usize,
    /// True if a new sample replaces the oldest waiting one.
    pub enable_safe_overflow: bool,
}

impl Qos {
    /// Returns the quality of service of a signal on links of these depths.
    pub fn for_signal(signal: Signal, depths: Depths) -> Self {
        Self {
            max_publishers: 1,
            max_subscribers: match signal {
                Signal::Schedule => MAX_SCHEDULE_READERS,
                Signal::Input => MAX_INPUT_READERS,
                _ => MAX_READERS,
            },
            max_nodes: MAX_NODES,
            history_size: history(signal, depths),
            subscriber_max_buffer_size: deepest(signal, depths),
            subscriber_max_borrowed_samples: MAX_BORROWED,
            enable_safe_overflow: true,
        }
    }

    /// Returns the quality of service of a fleet's signal.
    pub fn for_fleet(signal: Signal, depths: Depths) -> Self {
        Self { max_subscribers: MAX_FLEET_READERS, ..Self::for_signal(signal, depths) }
    }
}

/// Returns the queue depth of a reader of a signal.
pub fn buffer_size(signal: Signal, reader: Reader, depths: Depths) -> usize {
    match signal {
        Signal::Input => deepest(signal, depths),
        _ => depths.for_reader(reader).min(deepest(signal, depths)),
    }
}

/// Returns the number of past samples for new readers. Health and schedule need none: they are published repeatedly.
fn history(signal: Signal, depths: Depths) -> usize {
    match signal {
        Signal::Health | Signal::Schedule => 0,
        Signal::Input => CHANGES_MAX + SCRIPTED_MAX,
        Signal::Truth | Signal::Measurement | Signal::Estimate | Signal::Command => depths.history,
    }
}

/// Returns the depth of the deepest queue. Scored and recorded signals are read rarely.
fn deepest(signal: Signal, depths: Depths) -> usize {
    match signal {
        Signal::Truth | Signal::Measurement | Signal::Estimate | Signal::Command => depths.scorer.max(depths.role),
        Signal::Health | Signal::Schedule => 1,
        Signal::Input => history(signal, depths),
    }
}

/// A sample for iceoryx2.
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

/// Returns true if a service has a writer. A killed writer counts until its remains are removed.
pub(super) fn has_writer<P: fmt::Debug + IceoryxSend + ?Sized>(service: &PortFactory<Ipc, P, ()>) -> bool {
    service.dynamic_config().number_of_publishers() > 0
}

/// Returns the process of a service's writer, dead or alive.
pub(super) fn writer<P: fmt::Debug + IceoryxSend + ?Sized>(service: &PortFactory<Ipc, P, ()>) -> Option<WriterProcess> {
    let mut found = None;
    service.dynamic_config().list_publishers(|details| {
        let node = details.node_id;
        found = node.pid::<Ipc>().ok().map(|pid| WriterProcess { pid: pid.value() as u32, unique: node.value() });
        CallbackProgression::Continue
    });
    found
}

/// Returns the configuration for a domain whose directory is at `root`.
pub(super) fn config(root: &std::path::Path, domain: &Domain) -> Result<Config, String> {
    let mut config = Config::default();
    let root = root.to_string_lossy();
    let root = Path::new(root.as_bytes()).map_err(|error| format!("{error:?}"))?;
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(domain.prefix().as_bytes()).map_err(|error| format!("{error:?}"))?;
    // Only the janitor cleans up after dead processes, because it may have to wait for a stopped process.
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
