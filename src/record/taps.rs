//! Takes every sample of a run off a bus, the truth included, and passes it on as the message of its channel.
//!
//! Warm-up samples apart, whatever was sent is passed on, as it was: second, late and broken samples too. Must not judge, nor
//! know what becomes of a message.

use super::RecordError;
use crate::bus::Port;
use crate::bus::{AnyBus, BusError, Reader, WordReader};
use crate::clock::{Grid, monotonic_ns};
use crate::config::ClockKind;
use crate::runtime::{RoleId, ports};
use crate::sample::{Layout, NO_SAMPLE, Stamp};
use crate::scenario::Scenario;
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

    /// Takes one sample as it is. Times are ns: when its tick was due, and where players put it.
    ///
    /// # Errors
    /// [`RecordError::Full`] if there is no room for it. [`RecordError::Write`].
    fn message(
        &mut self,
        channel: Channel,
        sequence: u32,
        due_ns: u64,
        logged_ns: u64,
        body: &[u8],
    ) -> Result<(), RecordError>;
}

/// What has come of one signal.
#[derive(Default)]
pub struct SignalCounters {
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

impl SignalCounters {
    /// Enters a sample; `due` is the last tick that it can be of.
    fn enter(&mut self, stamp: &Stamp, due: u64) {
        if stamp.tick < self.next || stamp.tick > due {
            self.extra += 1;
            return;
        }
        self.gap_to(stamp.tick);
        *(if stamp.generation & NO_SAMPLE == 0 { &mut self.recorded } else { &mut self.void }) += 1;
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
    joined: Option<u64>,
    last_tick: u64,
    realtime: bool,
}

/// One signal.
struct Tap {
    port: Port,
    role: String,
    reader: WordReader,
    channel: Channel,
    counters: SignalCounters,
}

impl Tap {
    /// Passes on whatever has come; returns how many samples.
    fn drain(&mut self, desk: &mut Desk<'_>) -> Result<u64, RecordError> {
        let mut taken = 0;
        while let Some(words) = self.reader.next()? {
            let body = bytemuck::cast_slice(words);
            let stamp: Stamp = bytemuck::pod_read_unaligned(&body[..size_of::<Stamp>()]);
            if (stamp.generation == 0 || desk.joined.is_some_and(|from| stamp.tick < from)) && !self.counters.begun {
                continue;
            }
            let now_ns = monotonic_ns();
            let due = match (desk.realtime, self.counters.begun) {
                (true, _) => desk.grid.tick_at(now_ns).min(desk.last_tick),
                // Where nothing can be lost, a sample is of the next tick or of none.
                (false, true) if desk.joined.is_none() => self.counters.next,
                (false, _) => desk.last_tick,
            };
            let due_ns = if stamp.tick <= desk.last_tick { desk.grid.due_ns(stamp.tick) } else { now_ns };
            // Only real time has another time than that of the ticks.
            let logged_ns = if desk.realtime { now_ns } else { due_ns };
            desk.sink.message(self.channel, stamp.tick as u32, due_ns, logged_ns, body)?;
            self.counters.enter(&stamp, due);
            taken += 1;
        }
        Ok(taken)
    }

    fn announce(&mut self, sink: &mut dyn MessageSink) -> Result<(), RecordError> {
        let Port { topic, type_name, fields, .. } = &self.port;
        let about = [
            ("service", topic.to_string()),
            ("type_name", (*type_name).to_owned()),
            ("role", self.role.clone()),
            ("body", topic.body.clone()),
            ("signal", topic.signal.name().to_owned()),
        ];
        let about = about.map(|(key, value)| (key.to_owned(), value)).into();
        self.channel = sink.channel(&topic.to_string(), &Layout::from_fields(type_name, fields), about)?;
        Ok(())
    }
}

/// Every signal of a run.
pub struct Taps {
    taps: Vec<Tap>,
    grid: Grid,
    joined: Option<u64>,
    last_tick: u64,
    realtime: bool,
}

impl Taps {
    /// Opens every signal of a scenario on its bus.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open<'a>(scenario: &Scenario, bus: impl Into<AnyBus<'a>>) -> Result<Self, BusError> {
        let (bus, mut taps) = (bus.into(), Vec::new());
        for role in RoleId::all(scenario) {
            for port in ports(scenario, role).writes {
                let (reader, role) = (port.reader(bus, Reader::Scorer)?, role.name(scenario).to_owned());
                taps.push(Tap { port, role, reader, channel: 0, counters: SignalCounters::default() });
            }
        }
        Ok(Self {
            taps,
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            joined: None,
            last_tick: scenario.last_tick,
            realtime: scenario.clock == ClockKind::Realtime,
        })
    }

    /// Sets the epoch of the ticks, once it is known: 0 where there is no time; and the first tick that is taken, if
    /// some have run.
    pub fn start(&mut self, epoch_ns: u64, joined: Option<u64>) {
        (self.grid.epoch_ns, self.joined) = (epoch_ns, joined);
    }

    /// Connects to every writer that there is now: what these send is taken even if they are gone by then.
    pub fn connect(&mut self) {
        self.taps.iter_mut().for_each(|tap| tap.reader.refresh());
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
        let Self { taps, grid, joined, last_tick, realtime } = self;
        let mut desk = Desk { sink, grid: *grid, joined: *joined, last_tick: *last_tick, realtime: *realtime };
        let mut taken = 0;
        for tap in taps {
            taken += tap.drain(&mut desk)?;
        }
        Ok(taken)
    }

    /// The tick of which not every signal is here yet.
    pub fn next_tick(&self) -> u64 {
        self.taps.iter().map(|tap| tap.counters.next).min().unwrap_or(0)
    }

    /// Closes every signal; gives services and what came of them.
    pub fn close(&mut self) -> Vec<(String, SignalCounters)> {
        let close = |tap: Tap| (tap.port.topic.to_string(), tap.counters);
        std::mem::take(&mut self.taps).into_iter().map(close).collect()
    }
}
