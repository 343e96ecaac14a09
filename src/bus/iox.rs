//! The bus over shared memory, and the only file that knows iceoryx2.
//!
//! Publish-subscribe with overflow: a slow or dead reader never holds a writer up. What a reader must not lose is bounded
//! by the loop itself (lockstep), not by a writer that waits.

mod cause;
mod fleet;
mod latest;

pub use fleet::{IoxFleetReader, IoxFleetWriter};

use self::latest::{LatestReader, LatestWriter};
use super::bell::{BELLS_BYTES, Bell, Bells};
use super::domain::Domain;
use super::{Bus, BusError, Depths, Read, Reader, Signal, Topic, Write};
use crate::clock::{monotonic_ns, sleep_until};
use crate::sample::{FleetLayout, Sample, VOID};
use crate::system::remedy;
use iceoryx2::config::Config;
use iceoryx2::node::NodeState;
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample as Received;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::builder::blackboard::BlackboardCreateError;
use iceoryx2::service::builder::publish_subscribe::{
    Builder, PublishSubscribeCreateError, PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use std::fmt;
use std::io;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// The most processes in one run: roles, launcher, recorders, watchers.
const MAX_NODES: usize = 128;
/// The most readers of the launcher's schedule: every role.
const MAX_SCHEDULE_READERS: usize = 128;
/// The most readers of any other signal: roles, scorer, recorder, watchers.
const MAX_READERS: usize = 8;
/// The most readers of a fleet's signals, of which every sample is large: role, scorer, recorder, a watcher.
const MAX_FLEET_READERS: usize = 4;
/// Samples that a reader holds at once: the one at hand, and the next while they are exchanged.
const MAX_BORROWED: usize = 2;

/// How long the transport waits for what somebody else has begun to make: longer than any machine keeps a maker from going
/// on, because a connection that was given up is not tried again. The wait for a maker that is dead is ended by the janitor.
const CREATION_TIMEOUT: Duration = Duration::from_secs(10);
/// For so long an opening tries again where no other limit is given, ns.
const OPENING_NS: u64 = 10_000_000_000;
/// A dead process holds its place until the janitor has put away what it left: for so long a successor asks again, ns.
const VACATE_NS: u64 = 2_000_000_000;
/// Between two attempts at an opening, ns.
const RETRY_NS: u64 = 20_000_000;

/// The transport's version, which every process of a run must have: the layout in shared memory changes between them.
pub const VERSION: &str = "0.10.0";

/// An upper bound on what the transport puts before a sample, bytes.
const HEADER_BYTES: usize = 64;
/// An upper bound on what a signal takes besides its samples: queues, lists of members, rounding to pages; bytes.
const SIGNAL_BYTES: usize = 64 << 10;

pub(super) type Ipc = ipc::Service;

/// An upper bound on the shared memory that one signal with samples of `size` bytes takes, bytes.
pub fn footprint(qos: &Qos, size: usize) -> usize {
    let waiting = qos.subscriber_max_buffer_size + qos.subscriber_max_borrowed_samples;
    (qos.max_subscribers * waiting + qos.history_size + 2) * (HEADER_BYTES + size) + SIGNAL_BYTES
}

/// What a run takes of shared memory besides its signals, bytes.
pub const COMMON_BYTES: usize = BELLS_BYTES;

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
    pub fn of(signal: Signal, depths: Depths) -> Self {
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
    pub fn of_fleet(signal: Signal, depths: Depths) -> Self {
        Self { max_subscribers: MAX_FLEET_READERS, ..Self::of(signal, depths) }
    }
}

/// How many samples of a signal may wait for a reader.
pub fn buffer_size(signal: Signal, reader: Reader, depths: Depths) -> usize {
    depths.of(reader).min(deepest(signal, depths))
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
    node: Rc<Node<Ipc>>,
    bells: Bells,
    depths: Depths,
    /// Whether a signal that nobody has opened yet is made.
    makes: bool,
    domain: Domain,
    /// For how long an opening tries again, ns.
    opening_ns: u64,
}

impl IoxBus {
    /// Enters a domain as `name`.
    ///
    /// # Errors
    /// [`BusError::Domain`].
    pub fn enter(domain: &Domain, name: &str, depths: Depths) -> Result<Self, BusError> {
        Self::over(domain, name, depths, Bells::open(domain), true)
    }

    /// The same for one who only looks: of the signals nothing is made, and one that nobody has opened is an error.
    ///
    /// # Errors
    /// [`BusError::Domain`].
    pub fn join(domain: &Domain, name: &str, depths: Depths) -> Result<Self, BusError> {
        Self::over(domain, name, depths, Bells::join(domain), false)
    }

    fn over(
        domain: &Domain,
        name: &str,
        depths: Depths,
        bells: io::Result<Bells>,
        makes: bool,
    ) -> Result<Self, BusError> {
        cause::hear();
        let failed = |reason| BusError::Domain { domain: domain.root().display().to_string(), reason };
        let bells = bells.map_err(|error| failed(format!("{error}; {}", remedy(&error))))?;
        let node = Rc::new(enter(domain, name).map_err(failed)?);
        Ok(Self { node, bells, depths, makes, domain: domain.clone(), opening_ns: OPENING_NS })
    }

    /// The same, with another limit on how long an opening may take.
    pub fn within(self, limit: Duration) -> Self {
        Self { opening_ns: limit.as_nanos() as u64, ..self }
    }

    /// Whether a signal has a fast lane: where only the newest sample counts.
    fn has_lane(&self, topic: &Topic) -> bool {
        let for_roles = matches!(topic.signal, Signal::Measurement | Signal::Estimate | Signal::Command);
        for_roles && self.depths.role == 1
    }

    fn service<S: Sample>(&self, topic: &Topic, end: &'static str) -> Result<PortFactory<Ipc, Wire<S>, ()>, BusError> {
        self.open(topic, end, || {
            let builder = self.builder::<Wire<S>>(topic, &Qos::of(topic.signal, self.depths))?;
            Ok(if self.makes { builder.open_or_create()? } else { builder.open()? })
        })
    }

    fn fleet_service<L: FleetLayout>(
        &self,
        topic: &Topic,
        end: &'static str,
    ) -> Result<PortFactory<Ipc, [fleet::Word<L>], ()>, BusError> {
        self.open(topic, end, || {
            let builder = self.builder::<[fleet::Word<L>]>(topic, &Qos::of_fleet(topic.signal, self.depths))?;
            Ok(if self.makes { builder.open_or_create()? } else { builder.open()? })
        })
    }

    /// Opens something, again and again while what is in the way may pass. A signal to this process only breaks off an
    /// attempt: what it asks for is done in order, by whoever looks for it.
    fn open<T>(
        &self,
        topic: &Topic,
        end: &'static str,
        mut attempt: impl FnMut() -> Result<T, Refusal>,
    ) -> Result<T, BusError> {
        let begun_ns = monotonic_ns();
        loop {
            cause::forget();
            let refusal = match attempt() {
                Ok(opened) => return Ok(opened),
                Err(refusal) => refusal,
            };
            let limit_ns = match refusal.passes {
                Passes::Never => 0,
                Passes::WhenFinished => self.opening_ns,
                Passes::WhenVacated => VACATE_NS.min(self.opening_ns),
            };
            if monotonic_ns() - begun_ns >= limit_ns {
                return Err(self.failed_to_open(topic, end, refusal));
            }
            sleep_until(monotonic_ns() + RETRY_NS);
        }
    }

    fn failed_to_open(&self, topic: &Topic, end: &'static str, refusal: Refusal) -> BusError {
        let Refusal { mut reason, passes } = refusal;
        if passes == Passes::WhenFinished {
            let limit_s = self.opening_ns as f64 / 1e9;
            let unfinished =
                self.domain.unfinished().iter().map(|path| format!(" {}", path.display())).collect::<String>();
            let files = if unfinished.is_empty() { String::new() } else { format!("; unfinished:{unfinished}") };
            reason = format!("{reason} for {limit_s} s: whoever makes it stands still{files}");
        } else {
            let remedy = format!("is another process of this run its {end}, or of another version?");
            reason = cause::reason(|| format!("{reason}; {remedy}"));
        }
        BusError::Open { service: topic.to_string(), end, reason }
    }

    fn builder<P: IceoryxSend + fmt::Debug + ?Sized>(
        &self,
        topic: &Topic,
        qos: &Qos,
    ) -> Result<Builder<P, (), Ipc>, Refusal> {
        let name: ServiceName = topic.to_string().as_str().try_into().map_err(Refusal::never)?;
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

/// Puts away what processes of a domain left behind when they died, so that others can take their places. For the janitor
/// alone: it may take long, or for ever where somebody stands still.
pub fn clear_dead(domain: &Domain) -> Result<(), BusError> {
    set_log_level(LogLevel::Fatal);
    let failed = |reason| BusError::Domain { domain: domain.root().display().to_string(), reason };
    let clear = |node: NodeState<Ipc>| {
        if let NodeState::Dead(dead) = node {
            // What cannot be put away now is so the next time.
            let _ = dead.try_remove_stale_resources();
        }
        CallbackProgression::Continue
    };
    Node::<Ipc>::list(&config(domain).map_err(failed)?, clear).map_err(|error| failed(format!("{error:?}")))
}

/// Whether what keeps something from being opened may pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Passes {
    Never,
    /// Once somebody else has finished what he makes, or this process the handling of a signal.
    WhenFinished,
    /// Once the remains of a dead process are put away.
    WhenVacated,
}

/// Why something could not be opened.
#[derive(Debug)]
struct Refusal {
    reason: String,
    passes: Passes,
}

impl Refusal {
    fn new(error: impl fmt::Debug, passes: Passes) -> Self {
        Self { reason: format!("{error:?}"), passes }
    }

    fn never(error: impl fmt::Debug) -> Self {
        Self::new(error, Passes::Never)
    }
}

impl From<PublishSubscribeOpenError> for Refusal {
    fn from(error: PublishSubscribeOpenError) -> Self {
        use PublishSubscribeOpenError as Error;
        Self::new(
            error,
            match error {
                Error::Interrupt | Error::HangsInCreation | Error::IsMarkedForDestruction => Passes::WhenFinished,
                Error::ExceedsMaxNumberOfNodes => Passes::WhenVacated,
                _ => Passes::Never,
            },
        )
    }
}

impl From<PublishSubscribeOpenOrCreateError> for Refusal {
    fn from(error: PublishSubscribeOpenOrCreateError) -> Self {
        use PublishSubscribeCreateError as Create;
        use PublishSubscribeOpenOrCreateError as Error;
        match error {
            Error::PublishSubscribeOpenError(error) => error.into(),
            Error::PublishSubscribeCreateError(
                Create::Interrupt
                | Create::AlreadyExists
                | Create::HangsInCreation
                | Create::IsBeingCreatedByAnotherInstance,
            )
            | Error::SystemInFlux => Self::new(error, Passes::WhenFinished),
            Error::PublishSubscribeCreateError(_) => Self::never(error),
        }
    }
}

impl From<BlackboardCreateError> for Refusal {
    fn from(error: BlackboardCreateError) -> Self {
        use BlackboardCreateError as Error;
        let begun = matches!(error, Error::Interrupt | Error::HangsInCreation | Error::IsBeingCreatedByAnotherInstance);
        Self::new(error, if begun { Passes::WhenFinished } else { Passes::Never })
    }
}

impl From<PublisherCreateError> for Refusal {
    fn from(error: PublisherCreateError) -> Self {
        let taken = error == PublisherCreateError::ExceedsMaxSupportedPublishers;
        Self::new(error, if taken { Passes::WhenVacated } else { Passes::Never })
    }
}

impl From<SubscriberCreateError> for Refusal {
    fn from(error: SubscriberCreateError) -> Self {
        let taken = error == SubscriberCreateError::ExceedsMaxSupportedSubscribers;
        Self::new(error, if taken { Passes::WhenVacated } else { Passes::Never })
    }
}

/// Whether an end that is being opened could be connected to every other end there is. The transport itself only logs it,
/// and never tries again.
#[derive(Clone, Default)]
struct Connections {
    failed: Arc<AtomicBool>,
}

impl Connections {
    /// What the transport is to call if it cannot connect.
    fn watch(&self) -> impl Fn(DegradationCause, &DegradationInfo) -> DegradationAction + Send + 'static {
        let failed = self.failed.clone();
        move |_, _| {
            failed.store(true, Ordering::Relaxed);
            DegradationAction::Warn
        }
    }

    /// The end, if it is connected.
    fn whole<T>(&self, end: T) -> Result<T, Refusal> {
        if self.failed.load(Ordering::Relaxed) {
            return Err(Refusal {
                reason: "not connected to every process that has it open (is /dev/shm full?)".to_owned(),
                passes: Passes::Never,
            });
        }
        Ok(end)
    }
}

/// Whether a service has a writer. One that was killed is one until its remains are cleared.
fn is_written<P: fmt::Debug + IceoryxSend + ?Sized>(service: &PortFactory<Ipc, P, ()>) -> bool {
    service.dynamic_config().number_of_publishers() > 0
}

/// The transport's configuration by which a process enters a domain.
fn config(domain: &Domain) -> Result<Config, String> {
    let mut config = Config::default();
    let root = domain.root().to_string_lossy();
    let root = Path::new(root.as_bytes()).map_err(|error| format!("{error:?}"))?;
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(domain.prefix().as_bytes()).map_err(|error| format!("{error:?}"))?;
    // The janitor alone puts away what the dead left: it may have to wait for somebody who stands still.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    config.global.creation_timeout = CREATION_TIMEOUT;
    Ok(config)
}

pub(super) fn enter(domain: &Domain, name: &str) -> Result<Node<Ipc>, String> {
    let config = config(domain)?;
    cause::forget();
    NodeBuilder::new()
        .name(&name.try_into().map_err(|error| format!("{error:?}"))?)
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Ipc>()
        .map_err(|error| cause::reason(|| format!("{error:?}; check that /dev/shm and this directory are writable")))
}

impl Bus for IoxBus {
    const REPEATS: bool = true;
    type Writer<S: Sample> = IoxWriter<S>;
    type Reader<S: Sample> = IoxReader<S>;
    type FleetWriter<L: FleetLayout> = IoxFleetWriter<L>;
    type FleetReader<L: FleetLayout> = IoxFleetReader<L>;

    fn writer<S: Sample>(&self, topic: &Topic, generation: u64) -> Result<IoxWriter<S>, BusError> {
        let lane = || self.open(topic, "writer", || LatestWriter::create(&self.node, topic, generation));
        let latest = self.has_lane(topic).then(lane).transpose()?;
        let service = self.service::<S>(topic, "writer")?;
        let publisher = self.open(topic, "writer", || {
            let connections = Connections::default();
            let builder = service.publisher_builder().max_loaned_samples(1);
            let builder = builder.backpressure_strategy(BackpressureStrategy::DiscardData);
            connections.whole(builder.set_degradation_handler(connections.watch()).create()?)
        })?;
        Ok(IoxWriter { publisher, latest, loan: None, shown: None, bell: self.bells.of(topic), topic: topic.clone() })
    }

    fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<IoxReader<S>, BusError> {
        let depth = buffer_size(topic.signal, reader, self.depths);
        let service = self.service::<S>(topic, "reader")?;
        let subscriber = self.open(topic, "reader", || {
            let connections = Connections::default();
            let builder = service.subscriber_builder().buffer_size(depth);
            connections.whole(builder.set_degradation_handler(connections.watch()).create()?)
        })?;
        // Who reads every sample has no use for the latest.
        let lane = match reader {
            Reader::Role if self.has_lane(topic) => Lane::Wanted { generation: 1 },
            _ => Lane::None,
        };
        let (node, bell, topic) = (self.node.clone(), self.bells.of(topic), topic.clone());
        let (current, pending, newest) = (Current::None, None, (0, 0));
        Ok(IoxReader { node, service, subscriber, current, pending, newest, lane, idle: 0, bell, topic })
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

/// The writing end.
pub struct IoxWriter<S: Sample> {
    publisher: Publisher<Ipc, Wire<S>, ()>,
    latest: Option<LatestWriter<S>>,
    loan: Option<SampleMut<Ipc, Wire<S>, ()>>,
    /// What was shown in the lane and is not sent.
    shown: Option<SampleMut<Ipc, Wire<S>, ()>>,
    bell: Bell,
    topic: Topic,
}

impl<S: Sample> IoxWriter<S> {
    /// The sample that was filled, and is in the lane if there is one.
    #[inline]
    fn filled(&mut self) -> Option<SampleMut<Ipc, Wire<S>, ()>> {
        let sample = self.loan.take()?;
        if let Some(latest) = &self.latest {
            latest.put(&sample.payload().0);
            // Whoever looks at the lane need not sleep until the queues are served.
            self.bell.ring();
        }
        Some(sample)
    }

    #[inline]
    fn queue(&self, sample: SampleMut<Ipc, Wire<S>, ()>) -> Result<(), BusError> {
        sample.send().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))?;
        self.bell.ring();
        Ok(())
    }

    fn loan(&self) -> Result<SampleMut<Ipc, Wire<S>, ()>, BusError> {
        let chunk =
            self.publisher.loan_uninit().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))?;
        Ok(chunk.write_payload(Wire(S::zeroed())))
    }

    #[cold]
    fn failed(&self, reason: String) -> BusError {
        BusError::Send { service: self.topic.to_string(), reason }
    }
}

