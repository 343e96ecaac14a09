//! The relay process: on its host it stands in for all roles that run elsewhere.
//!
//! In real time a sample for which a role waits is sent at once and may be lost. Samples that only the launcher reads, and all samples
//! in lockstep, go through a lossless stream. A late or repeated sample is counted and not passed on; its reader counts it as missing.
//! No role waits for the relay. Must not interpret a sample.

use super::changes::SharedChanges;
use super::clock::{ClockError, HostClock};
use super::endpoint::{HostEndpoint, RELAY};
use super::forward::Forwarders;
use super::join::{GONE_NS, HostTable};
use super::net::{Arrival, NetError, Network, Outbox, connect_timeout};
use super::offset::Exchange;
use super::plan::Plan;
use super::report::{HostStatistics, LinkStatistics, Silence, far_end_path, ready_path, relay_report_path};
use super::stream::{Receiver, Sender};
use super::wire::{Content, Message, Payload};
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal, WordReader, WordWriter, Write};
use crate::clock::{Grid, RunClock, monotonic_ns, raw_ns};
use crate::config::ClockKind;
use crate::runtime::{RetainedSamples, depths, retained_samples, take_priority_above_roles, topic};
use crate::sample::{Health, Phase, Schedule, Stamp};
use crate::scenario::Scenario;
use crate::seat::{RoleError, clock_path, join, open_ledger, report_path, scenario_path, write_whole};
use crate::system::{remedy, tell};
use crate::telemetry::Latency;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

/// Interval of heartbeats and of the launcher's announcements while they do not change, ns.
const STATUS_NS: u64 = 20_000_000;
/// Time without messages after which a host is silent, ns: it sends every [`STATUS_NS`].
const SILENT_NS: u64 = 250_000_000;
/// Time for which the first session requests the launching host's time without an answer, ns, before a new session replaces it; the
/// time doubles with every second session, up to the maximum. The network may have lost a declaration of the session.
const TRY_NS: u64 = 500_000_000;
const TRY_MAX_NS: u64 = 4_000_000_000;
/// Timeout of the measurement of the time after the first answer, ns.
const SYNC_NS: u64 = 15_000_000_000;
/// Time without an answer to the 20 time requests per second after which a joined host replaces its session, ns.
const UNANSWERED_NS: u64 = 1_500_000_000;
/// Timeout of one attempt to replace a session.
const REOPEN: Duration = Duration::from_secs(3);
/// Time for which an ending host sends its final files, and for which the launching host waits for them, ns: since the last message of
/// the other host, and in total.
const LEAVE_NS: u64 = 4_000_000_000;
const LEAVE_MAX_NS: u64 = 20_000_000_000;
/// Time for which the launching host still sends acknowledgements after the run, ns.
const LINGER_NS: u64 = 200_000_000;
/// Largest queue of a stream in real time, bytes; it has room for at least this number of frames.
const QUEUE_BYTES: usize = 64 << 20;
const QUEUE_FRAMES: usize = 1024;
/// Pause of an idle relay in lockstep, for its first idle rounds.
const SHORT_PAUSE: Duration = Duration::from_micros(50);
const SHORT_PAUSES: u32 = 200;
/// Any other pause of an idle relay.
const PAUSE: Duration = Duration::from_millis(1);

/// Options of a relay.
#[derive(Debug, Clone)]
pub struct RelayOptions {
    /// Directory of the domain.
    pub domain: PathBuf,
    /// This host, with the address of the launching host.
    pub host: HostEndpoint,
    /// Name of the launching host.
    pub hub: String,
}

/// Failures of a relay.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum RelayError {
    /// The domain cannot be joined.
    #[error(transparent)]
    #[strum(transparent)]
    Role(#[from] RoleError),
    /// The scenario lacks a host, or a role's host.
    #[error("the scenario lacks the host `{0}` or `{1}`, or has roles without a host; check its [[host]] tables")]
    #[strum(serialize = "no-such-host")]
    NoHost(String, String),
    /// The other hosts cannot be reached.
    #[error(transparent)]
    #[strum(transparent)]
    Net(#[from] NetError),
    /// The run's time could not be measured.
    #[error("the clock was not synchronised within {0} s; check the connection to the launching host")]
    NoTime(u64),
    /// The clock does not suffice for the run.
    #[error(transparent)]
    #[strum(transparent)]
    Clock(#[from] ClockError),
    /// A host joined and fell silent before the ticks.
    #[error(
        "the host {host} joined and then sent nothing for {limit_s} s; read the output of its `join`, and start both again"
    )]
    #[strum(serialize = "host-lost")]
    Lost {
        /// The host.
        host: String,
        /// The timeout, s.
        limit_s: f64,
    },
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// A file could not be written.
    #[error("cannot write {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), RelayError> {
    write_whole(path, bytes).map_err(|source| RelayError::Write { path: path.to_owned(), source })
}

