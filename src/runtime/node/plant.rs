//! A plant on a bus: command in; measurement, then truth out; then the body moves on.

use super::{Gate, Node, Poll, RoleId, Seat};
use crate::bus::{Bus, BusError, Carried, Signal};
use crate::clock::{Clock, Grid};
use crate::rig::BodyInfo;
use crate::role::{Body, CommandEvent, Guard, Plant};
use crate::runtime::disturb::Interruptions;
use crate::runtime::link::{Horizon, Input, Output, Seek};
use crate::sample::{Message, Stamp};
use crate::telemetry::{Latency, Ledger, StageReport, TickBook, Ticks, Words};
use std::borrow::{Borrow, BorrowMut};
use std::marker::PhantomData;

/// A body whose samples links carry: one, or a fleet.
pub trait Hosted: Body<Truth: Carried, Measurement: Carried, Command: Carried> {}

impl<P: Body<Truth: Carried, Measurement: Carried, Command: Carried>> Hosted for P {}

/// A plant with its links and books.
pub struct PlantNode<P: Hosted, G, B: Bus> {
    plant: Plant<P>,
    command: Option<Input<B, P::Command, G>>,
    measurement: Output<B, P::Measurement>,
    truth: Output<B, P::Truth>,
    clock: Clock,
    grid: Grid,
    last_tick: u64,
    book: TickBook,
    interruptions: Interruptions,
    state: StateBook<P::Truth>,
    /// The last state that a predecessor left, until this one executes a tick: until then nobody served the body.
    predecessor: Option<<P::Truth as Carried>::Owned>,
    lateness: Latency,
    age: Latency,
    step: Latency,
}

impl<P: Hosted, G: Guard<P::Command>, B: Bus> PlantNode<P, G, B> {
    pub fn open(body: P, guard: G, info: &BodyInfo, seat: &Seat<'_, B>) -> Result<Self, BusError> {
        let scenario = seat.scenario;
        let book = TickBook::go_on(seat.ledger);
        let measurement = seat.output(info, Signal::Measurement)?;
        let truth = seat.output(info, Signal::Truth)?;
        let command = info.driven.then(|| seat.input(info, Signal::Command, guard)).transpose()?;
        Ok(Self {
            plant: Plant::new(body, scenario.actuation(info.driven), scenario.tick_s()),
            command,
            measurement,
            truth,
            clock: seat.clock,
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            last_tick: scenario.last_tick,
            book,
            interruptions: seat.interruptions(),
            state: StateBook::open(seat.ledger, info.bodies()),
            predecessor: None,
            lateness: Latency::default(),
            age: Latency::default(),
            step: Latency::default(),
        })
    }

    fn inputs_ready(&mut self) -> Result<bool, BusError> {
        match &mut self.command {
            Some(command) if self.book.next() > 0 => Ok(command.seek(self.book.next() - 1)? != Seek::NotYet),
            _ => Ok(true),
        }
    }

    /// Counts the ticks up to `tick` as missed, and their lateness too: nobody served them before now.
    fn catch_up(&mut self, tick: u64, now_ns: u64) {
        for missed in self.book.next()..tick {
            self.lateness.record(self.grid.due_ns(missed), now_ns);
        }
        self.take_over(tick);
    }

    /// Serves the body from `tick` on.
    fn take_over(&mut self, tick: u64) {
        match self.predecessor.take() {
            Some(truth) => self.resume(truth.borrow(), tick),
            None => self.skip_to(tick),
        }
    }

    /// Takes over a body from a predecessor that died: it has moved on by itself, and its actuators have protected it.
    fn resume(&mut self, truth: &P::Truth, first_tick: u64) {
        self.plant.resume(truth, self.measurement.made());
        let first_tick = first_tick.max(truth.stamp().tick + 1);
        self.plant.advance(1);
        for tick in truth.stamp().tick + 1..first_tick {
            self.plant.command(tick, None);
            self.plant.advance(1);
        }
        self.book.skip_to(first_tick);
    }

    #[inline]
    fn execute(&mut self, now_ns: u64) -> Result<Poll, BusError> {
        let tick = self.book.next();
        let event = self.take_command(tick, now_ns)?;
        if event.missed() {
            self.book.starved(tick);
        }
        if matches!(event, CommandEvent::Expired | CommandEvent::Safe) {
            self.book.safe();
        }
        let (plant, clock) = (&mut self.plant, self.clock);
        let mut stamp = Stamp { tick, origin_ns: self.grid.due_ns(tick), ..Stamp::default() };
        self.measurement.send(|sample| {
            stamp.sent_ns = clock.now_ns();
            plant.measure(&stamp, sample);
        })?;
        Ok(Poll::Executed)
    }

    #[inline]
    fn take_command(&mut self, tick: u64, now_ns: u64) -> Result<CommandEvent, BusError> {
        let Some(input) = &mut self.command else { return Ok(self.plant.command(tick, None)) };
        let found = if tick > 0 { input.seek(tick - 1)? } else { Seek::NotYet };
        if found == Seek::Rejected {
            return Ok(self.plant.reject(tick));
        }
        let command = input.sample().filter(|_| found == Seek::Found);
        let event = self.plant.command(tick, command);
        if let (CommandEvent::Applied, Some(command), Clock::Monotonic) = (event, command, self.clock) {
            self.age.record(command.stamp().origin_ns, now_ns);
        }
        Ok(event)
    }
}