impl<S: Sample> Write<S> for IoxWriter<S> {
    #[inline]
    fn fill(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        let mut sample = match self.loan.take() {
            Some(sample) => sample,
            None => self.loan()?,
        };
        fill(&mut sample.payload_mut().0);
        self.loan = Some(sample);
        Ok(())
    }

    #[inline]
    fn deliver(&mut self) -> Result<(), BusError> {
        let sample = self.filled();
        sample.map_or(Ok(()), |sample| self.queue(sample))
    }

    #[inline]
    fn show(&mut self) -> Result<(), BusError> {
        self.publish()?;
        self.shown = self.filled();
        if self.latest.is_none() { self.publish() } else { Ok(()) }
    }

    #[inline]
    fn publish(&mut self) -> Result<(), BusError> {
        self.shown.take().map_or(Ok(()), |sample| self.queue(sample))
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
        self.publisher.update_connections().map_err(|error| self.failed(cause::reason(|| format!("{error:?}"))))
    }
}

/// Looks at the fast lane between two at the queue, where nothing new is as a rule.
const LOOKS: u32 = 256;

/// The reading end.
pub struct IoxReader<S: Sample> {
    node: Rc<Node<Ipc>>,
    service: PortFactory<Ipc, Wire<S>, ()>,
    subscriber: Subscriber<Ipc, Wire<S>, ()>,
    lane: Lane<S>,
    /// Looks at the lane that found nothing.
    idle: u32,
    current: Current<S>,
    /// Taken from the queue before a sleep, and not told of yet.
    pending: Option<Received<Ipc, Wire<S>, ()>>,
    /// Generation and tick of the last sample told of.
    newest: (u64, u64),
    bell: Bell,
    topic: Topic,
}