/// State shared with zenoh's threads.
struct Shared {
    /// True once ticks run.
    running: AtomicBool,
    /// Time of each host's last message, on the monotonic clock, ns.
    last_message_ns: Vec<AtomicU64>,
}

/// Relays between this host and the others until the run ends.
///
/// # Errors
/// [`RelayError`].
pub fn run_relay(options: &RelayOptions, terminated: &AtomicBool) -> Result<(), RelayError> {
    let (domain, scenario) = join(&options.domain)?;
    let (own, hub) = (&options.host.host, &options.hub);
    let plan = Plan::new(&scenario, own, hub).ok_or_else(|| RelayError::NoHost(own.clone(), hub.clone()))?;
    if scenario.clock == ClockKind::Realtime {
        // Before zenoh starts its threads, which inherit the priority.
        take_priority_above_roles(&scenario);
    }
    let run = scenario.run.map_or_else(|| scenario.name.clone(), |run| run.to_string());
    let shared = Arc::new(Shared {
        running: AtomicBool::new(false),
        last_message_ns: plan.hosts.iter().map(|_| AtomicU64::new(raw_ns())).collect(),
    });
    let (arrivals, inbox) = mpsc::channel();
    let table = if plan.own == plan.hub {
        let path = scenario_path(&domain);
        let text = std::fs::read_to_string(&path).map_err(|source| RelayError::Write { path, source })?;
        Some(Arc::new(HostTable::new(&scenario, text, &run, own)))
    } else {
        None
    };
    let joins = table.clone().map(|table| {
        let shared = shared.clone();
        let answers = move |request: &[u8]| {
            table.answer(request, raw_ns(), shared.running.load(Ordering::Relaxed), &shared.last_message_ns)
        };
        Box::new(answers) as super::net::Answers
    });
    let noting = shared.clone();
    let on_message = move |arrival: Arrival| {
        // Noted here, so that a host does not count as silent while this one is too busy to take its messages.
        if let Some(last_ns) = arrival.bytes.first().and_then(|from| noting.last_message_ns.get(usize::from(*from))) {
            last_ns.store(arrival.at_ns, Ordering::Relaxed);
        }
        let _ = arrivals.send(arrival);
    };
    let numbers = (plan.own, plan.hosts.len() as u8);
    let network = Arc::new(Network::open(&options.host.endpoint, &run, numbers, on_message, joins)?);
    let clock = match &table {
        Some(_) => None,
        None => {
            let timeout = connect_timeout(&options.host.endpoint);
            Some(synchronise((&domain, &scenario), &plan, (&network, timeout), &inbox, terminated)?)
        }
    };
    let bus = IoxBus::enter(&domain, RELAY, depths(&scenario))?;
    let mut relay = Relay::open(&domain, &scenario, &plan, &network.outbox(), shared, clock, &bus)?;
    let forwarders = Forwarders::start(&domain, &scenario, &plan, &network.outbox())?;
    write(&ready_path(domain.root()), b"")?;
    let served = relay.serve(&inbox, &forwarders, (&network, table.as_deref()), terminated);
    let sent = forwarders.end();
    let statistics = relay.statistics(&sent);
    let written = served.and_then(|()| {
        let text = serde_json::to_vec(&statistics).expect("plain values are JSON");
        if plan.own == plan.hub { write(&relay_report_path(domain.root(), own), &text) } else { Ok(()) }
    });
    drop((relay, bus));
    domain.remove_if_over();
    written
}

