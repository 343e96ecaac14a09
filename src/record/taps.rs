//! Takes every sample of a run off a bus, the truth included, and passes it on as the message of its channel.
//!
//! Warm-up samples apart, whatever was sent is passed on, as it was: second, late and broken samples too. Must not judge, nor
//! know what becomes of a message.

use super::RecordError;
use super::layout::Layout;
use crate::bus::{Bus, BusError, Carried, Read, Reader, Topic};
use crate::clock::{Grid, monotonic_ns};
use crate::config::{ClockKind, Scenario};
use crate::runtime::{RoleId, Visit, visit_writes};
use crate::sample::{FleetLayout, FleetSample, Sample, Stamp, VOID};
use std::collections::BTreeMap;

/// The most gaps that are told one by one.
const GAPS_TOLD: usize = 1000;

/// The number of a channel.
pub type Channel = u16;

/// Where messages go.
pub trait MessageSink {
    /// Announces a signal. `about` is told of it besides.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    fn channel(
        &mut self,
        service: &str,
        layout: &Layout,
        about: BTreeMap<String, String>,
    ) -> Result<Channel, RecordError>;

    /// Takes one sample as it is. Times are ns.
    ///
    /// # Errors
    /// [`RecordError::Full`] if there is no room for it. [`RecordError::Write`].
    fn message(
        &mut self,
        channel: Channel,
        sequence: u32,
        due_ns: u64,
        received_ns: u64,
        body: &[u8],
    ) -> Result<(), RecordError>;
}

/// What has come of one signal.
#[derive(Default)]
pub struct Book {
    /// The tick behind the last one of which something has come.
    pub next: u64,
    begun: bool,
    /// Ticks of which there is a sample.
    pub recorded: u64,
    /// Ticks of which there is a void.
    pub void: u64,
    /// Samples beside the one of their tick.
    pub extra: u64,
    /// Ticks, first and last, of which there is nothing.
    pub gaps: Vec<[u64; 2]>,
    /// Gaps beyond those told.
    pub more_gaps: u64,
}

impl Book {
    /// Enters a sample; `due` is the last tick that it can be of.
    fn enter(&mut self, stamp: &Stamp, due: u64) {
        if stamp.tick < self.next || stamp.tick > due {
            self.extra += 1;
            return;
        }
        self.gap_to(stamp.tick);
        *(if stamp.generation & VOID == 0 { &mut self.recorded } else { &mut self.void }) += 1;
        (self.next, self.begun) = (stamp.tick + 1, true);
    }

    fn gap_to(&mut self, tick: u64) {
        if tick > self.next {
            if self.gaps.len() < GAPS_TOLD {
                self.gaps.push([self.next, tick - 1]);
            } else {
                self.more_gaps += 1;
            }
        }
    }
}

/// What a tap needs to pass on what it takes.
struct Desk<'a> {
    sink: &'a mut dyn MessageSink,
    grid: Grid,
    last_tick: u64,
    realtime: bool,
}

/// One signal.
trait Tap {
    /// Passes on whatever has come; returns how many samples.
    fn drain(&mut self, desk: &mut Desk<'_>) -> Result<u64, RecordError>;
    fn announce(&mut self, sink: &mut dyn MessageSink) -> Result<(), RecordError>;
    fn book(&mut self) -> &mut Book;
    fn service(&self) -> String;
}

struct SignalTap<B: Bus, S: Carried + ?Sized> {
    topic: Topic,
    role: String,
    reader: S::Reader<B>,
    bodies: usize,
    channel: Channel,
    book: Book,
}

impl<B: Bus, S: Carried + ?Sized> Tap for SignalTap<B, S> {
    fn drain(&mut self, desk: &mut Desk<'_>) -> Result<u64, RecordError> {
        let mut taken = 0;
        while self.reader.advance()? {
            let Some(sample) = self.reader.current() else { break };
            let stamp = *sample.stamp();
            if stamp.generation == 0 && !self.book.begun {
                continue;
            }
            let now_ns = monotonic_ns();
            let due = match (desk.realtime, self.book.begun) {
                (true, _) => desk.grid.tick_at(now_ns).min(desk.last_tick),
                // Where nothing is lost, a sample is of the next tick or of none.
                (false, true) => self.book.next,
                (false, false) => desk.last_tick,
            };
            let due_ns = if stamp.tick <= desk.last_tick { desk.grid.due_ns(stamp.tick) } else { now_ns };
            let body = bytemuck::cast_slice(sample.words());
            desk.sink.message(self.channel, stamp.tick as u32, due_ns, now_ns, body)?;
            self.book.enter(&stamp, due);
            taken += 1;
        }
        Ok(taken)
    }

