//! The counters of both ends of a link balance under every schedule of sends, reads, scripted faults and deaths.

use super::tests::{Store, WORDS};
use super::{AcceptedTicks, Extent, Input, Output};
use crate::bus::domain::OwnedDomain;
use crate::bus::iox::IoxBus;
use crate::bus::memory::MemoryBus;
use crate::bus::{Bus, BusError, Depths, Reader, Signal, Topic, Write};
use crate::clock::{Grid, monotonic_ns};
use crate::config::SHIPPED;
use crate::runtime::disturb::{Disturbance, LateSamples};
use crate::sample::{FleetLayout, RateCommand, Sample};
use crate::scenario::Scenario;
use crate::state::{Persist, StoredWords};
use crate::telemetry::{Ledger, LinkRead, LinkWritten};
use proptest::prelude::*;
use std::cell::{Cell, RefCell};
use std::rc::Rc;

/// Period of the schedule, ns: so long that no tick becomes due while the test runs.
const PERIOD_NS: u64 = 1_000_000_000;

/// The reader's action at a point of a schedule.
#[derive(Debug, Clone, Copy)]
enum Look {
    /// No action.
    Away,
    /// Reads all new samples.
    Advance,
    /// Connects to the current writer, then reads; the next poll also checks the queue.
    Refresh,
    /// Sleeps until a sample arrives.
    Sleep,
    /// Dies. Its successor continues from the last commit.
    Restart,
}

/// The writer's action at a tick.
#[derive(Debug, Clone, Copy)]
enum Turn {
    /// Misses the tick.
    Miss,
    /// Sends a no-sample marker.
    Void,
    /// Sends a sample.
    Send,
    /// Dies after a number of steps, with all sent samples recorded, or all but the last. A step writes a sample to the
    /// latest-value channel or to the queues.
    Die { steps: u64, marked: bool },
}

#[derive(Debug, Clone)]
struct Schedule {
    faults: Vec<String>,
    turns: Vec<Turn>,
    /// Consumed in order: one between the two steps of every sample, and three after every tick.
    looks: Vec<Look>,
}

/// The number of steps a writer lives, and a callback between its steps.
struct Life {
    steps: Cell<u64>,
    taken: Cell<u64>,
    between: Box<dyn Fn()>,
}

impl Life {
    fn lasts(&self) -> bool {
        self.taken.get() < self.steps.get()
    }

    fn step(&self) -> bool {
        let alive = self.lasts();
        self.taken.set(self.taken.get() + u64::from(alive));
        alive
    }
}

/// A bus on which the reader may act and the writer may die between channel and queues.
struct Interleaved<B> {
    bus: Rc<B>,
    life: Rc<Life>,
}

struct InterleavedWriter<W> {
    writer: W,
    life: Rc<Life>,
}

impl<S, W: Write<S>> Write<S> for InterleavedWriter<W> {
    fn fill(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        if self.life.lasts() { self.writer.fill(fill) } else { Ok(()) }
    }

    fn deliver(&mut self) -> Result<(), BusError> {
        if self.life.step() {
            self.writer.write_latest()?;
            (self.life.between)();
        }
        if self.life.step() { self.writer.publish() } else { Ok(()) }
    }

    fn prepare(&mut self) -> Result<(), BusError> {
        if self.life.lasts() { self.writer.prepare() } else { Ok(()) }
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        self.writer.refresh()
    }
}

impl<B: Bus> Bus for Interleaved<B> {
    const REPEATS: bool = B::REPEATS;
    type Writer<S: Sample> = InterleavedWriter<B::Writer<S>>;
    type Reader<S: Sample> = B::Reader<S>;
    type FleetWriter<L: FleetLayout> = B::FleetWriter<L>;
    type FleetReader<L: FleetLayout> = B::FleetReader<L>;

    fn writer<S: Sample>(&self, topic: &Topic, generation: u64) -> Result<Self::Writer<S>, BusError> {
        Ok(InterleavedWriter { writer: self.bus.writer(topic, generation)?, life: self.life.clone() })
    }

    fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<Self::Reader<S>, BusError> {
        self.bus.reader(topic, reader)
    }

    fn fleet_writer<L: FleetLayout>(&self, topic: &Topic, bodies: usize) -> Result<Self::FleetWriter<L>, BusError> {
        self.bus.fleet_writer(topic, bodies)
    }

    fn fleet_reader<L: FleetLayout>(
        &self,
        topic: &Topic,
        reader: Reader,
        bodies: usize,
    ) -> Result<Self::FleetReader<L>, BusError> {
        self.bus.fleet_reader(topic, reader, bodies)
    }
}

