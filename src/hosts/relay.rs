//! The relay as a process: on its host it has the place of all roles that run elsewhere.
//!
//! In real time a sample that a role waits for goes at once and may be lost; what only the launcher wants, and everything in lockstep,
//! goes by a stream that loses nothing. A sample that comes late or a second time is counted and not passed on, so a role only ever
//! misses it. Must not be waited for by any role, nor know what a sample means.

use super::carry::Carriers;
use super::join::{GONE_NS, Parts};
use super::net::{Arrived, Net, NetError, Post, patience};
use super::offset::Exchange;
use super::plan::Plan;
use super::report::{HostReport, LinkEnd, Silence, far_end_path, ready_path, relay_report_path};
use super::seat::{HostSeat, RELAY};
use super::stream::{Receiver, Sender};
use super::timing::{ClockRefused, Timing};
use super::wire::{Content, Message, What};
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

/// Between two words about roles, and of the launcher, unless there is news, ns.
const WORD_NS: u64 = 20_000_000;
/// A host that is not heard for so long is silent, ns: it speaks every [`WORD_NS`].
const SILENT_NS: u64 = 250_000_000;
/// The time for which one session asks the launching host for its time without any answer, ns: twice as long in every second
/// session, up to the last of these. A way that loses may have lost what the session declared.
const TRY_NS: u64 = 500_000_000;
const TRY_MAX_NS: u64 = 4_000_000_000;
/// The time limit for knowing it well enough once there are answers, ns.
const KNOW_NS: u64 = 15_000_000_000;
/// A host that joined replaces its session after so long without an answer about the time, ns; that is asked for 20 times a second.
const DEAF_NS: u64 = 1_500_000_000;
/// Time limit of one attempt to replace it.
const REOPEN: Duration = Duration::from_secs(3);
/// How long a host that ends tries to tell how it ended, and the one that launched waits for it, ns: while nothing is heard of
/// the other one, and in all.
const LEAVE_NS: u64 = 4_000_000_000;
const LEAVE_HEARD_NS: u64 = 20_000_000_000;
/// How long the last acknowledgements are repeated, ns.
const LINGER_NS: u64 = 200_000_000;
/// Bytes that wait for one host at the most, where that is enough to go on, and so many frames in any case.
const WAITING_BYTES: usize = 64 << 20;
const WAITING_FRAMES: usize = 1024;
/// Pauses when there is nothing to do: in lockstep, then when there was nothing for so many rounds, and in real time.
const LULL: Duration = Duration::from_micros(50);
const LULLS: u32 = 200;
const PAUSE: Duration = Duration::from_millis(1);

/// Which host of a run, where.
#[derive(Debug, Clone)]
pub struct RelaySeat {
    /// The domain's directory.
    pub domain: PathBuf,
    /// This host, and where the one that launches listens.
    pub seat: HostSeat,
    /// The name of the host that launches.
    pub hub: String,
}