/// A reader's fast lane.
#[allow(clippy::large_enum_variant, reason = "there is one per reader, and it is looked at at every tick")]
enum Lane<S: Sample> {
    /// There is none.
    None,
    /// It is to be looked for: that of a writer of this generation.
    Wanted { generation: u64 },
    /// It is there.
    Open(LatestReader<S>),
}

/// What tells the samples of a signal apart, and orders them: generation and tick.
#[inline]
fn key(sample: &impl Sample) -> (u64, u64) {
    let stamp = sample.stamp();
    (stamp.generation & !VOID, stamp.tick)
}

/// Where the sample at hand is.
enum Current<S: Sample> {
    None,
    InLane,
    Queued(Received<Ipc, Wire<S>, ()>),
}

impl<S: Sample> IoxReader<S> {
    /// Whether somebody has the writing end open. One that was killed has until its remains are cleared.
    pub fn written(&self) -> bool {
        is_written(&self.service)
    }

    #[cold]
    fn failed(&self, reason: String) -> BusError {
        BusError::Receive { service: self.topic.to_string(), reason }
    }

    /// Takes the next sample from the queue, unless the lane has had it.
    fn receive(&mut self) -> Result<bool, BusError> {
        let received = match self.pending.take() {
            Some(sample) => sample,
            None => match self.subscriber.receive() {
                Ok(Some(sample)) => sample,
                Ok(None) => return Ok(false),
                Err(error) => return Err(self.failed(cause::reason(|| format!("{error:?}")))),
            },
        };
        let key = key(&received.payload().0);
        let (generation, _) = key;
        match &mut self.lane {
            Lane::Open(latest) if key <= self::key(latest.sample()) => return Ok(false),
            Lane::Open(latest) if generation > latest.generation() => self.lane = Lane::Wanted { generation },
            // Warm-up tells nothing of its writer.
            Lane::Wanted { generation: wanted } if generation > 0 => *wanted = generation,
            _ => {}
        }
        self.newest = key;
        self.current = Current::Queued(received);
        Ok(true)
    }
}

