//! The ways in which two processes can exchange a sample, ours among them, behind one trait: what the hop row compares.
//!
//! Every way carries the same words and is used as a plain, careful program would use it. Must not know what is measured.

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
/// Words of a sample that are its stamp.
const STAMP: usize = 4;
/// The generation of all samples.
const GENERATION: u64 = 1;
/// How long one who spun for too long sleeps between two looks, ns.
const NAP_NS: u64 = 50_000;
/// How long a sleeper sleeps at most before it looks whether it is to give up, ns.
const SLEEP_NS: u64 = 1_000_000_000;
/// How often one who spins looks at the clock: a partner that is gone must not leave a real-time process spinning.
const POLLS: u32 = 1024;
/// How long after the end of its spin one who only spins goes on, ns.
const PATIENCE_NS: u64 = 5_000_000;

/// How a sample is carried, and what wakes a receiver that sleeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) enum Mechanism {
    /// Our bus.
    Ours,
    /// iceoryx2 publish-subscribe, and its event.
    Iceoryx,
    /// A bare mailbox in shared memory, and a futex.
    SharedMemory,
    /// UDP over the loopback interface.
    Udp,
}

/// How a receiver waits.
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

/// What a sample says, where our samples have their stamp: number, generation, when due, when sent. The other words repeat
/// the number, so that a torn one is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Content {
    /// From 1.
    pub number: u64,
    /// When it was due, ns.
    pub due_ns: u64,
    /// When it was sent, ns.
    pub sent_ns: u64,
}

/// Which end of which exchange to open.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub(super) struct Opening {
    pub mechanism: Mechanism,
    pub wake: Wake,
    pub words: usize,
    /// Names the exchange in its domain.
    pub name: String,
    /// 0 from the sender, 1 back to it.
    pub direction: usize,
}

/// One end that sends.
pub(super) struct Sender {
    carry: Box<dyn Out>,
    words: usize,
}

/// One end that receives.
pub(super) struct Receiver {
    carry: Box<dyn In>,
    words: usize,
    wake: Wake,
    /// Whether the sender needs the core on which this one polls.
    gives_way: bool,
}

trait Out {
    /// Sends these words.
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError>;
    /// Gets ready for the next.
    fn prepare(&mut self) -> Result<(), BenchError> {
        Ok(())
    }
}

trait In {
    /// Takes the next words, if they are there. A socket waits for them.
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError>;
    /// Finds the shortest way to a writer that has come.
    fn refresh(&mut self) {}
    /// Sleeps until it is notified, where the receiver is opened to sleep.
    fn sleep(&mut self, _until_ns: u64) -> Result<(), BenchError> {
        Ok(())
    }
}

/// The node or bus of a process, one per exchange.
pub(super) struct Station<'a> {
    pub domain: &'a Domain,
    /// Makes the names of nodes differ.
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

/// Ours: the stamp has the first words.
impl<S: Sample> Out for IoxWriter<S> {
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

impl<S: Sample> In for IoxReader<S> {
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

/// A bare end of publish-subscribe, and of the event that wakes a sleeper.
struct Iceoryx<End, Event>(End, Option<Event>);

impl<const WORDS: usize> Out for Iceoryx<RawPublisher<WORDS>, RawNotifier> {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        self.0.send(words)?;
        Ok(self.1.as_ref().map_or(Ok(()), RawNotifier::notify)?)
    }
}

impl<const WORDS: usize> In for Iceoryx<RawSubscriber<WORDS>, RawListener> {
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
    /// The count of notifications before the mailbox was last looked into.
    notified: u32,
}

impl Out for Mailbox {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        self.page.put(self.direction, words);
        if self.wakes {
            self.page.notify(self.direction).map_err(|error| system("wake", error))?;
        }
        Ok(())
    }
}

impl In for Mailbox {
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

impl Out for UdpSocket {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        let sent = UdpSocket::send(self, bytemuck::cast_slice(words)).map_err(|error| system("send", error))?;
        if sent == size_of_val(words) { Ok(()) } else { Err(system("send", "only a part was taken")) }
    }
}

impl In for UdpSocket {
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

    /// The file in which a receiver leaves its port.
    fn port(&self, opening: &Opening) -> PathBuf {
        self.domain.shared(&format!("{}.port{}", opening.name, opening.direction))
    }

    /// Opens an end that sends; over UDP the end that receives must be open.
    pub fn sender(&self, opening: &Opening) -> Result<Sender, BenchError> {
        let words = opening.words;
        let service = format!("bench/{}/{}", opening.name, opening.direction);
        let carry: Box<dyn Out> = match opening.mechanism {
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

    /// Opens an end that receives.
    pub fn receiver(&self, opening: &Opening) -> Result<Receiver, BenchError> {
        let (words, wake) = (opening.words, opening.wake);
        let service = format!("bench/{}/{}", opening.name, opening.direction);
        let carry: Box<dyn In> = match opening.mechanism {
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
        Ok(Receiver { carry, words, wake, gives_way: false })
    }
}

impl Sender {
    /// Sends a sample and wakes whoever sleeps; what was sent when is in it.
    #[inline]
    pub fn send(&mut self, number: u64, due_ns: u64) -> Result<(), BenchError> {
        let mut words = [number; MAX_WORDS];
        (words[1], words[2], words[3]) = (GENERATION, due_ns, monotonic_ns());
        self.carry.send(&words[..self.words])
    }

    /// Gets ready for the next sample, off the critical path.
    pub fn prepare(&mut self) -> Result<(), BenchError> {
        self.carry.prepare()
    }
}

impl Receiver {
    /// Finds the shortest way to a sender that has come, off the critical path.
    pub fn refresh(&mut self) {
        self.carry.refresh();
    }

    /// Gives way to others of the same priority on the same core while it polls.
    pub fn give_way(&mut self) {
        self.gives_way = true;
    }

    /// How it waits.
    pub fn wake(&self) -> Wake {
        self.wake
    }

    /// Waits for the next sample: polls until `spin_end_ns`, then as it does. `None` if there is none by `end_ns`.
    ///
    /// # Errors
    /// [`BenchError`]; also if a sample is torn.
    #[inline]
    pub fn receive(&mut self, spin_end_ns: u64, end_ns: u64) -> Result<Option<Content>, BenchError> {
        let mut words = [0; MAX_WORDS];
        let words = &mut words[..self.words];
        let mut polled = 0_u32;
        loop {
            if self.carry.receive(words)? {
                let whole = words[STAMP..].iter().all(|word| *word == words[0]);
                let content = Content { number: words[0], due_ns: words[2], sent_ns: words[3] };
                return if whole { Ok(Some(content)) } else { Err(system("receive", "a sample is torn")) };
            }
            polled += 1;
            let polls = match self.wake {
                Wake::Spin => !polled.is_multiple_of(POLLS) || monotonic_ns() < spin_end_ns + PATIENCE_NS,
                Wake::Event => false,
                Wake::Hybrid => monotonic_ns() < spin_end_ns,
            };
            if polls && self.gives_way {
                std::thread::yield_now();
            } else if polls {
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