/// Requests the launching host's time until the clock can be set. Replaces the session while no answer arrives.
fn synchronise(
    (domain, scenario): (&Domain, &Scenario),
    plan: &Plan,
    (network, timeout): (&Network, Duration),
    inbox: &mpsc::Receiver<Arrival>,
    terminated: &AtomicBool,
) -> Result<HostClock, RelayError> {
    let path = clock_path(domain);
    let run_clock = RunClock::open(&path).map_err(|source| RelayError::Write { path, source })?;
    let (mut clock, outbox) = (HostClock::new(scenario, plan.name(plan.own), run_clock), network.outbox());
    let (begun_ns, limit_ns) = (raw_ns(), timeout.as_nanos() as u64);
    let (mut sessions, mut try_ns, mut opened_ns, mut answered_ns) = (1, TRY_NS, raw_ns(), None);
    while !clock.try_set(raw_ns())? {
        let now_ns = raw_ns();
        let late = match answered_ns {
            Some(answered_ns) => now_ns - answered_ns > SYNC_NS,
            None => now_ns - begun_ns > limit_ns,
        };
        if late || terminated.load(Ordering::Relaxed) {
            return Err(RelayError::NoTime((now_ns - begun_ns) / 1_000_000_000));
        }
        if answered_ns.is_none() && now_ns - opened_ns > try_ns {
            // If this fails, the previous session may still work.
            let _ = network.reopen(REOPEN);
            (sessions, opened_ns) = (sessions + 1, raw_ns());
            try_ns = if sessions % 2 == 1 { (2 * try_ns).min(TRY_MAX_NS) } else { try_ns };
        }
        request_time(&mut clock, plan, &outbox);
        let Ok(Arrival { at_ns, bytes }) = inbox.recv_timeout(PAUSE) else { continue };
        if let Some(Message { from, payload: payload @ Payload::Pong { .. } }) = Message::decode(&bytes)
            && from == plan.hub
        {
            answered_ns.get_or_insert(at_ns);
            take_time(&mut clock, &payload, at_ns);
        }
    }
    Ok(clock)
}

/// Requests the time, if a request is due.
fn request_time(clock: &mut HostClock, plan: &Plan, outbox: &Outbox) {
    if clock.is_request_due(raw_ns()) {
        // A lost request is repeated.
        let _ = outbox.send(plan.hub, true, &Message { from: plan.own, payload: Payload::Ping { sent_ns: raw_ns() } });
    }
}

/// Takes the answer to a time request; ignores any other payload.
fn take_time(clock: &mut HostClock, payload: &Payload<'_>, returned_ns: u64) {
    if let Payload::Pong { sent_ns, received_ns, answered_ns, tai_offset_ns } = *payload {
        clock.take(Exchange { sent_ns, received_ns, answered_ns, returned_ns }, tai_offset_ns as i64);
    }
}

/// Replaces a joined host's session if the launching host does not answer; in a thread, because zenoh blocks.
struct SessionMonitor {
    /// Time of the launching host's last answer, ns.
    answered_ns: u64,
    replacement: Option<std::thread::JoinHandle<()>>,
}

impl SessionMonitor {
    fn check(&mut self, network: &Arc<Network>, now_ns: u64) {
        if self.replacement.as_ref().is_some_and(std::thread::JoinHandle::is_finished) {
            // The new session has the same time to answer.
            (self.replacement, self.answered_ns) = (None, now_ns);
        }
        if self.replacement.is_none() && now_ns.saturating_sub(self.answered_ns) > UNANSWERED_NS {
            let network = network.clone();
            // A failed attempt is repeated.
            let replace = move || drop(network.reopen(REOPEN));
            self.replacement = std::thread::Builder::new().name("reopen".to_owned()).spawn(replace).ok();
        }
    }
}

/// A signal of another host that is written here.
struct Incoming {
    writer: Option<WordWriter>,
    /// Copies of samples in lockstep, for the successor of a reader that dies before it has used them.
    retained: Option<RetainedSamples>,
    /// Number of retained samples.
    retained_count: u64,
    /// Stamp of the last sample of a lossless link.
    last: Option<Stamp>,
    lossless: bool,
    /// Number of the next expected sample.
    next: u64,
    received: u64,
    lost: u64,
    stale: u64,
    one_way: Latency,
}

/// A signal of this host that goes into the streams to other hosts.
struct StreamSource {
    link: u16,
    reader: WordReader,
    to: Vec<u8>,
    sent: u64,
}

struct Relay<'a> {
    domain: &'a Domain,
    scenario: &'a Scenario,
    plan: &'a Plan,
    outbox: Arc<Outbox>,
    shared: Arc<Shared>,
    /// The clock of a joined host.
    clock: Option<HostClock>,
    session_monitor: SessionMonitor,
    /// Hosts that joined and fell silent before the ticks.
    lost: Vec<String>,
    streams: Vec<(Sender, Receiver)>,
    incoming: Vec<Incoming>,
    sources: Vec<StreamSource>,
    /// The launcher's announcements: read on the launching host, written on joined ones.
    schedule_in: Option<<IoxBus as Bus>::Reader<Schedule>>,
    schedule_out: Option<<IoxBus as Bus>::Writer<Schedule>>,
    schedule: Schedule,
    /// The newest announcement that a joined host has received, and the number of changes of inputs that precede it.
    announced: (u64, Schedule),
    changes: SharedChanges,
    next_status_ns: u64,
    /// Heartbeats of the roles here, which are sent, and of those elsewhere, which are written.
    health_in: Vec<(u16, <IoxBus as Bus>::Reader<Health>)>,
    health_out: Vec<Option<<IoxBus as Bus>::Writer<Health>>>,
    /// Per host, true once its final files have arrived; true for this host.
    ended: Vec<bool>,
    /// Per host, the start of its current silence, ns, and the tick.
    silent: Vec<Option<(u64, u64)>>,
    silences: Vec<Silence>,
    malformed: u64,
}

