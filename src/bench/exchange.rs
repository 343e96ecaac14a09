//! The ways in which two processes can exchange a sample, ours among them, behind one trait: what the hop row compares.
//!
//! Every way carries the same words and is used as a plain, careful program would use it. Must not know what is measured.

use super::page::Page;
use super::session::BenchError;
use crate::bus::domain::Domain;
use crate::bus::iox::{IoxBus, IoxReader, IoxWriter};
use crate::bus::raw::{RawBoardReader, RawBoardWriter, RawListener, RawNode, RawNotifier, RawPublisher, RawSubscriber};
use crate::bus::{Bus, Depths, Read, Reader, Signal, Topic, Write};
use crate::clock::{monotonic_ns, sleep_until};
use crate::sample::{Sample, sample};
use rustix::fd::OwnedFd;
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
    /// iceoryx2's blackboard.
    Blackboard,
    /// A bare mailbox in shared memory, and a futex.
    SharedMemory,
    /// The same mailbox, and an eventfd.
    EventFd,
    /// A pipe.
    Pipe,
    /// A Unix datagram socket.
    UnixSocket,
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
            (Self::Blackboard, _) => "iceoryx2 blackboard",
            (Self::SharedMemory, Wake::Spin) => "shared memory",
            (Self::SharedMemory, _) => "futex",
            (Self::EventFd, _) => "eventfd",
            (Self::Pipe, _) => "pipe",
            (Self::UnixSocket, _) => "Unix socket",
            (Self::Udp, _) => "UDP loopback",
        }
    }

    /// Whether it needs descriptors that both ends share.
    pub fn descriptors(self) -> bool {
        matches!(self, Self::EventFd | Self::Pipe | Self::UnixSocket | Self::Udp)
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
    /// The descriptor to read from and to write to, where the mechanism needs some.
    pub descriptors: Option<[i32; 2]>,
}

/// One end that sends.
pub(super) struct Sender {
    carry: Box<dyn Out>,
    notifier: Notification,
    words: usize,
}

/// One end that receives.
pub(super) struct Receiver {
    carry: Box<dyn In>,
    notifier: Notification,
    words: usize,
    wake: Wake,
    /// Whether the sender needs the core on which this one polls.
    gives_way: bool,
}

/// What wakes a sleeper.
enum Notification {
    /// Nobody sleeps, or what carries the sample wakes too.
    None,
    /// That of our links.
    Ours,
    Futex(Page, usize),
    EventFd(OwnedFd),
    Notifier(RawNotifier),
    Listener(RawListener),
}

trait Out {
    /// Sends these words.
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError>;
    /// Gets ready for the next.
    fn prepare(&mut self) -> Result<(), BenchError> {
        Ok(())
    }
    /// Tells readers that came late of this end.
    fn refresh(&mut self) -> Result<(), BenchError> {
        Ok(())
    }
}

trait In {
    /// Takes the next words, if they are there. What blocks by itself waits for them.
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError>;
    /// Finds the shortest way to a writer that has come.
    fn refresh(&mut self) {}
    /// Sleeps until there may be some, if it knows how to.
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

    fn refresh(&mut self) -> Result<(), BenchError> {
        Ok(Write::refresh(self)?)
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

impl<const WORDS: usize> Out for RawPublisher<WORDS> {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        Ok(RawPublisher::send(self, words)?)
    }
}

impl<const WORDS: usize> In for RawSubscriber<WORDS> {
    #[inline]
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError> {
        let there = RawSubscriber::receive(self, |sample| words.copy_from_slice(sample))?;
        Ok(there.is_some())
    }
}

impl<const WORDS: usize> Out for RawBoardWriter<WORDS> {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        RawBoardWriter::send(self, words);
        Ok(())
    }
}

/// A blackboard with the number of the last value seen.
struct Newest<const WORDS: usize>(RawBoardReader<WORDS>, u64);

impl<const WORDS: usize> In for Newest<WORDS> {
    #[inline]
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError> {
        let value = self.0.get();
        let there = value[0] != self.1;
        self.1 = value[0];
        words.copy_from_slice(&value);
        Ok(there)
    }
}

/// A mailbox of a page, with the number of the last words seen.
struct Mailbox(Page, usize, u64);

impl Out for Mailbox {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        self.0.put(self.1, words);
        Ok(())
    }
}

impl In for Mailbox {
    #[inline]
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError> {
        let there = self.0.take(self.1, self.2, words);
        if there {
            self.2 = words[0];
        }
        Ok(there)
    }
}

/// What the kernel carries, and wakes for.
struct Descriptor(OwnedFd);

impl Out for Descriptor {
    #[inline]
    fn send(&mut self, words: &[u64]) -> Result<(), BenchError> {
        let bytes: &[u8] = bytemuck::cast_slice(words);
        let sent = rustix::io::write(&self.0, bytes).map_err(|error| system("write", error))?;
        if sent == bytes.len() { Ok(()) } else { Err(system("write", "only a part was taken")) }
    }
}

