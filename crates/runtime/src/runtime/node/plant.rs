//! A plant on a bus: reads the command, sends measurement and truth, then integrates.

use super::context::NodeContext;
use super::contract::{Node, Poll, RunCondition, counted};
use super::missed::MissedTicks;
use super::persistent::{Inherited, Persistent, commit, commit_last, restore};
use crate::bus::{Bus, BusError, Carried, Reader, Signal};
use crate::clock::{Clock, Grid};
use crate::config::{DISCONNECTED, InputUser};
use crate::rig::{BodyInfo, DelayLine, Due, plant};
use crate::role::{Body, CommandEvent, Guard, Plant};
use crate::runtime::disturb::Interruptions;
use crate::runtime::error::NodeError;
use crate::runtime::link::{AcceptedTicks, Input, Output, Seek};
use crate::runtime::role_function::FunctionRole;
use crate::runtime::role_id::RoleId;
use crate::runtime::role_inputs::{NewValue, RoleInputs};
use crate::sample::{Field, Message, Stamp, is_number};
use crate::state::{NumberWords, Persist, Words};
use crate::telemetry::{LateRecord, Latency, Ledger, LedgerError, StageReport, TickCounters};
use std::borrow::{Borrow, BorrowMut};

/// A body or fleet whose samples links carry.
pub trait LinkedBody: Body<Truth: Carried, Measurement: Carried, Command: Carried> + Persist {}

impl<P: Body<Truth: Carried, Measurement: Carried, Command: Carried> + Persist> LinkedBody for P {}

/// A plant with its links and counters.
pub struct PlantNode<P: LinkedBody, G, B: Bus> {
    plant: Plant<P>,
    command: Option<Input<B, P::Command, G>>,
    /// Commands that have arrived and are not due, with an actuation delay above one tick.
    line: Option<DelayLine<<P::Command as Carried>::Owned>>,
    command_fields: Vec<Field>,
    measurement: Output<B, P::Measurement>,
    truth: Output<B, P::Truth>,
    clock: Clock,
    grid: Grid,
    last_tick: u64,
    counters: TickCounters,
    interruptions: Interruptions,
    inputs: RoleInputs,
    ledger: Ledger,
    /// The function that computes the samples, if not the body.
    function: Option<Box<FunctionRole>>,
    inherited: Inherited,
    /// The executed tick whose truth is not sent and whose integration step is missing.
    unfinished: Option<u64>,
    /// Number of missed ticks: the body moves over them without commands before the next tick.
    behind: u64,
    /// Origin of the command applied last, at the leader, ns. The plant may still hold that command.
    acting_ns: Option<u64>,
    missed: MissedTicks,
    lateness: Latency,
    late_ns: u64,
    age: Latency,
    step: Latency,
}

impl<P: LinkedBody, G: Guard<P::Command> + Persist, B: Bus> PlantNode<P, G, B> {
    pub fn open(
        body: P,
        guard: G,
        info: &BodyInfo,
        context: &NodeContext<'_, B>,
        function: Option<Box<FunctionRole>>,
    ) -> Result<Self, BusError> {
        let scenario = context.scenario;
        let measurement = context.output(info, Signal::Measurement)?;
        let truth = context.output(info, Signal::Truth)?;
        let delay_ticks = scenario.actuation_delay_ticks;
        // If several commands may arrive before one is due, the newest is not enough.
        let (delayed, bodies) = (delay_ticks > 1, info.bodies());
        let reader = if delayed { Reader::Scorer } else { Reader::Role };
        let command = info.driven.then(|| context.input_of(info, Signal::Command, guard, reader)).transpose()?;
        let line = (delayed && info.driven).then(|| DelayLine::new(delay_ticks, || P::Command::blank(bodies)));
        Ok(Self {
            plant: plant(body, scenario.actuation(info.driven), scenario),
            command,
            line,
            command_fields: P::Command::fields(bodies),
            measurement,
            truth,
            clock: context.clock,
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            last_tick: scenario.last_tick,
            counters: TickCounters::new(context.scenario.realtime.start_grace_ticks),
            interruptions: context.interruptions(),
            inputs: match context.role {
                RoleId::Plant(index) => {
                    context.inputs(|user| user == InputUser::Body(index) || user == InputUser::Actuator(index))
                }
                _ => context.inputs(|_| false),
            },
            ledger: context.ledger.reopened(),
            function,
            inherited: Inherited::Nothing,
            unfinished: None,
            behind: 0,
            acting_ns: None,
            missed: MissedTicks::default(),
            lateness: Latency::default(),
            late_ns: scenario.realtime.late_ns(scenario.period_ns),
            age: Latency::default(),
            step: Latency::default(),
        })
    }