impl<'a> Relay<'a> {
    fn open(
        domain: &'a Domain,
        scenario: &'a Scenario,
        plan: &'a Plan,
        outbox: &Arc<Outbox>,
        shared: Arc<Shared>,
        clock: Option<HostClock>,
        bus: &IoxBus,
    ) -> Result<Self, BusError> {
        let is_hub = plan.own == plan.hub;
        // Before the links of the loop: the launcher judges a role whose heartbeat is not connected by its samples alone.
        let (mut health_in, mut health_out) = (Vec::new(), Vec::new());
        for (number, (role, host)) in plan.roles.iter().enumerate() {
            let topic = topic(scenario, role.name(scenario), Signal::Health);
            health_out.push((is_hub && *host != plan.own).then(|| bus.writer(&topic, 1)).transpose()?);
            if !is_hub && *host == plan.own {
                health_in.push((number as u16, bus.reader(&topic, Reader::Role)?));
            }
        }
        let (mut incoming, mut sources) = (Vec::new(), Vec::new());
        for (number, link) in plan.links.iter().enumerate() {
            let here = link.to.iter().find(|destination| destination.host == plan.own);
            incoming.push(Incoming {
                writer: here.map(|_| link.port.writer(bus)).transpose()?,
                retained: here.and_then(|_| {
                    retained_samples(scenario, &link.port.topic, |role| open_ledger(domain, scenario, role).ok())
                }),
                retained_count: 0,
                last: None,
                lossless: here.is_some_and(|destination| destination.lossless),
                next: 0,
                received: 0,
                lost: 0,
                stale: 0,
                one_way: Latency::default(),
            });
            let lossless = link.to.iter().filter(|destination| destination.lossless);
            let to: Vec<u8> = lossless.map(|destination| destination.host).collect();
            if link.from == plan.own && !to.is_empty() {
                let reader = link.port.reader(bus, Reader::Scorer)?;
                sources.push(StreamSource { link: number as u16, reader, to, sent: 0 });
            }
        }
        let longest = plan.links.iter().map(|link| link.port.size).max().unwrap_or(1);
        let capacity = match scenario.clock {
            ClockKind::Realtime => (QUEUE_BYTES / longest).max(QUEUE_FRAMES),
            // The loop's credit bounds the queue.
            ClockKind::Lockstep | ClockKind::InProcess => usize::MAX,
        };
        let schedule = |body| topic(scenario, body, Signal::Schedule);
        Ok(Self {
            domain,
            scenario,
            plan,
            outbox: outbox.clone(),
            shared,
            clock,
            session_monitor: SessionMonitor { answered_ns: raw_ns(), replacement: None },
            lost: Vec::new(),
            streams: plan.hosts.iter().map(|_| (Sender::new(capacity), Receiver::default())).collect(),
            incoming,
            sources,
            schedule_in: is_hub.then(|| bus.reader(&schedule("run"), Reader::Role)).transpose()?,
            schedule_out: (!is_hub).then(|| bus.writer(&schedule(RELAY), 1)).transpose()?,
            schedule: Schedule::default(),
            announced: Default::default(),
            changes: SharedChanges::new(scenario.inputs.received(), plan.hosts.len()),
            next_status_ns: 0,
            health_in,
            health_out,
            ended: plan.hosts.iter().enumerate().map(|(host, _)| host as u8 == plan.own).collect(),
            silent: vec![None; plan.hosts.len()],
            silences: Vec::new(),
            malformed: 0,
        })
    }

    fn send(&self, to: u8, urgent: bool, payload: Payload<'_>) {
        // A message that cannot be sent is lost like one that does not arrive.
        let _ = self.outbox.send(to, urgent, &Message { from: self.plan.own, payload });
    }

