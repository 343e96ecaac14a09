//! The relay process: on its host it stands in for all roles that run elsewhere.
//!
//! In real time a sample for which a role waits is sent at once and may be lost. Samples that only the launcher reads, and all samples
//! in lockstep, go through a lossless stream. A late or repeated sample is counted and not passed on; its reader counts it as missing.
//! No role waits for the relay. Must not interpret a sample.

mod absence;
mod arrivals;
mod error;
mod session;

pub use error::RelayError;

use super::changes::SharedChanges;
use super::clock::HostClock;
use super::endpoint::{HostEndpoint, RELAY};
use super::forward::Forwarders;
use super::join::HostTable;
use super::net::{Answers, Arrival, Network, Outbox, connect_timeout};
use super::plan::Plan;
use super::report::{HostStatistics, LinkStatistics, Silence, ready_path, relay_report_path};
use super::stream::{Receiver, Sender};
use super::wire::{Content, Message, Payload};
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal, WordReader, WordWriter};
use crate::clock::raw_ns;
use crate::config::ClockKind;
use crate::runtime::{RetainedSamples, depths, retained_samples, take_priority_above_roles, topic};
use crate::sample::{Health, Phase, Schedule, Stamp};
use crate::scenario::Scenario;
use crate::seat::{join, open_ledger, scenario_path};
use crate::telemetry::Latency;
use error::write;
use session::{PAUSE, SessionMonitor, request_time, synchronise};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

/// Interval of heartbeats and of the launcher's announcements while they do not change, ns.
const STATUS_NS: u64 = 20_000_000;
/// Largest queue of a stream in real time, bytes; it has room for at least this number of frames.
const QUEUE_BYTES: usize = 64 << 20;
const QUEUE_FRAMES: usize = 1024;
/// Pause of an idle relay in lockstep, for its first idle rounds.
const SHORT_PAUSE: Duration = Duration::from_micros(50);
const SHORT_PAUSES: u32 = 200;

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
        Box::new(answers) as Answers
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
            session_monitor: SessionMonitor::start(),
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
