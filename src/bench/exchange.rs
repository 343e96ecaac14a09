//! The compared mechanisms of exchanging a sample between two processes, including this program's bus, behind one trait.
//!
//! Every mechanism carries the same words and is used as a plain, careful program would use it. Must not know the measurements.

use super::page::Page;
use super::session::BenchError;
use crate::bus::domain::Domain;
use crate::bus::iox::{IoxBus, IoxReader, IoxWriter};
use crate::bus::raw::{RawListener, RawNode, RawNotifier, RawPublisher, RawSubscriber};
use crate::bus::{Bus, Depths, Read, Reader, Signal, Topic, Write};
use crate::clock::{monotonic_ns, sleep_until};
use crate::sample::{Sample, sample};
use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::path::PathBuf;
use std::time::Duration;

/// The most words of a sample.
const MAX_WORDS: usize = 32;
/// Words of a sample's stamp.
const STAMP: usize = 4;
/// The generation of all samples.
const GENERATION: u64 = 1;
/// The sleep between two polls of a receiver that has spun for too long, ns.
const NAP_NS: u64 = 50_000;
/// The longest sleep before a receiver checks its timeout, ns.
const SLEEP_NS: u64 = 1_000_000_000;
/// Polls between two clock reads of a spinning receiver: a real-time process must not spin forever for a dead partner.
const POLLS: u32 = 1024;
/// The extra spin time of a receiver that never sleeps on a notifier, ns.
const PATIENCE_NS: u64 = 5_000_000;

/// The transport of a sample, with the notifier that wakes a sleeping receiver.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) enum Mechanism {
    /// This program's bus.
    Ours,
    /// iceoryx2 publish-subscribe, and its event.
    Iceoryx,
    /// A bare mailbox in shared memory, and a futex.
    SharedMemory,
    /// UDP over the loopback interface.
    Udp,
}

/// The way in which a receiver waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) enum Wake {
    /// Polls, from shortly before the sample is due.
    Spin,
    /// Sleeps until it is woken.
    Event,
    /// Polls for a while, then sleeps.
    Hybrid,
}

impl Wake {
    pub fn name(self) -> &'static str {
        match self {
            Self::Spin => "spin",
            Self::Event => "event",
            Self::Hybrid => "hybrid",
        }
    }
}

impl Mechanism {
    pub fn name(self, wake: Wake) -> &'static str {
        match (self, wake) {
            (Self::Ours, _) => "ours",
            (Self::Iceoryx, _) => "iceoryx2",
            (Self::SharedMemory, Wake::Spin) => "shared memory",
            (Self::SharedMemory, _) => "futex",
            (Self::Udp, _) => "UDP loopback",
        }
    }
}

/// The content of a sample. Its words are number, generation, due time and sent time, in the place of the stamp; all others repeat
/// the number, so that a torn sample is detected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Content {
    /// The number of the sample, from 1.
    pub number: u64,
    /// The due time, ns.
    pub due_ns: u64,
    /// The send time, ns.
    pub sent_ns: u64,
}

/// The end of an exchange to open.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub(super) struct Opening {
    pub mechanism: Mechanism,
    pub wake: Wake,
    pub words: usize,
    /// The name of the exchange in its domain.
    pub name: String,
    /// 0 from the sender, 1 back to it.
    pub direction: usize,
}

/// The sending end of an exchange.
pub(super) struct Sender {
    carry: Box<dyn Output>,
    words: usize,
}

/// The receiving end of an exchange.
pub(super) struct Receiver {
    carry: Box<dyn Input>,
    words: usize,
    wake: Wake,
    /// True if the receiver yields between two polls, because the sender needs its core.
    yields: bool,
}

trait Output {
    /// Sends these words.
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError>;
    /// Prepares the next send.
    fn prepare(&mut self) -> Result<(), BenchError> {
        Ok(())
    }
}

