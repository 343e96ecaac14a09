//! Takes every sample of a run off a bus, truth included, and passes it to a sink as a message of its channel.
//!
//! Passes on all samples unchanged except warm-up: duplicates, late and malformed samples too. Must not judge a sample, nor
//! depend on the sink.

use super::error::RecordError;
use crate::bus::Port;
use crate::bus::{AnyBus, BusError, Reader, WordReader};
use crate::clock::{Grid, monotonic_ns};
use crate::config::ClockKind;
use crate::runtime::{RoleId, ports};
use crate::sample::{Layout, Order, Place, Stamp};
use crate::scenario::Scenario;
use std::collections::BTreeMap;

/// Largest number of gaps that are listed.
const GAPS_LISTED: usize = 1000;

/// The number of a channel.
pub type Channel = u16;

/// A receiver of messages.
pub trait MessageSink {
    /// Adds a channel for a signal, with the metadata `about`.
    ///
    /// # Errors
    /// [`RecordError::Write`].
    fn channel(
        &mut self,
        service: &str,
        layout: &Layout,
        about: BTreeMap<String, String>,
    ) -> Result<Channel, RecordError>;

    /// Takes one sample. `due_ns` is the due time of its tick, `logged_ns` the time by which players sort it.
    ///
    /// # Errors
    /// [`RecordError::Full`] if the disk is full. [`RecordError::Write`].
    fn message(
        &mut self,
        channel: Channel,
        sequence: u32,
        due_ns: u64,
        logged_ns: u64,
        body: &[u8],
    ) -> Result<(), RecordError>;
}

/// Counters of the samples of one signal.
#[derive(Default)]
pub struct SignalCounters {
    /// The ticks with a sample or marker so far.
    pub order: Order,
    /// Number of ticks with a sample.
    pub recorded: u64,
    /// Number of ticks with a no-sample marker.
    pub void: u64,
    /// Number of duplicate, late and impossible samples.
    pub extra: u64,
    /// First and last ticks of stretches without sample or marker.
    pub gaps: Vec<[u64; 2]>,
    /// Number of gaps that are not listed.
    pub more_gaps: u64,
}

impl SignalCounters {
    /// Counts a sample or marker; `max_tick` is the last tick that it can have.
    fn count(&mut self, stamp: &Stamp, max_tick: u64) {
        let next = self.order.next();
        match self.order.place(stamp, max_tick) {
            Place::WarmUp => {}
            Place::Extra => self.extra += 1,
            place => {
                self.add_gap(next, stamp.tick);
                *(if place == Place::NoSample { &mut self.void } else { &mut self.recorded }) += 1;
            }
        }
    }

    /// Adds the gap from a missing tick to the one before `tick`, if there is one.
    fn add_gap(&mut self, missing: u64, tick: u64) {
        if tick > missing {
            if self.gaps.len() < GAPS_LISTED {
                self.gaps.push([missing, tick - 1]);
            } else {
                self.more_gaps += 1;
            }
        }
    }
}

/// The sink and the run's ticks, as each tap needs them.
struct TapContext<'a> {
    sink: &'a mut dyn MessageSink,
    grid: Grid,
    joined: Option<u64>,
    last_tick: u64,
    realtime: bool,
}

/// A reader of one signal.
struct Tap {
    port: Port,
    role: String,
    reader: WordReader,
    channel: Channel,
    counters: SignalCounters,
}

impl Tap {
    /// Passes on the samples that have arrived, and returns their number.
    fn drain(&mut self, context: &mut TapContext<'_>) -> Result<u64, RecordError> {
        let mut taken = 0;
        while let Some(words) = self.reader.next()? {
            let body = bytemuck::cast_slice(words);
            let stamp: Stamp = bytemuck::pod_read_unaligned(&body[..size_of::<Stamp>()]);
            let order = &self.counters.order;
            if (stamp.generation == 0 || context.joined.is_some_and(|from| stamp.tick < from)) && !order.begun() {
                continue;
            }
            let now_ns = monotonic_ns();
            let max_tick = match context.realtime.then(|| context.grid.tick_at(now_ns)) {
                // A reader that joined a run in lockstep may have missed samples.
                None if context.joined.is_some() => context.last_tick,
                due_tick => order.max_tick(due_tick, context.last_tick),
            };
            let due_ns = if stamp.tick <= context.last_tick { context.grid.due_ns(stamp.tick) } else { now_ns };
            // Without real time, the due time of the tick is the only meaningful one.
            let logged_ns = if context.realtime { now_ns } else { due_ns };
            context.sink.message(self.channel, stamp.tick as u32, due_ns, logged_ns, body)?;
            self.counters.count(&stamp, max_tick);
            taken += 1;
        }
        Ok(taken)
    }

    fn announce(&mut self, sink: &mut dyn MessageSink) -> Result<(), RecordError> {
        let Port { topic, type_name, fields, .. } = &self.port;
        let layout = Layout::from_fields(type_name, fields);
        self.channel = sink.channel(&topic.to_string(), &layout, about(&self.port, &self.role))?;
        Ok(())
    }
}

/// Returns the metadata of the channel of a signal that a role publishes.
pub(super) fn about(port: &Port, role: &str) -> BTreeMap<String, String> {
    let Port { topic, type_name, .. } = port;
    let about = [
        ("service", topic.to_string()),
        ("type_name", (*type_name).to_owned()),
        ("role", role.to_owned()),
        ("body", topic.body.clone()),
        ("signal", topic.signal.name().to_owned()),
    ];
    about.map(|(key, value)| (key.to_owned(), value)).into()
}

/// Readers of all signals of a run.
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

    /// Sets the time of tick 0, which is 0 unless the clock is real time, and the first tick to take in a run that has begun.
    pub fn start(&mut self, epoch_ns: u64, joined: Option<u64>) {
        (self.grid.epoch_ns, self.joined) = (epoch_ns, joined);
    }

    /// Connects to all current writers, so that their samples arrive even if they end before the next call of
    /// [`Self::drain`].
    pub fn connect(&mut self) {
        self.taps.iter_mut().for_each(|tap| tap.reader.refresh());
    }

    /// Adds a channel to the sink for every signal.
    ///
    /// # Errors
    /// The sink's.
    pub fn announce(&mut self, sink: &mut dyn MessageSink) -> Result<(), RecordError> {
        self.taps.iter_mut().try_for_each(|tap| tap.announce(sink))
    }

    /// Passes on the samples that have arrived, and returns their number.
    ///
    /// # Errors
    /// [`RecordError::Bus`], and the sink's.
    pub fn drain(&mut self, sink: &mut dyn MessageSink) -> Result<u64, RecordError> {
        let Self { taps, grid, joined, last_tick, realtime } = self;
        let mut context = TapContext { sink, grid: *grid, joined: *joined, last_tick: *last_tick, realtime: *realtime };
        let mut taken = 0;
        for tap in taps {
            taken += tap.drain(&mut context)?;
        }
        Ok(taken)
    }

    /// Returns the first tick that some signal still lacks.
    pub fn next_tick(&self) -> u64 {
        self.taps.iter().map(|tap| tap.counters.order.next()).min().unwrap_or(0)
    }

    /// Closes all signals and returns their services and counters.
    pub fn close(&mut self) -> Vec<(String, SignalCounters)> {
        let close = |tap: Tap| (tap.port.topic.to_string(), tap.counters);
        std::mem::take(&mut self.taps).into_iter().map(close).collect()
    }
}