impl<P: Hosted, G: Guard<P::Command>, B: Bus> Node for PlantNode<P, G, B> {
    fn time_triggered(&self) -> bool {
        true
    }

    fn next_tick(&self) -> u64 {
        self.book.next()
    }

    fn start(&mut self, grid: Grid, first_tick: u64) {
        self.grid = grid;
        if let (Some(command), Clock::Monotonic) = (&mut self.command, self.clock) {
            command.expect(Horizon::Due(grid));
        }
        self.predecessor = self.state.load();
        if self.clock == Clock::Monotonic && self.predecessor.is_some() {
            // Whether that tick will be missed too is not known yet.
            self.book.skip_to(first_tick);
        } else {
            self.take_over(first_tick);
        }
    }

    #[inline]
    fn before_tick(&mut self) -> bool {
        self.interruptions.before_next(&mut self.book)
    }

    #[inline]
    fn poll(&mut self, gate: Gate) -> Result<Poll, BusError> {
        match gate {
            Gate::Inputs { up_to } if self.book.next() <= up_to && self.inputs_ready()? => self.execute(0),
            Gate::Now { tick, now_ns } => {
                self.catch_up(tick.min(self.last_tick + 1), now_ns);
                if self.book.next() > self.last_tick {
                    return Ok(Poll::Waiting);
                }
                self.lateness.record(self.grid.due_ns(tick), now_ns);
                self.execute(now_ns)
            }
            Gate::Inputs { .. } | Gate::Arrived | Gate::Overdue => Ok(Poll::Waiting),
        }
    }

    fn awaits(&self) -> Option<RoleId> {
        None
    }

    fn sleep(&mut self, until_ns: u64) -> Result<bool, BusError> {
        let Some(last) = self.book.next().checked_sub(1) else { return Ok(false) };
        let lacking = self.command.as_mut().filter(|command| !command.knows(last));
        let lacks = lacking.is_some();
        lacking.map_or(Ok(()), |command| command.sleep(until_ns))?;
        Ok(lacks)
    }

    #[inline]
    fn settle(&mut self) -> Result<(), BusError> {
        let (plant, clock) = (&self.plant, self.clock);
        let (tick, origin_ns) = (self.book.next(), self.grid.due_ns(self.book.next()));
        self.truth.send(|sample| {
            plant.truth(&Stamp { tick, origin_ns, sent_ns: clock.now_ns(), ..Stamp::default() }, sample);
        })?;
        let before_ns = self.clock.now_ns();
        self.plant.advance(1);
        if self.clock == Clock::Monotonic {
            self.step.record(before_ns, self.clock.now_ns());
        }
        self.measurement.settle()?;
        self.truth.settle()?;
        self.state.store(self.truth.sent());
        self.book.executed();
        Ok(())
    }

    fn skip_to(&mut self, tick: u64) {
        let missed = self.book.skip_to(tick);
        self.plant.advance(missed);
    }

    fn warm_up(&mut self) -> Result<(), BusError> {
        if let Some(command) = &mut self.command {
            command.warm_up()?;
        }
        self.measurement.warm_up()?;
        self.truth.warm_up()
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        if let Some(command) = &mut self.command {
            command.refresh();
        }
        self.measurement.refresh()?;
        self.truth.refresh()
    }

    fn ticks(&self) -> Ticks {
        self.book.report()
    }

    fn stages(&self) -> Vec<StageReport> {
        StageReport::all(&[("lateness", &self.lateness), ("age", &self.age), ("step", &self.step)])
    }
}

/// The last state of a body, kept in the ledger so that whoever simulates it next can go on from there: a body does not
/// vanish with the process that simulates it.
pub struct StateBook<S: ?Sized> {
    words: Words,
    bodies: usize,
    sample: PhantomData<S>,
}

impl<S: Carried + ?Sized> StateBook<S> {
    /// Words of the ledger: which of the two copies holds, from 1, and the copies. One of them is always whole.
    pub fn words(bodies: usize) -> usize {
        1 + 2 * S::length(bodies)
    }

    pub fn open(ledger: &Ledger, bodies: usize) -> Self {
        Self { words: ledger.take(Self::words(bodies)), bodies, sample: PhantomData }
    }

    fn begin(&self, copy: u64) -> usize {
        1 + (copy as usize - 1) * S::length(self.bodies)
    }

    #[inline]
    pub fn store(&mut self, sample: &S) {
        let copy = if self.words.get(0) == 1 { 2 } else { 1 };
        self.words.set_all(self.begin(copy), sample.words());
        self.words.set(0, copy);
    }

    fn load(&self) -> Option<S::Owned> {
        let copy = self.words.get(0);
        if !(1..=2).contains(&copy) {
            return None;
        }
        let mut sample = S::blank(self.bodies);
        let begin = self.begin(copy);
        for (index, word) in sample.borrow_mut().words_mut().iter_mut().enumerate() {
            *word = self.words.get(begin + index);
        }
        Some(sample)
    }
}