trait Input {
    /// Takes the next words, if any. A socket waits for them.
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError>;
    /// Connects directly to a new writer.
    fn refresh(&mut self) {}
    /// Sleeps until a notification, if the receiver was opened to sleep.
    fn sleep(&mut self, _until_ns: u64) -> Result<(), BenchError> {
        Ok(())
    }
}

/// A process that takes part in exchanges.
pub(super) struct Station<'a> {
    pub domain: &'a Domain,
    /// The suffix that makes the names of nodes unique.
    pub process: &'static str,
}

pub(super) fn system(what: &'static str, error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> BenchError {
    BenchError::System { what, source: std::io::Error::other(error) }
}

sample! {
    /// A sample of 64 bytes.
    Probe64 = "corotate/bench/probe-64/v1" {
        /// The number, again and again.
        words: [u64; 4],
    }
}

sample! {
    /// A sample of 128 bytes.
    Probe128 = "corotate/bench/probe-128/v1" {
        /// The number, again and again.
        words: [u64; 12],
    }
}

sample! {
    /// A sample of 256 bytes.
    Probe256 = "corotate/bench/probe-256/v1" {
        /// The number, again and again.
        words: [u64; 28],
    }
}

/// The bus of this program: the stamp holds the first words.
impl<S: Sample> Output for IoxWriter<S> {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        Write::send(self, |sample: &mut S| {
            bytemuck::bytes_of_mut(sample).copy_from_slice(bytemuck::cast_slice(words));
        })?;
        Ok(())
    }

    fn prepare(&mut self) -> Result<(), BenchError> {
        Ok(Write::prepare(self)?)
    }
}

impl<S: Sample> Input for IoxReader<S> {
    #[inline]
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError> {
        let there = self.advance()?;
        if let (true, Some(sample)) = (there, self.current()) {
            words.copy_from_slice(bytemuck::cast_slice(bytemuck::bytes_of(sample)));
        }
        Ok(there)
    }

    fn refresh(&mut self) {
        Read::refresh(self);
    }

    fn sleep(&mut self, until_ns: u64) -> Result<(), BenchError> {
        Ok(Read::sleep(self, until_ns)?)
    }
}

/// A bare end of publish-subscribe, with that of the event that wakes a sleeper.
struct Iceoryx<End, Event>(End, Option<Event>);

impl<const WORDS: usize> Output for Iceoryx<RawPublisher<WORDS>, RawNotifier> {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        self.0.send(words)?;
        Ok(self.1.as_ref().map_or(Ok(()), RawNotifier::notify)?)
    }
}

impl<const WORDS: usize> Input for Iceoryx<RawSubscriber<WORDS>, RawListener> {
    #[inline]
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError> {
        let there = self.0.receive(|sample| words.copy_from_slice(sample))?;
        Ok(there.is_some())
    }

    fn sleep(&mut self, _until_ns: u64) -> Result<(), BenchError> {
        Ok(self.1.as_ref().map_or(Ok(()), |listener| listener.wait(Duration::from_nanos(SLEEP_NS)))?)
    }
}

/// A mailbox of a page.
struct Mailbox {
    page: Page,
    direction: usize,
    /// True if a futex wakes the receiver.
    wakes: bool,
    /// The number of the last words received.
    last: u64,
    /// The number of notifications before the last read of the mailbox.
    notified: u32,
}

impl Output for Mailbox {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        self.page.put(self.direction, words);
        if self.wakes {
            self.page.notify(self.direction).map_err(|error| system("wake", error))?;
        }
        Ok(())
    }
}

impl Input for Mailbox {
    #[inline]
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError> {
        if self.wakes {
            self.notified = self.page.notified(self.direction);
        }
        let there = self.page.take(self.direction, self.last, words);
        if there {
            self.last = words[0];
        }
        Ok(there)
    }

    fn sleep(&mut self, _until_ns: u64) -> Result<(), BenchError> {
        if self.wakes {
            self.page.wait(self.direction, self.notified);
        }
        Ok(())
    }
}