    /// Relays in both directions until the run is over for this host.
    fn serve(
        &mut self,
        inbox: &mpsc::Receiver<Arrival>,
        forwarders: &Forwarders,
        (network, table): (&Arc<Network>, Option<&HostTable>),
        terminated: &AtomicBool,
    ) -> Result<(), RelayError> {
        let (mut idle, mut leaving_ns, mut next_check_ns) = (0_u32, None, 0);
        loop {
            let mut busy = false;
            while let Ok(arrival) = inbox.try_recv() {
                self.take(&arrival)?;
                busy = true;
            }
            busy |= self.fill_streams()?;
            let now_ns = raw_ns();
            self.send_status(now_ns)?;
            self.send_frames(now_ns);
            if let Some(clock) = &mut self.clock {
                request_time(clock, self.plan, &self.outbox);
                clock.track(now_ns);
            }
            if now_ns >= next_check_ns || leaving_ns.is_some() {
                next_check_ns = now_ns + STATUS_NS;
                self.check_silence(now_ns);
                match table {
                    Some(table) => self.check_joined(table, now_ns)?,
                    None => self.session_monitor.check(network, now_ns),
                }
                if terminated.load(Ordering::Relaxed) || !self.domain.exists() {
                    return Ok(());
                }
                if self.may_leave(&mut leaving_ns, forwarders, now_ns)? {
                    return Ok(());
                }
            }
            idle = if busy { 0 } else { idle.saturating_add(1) };
            let pause = match self.scenario.clock {
                ClockKind::Lockstep if idle < SHORT_PAUSES => SHORT_PAUSE,
                _ => PAUSE,
            };
            if let Some(arrival) = (!busy).then(|| inbox.recv_timeout(pause).ok()).flatten() {
                self.take(&arrival)?;
                idle = 0;
            }
        }
    }

    /// Takes a message of another host.
    fn take(&mut self, arrival: &Arrival) -> Result<(), RelayError> {
        let hosts = self.plan.hosts.len() as u8;
        let known =
            Message::decode(&arrival.bytes).filter(|message| message.from < hosts && message.from != self.plan.own);
        let Some(Message { from, payload }) = known else {
            self.malformed += 1;
            return Ok(());
        };
        self.end_silence(from, arrival.at_ns);
        let from_hub = from == self.plan.hub;
        match payload {
            Payload::Sample { link, number, sample } => self.take_sample(from, link, Some(number), sample)?,
            Payload::Frame { number, content } => {
                if self.streams[usize::from(from)].1.take(number) {
                    self.take_content(from, content)?;
                }
            }
            Payload::Acknowledge { next } => self.streams[usize::from(from)].0.acknowledge(next, raw_ns()),
            Payload::Health { role, sample } => self.take_health(from, role, sample)?,
            Payload::Schedule { changes, sample } => match bytemuck::try_pod_read_unaligned::<Schedule>(sample) {
                Ok(schedule) if from_hub => {
                    // An older announcement may arrive after a newer one.
                    if schedule.stamp.tick > self.announced.1.stamp.tick {
                        self.announced = (changes, schedule);
                    }
                    self.adopt_schedule()?;
                }
                _ => self.malformed += 1,
            },
            Payload::Changes { first, changes: [] } => self.changes.requested(from, first),
            Payload::Changes { first, changes } if from_hub => {
                let next = self.changes.take(first, changes);
                self.send(from, true, Payload::Changes { first: next, changes: &[] });
                self.adopt_schedule()?;
            }
            Payload::Changes { .. } => self.malformed += 1,
            pong @ Payload::Pong { .. } => {
                if let Some(clock) = self.clock.as_mut().filter(|_| from_hub) {
                    self.session_monitor.answered_ns = arrival.at_ns;
                    take_time(clock, &pong, arrival.at_ns);
                }
            }
            // Answered in `net`, on arrival.
            Payload::Ping { .. } => {}
        }
        Ok(())
    }

    /// Passes the newest announcement on to the roles of a joined host, once they can see the changes of inputs that precede it.
    fn adopt_schedule(&mut self) -> Result<(), RelayError> {
        let (changes, schedule) = self.announced;
        let is_new = schedule.stamp.tick > self.schedule.stamp.tick && self.changes.count() >= changes;
        if let Some(out) = self.schedule_out.as_mut().filter(|_| is_new) {
            self.schedule = schedule;
            out.send(|sample| *sample = schedule)?;
        }
        Ok(())
    }