    fn inputs_ready(&mut self) -> Result<bool, NodeError> {
        let Some(last) = self.counters.next().checked_sub(1) else { return Ok(true) };
        match &mut self.command {
            Some(_) if self.line.is_some() => self.collect(last),
            Some(command) => Ok(command.seek(last)? != Seek::NotYet),
            None => Ok(true),
        }
    }

    /// Moves the arrived commands up to `last` into the delay line; returns true once each has arrived or is known to
    /// be missing.
    fn collect(&mut self, last: u64) -> Result<bool, NodeError> {
        let (Some(input), Some(line)) = (&mut self.command, &mut self.line) else { return Ok(true) };
        for tick in line.wanted_at(last + 1)..=last {
            match input.seek(tick)? {
                Seek::NotYet => return Ok(false),
                Seek::Passed => line.lack(tick),
                Seek::Rejected => line.reject(tick),
                Seek::Found => match input.sample() {
                    Some(command) => line.put(tick).borrow_mut().assign(command),
                    None => line.lack(tick),
                },
            }
        }
        Ok(true)
    }

    /// Counts the ticks before `tick` as missed, and records their lateness.
    fn catch_up(&mut self, tick: u64, now_ns: u64) {
        for missed in self.counters.next()..tick {
            self.lateness.record_missed(self.grid.due_ns(missed), now_ns);
        }
        self.skip_to(tick);
    }

    /// Records missed ticks in the stages from their due instants; the previous command acted on them.
    #[inline]
    fn enter_missed(&mut self, due_ns: impl Iterator<Item = u64>, until_ns: u64) {
        for due_ns in due_ns {
            self.step.record_missed(due_ns, until_ns);
            self.acting_ns.iter().for_each(|acting_ns| self.age.record_missed(*acting_ns, due_ns));
        }
    }

    /// Records the age of the acting command; a held command counts as missed.
    #[inline]
    fn enter_age(&mut self, event: CommandEvent, now_ns: u64) {
        let Some(acting_ns) = self.acting_ns else { return };
        match event {
            CommandEvent::Applied => self.age.record(acting_ns, now_ns),
            _ => self.age.record_missed(acting_ns, now_ns),
        }
    }

    /// Completes what a predecessor committed. From then on the body moves by itself, protected by its actuators.
    fn take_over(&mut self) -> Result<(), NodeError> {
        self.measurement.dispatch()?;
        self.measurement.finish()?;
        let unfinished = self.unfinished.take();
        if let Some(tick) = unfinished {
            self.stage_truth(tick)?;
        }
        self.truth.dispatch_rest()?;
        self.truth.finish()?;
        self.plant.advance(u64::from(unfinished.is_some()));
        Ok(())
    }

    /// Skips the next tick for a scripted fault: no samples, no command; the body moves by itself.
    #[cold]
    fn miss(&mut self) -> Result<Poll, NodeError> {
        let tick = self.counters.next();
        self.measurement.stage_marker(tick);
        self.truth.stage_marker(tick);
        self.counters.pass(true);
        self.behind += 1;
        commit(self);
        self.measurement.dispatch()?;
        self.truth.dispatch()?;
        self.measurement.finish()?;
        self.truth.finish()?;
        Ok(Poll::Missed)
    }

    /// Executes the next tick, unless a scripted fault skips it.
    #[inline]
    fn execute_or_miss(&mut self, now_ns: u64) -> Result<Poll, NodeError> {
        if self.interruptions.misses(self.counters.next()) { self.miss() } else { self.execute(now_ns) }
    }

    fn stage_truth(&mut self, tick: u64) -> Result<(), NodeError> {
        let (plant, clock, origin_ns) = (&self.plant, self.clock, self.grid.due_ns(tick));
        let function = &self.function;
        Ok(self.truth.stage(|sample| {
            plant.truth(&Stamp { tick, origin_ns, sent_ns: clock.now_ns(), ..Stamp::default() }, sample);
            if let Some(function) = function {
                function.write_truth(sample.words_mut());
            }
        })?)
    }