    fn announce(&mut self, sink: &mut dyn MessageSink) -> Result<(), RecordError> {
        let about = [
            ("service", self.topic.to_string()),
            ("type_name", S::type_name().to_owned()),
            ("role", self.role.clone()),
            ("body", self.topic.body.clone()),
            ("signal", self.topic.signal.name().to_owned()),
        ];
        let about = about.map(|(key, value)| (key.to_owned(), value)).into();
        self.channel = sink.channel(&self.service(), &Layout::of(S::type_name(), &S::fields(self.bodies)), about)?;
        Ok(())
    }

    fn book(&mut self) -> &mut Book {
        &mut self.book
    }

    fn service(&self) -> String {
        self.topic.to_string()
    }
}

/// Opens the signals of one role.
struct Open<'a, B> {
    bus: &'a B,
    role: &'a str,
}

impl<B: Bus + 'static> Open<'_, B> {
    fn tap<S: Carried + ?Sized>(&self, topic: Topic, bodies: usize) -> Result<Box<dyn Tap>, BusError> {
        let reader = S::reader(self.bus, &topic, Reader::Scorer, bodies)?;
        let role = self.role.to_owned();
        Ok(Box::new(SignalTap::<B, S> { topic, role, reader, bodies, channel: 0, book: Book::default() }))
    }
}

impl<B: Bus + 'static> Visit for Open<'_, B> {
    type Made = Result<Box<dyn Tap>, BusError>;

    fn visit<S: Sample>(&mut self, topic: Topic) -> Self::Made {
        self.tap::<S>(topic, 1)
    }

    fn visit_fleet<L: FleetLayout>(&mut self, topic: Topic, bodies: usize) -> Self::Made {
        self.tap::<FleetSample<L>>(topic, bodies)
    }
}

/// Every signal of a run.
pub struct Taps {
    taps: Vec<Box<dyn Tap>>,
    grid: Grid,
    last_tick: u64,
    realtime: bool,
}

impl Taps {
    /// Opens every signal of a scenario on its bus.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open<B: Bus + 'static>(scenario: &Scenario, bus: &B) -> Result<Self, BusError> {
        let mut taps = Vec::new();
        for role in RoleId::all(scenario) {
            let made = visit_writes(scenario, role, &mut Open { bus, role: role.name(scenario) });
            taps.extend(made.into_iter().collect::<Result<Vec<_>, _>>()?);
        }
        Ok(Self {
            taps,
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            last_tick: scenario.last_tick,
            realtime: scenario.clock == ClockKind::Realtime,
        })
    }

    /// Sets the epoch of the ticks, once it is known: 0 where there is no time.
    pub fn start(&mut self, epoch_ns: u64) {
        self.grid.epoch_ns = epoch_ns;
    }

    /// Announces every signal.
    ///
    /// # Errors
    /// The sink's.
    pub fn announce(&mut self, sink: &mut dyn MessageSink) -> Result<(), RecordError> {
        self.taps.iter_mut().try_for_each(|tap| tap.announce(sink))
    }

    /// Passes on whatever has come; returns how many samples.
    ///
    /// # Errors
    /// [`RecordError::Bus`], and the sink's.
    pub fn drain(&mut self, sink: &mut dyn MessageSink) -> Result<u64, RecordError> {
        let Self { taps, grid, last_tick, realtime } = self;
        let mut desk = Desk { sink, grid: *grid, last_tick: *last_tick, realtime: *realtime };
        let mut taken = 0;
        for tap in taps {
            taken += tap.drain(&mut desk)?;
        }
        Ok(taken)
    }

    /// The tick of which not every signal is here yet.
    pub fn next_tick(&mut self) -> u64 {
        self.taps.iter_mut().map(|tap| tap.book().next).min().unwrap_or(0)
    }

    /// Closes every signal; gives services and what came of them.
    pub fn close(&mut self) -> Vec<(String, Book)> {
        let close = |mut tap: Box<dyn Tap>| (tap.service(), std::mem::take(tap.book()));
        std::mem::take(&mut self.taps).into_iter().map(close).collect()
    }
}