/// The reading end with its last committed state.
struct Reading<B: Bus> {
    input: Input<B, RateCommand>,
    committed: [Store; 2],
    looks: std::vec::IntoIter<Look>,
}

impl<B: Bus> Reading<B> {
    fn commit(&mut self) {
        self.committed = [Store::default(), Store::default()];
        self.input.counters().persist(&mut self.committed[0]);
        self.input.persist(&mut self.committed[1]);
    }

    /// Performs the next action; `open` opens the link for a successor.
    fn look(&mut self, open: impl FnOnce() -> Input<B, RateCommand>) {
        match self.looks.next().unwrap_or(Look::Away) {
            Look::Away => {}
            Look::Advance => while self.input.advance().unwrap() {},
            Look::Refresh => {
                self.input.refresh();
                while self.input.advance().unwrap() {}
            }
            Look::Sleep => self.input.sleep(monotonic_ns()).unwrap(),
            Look::Restart => {
                self.input = open();
                if let [counters, state] = &self.committed
                    && !state.0.is_empty()
                {
                    self.input.counters().persist(&mut StoredWords(&counters.0));
                    self.input.persist(&mut StoredWords(&state.0));
                }
                self.input.expect_repeats();
            }
        }
    }
}

/// Runs a schedule on a bus; `reader` selects the channel or every sample. `service` keeps the links of several runs
/// apart.
fn run<B: Bus + 'static>(schedule: &Schedule, bus: &Rc<B>, service: u64, reader: Reader, lossless: bool) {
    let clock = if lossless { "lockstep" } else { "realtime" };
    let overrides = [format!("clock='{clock}'"), format!("fault=[{}]", schedule.faults.join(", "))];
    let scenario = Rc::new(Scenario::parse(SHIPPED[0].1, "pair", &overrides).unwrap());
    let topic = Topic { scenario: "s".to_owned(), body: service.to_string(), signal: Signal::Command };
    let extent = Extent { last_tick: 100, retained_samples: 0 };
    let directory = tempfile::tempdir().unwrap();
    let ledger = Ledger::shared(&directory.path().join("x.books"), extent.words(WORDS)).unwrap();
    let grid = Rc::new(Cell::new(None));
    let accepted_ticks = move |grid: Option<Grid>| match grid {
        _ if lossless => AcceptedTicks::Next,
        None => AcceptedTicks::Unknown,
        Some(grid) => AcceptedTicks::Due(grid),
    };
    let open = {
        let (bus, topic, scenario, grid) = (bus.clone(), topic.clone(), scenario.clone(), grid.clone());
        Rc::new(move || {
            let mut input = Input::<B, RateCommand>::open(&*bus, &topic, reader)
                .unwrap()
                .with_late(LateSamples::for_signal(&scenario, Signal::Command, "follower"));
            input.expect(accepted_ticks(grid.get()));
            input
        })
    };
    let looks = schedule.looks.clone().into_iter();
    let reading = Rc::new(RefCell::new(Reading { input: open(), committed: Default::default(), looks }));
    let look = {
        let (reading, open) = (reading.clone(), open.clone());
        move || reading.borrow_mut().look(&*open)
    };
    let life = Life { steps: Cell::new(u64::MAX), taken: Cell::new(0), between: Box::new(look.clone()) };
    let life = Rc::new(life);
    let bus = Interleaved { bus: bus.clone(), life: life.clone() };
    let writer = |generation, next_tick| {
        let faults = Disturbance::for_signal(&scenario, "controller", "follower", 1, next_tick);
        let output = Output::<_, RateCommand>::open(&bus, &topic, 1, generation, &ledger.reopened(), extent);
        output.unwrap().with_markers(lossless).disturbed(faults)
    };
    let (mut generation, mut output) = (1, writer(1, 0));
    output.warm_up().unwrap();
    reading.borrow_mut().input.warm_up().unwrap();
    for (tick, turn) in schedule.turns.iter().enumerate() {
        let tick = tick as u64;
        grid.set(Some(Grid { epoch_ns: monotonic_ns() - tick * PERIOD_NS, period_ns: PERIOD_NS }));
        reading.borrow_mut().input.expect(accepted_ticks(grid.get()));
        match turn {
            Turn::Miss if !lossless => {}
            Turn::Miss | Turn::Void => {
                output.stage_marker(tick);
                output.dispatch().unwrap();
                output.finish().unwrap();
            }
            Turn::Send => {
                output.stage(|sample| sample.stamp.tick = tick).unwrap();
                output.dispatch().unwrap();
                output.finish().unwrap();
            }
            Turn::Die { steps, marked } => {
                output.stage(|sample| sample.stamp.tick = tick).unwrap();
                let mut committed = Store::default();
                output.persist(&mut committed);
                output.persist_late(&mut committed);
                let sent = ledger.reopened().take(1).get(0);
                life.taken.set(0);
                life.steps.set(*steps);
                output.dispatch().unwrap();
                let whole = life.taken.get() / 2;
                drop(output);
                ledger.reopened().take(1).set(0, sent + whole.saturating_sub(u64::from(!marked)));
                life.steps.set(u64::MAX);
                (0..3).for_each(|_| look());
                generation += 1;
                output = writer(generation, tick + 1);
                let mut words = StoredWords(&committed.0);
                output.persist(&mut words);
                output.persist_late(&mut words);
                output.dispatch().unwrap();
                output.finish().unwrap();
            }
        }
        (0..3).for_each(|_| look());
        reading.borrow_mut().commit();
        let (written, read) = (output.counters().report(""), reading.borrow_mut().input.counters().report(""));
        assert_balanced(&written, &read, lossless);
    }
}