impl Output for UdpSocket {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        let sent = UdpSocket::send(self, bytemuck::cast_slice(words)).map_err(|error| system("send", error))?;
        if sent == size_of_val(words) { Ok(()) } else { Err(system("send", "only a part was taken")) }
    }
}

impl Input for UdpSocket {
    #[inline]
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError> {
        match self.recv(bytemuck::cast_slice_mut(words)) {
            Ok(received) if received == size_of_val(words) => Ok(true),
            Ok(_) => Err(system("receive", "a part of a sample")),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(false),
            Err(error) => Err(system("receive", error)),
        }
    }
}

/// Runs an expression with the number of words as a constant.
macro_rules! of_size {
    ($words:expr, $size:ident => $body:expr) => {
        match $words {
            8 => {
                const $size: usize = 8;
                $body
            }
            16 => {
                const $size: usize = 16;
                $body
            }
            _ => {
                const $size: usize = MAX_WORDS;
                $body
            }
        }
    };
}

impl Station<'_> {
    fn raw(&self, opening: &Opening) -> Result<RawNode, BenchError> {
        Ok(RawNode::enter(self.domain, &format!("{}-{}", opening.name, self.process))?)
    }

    fn ours(&self, opening: &Opening) -> Result<(IoxBus, Topic), BenchError> {
        let depths = Depths { role: 1, scorer: 64, history: 0 };
        let bus = IoxBus::enter(self.domain, &format!("{}-{}", opening.name, self.process), depths)?;
        let body = format!("{}-{}", opening.name, opening.direction);
        Ok((bus, Topic { scenario: "bench".to_owned(), body, signal: Signal::Measurement }))
    }

    fn mailbox(&self, opening: &Opening) -> Result<Mailbox, BenchError> {
        let path = self.domain.shared(&format!("{}.page", opening.name));
        let page = Page::open(&path).map_err(|error| system("map shared memory", error))?;
        Ok(Mailbox { page, direction: opening.direction, wakes: opening.wake != Wake::Spin, last: 0, notified: 0 })
    }

    /// Returns the file in which a receiver writes its port.
    fn port(&self, opening: &Opening) -> PathBuf {
        self.domain.shared(&format!("{}.port{}", opening.name, opening.direction))
    }

    /// Opens a sending end; over UDP the receiving end must be open.
    pub fn sender(&self, opening: &Opening) -> Result<Sender, BenchError> {
        let words = opening.words;
        let service = format!("bench/{}/{}", opening.name, opening.direction);
        let carry: Box<dyn Output> = match opening.mechanism {
            Mechanism::Ours => {
                let (bus, topic) = self.ours(opening)?;
                match words {
                    8 => Box::new(bus.writer::<Probe64>(&topic, GENERATION)?),
                    16 => Box::new(bus.writer::<Probe128>(&topic, GENERATION)?),
                    _ => Box::new(bus.writer::<Probe256>(&topic, GENERATION)?),
                }
            }
            Mechanism::Iceoryx => {
                let node = self.raw(opening)?;
                let notifier = (opening.wake != Wake::Spin).then(|| node.notifier(&service)).transpose()?;
                of_size!(words, SIZE => Box::new(Iceoryx(node.publisher::<SIZE>(&service)?, notifier)))
            }
            Mechanism::SharedMemory => Box::new(self.mailbox(opening)?),
            Mechanism::Udp => {
                let connect = || {
                    let port = std::fs::read_to_string(self.port(opening))?;
                    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
                    socket.connect((Ipv4Addr::LOCALHOST, port.parse().map_err(io::Error::other)?))?;
                    Ok(socket)
                };
                Box::new(connect().map_err(BenchError::system("connect a socket"))?)
            }
        };
        Ok(Sender { carry, words })
    }

    /// Opens a receiving end.
    pub fn receiver(&self, opening: &Opening) -> Result<Receiver, BenchError> {
        let (words, wake) = (opening.words, opening.wake);
        let service = format!("bench/{}/{}", opening.name, opening.direction);
        let carry: Box<dyn Input> = match opening.mechanism {
            Mechanism::Ours => {
                let (bus, topic) = self.ours(opening)?;
                match words {
                    8 => Box::new(bus.reader::<Probe64>(&topic, Reader::Role)?),
                    16 => Box::new(bus.reader::<Probe128>(&topic, Reader::Role)?),
                    _ => Box::new(bus.reader::<Probe256>(&topic, Reader::Role)?),
                }
            }
            Mechanism::Iceoryx => {
                let node = self.raw(opening)?;
                let listener = (wake != Wake::Spin).then(|| node.listener(&service)).transpose()?;
                of_size!(words, SIZE => Box::new(Iceoryx(node.subscriber::<SIZE>(&service)?, listener)))
            }
            Mechanism::SharedMemory => Box::new(self.mailbox(opening)?),
            Mechanism::Udp => {
                let bind = || {
                    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
                    socket.set_read_timeout(Some(Duration::from_nanos(SLEEP_NS)))?;
                    std::fs::write(self.port(opening), socket.local_addr()?.port().to_string())?;
                    Ok(socket)
                };
                Box::new(bind().map_err(BenchError::system("open a socket"))?)
            }
        };
        Ok(Receiver { carry, words, wake, yields: false })
    }
}