    /// Writes a sample of another host, unless it is malformed, repeated or late.
    fn take_sample(&mut self, from: u8, link: u16, number: Option<u64>, sample: &[u8]) -> Result<(), RelayError> {
        let plan = self.plan.links.get(usize::from(link));
        let fits = plan.filter(|plan| plan.from == from && plan.port.size == sample.len());
        let Some((_, incoming)) = fits.zip(self.incoming.get_mut(usize::from(link))) else {
            self.malformed += 1;
            return Ok(());
        };
        let Some(writer) = incoming.writer.as_mut().filter(|_| incoming.lossless == number.is_none()) else {
            self.malformed += 1;
            return Ok(());
        };
        if let Some(number) = number {
            if number < incoming.next {
                incoming.stale += 1;
                return Ok(());
            }
            incoming.lost += number - incoming.next;
            incoming.next = number + 1;
        }
        incoming.received += 1;
        let stamp: Stamp = bytemuck::pod_read_unaligned(&sample[..size_of::<Stamp>()]);
        if number.is_none() && !stamp.is_warm_up() {
            // A successor of the writer may repeat its predecessor's last sample.
            let is_repeated = |last: Stamp| {
                last.generation < stamp.generation && stamp == Stamp { generation: stamp.generation, ..last }
            };
            if incoming.last.replace(stamp).is_some_and(is_repeated) {
                return Ok(());
            }
            if let Some(retained) = &incoming.retained {
                let words = sample.chunks_exact(size_of::<u64>()).map(bytemuck::pod_read_unaligned);
                retained.keep(incoming.retained_count, words);
                incoming.retained_count += 1;
            }
        }
        writer.send(sample)?;
        if self.scenario.clock == ClockKind::Realtime && stamp.generation > 0 {
            incoming.one_way.record(stamp.sent_ns, monotonic_ns());
        }
        Ok(())
    }

    fn take_content(&mut self, from: u8, content: &[u8]) -> Result<(), RelayError> {
        match Content::decode(content) {
            Some(Content::Sample { link, sample }) => self.take_sample(from, link, None, sample),
            // Only the launching host keeps files, and only the final files of the others.
            Some(Content::File { name, bytes }) if self.plan.own == self.plan.hub && self.is_final_file(from, name) => {
                let path = self.domain.root().join(name);
                write(&path, bytes)?;
                if path == far_end_path(self.domain.root(), self.plan.name(from)) {
                    self.mark_ended(from);
                }
                Ok(())
            }
            _ => {
                self.malformed += 1;
                Ok(())
            }
        }
    }

    /// Returns true if a host sends a file of this name at its end.
    fn is_final_file(&self, from: u8, name: &str) -> bool {
        self.final_files(from).iter().any(|path| path.file_name().is_some_and(|file| file == name))
    }

    /// Returns the files that a host sends at its end; the last one completes them.
    fn final_files(&self, from: u8) -> Vec<PathBuf> {
        let (root, host) = (self.domain.root(), self.plan.name(from));
        let roles = self.plan.roles.iter().filter(|(_, host)| *host == from);
        let reports = roles.map(|(role, _)| report_path(root, role.name(self.scenario)));
        reports.chain([relay_report_path(root, host), far_end_path(root, host)]).collect()
    }

    /// Notes that a host has ended: no further heartbeats of its roles are written.
    fn mark_ended(&mut self, from: u8) {
        self.ended[usize::from(from)] = true;
        let roles = self.plan.roles.iter().zip(&mut self.health_out);
        roles.filter(|((_, host), _)| *host == from).for_each(|(_, health)| *health = None);
    }

    fn take_health(&mut self, from: u8, role: u16, sample: &[u8]) -> Result<(), RelayError> {
        let role = usize::from(role);
        let theirs = self.plan.roles.get(role).is_some_and(|(_, host)| *host == from);
        match (self.health_out.get_mut(role), bytemuck::try_pod_read_unaligned::<Health>(sample)) {
            (Some(Some(out)), Ok(health)) if theirs => out.send(|sample| *sample = health)?,
            // A heartbeat may arrive after the host's final files.
            (Some(None), Ok(_)) if theirs => {}
            _ => self.malformed += 1,
        }
        Ok(())
    }

    /// Appends new samples of this host to the streams. Returns true if there were any.
    fn fill_streams(&mut self) -> Result<bool, RelayError> {
        let mut busy = false;
        for source in &mut self.sources {
            while let Some(words) = source.reader.next()? {
                let content = Content::Sample { link: source.link, sample: bytemuck::cast_slice(words) }.encode();
                for to in &source.to {
                    self.streams[usize::from(*to)].0.push(content.clone());
                }
                source.sent += 1;
                busy = true;
            }
        }
        Ok(busy)
    }