    #[inline]
    fn execute(&mut self, now_ns: u64) -> Result<Poll, NodeError> {
        let tick = self.counters.next();
        self.plant.advance_alone_to(tick, std::mem::take(&mut self.behind));
        let missed = self.missed.before(tick);
        self.enter_missed(missed, now_ns);
        if self.inputs.is_due(tick) {
            let plant = &mut self.plant;
            self.inputs.advance(tick, |new| set_input(plant, new));
        }
        let event = self.take_command(tick)?;
        if self.clock == Clock::Monotonic {
            self.enter_age(event, now_ns);
        }
        if event.missed() {
            self.counters.starved(tick, RoleId::Controller.number());
        } else if self.clock == Clock::Monotonic && now_ns.saturating_sub(self.grid.due_ns(tick)) > self.late_ns {
            let due_ns = self.grid.due_ns(tick);
            self.counters.late(LateRecord { tick, due_ns, began_ns: now_ns, done_ns: now_ns, ..LateRecord::default() });
        }
        if matches!(event, CommandEvent::Expired | CommandEvent::Safe) {
            self.counters.safe();
        }
        let driven = self.command.is_some();
        if let Some(function) = &mut self.function {
            let command = match due(self.command.as_mut(), self.line.as_ref(), tick)? {
                Due::Here(command) if event == CommandEvent::Applied => Some(command),
                _ => None,
            };
            function.tick(tick, &[command.map(Message::words)][..usize::from(driven)])?;
        }
        let (plant, function, clock) = (&mut self.plant, &self.function, self.clock);
        let mut stamp = Stamp { tick, origin_ns: self.grid.due_ns(tick), ..Stamp::default() };
        self.measurement.stage(|sample| {
            stamp.sent_ns = clock.now_ns();
            plant.measure_with(&stamp, sample, |sample| {
                if let Some(function) = function {
                    function.write(0, sample.words_mut());
                }
            });
        })?;
        self.unfinished = Some(tick);
        self.counters.executed();
        commit(self);
        self.measurement.dispatch()?;
        Ok(Poll::Executed)
    }

    #[inline]
    fn take_command(&mut self, tick: u64) -> Result<CommandEvent, NodeError> {
        if self.command.is_none() {
            return Ok(self.plant.command(tick, None));
        }
        if self.line.is_some() {
            let last = tick.checked_sub(1);
            last.map_or(Ok(true), |last| self.collect(last))?;
        }
        let (input, line) = (&mut self.command, &self.line);
        let due = due(input.as_mut(), line.as_ref(), tick)?;
        let (event, origin_ns) = match due {
            Due::Rejected => return Ok(self.plant.reject(tick)),
            Due::Missing => return Ok(self.plant.command(tick, None)),
            Due::Here(command) => (self.plant.command(tick, Some(command)), command.stamp().origin_ns),
        };
        if event == CommandEvent::Applied {
            self.acting_ns = Some(origin_ns);
        }
        Ok(event)
    }
}

fn set_input<P: LinkedBody>(plant: &mut Plant<P>, new: NewValue<'_>) {
    match new.by.user {
        InputUser::Actuator(_) if new.by.port == DISCONNECTED => plant.disconnect(new.values[0] != 0.0),
        InputUser::Actuator(_) => plant.demand_safe(new.values[0] != 0.0),
        _ => plant.set_input(new.by.port, new.values),
    }
}

/// Returns the command that is due at a tick.
#[inline]
fn due<'a, S: Carried + ?Sized, G: Guard<S>, B: Bus>(
    input: Option<&'a mut Input<B, S, G>>,
    line: Option<&'a DelayLine<S::Owned>>,
    tick: u64,
) -> Result<Due<&'a S>, NodeError> {
    Ok(match (input, line, tick.checked_sub(1)) {
        (_, Some(line), _) => match line.due(tick) {
            Due::Here(command) => Due::Here(command.borrow()),
            Due::Rejected => Due::Rejected,
            Due::Missing => Due::Missing,
        },
        (Some(input), None, Some(last)) => match input.seek(last)? {
            Seek::Found => input.sample().map_or(Due::Missing, Due::Here),
            Seek::Rejected => Due::Rejected,
            Seek::NotYet | Seek::Passed => Due::Missing,
        },
        _ => Due::Missing,
    })
}

impl<P: LinkedBody, G: Guard<P::Command> + Persist, B: Bus> Node for PlantNode<P, G, B> {
    counted!();

    fn time_triggered(&self) -> bool {
        true
    }