impl In for Descriptor {
    #[inline]
    fn receive(&mut self, words: &mut [u64]) -> Result<bool, BenchError> {
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(words);
        let received = rustix::io::read(&self.0, &mut *bytes).map_err(|error| system("read", error))?;
        if received == bytes.len() { Ok(true) } else { Err(system("read", "the other end is gone")) }
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

    fn page(&self, opening: &Opening) -> Result<Page, BenchError> {
        let path = self.domain.shared(&format!("{}.page", opening.name));
        Page::open(&path).map_err(|error| system("map shared memory", error))
    }

    /// Opens an end that sends.
    pub fn sender(&self, opening: &Opening, descriptor: Option<OwnedFd>) -> Result<Sender, BenchError> {
        let (words, direction) = (opening.words, opening.direction);
        let service = format!("bench/{}/{direction}", opening.name);
        let sleeps = opening.wake != Wake::Spin;
        let mut notifier = Notification::None;
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
                if sleeps {
                    notifier = Notification::Notifier(node.notifier(&service)?);
                }
                of_size!(words, SIZE => Box::new(node.publisher::<SIZE>(&service)?))
            }
            Mechanism::Blackboard => {
                of_size!(words, SIZE => Box::new(self.raw(opening)?.board_writer::<SIZE>(&service)?))
            }
            Mechanism::SharedMemory => {
                if sleeps {
                    notifier = Notification::Futex(self.page(opening)?, direction);
                }
                Box::new(Mailbox(self.page(opening)?, direction, 0))
            }
            Mechanism::EventFd => {
                notifier = descriptor.map_or(Notification::None, Notification::EventFd);
                Box::new(Mailbox(self.page(opening)?, direction, 0))
            }
            Mechanism::Pipe | Mechanism::UnixSocket | Mechanism::Udp => {
                Box::new(Descriptor(descriptor.ok_or_else(|| system("open a descriptor", "none was given"))?))
            }
        };
        Ok(Sender { carry, notifier, words })
    }

    /// Opens an end that receives.
    pub fn receiver(&self, opening: &Opening, descriptor: Option<OwnedFd>) -> Result<Receiver, BenchError> {
        let (words, direction, wake) = (opening.words, opening.direction, opening.wake);
        let service = format!("bench/{}/{direction}", opening.name);
        let sleeps = wake != Wake::Spin;
        let mut notifier = Notification::None;
        let carry: Box<dyn In> = match opening.mechanism {
            Mechanism::Ours => {
                let (bus, topic) = self.ours(opening)?;
                if sleeps {
                    notifier = Notification::Ours;
                }
                match words {
                    8 => Box::new(bus.reader::<Probe64>(&topic, Reader::Role)?),
                    16 => Box::new(bus.reader::<Probe128>(&topic, Reader::Role)?),
                    _ => Box::new(bus.reader::<Probe256>(&topic, Reader::Role)?),
                }
            }
            Mechanism::Iceoryx => {
                let node = self.raw(opening)?;
                if sleeps {
                    notifier = Notification::Listener(node.listener(&service)?);
                }
                of_size!(words, SIZE => Box::new(node.subscriber::<SIZE>(&service)?))
            }
            Mechanism::Blackboard => {
                of_size!(words, SIZE => Box::new(Newest(self.raw(opening)?.board_reader::<SIZE>(&service)?, 0)))
            }
            Mechanism::SharedMemory => {
                if sleeps {
                    notifier = Notification::Futex(self.page(opening)?, direction);
                }
                Box::new(Mailbox(self.page(opening)?, direction, 0))
            }
            Mechanism::EventFd => {
                notifier = descriptor.map_or(Notification::None, Notification::EventFd);
                Box::new(Mailbox(self.page(opening)?, direction, 0))
            }
            Mechanism::Pipe | Mechanism::UnixSocket | Mechanism::Udp => {
                Box::new(Descriptor(descriptor.ok_or_else(|| system("open a descriptor", "none was given"))?))
            }
        };
        Ok(Receiver { carry, notifier, words, wake, gives_way: false })
    }
}

impl Sender {
    /// Sends a sample and wakes whoever sleeps; what was sent when is in it.
    #[inline]
    pub fn send(&mut self, number: u64, due_ns: u64) -> Result<(), BenchError> {
        let mut words = [number; MAX_WORDS];
        (words[1], words[2], words[3]) = (GENERATION, due_ns, monotonic_ns());
        self.carry.send(&words[..self.words])?;
        match &self.notifier {
            Notification::Futex(page, direction) => page.notify(*direction).map_err(|error| system("wake", error)),
            Notification::EventFd(fd) => {
                rustix::io::write(fd, &1_u64.to_ne_bytes()).map(|_| ()).map_err(|e| system("wake", e))
            }
            Notification::Notifier(notifier) => Ok(notifier.notify()?),
            Notification::None | Notification::Ours | Notification::Listener(_) => Ok(()),
        }
    }

    /// Gets ready for the next sample, off the critical path.
    pub fn prepare(&mut self) -> Result<(), BenchError> {
        self.carry.prepare()
    }

    /// Tells readers that came late of this end.
    pub fn refresh(&mut self) -> Result<(), BenchError> {
        self.carry.refresh()
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
            let notified = match &self.notifier {
                Notification::Futex(page, direction) => page.notified(*direction),
                _ => 0,
            };
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
                self.sleep(notified)?;
            }
        }
    }

    fn sleep(&mut self, notified: u32) -> Result<(), BenchError> {
        match &self.notifier {
            Notification::Futex(page, direction) => page.wait(*direction, notified),
            Notification::EventFd(fd) => {
                rustix::io::read(fd, &mut [0; 8]).map_err(|error| system("wait", error))?;
            }
            Notification::Listener(listener) => listener.wait(Duration::from_nanos(SLEEP_NS))?,
            Notification::Ours => self.carry.sleep(monotonic_ns() + SLEEP_NS)?,
            // What carries the sample blocks by itself, or the partner keeps a spinner waiting for too long.
            Notification::None | Notification::Notifier(_) if self.wake == Wake::Spin => {
                sleep_until(monotonic_ns() + NAP_NS)
            }
            Notification::None | Notification::Notifier(_) => {}
        }
        Ok(())
    }
}