    /// Sends frames and acknowledgements of all streams.
    fn send_frames(&mut self, now_ns: u64) {
        let (outbox, from) = (&self.outbox, self.plan.own);
        for (host, (sender, receiver)) in self.streams.iter_mut().enumerate() {
            sender.poll(now_ns, |number, content| {
                let _ = outbox.send(host as u8, false, &Message { from, payload: Payload::Frame { number, content } });
            });
            if let Some(next) = receiver.acknowledgement() {
                let _ = outbox.send(host as u8, true, &Message { from, payload: Payload::Acknowledge { next } });
            }
        }
    }

    /// Sends the launcher's announcement, or the heartbeats of roles: on change, and every [`STATUS_NS`].
    fn send_status(&mut self, now_ns: u64) -> Result<(), RelayError> {
        let mut due = now_ns >= self.next_status_ns;
        let is_hub = self.schedule_in.is_some();
        if let Some(reader) = &mut self.schedule_in {
            while reader.advance()? {}
            let schedule = reader.current().copied().unwrap_or_default();
            let content = |schedule: &Schedule| (schedule.phase, schedule.epoch_ns, schedule.credit_tick);
            due |= content(&schedule) != content(&self.schedule);
            self.schedule = schedule;
            self.shared.running.store(Phase::from_number(schedule.phase) > Phase::Gather, Ordering::Relaxed);
        }
        // After the schedule: a change is in the list before a role may come to its tick.
        due |= is_hub && self.changes.grew();
        if !due {
            return Ok(());
        }
        self.next_status_ns = now_ns + STATUS_NS;
        if is_hub {
            for host in self.plan.peers() {
                if let Some((first, changes)) = self.changes.wanted_by(host) {
                    self.send(host, true, Payload::Changes { first, changes: bytemuck::cast_slice(&changes) });
                }
                let (changes, sample) = (self.changes.count(), bytemuck::bytes_of(&self.schedule));
                self.send(host, true, Payload::Schedule { changes, sample });
            }
        }
        for (_, health) in &mut self.health_in {
            while health.advance()? {}
        }
        for (role, health) in &self.health_in {
            if let Some(health) = health.current() {
                self.send(self.plan.hub, true, Payload::Health { role: *role, sample: bytemuck::bytes_of(health) });
            }
        }
        Ok(())
    }

    fn phase(&self) -> Phase {
        Phase::from_number(self.schedule.phase)
    }

    /// Notes hosts that fall silent while ticks run.
    fn check_silence(&mut self, now_ns: u64) {
        let grid = Grid { epoch_ns: self.schedule.epoch_ns, period_ns: self.scenario.period_ns };
        let realtime = self.scenario.clock == ClockKind::Realtime;
        let tick = if realtime { grid.tick_at(monotonic_ns()).min(self.scenario.last_tick) } else { 0 };
        for host in self.plan.peers().filter(|host| self.plan.own == self.plan.hub || *host == self.plan.hub) {
            let index = usize::from(host);
            let last_ns = self.shared.last_message_ns[index].load(Ordering::Relaxed);
            let silent = now_ns.saturating_sub(last_ns) > SILENT_NS && self.phase() == Phase::Run && !self.ended[index];
            if silent && self.silent[index].is_none() {
                self.silent[index] = Some((last_ns, tick));
                tell(format_args!("corotate: no messages from the host {}", self.plan.name(host)));
            }
        }
    }

    /// Notes hosts that joined and fell silent before the ticks. Another process may then join in their place.
    ///
    /// # Errors
    /// [`RelayError::Lost`] once a host has been silent for the time that roles may take to start.
    fn check_joined(&mut self, table: &HostTable, now_ns: u64) -> Result<(), RelayError> {
        if self.shared.running.load(Ordering::Relaxed) {
            return Ok(());
        }
        let limit_s = self.scenario.startup_timeout_s;
        let lost = table.lost(now_ns, GONE_NS, &self.shared.last_message_ns);
        for host in lost.iter().filter(|host| !self.lost.contains(host)) {
            tell(format_args!(
                "corotate: the host {host} joined and then fell silent; waiting {limit_s} s for it or for another `join`"
            ));
        }
        self.lost = lost;
        let host = table.lost(now_ns, (limit_s * 1e9) as u64, &self.shared.last_message_ns).into_iter().next();
        host.map_or(Ok(()), |host| Err(RelayError::Lost { host, limit_s }))
    }

    /// Ends the silence of a host, if it was silent.
    fn end_silence(&mut self, host: u8, at_ns: u64) {
        if let Some((since_ns, tick)) = self.silent[usize::from(host)].take() {
            let seconds = at_ns.saturating_sub(since_ns) as f64 / 1e9;
            let host = self.plan.name(host).to_owned();
            tell(format_args!("corotate: the host {host} sends again after {seconds:.2} s"));
            self.silences.push(Silence { host, tick, seconds, healed: true });
        }
    }