impl Sender {
    /// Sends a sample with its send time, and wakes a sleeping receiver.
    #[inline]
    pub fn send(&mut self, number: u64, due_ns: u64) -> Result<(), BenchError> {
        let mut words = [number; MAX_WORDS];
        (words[1], words[2], words[3]) = (GENERATION, due_ns, monotonic_ns());
        self.carry.send(&words[..self.words])
    }

    /// Prepares the next sample, off the critical path.
    pub fn prepare(&mut self) -> Result<(), BenchError> {
        self.carry.prepare()
    }
}

impl Receiver {
    /// Connects directly to a new sender, off the critical path.
    pub fn refresh(&mut self) {
        self.carry.refresh();
    }

    /// Makes it yield, between two polls, to threads of the same priority on the same core.
    pub fn enable_yield(&mut self) {
        self.yields = true;
    }

    /// Returns the way in which it waits.
    pub fn wake(&self) -> Wake {
        self.wake
    }

    /// Waits for the next sample: polls until `spin_end_ns`, then continues by its [`Wake`]. Returns `None` without one by `end_ns`.
    ///
    /// # Errors
    /// [`BenchError`]; also if a sample is torn.
    #[inline]
    pub fn receive(&mut self, spin_end_ns: u64, end_ns: u64) -> Result<Option<Content>, BenchError> {
        let mut words = [0; MAX_WORDS];
        let words = &mut words[..self.words];
        let mut polls = 0_u32;
        loop {
            if self.carry.receive(words)? {
                let whole = words[STAMP..].iter().all(|word| *word == words[0]);
                let content = Content { number: words[0], due_ns: words[2], sent_ns: words[3] };
                return if whole { Ok(Some(content)) } else { Err(system("receive", "a sample is torn")) };
            }
            polls += 1;
            let spins = match self.wake {
                Wake::Spin => !polls.is_multiple_of(POLLS) || monotonic_ns() < spin_end_ns + PATIENCE_NS,
                Wake::Event => false,
                Wake::Hybrid => monotonic_ns() < spin_end_ns,
            };
            if spins && self.yields {
                std::thread::yield_now();
            } else if spins {
                std::hint::spin_loop();
            } else if monotonic_ns() > end_ns {
                return Ok(None);
            } else {
                match self.wake {
                    Wake::Spin => sleep_until(monotonic_ns() + NAP_NS),
                    Wake::Event | Wake::Hybrid => self.carry.sleep(monotonic_ns() + SLEEP_NS)?,
                }
            }
        }
    }
}