impl<S: Sample> Read<S> for IoxReader<S> {
    #[inline]
    fn advance(&mut self) -> Result<bool, BusError> {
        if let Lane::Open(latest) = &mut self.lane {
            if latest.advance() {
                let before = std::mem::replace(&mut self.newest, key(latest.sample()));
                self.current = Current::InLane;
                // The queue may have been faster, and the lane may take one sample for two.
                return Ok(self.newest != before);
            }
            self.idle = self.idle.wrapping_add(1);
            if !self.idle.is_multiple_of(LOOKS) {
                return Ok(false);
            }
        }
        self.receive()
    }

    #[inline]
    fn current(&self) -> Option<&S> {
        match (&self.current, &self.lane) {
            (Current::Queued(sample), _) => Some(&sample.payload().0),
            (Current::InLane, Lane::Open(latest)) => Some(latest.sample()),
            _ => None,
        }
    }

    fn sleep(&mut self, until_ns: u64) -> Result<(), BusError> {
        let Self { subscriber, lane, idle, pending, bell, topic, .. } = self;
        let failed = |reason| BusError::Receive { service: topic.to_string(), reason };
        let Lane::Open(latest) = lane else {
            return bell.sleep(until_ns, || {
                subscriber.has_samples().map_err(|error| failed(cause::reason(|| format!("{error:?}"))))
            });
        };
        bell.sleep(until_ns, || {
            // What the lane has had waits in the queue too. It is no news, and is taken out, or no sleep would last.
            while !latest.has_news() && pending.is_none() {
                match subscriber.receive() {
                    Ok(Some(sample)) => {
                        *pending = Some(sample).filter(|sample| key(&sample.payload().0) > key(latest.sample()))
                    }
                    Ok(None) => return Ok(false),
                    Err(error) => return Err(failed(cause::reason(|| format!("{error:?}")))),
                }
            }
            // The next look goes to the queue, if nothing is in the lane.
            *idle = u32::MAX;
            Ok(true)
        })
    }