    /// Returns true once this host has sent or received all final files, or no longer waits for them.
    fn may_leave(
        &mut self,
        since_ns: &mut Option<u64>,
        forwarders: &Forwarders,
        now_ns: u64,
    ) -> Result<bool, RelayError> {
        let (own, root) = (self.plan.own, self.domain.root());
        if own == self.plan.hub {
            if self.phase() < Phase::Stop {
                return Ok(false);
            }
            let since_ns = *since_ns.get_or_insert(now_ns);
            let is_awaited = |host: u8| !self.ended[usize::from(host)] && !self.gives_up(host, since_ns, now_ns);
            return Ok(now_ns - since_ns > LINGER_NS && !self.plan.peers().any(is_awaited));
        }
        let end = far_end_path(root, self.plan.name(own));
        match *since_ns {
            None if end.exists() => {
                *since_ns = Some(now_ns);
                self.fill_streams()?;
                let statistics =
                    serde_json::to_vec(&self.statistics(&forwarders.sent())).expect("plain values are JSON");
                write(&relay_report_path(root, self.plan.name(own)), &statistics)?;
                for path in self.final_files(own) {
                    if let (Ok(bytes), Some(name)) =
                        (std::fs::read(&path), path.file_name().and_then(|name| name.to_str()))
                    {
                        self.streams[usize::from(self.plan.hub)].0.push(Content::File { name, bytes: &bytes }.encode());
                    }
                }
                Ok(false)
            }
            None => Ok(false),
            Some(since_ns) => {
                let is_delivered = self.streams[usize::from(self.plan.hub)].0.is_empty();
                Ok(is_delivered || self.gives_up(self.plan.hub, since_ns, now_ns))
            }
        }
    }

    /// Returns true if a host that leaves since `since_ns` no longer waits for host number `host`.
    fn gives_up(&self, host: u8, since_ns: u64, now_ns: u64) -> bool {
        let last_ns = self.shared.last_message_ns[usize::from(host)].load(Ordering::Relaxed).max(since_ns);
        now_ns.saturating_sub(last_ns) > LEAVE_NS || now_ns - since_ns > LEAVE_MAX_NS
    }

    /// Returns the statistics of this host; `sent` is the number of forwarded samples, by link and host.
    fn statistics(&self, sent: &[(usize, u8, u64)]) -> HostStatistics {
        let plan = self.plan;
        let end = |link: usize, to: u8, lossless: bool| LinkStatistics {
            service: plan.links[link].port.topic.to_string(),
            from: plan.name(plan.links[link].from).to_owned(),
            to: plan.name(to).to_owned(),
            lossless,
            sent: None,
            received: None,
            lost: 0,
            stale: 0,
            one_way: None,
        };
        let forwarded =
            sent.iter().map(|(link, to, sent)| LinkStatistics { sent: Some(*sent), ..end(*link, *to, false) });
        let streamed = self.sources.iter().flat_map(|source| {
            let sent = |to: &u8| LinkStatistics { sent: Some(source.sent), ..end(usize::from(source.link), *to, true) };
            source.to.iter().map(sent).collect::<Vec<_>>()
        });
        let incoming = self.incoming.iter().enumerate().filter(|(_, incoming)| incoming.writer.is_some());
        let received = incoming.map(|(link, incoming)| LinkStatistics {
            received: Some(incoming.received),
            lost: incoming.lost,
            stale: incoming.stale,
            one_way: (!incoming.one_way.is_empty()).then(|| incoming.one_way.percentiles()),
            ..end(link, plan.own, incoming.lossless)
        });
        let lasting = plan.peers().filter_map(|host| {
            let (since_ns, tick) = self.silent[usize::from(host)]?;
            let seconds = raw_ns().saturating_sub(since_ns) as f64 / 1e9;
            Some(Silence { host: plan.name(host).to_owned(), tick, seconds, healed: false })
        });
        HostStatistics {
            host: plan.name(plan.own).to_owned(),
            launched: plan.own == plan.hub,
            clock: self.clock.as_ref().map(HostClock::statistics),
            links: forwarded.chain(streamed).chain(received).collect(),
            silences: self.silences.iter().cloned().chain(lasting).collect(),
            repeated_frames: self.streams.iter().map(|(sender, _)| sender.repeated()).sum(),
            refused_frames: self.streams.iter().map(|(sender, _)| sender.refused()).sum(),
            malformed: self.malformed,
        }
    }
}