    fn restore(&mut self) -> Result<(), LedgerError> {
        self.inherited = restore(self)?;
        self.command.iter_mut().for_each(Input::expect_repeats);
        if self.inherited == Inherited::Counters {
            self.counters.restarted_without_state();
        }
        Ok(())
    }

    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), NodeError> {
        self.grid = grid;
        self.missed.start(self.clock, grid, self.counters.next());
        if let (Some(command), Clock::Monotonic) = (&mut self.command, self.clock) {
            command.expect(AcceptedTicks::Due(grid));
        }
        let plant = &mut self.plant;
        self.inputs.resume(self.counters.next(), |new| set_input(plant, new));
        if self.inherited != Inherited::Nothing {
            self.take_over()?;
        }
        if self.clock == Clock::None {
            self.skip_to(first_tick);
        }
        // Otherwise the first poll skips the ticks missed until then.
        Ok(())
    }

    #[inline]
    fn poll(&mut self, condition: RunCondition) -> Result<Poll, NodeError> {
        match condition {
            RunCondition::Inputs { up_to } if self.counters.next() <= up_to && self.inputs_ready()? => {
                self.execute_or_miss(0)
            }
            RunCondition::Now { tick, now_ns } => {
                self.catch_up(tick.min(self.last_tick + 1), now_ns);
                if self.counters.next() > self.last_tick {
                    return Ok(Poll::Waiting);
                }
                self.lateness.record(self.grid.due_ns(tick), now_ns);
                self.execute_or_miss(now_ns)
            }
            RunCondition::Inputs { .. } | RunCondition::Arrived | RunCondition::Overdue => Ok(Poll::Waiting),
        }
    }

    /// In lockstep; in real time a body waits for the time grid only.
    fn awaits(&self) -> Option<RoleId> {
        let last = self.counters.next().checked_sub(1)?;
        let lacks = self.command.as_ref().is_some_and(|command| !command.knows(last));
        lacks.then_some(RoleId::Controller)
    }

    fn sleep(&mut self, until_ns: u64) -> Result<bool, NodeError> {
        let Some(last) = self.counters.next().checked_sub(1) else { return Ok(false) };
        let lacking = self.command.as_mut().filter(|command| !command.knows(last));
        let lacks = lacking.is_some();
        lacking.map_or(Ok(()), |command| command.sleep(until_ns))?;
        Ok(lacks)
    }

    #[inline]
    fn finish_tick(&mut self) -> Result<(), NodeError> {
        let Some(tick) = self.unfinished.take() else { return Ok(()) };
        self.stage_truth(tick)?;
        self.truth.dispatch()?;
        let before_ns = self.clock.now_ns();
        self.plant.advance(1);
        if self.clock == Clock::Monotonic {
            self.step.record(before_ns, self.clock.now_ns());
        }
        self.measurement.finish()?;
        Ok(self.truth.finish()?)
    }

    fn finish(&mut self) -> Result<(), NodeError> {
        self.finish_tick()?;
        let (missed, until_ns) = self.missed.rest(self.counters.next());
        self.enter_missed(missed, until_ns);
        commit_last(self);
        Ok(())
    }

    fn skip_to(&mut self, tick: u64) {
        self.behind += self.counters.skip_to(tick);
    }

    fn warm_up(&mut self) -> Result<(), NodeError> {
        if let Some(command) = &mut self.command {
            command.warm_up()?;
        }
        self.measurement.warm_up()?;
        Ok(self.truth.warm_up()?)
    }

    fn refresh(&mut self) -> Result<(), NodeError> {
        if let Some(command) = &mut self.command {
            command.refresh();
        }
        self.measurement.refresh()?;
        Ok(self.truth.refresh()?)
    }

    fn numbers(&mut self, visit: &mut dyn FnMut(&mut f64)) {
        let mut numbers = NumberWords(visit);
        self.plant.persist(&mut numbers);
        let fields = &self.command_fields;
        let in_flight = self.line.iter_mut().flat_map(DelayLine::in_flight_mut);
        in_flight.for_each(|command| numbers.sample(command.borrow_mut().words_mut(), |word| is_number(fields, word)));
    }

    fn late_inputs(&self) -> u64 {
        self.inputs.late()
    }

    fn clear_stages(&mut self) {
        [&mut self.lateness, &mut self.age, &mut self.step].into_iter().for_each(Latency::clear);
    }

    fn stages(&self) -> Vec<StageReport> {
        StageReport::all(&[("lateness", &self.lateness), ("age", &self.age), ("step", &self.step)])
    }
}

impl<P: LinkedBody, G: Persist, B: Bus> Persistent for PlantNode<P, G, B> {
    fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    #[inline]
    fn counters<W: Words>(&mut self, words: &mut W) {
        self.counters.persist(words);
        self.measurement.persist(words);
        self.truth.persist(words);
        self.command.iter_mut().for_each(|command| command.counters().persist(words));
    }

    #[inline]
    fn state<W: Words>(&mut self, words: &mut W) {
        self.plant.persist(words);
        self.unfinished.persist(words);
        self.behind.persist(words);
        self.acting_ns.persist(words);
        self.command.iter_mut().for_each(|command| command.persist(words));
        if let Some(line) = &mut self.line {
            line.persist(words, |command, words| command.borrow_mut().words_mut().persist(words));
        }
        self.measurement.persist_late(words);
    }
}