/// Why a relay ended.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum RelayError {
    /// The domain is none.
    #[error(transparent)]
    #[strum(transparent)]
    Role(#[from] RoleError),
    /// The scenario has no such hosts.
    #[error("the scenario has no hosts `{0}` and `{1}`, or not every role has one")]
    #[strum(serialize = "no-such-host")]
    NoHost(String, String),
    /// The others cannot be reached.
    #[error(transparent)]
    #[strum(transparent)]
    Net(#[from] NetError),
    /// The time of the run cannot be had.
    #[error("no answer about the time for {0} s; is the network slower than that?")]
    NoTime(u64),
    /// The clock is of no use.
    #[error(transparent)]
    #[strum(transparent)]
    Clock(#[from] ClockRefused),
    /// A host has joined and gone before any tick.
    #[error(
        "the host {host} joined, and nothing has been heard of it for {limit_s} s: look at what its `join` printed, and start both again"
    )]
    #[strum(serialize = "host-lost")]
    Lost {
        /// The host.
        host: String,
        /// The limit, s.
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

/// What the engine's threads must know.
struct Shared {
    begun: AtomicBool,
    /// When each host was heard last, on the monotonic clock, ns.
    heard_ns: Vec<AtomicU64>,
}

/// Serves a host's part in a run to its end.
///
/// # Errors
/// [`RelayError`].
pub fn run_relay(seat: &RelaySeat, terminated: &AtomicBool) -> Result<(), RelayError> {
    let (domain, scenario) = join(&seat.domain)?;
    let (own, hub) = (&seat.seat.host, &seat.hub);
    let plan = Plan::new(&scenario, own, hub).ok_or_else(|| RelayError::NoHost(own.clone(), hub.clone()))?;
    if scenario.clock == ClockKind::Realtime {
        // Before the engine's threads are started, which inherit it.
        take_priority_above_roles(&scenario);
    }
    let run = scenario.run.map_or_else(|| scenario.name.clone(), |run| run.to_string());
    let shared = Arc::new(Shared {
        begun: AtomicBool::new(false),
        heard_ns: plan.hosts.iter().map(|_| AtomicU64::new(raw_ns())).collect(),
    });
    let (arrives, inbox) = mpsc::channel();
    let parts = if plan.own == plan.hub {
        let path = scenario_path(&domain);
        let text = std::fs::read_to_string(&path).map_err(|source| RelayError::Write { path, source })?;
        Some(Arc::new(Parts::new(&scenario, text, &run, own)))
    } else {
        None
    };
    let joins = parts.clone().map(|parts| {
        let shared = shared.clone();
        let answers = move |request: &[u8]| {
            parts.answer(request, raw_ns(), shared.begun.load(Ordering::Relaxed), &shared.heard_ns)
        };
        Box::new(answers) as super::net::Answers
    });
    let heard = shared.clone();
    let arrived = move |arrived: Arrived| {
        // Noted here: a host is heard even if this one has no time for what it says.
        if let Some(heard_ns) = arrived.bytes.first().and_then(|from| heard.heard_ns.get(usize::from(*from))) {
            heard_ns.store(arrived.at_ns, Ordering::Relaxed);
        }
        let _ = arrives.send(arrived);
    };
    let numbers = (plan.own, plan.hosts.len() as u8);
    let net = Arc::new(Net::open(&seat.seat.endpoint, &run, numbers, arrived, joins)?);
    let timing = match &parts {
        Some(_) => None,
        None => {
            let patience = patience(&seat.seat.endpoint);
            Some(know_time((&domain, &scenario), &plan, (&net, patience), &inbox, terminated)?)
        }
    };
    let bus = IoxBus::enter(&domain, RELAY, depths(&scenario))?;
    let mut relay = Relay::open(&domain, &scenario, &plan, &net.post(), shared, timing, &bus)?;
    let carriers = Carriers::start(&domain, &scenario, &plan, &net.post())?;
    write(&ready_path(domain.root()), b"")?;
    let served = relay.serve(&inbox, &carriers, (&net, parts.as_deref()), terminated);
    let links = carriers.end();
    let report = relay.report(&links);
    let written = served.and_then(|()| {
        let text = serde_json::to_vec(&report).expect("a report of plain values is JSON");
        if plan.own == plan.hub { write(&relay_report_path(domain.root(), own), &text) } else { Ok(()) }
    });
    drop((relay, bus));
    domain.remove_if_over();
    written
}

/// Asks the host that launched for the time until it is known well enough, in one session after the other while none answers.
fn know_time(
    (domain, scenario): (&Domain, &Scenario),
    plan: &Plan,
    (net, patience): (&Net, Duration),
    inbox: &mpsc::Receiver<Arrived>,
    terminated: &AtomicBool,
) -> Result<Timing, RelayError> {
    let path = clock_path(domain);
    let clock = RunClock::open(&path).map_err(|source| RelayError::Write { path, source })?;
    let (mut timing, post) = (Timing::new(scenario, plan.name(plan.own), clock), net.post());
    let (begun_ns, limit_ns) = (raw_ns(), patience.as_nanos() as u64);
    let (mut sessions, mut try_ns, mut deaf_ns, mut answered_ns) = (1, TRY_NS, raw_ns(), None);
    while !timing.ready(raw_ns())? {
        let now_ns = raw_ns();
        let late = match answered_ns {
            Some(answered_ns) => now_ns - answered_ns > KNOW_NS,
            None => now_ns - begun_ns > limit_ns,
        };
        if late || terminated.load(Ordering::Relaxed) {
            return Err(RelayError::NoTime((now_ns - begun_ns) / 1_000_000_000));
        }
        if answered_ns.is_none() && now_ns - deaf_ns > try_ns {
            // If that fails, the session before may still do.
            let _ = net.reopen(REOPEN);
            (sessions, deaf_ns) = (sessions + 1, raw_ns());
            try_ns = if sessions % 2 == 1 { (2 * try_ns).min(TRY_MAX_NS) } else { try_ns };
        }
        ask(&mut timing, plan, &post);
        let Ok(Arrived { at_ns, bytes }) = inbox.recv_timeout(PAUSE) else { continue };
        if let Some(Message { from, what: what @ What::Pong { .. } }) = Message::decode(&bytes)
            && from == plan.hub
        {
            answered_ns.get_or_insert(at_ns);
            answered(&mut timing, &what, at_ns);
        }
    }
    Ok(timing)
}

/// Asks for the time, if that is due.
fn ask(timing: &mut Timing, plan: &Plan, post: &Post) {
    if timing.asks(raw_ns()) {
        // A question that is lost is asked again.
        let _ = post.send(plan.hub, true, &Message { from: plan.own, what: What::Ping { sent_ns: raw_ns() } });
    }
}

/// Takes an answer about the time, if it is one.
fn answered(timing: &mut Timing, what: &What<'_>, returned_ns: u64) {
    if let What::Pong { sent_ns, received_ns, answered_ns, tai_offset_ns } = *what {
        timing.take(Exchange { sent_ns, received_ns, answered_ns, returned_ns }, tai_offset_ns as i64);
    }
}

/// Replaces a host's session once that has become deaf; the engine waits, so a thread of its own does it.
struct Ear {
    /// When the host that launched answered last, ns.
    answered_ns: u64,
    replaces: Option<std::thread::JoinHandle<()>>,
}

impl Ear {
    fn look(&mut self, net: &Arc<Net>, now_ns: u64) {
        if self.replaces.as_ref().is_some_and(std::thread::JoinHandle::is_finished) {
            // It has as long to answer as the one before had.
            (self.replaces, self.answered_ns) = (None, now_ns);
        }
        if self.replaces.is_none() && now_ns.saturating_sub(self.answered_ns) > DEAF_NS {
            let net = net.clone();
            // A failed attempt is followed by the next.
            let replace = move || drop(net.reopen(REOPEN));
            self.replaces = std::thread::Builder::new().name("reopen".to_owned()).spawn(replace).ok();
        }
    }
}

/// A signal of another host, to be written here.
struct Incoming {
    writer: Option<WordWriter>,
    /// In lockstep, what stands in for the writer's own: a reader that dies takes what it had not used with it.
    kept: Option<RetainedSamples>,
    /// How many were kept.
    retained_samples: u64,
    /// The stamp of the last sample of the loop, where nothing is lost.
    last: Option<Stamp>,
    lossless: bool,
    /// The number of the sample that is expected next.
    next: u64,
    received: u64,
    lost: u64,
    stale: u64,
    one_way: Latency,
}

/// A signal of this host, for the streams to these others.
struct Tap {
    link: u16,
    reader: WordReader,
    to: Vec<u8>,
    sent: u64,
}

struct Relay<'a> {
    domain: &'a Domain,
    scenario: &'a Scenario,
    plan: &'a Plan,
    post: Arc<Post>,
    shared: Arc<Shared>,
    timing: Option<Timing>,
    ear: Ear,
    /// Hosts that joined and are not heard, before any tick.
    lost: Vec<String>,
    streams: Vec<(Sender, Receiver)>,
    incoming: Vec<Incoming>,
    taps: Vec<Tap>,
    /// Where the launcher's word is read, and where it is written.
    word_in: Option<<IoxBus as Bus>::Reader<Schedule>>,
    word_out: Option<<IoxBus as Bus>::Writer<Schedule>>,
    word: Schedule,
    next_word_ns: u64,
    /// The health of roles here, to be sent, and of those elsewhere, to be written.
    health_in: Vec<(u16, <IoxBus as Bus>::Reader<Health>)>,
    health_out: Vec<Option<<IoxBus as Bus>::Writer<Health>>>,
    /// The hosts that have told how they ended.
    ended: Vec<bool>,
    /// Per host, since when it is silent, ns, and the tick.
    silent: Vec<Option<(u64, u64)>>,
    silences: Vec<Silence>,
    malformed: u64,
}

impl<'a> Relay<'a> {
    fn open(
        domain: &'a Domain,
        scenario: &'a Scenario,
        plan: &'a Plan,
        post: &Arc<Post>,
        shared: Arc<Shared>,
        timing: Option<Timing>,
        bus: &IoxBus,
    ) -> Result<Self, BusError> {
        let is_hub = plan.own == plan.hub;
        // Before the links of the loop: a role that has those open and not this one is judged by its samples alone.
        let (mut health_in, mut health_out) = (Vec::new(), Vec::new());
        for (number, (role, host)) in plan.roles.iter().enumerate() {
            let topic = topic(scenario, role.name(scenario), Signal::Health);
            health_out.push((is_hub && *host != plan.own).then(|| bus.writer(&topic, 1)).transpose()?);
            if !is_hub && *host == plan.own {
                health_in.push((number as u16, bus.reader(&topic, Reader::Role)?));
            }
        }
        let (mut incoming, mut taps) = (Vec::new(), Vec::new());
        for (number, link) in plan.links.iter().enumerate() {
            let here = link.to.iter().find(|way| way.host == plan.own);
            incoming.push(Incoming {
                writer: here.map(|_| link.port.writer(bus)).transpose()?,
                kept: here.and_then(|_| {
                    retained_samples(scenario, &link.port.topic, |role| open_ledger(domain, scenario, role).ok())
                }),
                retained_samples: 0,
                last: None,
                lossless: here.is_some_and(|way| way.lossless),
                next: 0,
                received: 0,
                lost: 0,
                stale: 0,
                one_way: Latency::default(),
            });
            let to: Vec<u8> = link.to.iter().filter(|way| way.lossless).map(|way| way.host).collect();
            if link.from == plan.own && !to.is_empty() {
                let reader = link.port.reader(bus, Reader::Scorer)?;
                taps.push(Tap { link: number as u16, reader, to, sent: 0 });
            }
        }
        let longest = plan.links.iter().map(|link| link.port.size).max().unwrap_or(1);
        let capacity = match scenario.clock {
            ClockKind::Realtime => (WAITING_BYTES / longest).max(WAITING_FRAMES),
            // Bounded by the credit of the loop itself.
            ClockKind::Lockstep | ClockKind::InProcess => usize::MAX,
        };
        let word = |body| topic(scenario, body, Signal::Schedule);
        Ok(Self {
            domain,
            scenario,
            plan,
            post: post.clone(),
            shared,
            timing,
            ear: Ear { answered_ns: raw_ns(), replaces: None },
            lost: Vec::new(),
            streams: plan.hosts.iter().map(|_| (Sender::new(capacity), Receiver::default())).collect(),
            incoming,
            taps,
            word_in: is_hub.then(|| bus.reader(&word("run"), Reader::Role)).transpose()?,
            word_out: (!is_hub).then(|| bus.writer(&word(RELAY), 1)).transpose()?,
            word: Schedule::default(),
            next_word_ns: 0,
            health_in,
            health_out,
            ended: plan.hosts.iter().enumerate().map(|(host, _)| host as u8 == plan.own).collect(),
            silent: vec![None; plan.hosts.len()],
            silences: Vec::new(),
            malformed: 0,
        })
    }

    fn send(&self, to: u8, hurry: bool, what: What<'_>) {
        // What does not go out is as lost as what does not arrive.
        let _ = self.post.send(to, hurry, &Message { from: self.plan.own, what });
    }

    /// Carries what comes and what goes, until the run is over for this host.
    fn serve(
        &mut self,
        inbox: &mpsc::Receiver<Arrived>,
        carriers: &Carriers,
        (net, parts): (&Arc<Net>, Option<&Parts>),
        terminated: &AtomicBool,
    ) -> Result<(), RelayError> {
        let (mut idle, mut leaving_ns, mut next_look_ns) = (0_u32, None, 0);
        loop {
            let mut busy = false;
            while let Ok(arrived) = inbox.try_recv() {
                self.take(&arrived)?;
                busy = true;
            }
            busy |= self.drain()?;
            let now_ns = raw_ns();
            self.tell(now_ns)?;
            self.pump(now_ns);
            if let Some(timing) = &mut self.timing {
                ask(timing, self.plan, &self.post);
                timing.track(now_ns);
            }
            if now_ns >= next_look_ns || leaving_ns.is_some() {
                next_look_ns = now_ns + WORD_NS;
                self.listen_for_silence(now_ns);
                match parts {
                    Some(parts) => self.listen_for_lost(parts, now_ns)?,
                    None => self.ear.look(net, now_ns),
                }
                if terminated.load(Ordering::Relaxed) || !self.domain.exists() {
                    return Ok(());
                }
                if self.leaves(&mut leaving_ns, carriers, now_ns)? {
                    return Ok(());
                }
            }
            idle = if busy { 0 } else { idle.saturating_add(1) };
            let pause = match self.scenario.clock {
                ClockKind::Lockstep if idle < LULLS => LULL,
                _ => PAUSE,
            };
            if let Some(arrived) = (!busy).then(|| inbox.recv_timeout(pause).ok()).flatten() {
                self.take(&arrived)?;
                idle = 0;
            }
        }
    }

    /// Takes what another host said.
    fn take(&mut self, arrived: &Arrived) -> Result<(), RelayError> {
        let others = self.plan.hosts.len() as u8;
        let known =
            Message::decode(&arrived.bytes).filter(|message| message.from < others && message.from != self.plan.own);
        let Some(Message { from, what }) = known else {
            self.malformed += 1;
            return Ok(());
        };
        self.heard(from, arrived.at_ns);
        let from_hub = from == self.plan.hub;
        match what {
            What::Sample { link, number, sample } => self.take_sample(from, link, Some(number), sample)?,
            What::Frame { number, content } => {
                if self.streams[usize::from(from)].1.take(number) {
                    self.take_content(from, content)?;
                }
            }
            What::Acknowledge { next } => self.streams[usize::from(from)].0.acknowledged(next, raw_ns()),
            What::Health { role, sample } => self.take_health(from, role, sample)?,
            What::Schedule { sample } => {
                match (&mut self.word_out, bytemuck::try_pod_read_unaligned::<Schedule>(sample)) {
                    (Some(out), Ok(word)) if from_hub => {
                        // An older word may come after a newer one.
                        if word.stamp.tick > self.word.stamp.tick {
                            self.word = word;
                            out.send(|sample| *sample = word)?;
                        }
                    }
                    _ => self.malformed += 1,
                }
            }
            pong @ What::Pong { .. } => {
                if let Some(timing) = self.timing.as_mut().filter(|_| from_hub) {
                    self.ear.answered_ns = arrived.at_ns;
                    answered(timing, &pong, arrived.at_ns);
                }
            }
            // Answered where it arrived.
            What::Ping { .. } => {}
        }
        Ok(())
    }

    /// Writes a sample of another host's, if it is one and the next or a later one.
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
            // A successor of the writer may send once more what its predecessor sent last.
            let again = |last: Stamp| {
                last.generation < stamp.generation && stamp == Stamp { generation: stamp.generation, ..last }
            };
            if incoming.last.replace(stamp).is_some_and(again) {
                return Ok(());
            }
            if let Some(kept) = &incoming.kept {
                let words = sample.chunks_exact(size_of::<u64>()).map(bytemuck::pod_read_unaligned);
                kept.keep(incoming.retained_samples, words);
                incoming.retained_samples += 1;
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
            // Only the host that launched keeps files, and of others only what these have to tell.
            Some(Content::File { name, bytes }) if self.plan.own == self.plan.hub && self.is_told(from, name) => {
                let path = self.domain.root().join(name);
                write(&path, bytes)?;
                if path == far_end_path(self.domain.root(), self.plan.name(from)) {
                    self.leave_to(from);
                }
                Ok(())
            }
            _ => {
                self.malformed += 1;
                Ok(())
            }
        }
    }

    /// Whether a host has to tell a file of this name.
    fn is_told(&self, from: u8, name: &str) -> bool {
        self.told_files(from).iter().any(|path| path.file_name().is_some_and(|told| told == name))
    }

    /// The files that a host has to tell, the one that says that it has ended last.
    fn told_files(&self, from: u8) -> Vec<PathBuf> {
        let (root, host) = (self.domain.root(), self.plan.name(from));
        let roles = self.plan.roles.iter().filter(|(_, host)| *host == from);
        let reports = roles.map(|(role, _)| report_path(root, role.name(self.scenario)));
        reports.chain([relay_report_path(root, host), far_end_path(root, host)]).collect()
    }

    /// A host has ended: its roles say no more.
    fn leave_to(&mut self, from: u8) {
        self.ended[usize::from(from)] = true;
        let roles = self.plan.roles.iter().zip(&mut self.health_out);
        roles.filter(|((_, host), _)| *host == from).for_each(|(_, health)| *health = None);
    }

    fn take_health(&mut self, from: u8, role: u16, sample: &[u8]) -> Result<(), RelayError> {
        let role = usize::from(role);
        let theirs = self.plan.roles.get(role).is_some_and(|(_, host)| *host == from);
        match (self.health_out.get_mut(role), bytemuck::try_pod_read_unaligned::<Health>(sample)) {
            (Some(Some(out)), Ok(health)) if theirs => out.send(|sample| *sample = health)?,
            // Of a host that has ended a last word may still come.
            (Some(None), Ok(_)) if theirs => {}
            _ => self.malformed += 1,
        }
        Ok(())
    }

    /// Puts what was sent here into the streams; whether there was anything.
    fn drain(&mut self) -> Result<bool, RelayError> {
        let mut busy = false;
        for tap in &mut self.taps {
            while let Some(words) = tap.reader.next()? {
                let content = Content::Sample { link: tap.link, sample: bytemuck::cast_slice(words) }.encode();
                for to in &tap.to {
                    self.streams[usize::from(*to)].0.push(content.clone());
                }
                tap.sent += 1;
                busy = true;
            }
        }
        Ok(busy)
    }

    /// Sends what streams have to send, and acknowledges what came.
    fn pump(&mut self, now_ns: u64) {
        let (post, from) = (&self.post, self.plan.own);
        for (host, (sender, receiver)) in self.streams.iter_mut().enumerate() {
            sender.poll(now_ns, |number, content| {
                let _ = post.send(host as u8, false, &Message { from, what: What::Frame { number, content } });
            });
            if let Some(next) = receiver.acknowledgement() {
                let _ = post.send(host as u8, true, &Message { from, what: What::Acknowledge { next } });
            }
        }
    }

    /// Tells the launcher's word, or how the roles are: at once if there is news, and again and again.
    fn tell(&mut self, now_ns: u64) -> Result<(), RelayError> {
        let mut news = now_ns >= self.next_word_ns;
        if let Some(word) = &mut self.word_in {
            while word.advance()? {}
            let said = word.current().copied().unwrap_or_default();
            let of = |word: &Schedule| (word.phase, word.epoch_ns, word.credit_tick);
            news |= of(&said) != of(&self.word);
            self.word = said;
            self.shared.begun.store(Phase::from_number(said.phase) > Phase::Gather, Ordering::Relaxed);
        }
        if !news {
            return Ok(());
        }
        self.next_word_ns = now_ns + WORD_NS;
        if self.word_in.is_some() {
            for host in self.plan.others() {
                self.send(host, true, What::Schedule { sample: bytemuck::bytes_of(&self.word) });
            }
        }
        for (_, health) in &mut self.health_in {
            while health.advance()? {}
        }
        for (role, health) in &self.health_in {
            if let Some(health) = health.current() {
                self.send(self.plan.hub, true, What::Health { role: *role, sample: bytemuck::bytes_of(health) });
            }
        }
        Ok(())
    }

    fn phase(&self) -> Phase {
        Phase::from_number(self.word.phase)
    }

    /// Notes hosts that are not heard while the ticks run.
    fn listen_for_silence(&mut self, now_ns: u64) {
        let grid = Grid { epoch_ns: self.word.epoch_ns, period_ns: self.scenario.period_ns };
        let realtime = self.scenario.clock == ClockKind::Realtime;
        let tick = if realtime { grid.tick_at(monotonic_ns()).min(self.scenario.last_tick) } else { 0 };
        for host in self.plan.others().filter(|host| self.plan.own == self.plan.hub || *host == self.plan.hub) {
            let index = usize::from(host);
            let heard_ns = self.shared.heard_ns[index].load(Ordering::Relaxed);
            let silent =
                now_ns.saturating_sub(heard_ns) > SILENT_NS && self.phase() == Phase::Run && !self.ended[index];
            if silent && self.silent[index].is_none() {
                self.silent[index] = Some((heard_ns, tick));
                tell(format_args!("corotate: nothing is heard of the host {}", self.plan.name(host)));
            }
        }
    }

    /// Notes hosts that joined and are not heard before any tick; such a part is free for another process.
    ///
    /// # Errors
    /// [`RelayError::Lost`] once one is not heard for as long as roles may take to come up.
    fn listen_for_lost(&mut self, parts: &Parts, now_ns: u64) -> Result<(), RelayError> {
        if self.shared.begun.load(Ordering::Relaxed) {
            return Ok(());
        }
        let limit_s = self.scenario.startup_timeout_s;
        let lost = parts.lost(now_ns, GONE_NS, &self.shared.heard_ns);
        for host in lost.iter().filter(|host| !self.lost.contains(host)) {
            tell(format_args!(
                "corotate: the host {host} joined and is not heard any more; waiting {limit_s} s for it, or for another `join`"
            ));
        }
        self.lost = lost;
        let host = parts.lost(now_ns, (limit_s * 1e9) as u64, &self.shared.heard_ns).into_iter().next();
        host.map_or(Ok(()), |host| Err(RelayError::Lost { host, limit_s }))
    }

    /// A host was heard.
    fn heard(&mut self, host: u8, at_ns: u64) {
        if let Some((since_ns, tick)) = self.silent[usize::from(host)].take() {
            let seconds = at_ns.saturating_sub(since_ns) as f64 / 1e9;
            let of = self.plan.name(host).to_owned();
            tell(format_args!("corotate: the host {of} is heard again after {seconds:.2} s"));
            self.silences.push(Silence { of, tick, seconds, healed: true });
        }
    }

    /// Whether all is told and this host can go.
    fn leaves(&mut self, since_ns: &mut Option<u64>, carriers: &Carriers, now_ns: u64) -> Result<bool, RelayError> {
        let (own, root) = (self.plan.own, self.domain.root());
        if own == self.plan.hub {
            if self.phase() < Phase::Stop {
                return Ok(false);
            }
            let since_ns = *since_ns.get_or_insert(now_ns);
            let waits = |host: u8| !self.ended[usize::from(host)] && !self.gives_up(host, since_ns, now_ns);
            return Ok(now_ns - since_ns > LINGER_NS && !self.plan.others().any(waits));
        }
        let end = far_end_path(root, self.plan.name(own));
        match *since_ns {
            None if end.exists() => {
                *since_ns = Some(now_ns);
                self.drain()?;
                let report =
                    serde_json::to_vec(&self.report(&carriers.sent())).expect("a report of plain values is JSON");
                write(&relay_report_path(root, self.plan.name(own)), &report)?;
                for path in self.told_files(own) {
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
                let told = self.streams[usize::from(self.plan.hub)].0.is_empty();
                Ok(told || self.gives_up(self.plan.hub, since_ns, now_ns))
            }
        }
    }

    /// Whether a host is not waited for any longer by one that leaves since `since_ns`.
    fn gives_up(&self, host: u8, since_ns: u64, now_ns: u64) -> bool {
        let heard_ns = self.shared.heard_ns[usize::from(host)].load(Ordering::Relaxed).max(since_ns);
        now_ns.saturating_sub(heard_ns) > LEAVE_NS || now_ns - since_ns > LEAVE_HEARD_NS
    }

    /// This host's account; `sent` is what went in a hurry, by link and host.
    fn report(&self, sent: &[(usize, u8, u64)]) -> HostReport {
        let plan = self.plan;
        let end = |link: usize, to: u8, lossless: bool| LinkEnd {
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
        let hurried = sent.iter().map(|(link, to, sent)| LinkEnd { sent: Some(*sent), ..end(*link, *to, false) });
        let streamed = self.taps.iter().flat_map(|tap| {
            let sent = |to: &u8| LinkEnd { sent: Some(tap.sent), ..end(usize::from(tap.link), *to, true) };
            tap.to.iter().map(sent).collect::<Vec<_>>()
        });
        let incoming = self.incoming.iter().enumerate().filter(|(_, incoming)| incoming.writer.is_some());
        let received = incoming.map(|(link, incoming)| LinkEnd {
            received: Some(incoming.received),
            lost: incoming.lost,
            stale: incoming.stale,
            one_way: (!incoming.one_way.is_empty()).then(|| incoming.one_way.percentiles()),
            ..end(link, plan.own, incoming.lossless)
        });
        let lasting = plan.others().filter_map(|host| {
            let (since_ns, tick) = self.silent[usize::from(host)]?;
            let seconds = raw_ns().saturating_sub(since_ns) as f64 / 1e9;
            Some(Silence { of: plan.name(host).to_owned(), tick, seconds, healed: false })
        });
        HostReport {
            host: plan.name(plan.own).to_owned(),
            launched: plan.own == plan.hub,
            clock: self.timing.as_ref().map(Timing::report),
            links: hurried.chain(streamed).chain(received).collect(),
            silences: self.silences.iter().cloned().chain(lasting).collect(),
            repeated_frames: self.streams.iter().map(|(sender, _)| sender.repeated()).sum(),
            refused_frames: self.streams.iter().map(|(sender, _)| sender.refused()).sum(),
            malformed: self.malformed,
        }
    }
}