    fn refresh(&mut self) {
        // Or the first look at the queue, once the lane is open, would connect to its writer in the midst of the loop. What
        // is wrong with it is told by that look.
        let _ = self.subscriber.update_connections();
        if let Lane::Wanted { generation } = self.lane {
            match LatestReader::open(&self.node, &self.topic, generation) {
                Some(latest) => self.lane = Lane::Open(latest),
                // Where there is none there will be none: a lane is made before its signal. But before the first sample it
                // is not known whose to look for.
                None if self.newest != (0, 0) => self.lane = Lane::None,
                None => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::domain::OwnedDomain;
    use super::*;
    use crate::clock::monotonic_ns;
    use crate::sample::{RateCommand, RateTruth};

    fn topic() -> Topic {
        Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Truth }
    }

    fn bus(domain: &OwnedDomain) -> IoxBus {
        IoxBus::enter(domain.domain(), "test", Depths { role: 1, scorer: 8, history: 0 }).unwrap()
    }

    /// Opens by attempts that are refused until so many have been made; returns how many were.
    fn attempts(bus: &IoxBus, until: u32, refusal: impl Fn() -> Refusal) -> (u32, Result<(), BusError>) {
        let mut made = 0;
        let attempt = || {
            made += 1;
            if made > until { Ok(()) } else { Err(refusal()) }
        };
        let opened = bus.open(&topic(), "reader", attempt);
        (made, opened)
    }

    #[test]
    fn what_may_pass_is_tried_again_and_nothing_else() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let interrupted = || PublishSubscribeOpenOrCreateError::from(PublishSubscribeOpenError::Interrupt).into();
        assert!(matches!(attempts(&bus, 2, interrupted), (3, Ok(()))));
        let (made, refused) = attempts(&bus, 2, || Refusal::never("a signal called Interrupt"));
        assert!(made == 1 && refused.is_err());
    }

    #[test]
    fn an_opening_has_a_limit_and_names_the_file_that_it_waits_for() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain).within(Duration::from_millis(50));
        let path = domain.domain().shared("begun");
        std::fs::write(&path, "").unwrap();
        let (_, refused) = attempts(&bus, u32::MAX, || PublishSubscribeOpenError::HangsInCreation.into());
        let reason = refused.unwrap_err().to_string();
        assert!(reason.contains("0.05 s") && reason.contains(path.to_str().unwrap()), "{reason}");
    }

    #[test]
    fn what_the_dead_left_is_not_put_away_by_whoever_comes() {
        let domain = OwnedDomain::create(0).unwrap();
        let config = config(domain.domain()).unwrap();
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
        assert!(!newest.written());
        let mut writer = ours.writer::<RateTruth>(&topic(), 1).unwrap();
        assert!(newest.written());
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
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let _writer = bus.writer::<RateTruth>(&topic(), 1).unwrap();
        assert!(matches!(bus.writer::<RateTruth>(&topic(), 1), Err(BusError::Open { .. })));
        let error = bus.reader::<RateCommand>(&topic(), Reader::Role).err().unwrap();
        assert!(error.to_string().contains("IncompatibleTypes"), "{error}");
    }

    /// A foreign program is told this version: it must be the one that is linked.
    #[test]
    fn the_version_is_the_transport_s_own() {
        let domain = OwnedDomain::create(0).unwrap();
        let _reader = bus(&domain).reader::<RateTruth>(&topic(), Reader::Role).unwrap();
        let mut versions = Vec::new();
        Ipc::list(&config(domain.domain()).unwrap(), |service| {
            versions.push(service.static_details.iceoryx2_version().to_string());
            CallbackProgression::Continue
        })
        .unwrap();
        assert_eq!(versions, [VERSION]);
    }

    /// A signal with a fast lane, whose bus has links of the newest sample.
    fn fast() -> Topic {
        Topic { signal: Signal::Command, ..topic() }
    }

    fn send(writer: &mut IoxWriter<RateCommand>, tick: u64, generation: u64) {
        writer.send(|sample| (sample.stamp.tick, sample.stamp.generation) = (tick, generation)).unwrap();
    }

    /// The queue still holds what the lane has given: that must not keep the reader awake.
    #[test]
    fn a_reader_of_the_lane_sleeps_at_once_when_there_is_nothing_new() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let mut writer = bus.writer::<RateCommand>(&fast(), 1).unwrap();
        let mut reader = bus.reader::<RateCommand>(&fast(), Reader::Role).unwrap();
        send(&mut writer, 0, 1);
        assert!(reader.advance().unwrap());
        reader.refresh();
        assert!(matches!(reader.lane, Lane::Open(_)));
        for tick in 1..20 {
            send(&mut writer, tick, 1);
            assert!(reader.advance().unwrap());
            assert!(matches!(reader.current, Current::InLane));
            let (until_ns, mut sleeps) = (monotonic_ns() + 2_000_000, 0);
            while monotonic_ns() < until_ns {
                reader.sleep(until_ns).unwrap();
                assert!(!reader.advance().unwrap());
                sleeps += 1;
            }
            assert!(sleeps <= 2, "tick {tick}: {sleeps} sleeps in 2 ms");
        }
    }

    /// A successor of the writer has a lane of its own, which is looked for only later.
    #[test]
    fn what_only_the_queue_has_ends_the_sleep_and_is_found_at_the_next_look() {
        let domain = OwnedDomain::create(0).unwrap();
        let bus = bus(&domain);
        let mut reader = bus.reader::<RateCommand>(&fast(), Reader::Role).unwrap();
        for generation in 1..4 {
            let mut writer = bus.writer::<RateCommand>(&fast(), generation).unwrap();
            for tick in 0..3 {
                let tick = 10 * generation + tick;
                send(&mut writer, tick, generation);
                reader.sleep(monotonic_ns() + 1_000_000).unwrap();
                assert!(reader.advance().unwrap(), "generation {generation}, tick {tick}");
                assert_eq!(key(reader.current().unwrap()), (generation, tick));
                assert!(!reader.advance().unwrap(), "once");
            }
            reader.refresh();
            assert!(!reader.advance().unwrap(), "what is in the lane now was in the queue");
        }
    }

    #[test]
    fn two_domains_never_meet() {
        let (one, other) = (OwnedDomain::create(0).unwrap(), OwnedDomain::create(0).unwrap());
        let mut writer = bus(&one).writer::<RateTruth>(&topic(), 1).unwrap();
        let mut reader = bus(&other).reader::<RateTruth>(&topic(), Reader::Scorer).unwrap();
        reader.advance().unwrap();
        writer.send(|sample| sample.stamp.tick = 1).unwrap();
        assert!(!reader.advance().unwrap());
    }
}