fn assert_balanced(written: &LinkWritten, read: &LinkRead, lossless: bool) {
    assert!(written.balances(), "{written:?}");
    assert!(read.balances(lossless), "{read:?}");
    assert!(read.agrees(written, 0), "{written:?} {read:?}");
}

fn fault() -> impl Strategy<Value = String> {
    let kind = prop_oneof![
        Just("kind='drop'".to_owned()),
        Just("kind='duplicate'".to_owned()),
        Just("kind='bit-flip', field='tick'".to_owned()),
        Just("kind='bit-flip', field='generation'".to_owned()),
        (1..4_u64).prop_map(|delay| format!("kind='delay', delay_ticks={delay}")),
        (0..3_u64, 1..4_u64)
            .prop_map(|(delay, jitter)| format!("kind='delay', delay_ticks={delay}, jitter_ticks={jitter}")),
    ];
    (kind, 1..20_u64, 1..8_u64, prop_oneof![Just(1.0), 0.2..0.9]).prop_map(|(kind, from, ticks, probability)| {
        format!("{{{kind}, role='controller', from_tick={from}, ticks={ticks}, probability={probability:.3}}}")
    })
}

fn schedule() -> impl Strategy<Value = Schedule> {
    let look = prop_oneof![
        2 => Just(Look::Away),
        4 => Just(Look::Advance),
        4 => Just(Look::Refresh),
        2 => Just(Look::Sleep),
        1 => Just(Look::Restart),
    ];
    let turn = prop_oneof![
        1 => Just(Turn::Miss),
        1 => Just(Turn::Void),
        20 => Just(Turn::Send),
        2 => (0..6_u64, any::<bool>()).prop_map(|(steps, marked)| Turn::Die { steps, marked }),
    ];
    let faults = prop::collection::vec(fault(), 1..4);
    (faults, prop::collection::vec(turn, 1..24), prop::collection::vec(look, 0..150))
        .prop_map(|(faults, turns, looks)| Schedule { faults, turns, looks })
}

/// Returns a quarter of the usual number of cases, which `PROPTEST_CASES` sets.
fn config() -> ProptestConfig {
    let config = ProptestConfig::default();
    ProptestConfig { cases: config.cases / 4, failure_persistence: None, ..config }
}

fn balances_over_shared_memory(reader: Reader) {
    let domain = OwnedDomain::create(0).unwrap();
    let depths = Depths { role: 1, scorer: 64, history: 0 };
    let (bus, service) = (Rc::new(IoxBus::enter(domain.domain(), "test", depths).unwrap()), Cell::new(0));
    proptest!(config(), |(schedule in schedule())| {
        service.set(service.get() + 1);
        run(&schedule, &bus, service.get(), reader, false);
    });
}

#[test]
fn a_link_with_a_channel_balances() {
    balances_over_shared_memory(Reader::Role);
}

#[test]
fn a_link_of_every_sample_balances() {
    balances_over_shared_memory(Reader::Scorer);
}

/// Another test covers deaths on such a link.
#[test]
fn a_link_that_loses_nothing_balances() {
    let bus = Rc::new(MemoryBus::new(Depths { role: 64, scorer: 64, history: 0 }));
    let service = Cell::new(0);
    proptest!(config(), |(mut schedule in schedule())| {
        for turn in &mut schedule.turns {
            *turn = if let Turn::Die { .. } = turn { Turn::Send } else { *turn };
        }
        schedule.looks.retain(|look| !matches!(look, Look::Restart));
        service.set(service.get() + 1);
        run(&schedule, &bus, service.get(), Reader::Role, true);
    });
}
