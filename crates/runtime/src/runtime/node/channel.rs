//! The controller's links to a driven body or fleet.

use super::context::NodeContext;
use super::held::{Held, repeat};
use super::missed::MissedTicks;
use crate::bus::{Bus, BusError, Carried, Signal};
use crate::clock::{Clock, Grid};
use crate::config::InputUser;
use crate::rig::{BodyInfo, Estimate, Fleet, Rig, controller};
use crate::role::{Controller, Guard, Law};
use crate::runtime::error::NodeError;
use crate::runtime::link::{AcceptedTicks, Input, Output, Seek};
use crate::runtime::role_id::RoleId;
use crate::runtime::role_inputs::NewValue;
use crate::runtime::sample_source::SampleSource;
use crate::sample::Message;
use crate::state::{Persist, Words};
use crate::telemetry::{LateRecord, Latency};

/// The channel of a single driven body.
pub type Single<R, B> = Channel<<R as Rig>::Law, <R as Rig>::MeasurementGuard, <R as Rig>::EstimateGuard, B>;
/// The channel of a fleet.
pub type Many<R, B> = Channel<
    <<R as Rig>::Fleet as Fleet<Estimate<R>>>::Law,
    <<R as Rig>::Fleet as Fleet<Estimate<R>>>::MeasurementGuard,
    <R as Rig>::EstimateGuard,
    B,
>;

/// The channels of a controller: those of the single bodies, then those of the fleets.
pub struct Channels<R: Rig, B: Bus> {
    pub single: Vec<Single<R, B>>,
    pub fleets: Vec<Many<R, B>>,
}

impl<R: Rig, B: Bus> Channels<R, B> {
    #[inline]
    pub fn iter(&self) -> impl Iterator<Item = &dyn AnyChannel<Estimate<R>>> {
        let single = self.single.iter().map(|channel| channel as &dyn AnyChannel<_>);
        single.chain(self.fleets.iter().map(|channel| channel as &dyn AnyChannel<_>))
    }

    #[inline]
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut dyn AnyChannel<Estimate<R>>> {
        let single = self.single.iter_mut().map(|channel| channel as &mut dyn AnyChannel<_>);
        single.chain(self.fleets.iter_mut().map(|channel| channel as &mut dyn AnyChannel<_>))
    }

    /// Passes new values of an input to the law that uses it.
    pub fn set_input(&mut self, new: NewValue<'_>) {
        self.iter_mut().for_each(|channel| channel.set_input(new));
    }
}

/// The controller's links to one driven body or fleet.
pub struct Channel<L: Law<Measurement: Carried, Command: Carried>, G, E, B: Bus> {
    /// The body's index.
    body: usize,
    controller: Controller<L>,
    pub measurement: Input<B, L::Measurement, G>,
    /// The estimate of the body's own state; `None` for the first body and for one without observer.
    pub own_estimate: Option<Input<B, L::Estimate, E>>,
    pub command: Output<B, L::Command>,
    held: Held<L::Command>,
    /// True while the measurement of the current tick is available, and its own estimate.
    measured: bool,
    estimated: bool,
    /// True while every input of the current tick is available and a command will be sent.
    pub ready: bool,
    /// Start of the current command's computation, and its sending, ns; 0 if no command was sent.
    began_ns: u64,
    sent_ns: u64,
    missed: MissedTicks,
}

impl<L, G, E, B> Channel<L, G, E, B>
where
    L: Law<Measurement: Carried, Command: Carried>,
    G: Guard<L::Measurement>,
    E: Guard<L::Estimate>,
    B: Bus,
{
    pub fn open(
        index: usize,
        (body, command): (&BodyInfo, Output<B, L::Command>),
        law: L,
        guard: G,
        context: &NodeContext<'_, B>,
    ) -> Result<Self, BusError> {
        Ok(Self {
            body: index,
            controller: controller(law, context.scenario),
            measurement: context.input(body, Signal::Measurement, guard)?,
            own_estimate: None,
            command,
            held: Held::new(context.scenario.rates.controller_ticks, body.bodies()),
            measured: false,
            estimated: false,
            ready: false,
            began_ns: 0,
            sent_ns: 0,
            missed: MissedTicks::default(),
        })
    }

    /// Returns the own estimate of the current tick as words; `None` if the channel has no such input.
    pub fn own_words(&self) -> Option<Option<&[u64]>> {
        let own = self.own_estimate.as_ref()?;
        Some(own.sample().filter(|_| self.estimated).map(Message::words))
    }

    pub fn state<W: Words>(&mut self, words: &mut W)
    where
        L: Persist,
        G: Persist,
        E: Persist,
    {
        self.controller.persist(words);
        self.held.persist(words);
        self.measurement.persist(words);
        self.own_estimate.iter_mut().for_each(|own| own.persist(words));
        self.command.persist_late(words);
    }
}

/// The operations of a controller on each of its channels.
pub trait AnyChannel<E> {
    /// Accepts the samples that a predecessor has already used.
    fn expect_repeats(&mut self);
    /// Passes new values of an input to the law, if it is for this body.
    fn set_input(&mut self, new: NewValue<'_>);
    /// Sets the time grid and the first tick that counts.
    fn start(&mut self, clock: Clock, grid: Grid, next: u64);
    /// Looks for the measurement and the own estimate of a tick; returns true once each has arrived or is known to be missing.
    fn gather(&mut self, tick: u64) -> Result<bool, NodeError>;
    /// Returns the sender of an input of this tick that may still arrive.
    fn late(&self, tick: u64) -> Option<RoleId>;
    /// Returns the sender of an input that the current tick lacks.
    fn absent(&self) -> Option<RoleId>;
    /// Returns the measurement of the current tick as words.
    fn words(&self) -> Option<&[u64]>;
    /// Passes over a tick without command.
    fn pass_over(&mut self, tick: u64) -> Result<(), NodeError>;
    /// Stages the command of this tick, begun at `began_ns`, unless an input is missing or the watchdog is latched.
    /// Returns the start of the next command's computation; sets `starved` if an input is missing.
    fn execute(
        &mut self,
        estimate: &E,
        silent: bool,
        began: (Clock, u64),
        starved: &mut bool,
        computed: Option<(&SampleSource, usize)>,
    ) -> Result<u64, NodeError>;
    /// Sends the staged command.
    fn dispatch(&mut self) -> Result<(), NodeError>;
    /// Prepares the next command.
    fn finish_command(&mut self) -> Result<(), NodeError>;
    /// Waits for an input of this tick that may still arrive, or for the next measurement.
    fn sleep(&mut self, tick: u64, until_ns: u64) -> Result<(), NodeError>;
    /// Records the latencies of a sent command, and prepares the next one.
    fn finish_tick(&mut self, stages: Option<&mut Stages>) -> Result<(), NodeError>;
    /// Records the missed commands before `tick` at the end of the run.
    fn enter_rest(&mut self, tick: u64, stages: &mut Stages);
    fn warm_up(&mut self) -> Result<(), NodeError>;
    fn refresh(&mut self) -> Result<(), NodeError>;
}

impl<L, G, E, B> AnyChannel<L::Estimate> for Channel<L, G, E, B>
where
    L: Law<Measurement: Carried, Command: Carried>,
    G: Guard<L::Measurement>,
    E: Guard<L::Estimate>,
    B: Bus,
{
    fn expect_repeats(&mut self) {
        self.measurement.expect_repeats();
        self.own_estimate.iter_mut().for_each(Input::expect_repeats);
    }

    fn set_input(&mut self, new: NewValue<'_>) {
        match new.by.user {
            InputUser::Law(body) if body == self.body => self.controller.set_input(new.by.port, new.values),
            InputUser::Reference => self.controller.set_reference(new.by.port, new.values),
            _ => {}
        }
    }

    fn start(&mut self, clock: Clock, grid: Grid, next: u64) {
        if clock == Clock::Monotonic {
            self.measurement.expect(AcceptedTicks::Due(grid));
            self.own_estimate.iter_mut().for_each(|own| own.expect(AcceptedTicks::Due(grid)));
        }
        self.missed.start(clock, grid, next);
    }

    #[inline]
    fn dispatch(&mut self) -> Result<(), NodeError> {
        Ok(self.command.dispatch()?)
    }

    #[inline]
    fn finish_command(&mut self) -> Result<(), NodeError> {
        Ok(self.command.finish()?)
    }

    fn sleep(&mut self, tick: u64, until_ns: u64) -> Result<(), NodeError> {
        match &mut self.own_estimate {
            Some(own) if self.measurement.knows(tick) => own.sleep(until_ns)?,
            _ => self.measurement.sleep(until_ns)?,
        };
        Ok(())
    }

    #[inline]
    fn gather(&mut self, tick: u64) -> Result<bool, NodeError> {
        let measured = self.measurement.seek(tick)?;
        let mut estimated = Seek::Found;
        if let Some(own) = &mut self.own_estimate {
            estimated = own.seek(tick)?;
        }
        (self.measured, self.estimated) = (measured == Seek::Found, estimated == Seek::Found);
        self.ready = self.measured && self.estimated;
        Ok(measured != Seek::NotYet && estimated != Seek::NotYet)
    }

    #[inline]
    fn late(&self, tick: u64) -> Option<RoleId> {
        let lacks = |own: &Input<B, L::Estimate, E>| !own.knows(tick);
        match self.measurement.knows(tick) {
            false => Some(RoleId::Plant(self.body)),
            true => self.own_estimate.as_ref().is_some_and(lacks).then_some(RoleId::Observer(self.body)),
        }
    }

    fn absent(&self) -> Option<RoleId> {
        let sender = if self.measured { RoleId::Observer(self.body) } else { RoleId::Plant(self.body) };
        (!self.ready).then_some(sender)
    }

    fn words(&self) -> Option<&[u64]> {
        self.measurement.sample().filter(|_| self.measured).map(Message::words)
    }

    fn pass_over(&mut self, tick: u64) -> Result<(), NodeError> {
        // Consumes the unused inputs, which must not fill the links.
        self.measurement.seek(tick)?;
        if let Some(own) = &mut self.own_estimate {
            own.seek(tick)?;
        }
        (self.measured, self.estimated, self.ready) = (false, false, false);
        self.command.stage_marker(tick);
        Ok(())
    }

    #[inline]
    fn execute(
        &mut self,
        estimate: &L::Estimate,
        silent: bool,
        (clock, began_ns): (Clock, u64),
        starved: &mut bool,
        computed: Option<(&SampleSource, usize)>,
    ) -> Result<u64, NodeError> {
        let tick = estimate.stamp().tick;
        let due = self.controller.is_due(tick);
        *starved |= due && !self.ready;
        if silent {
            // The watchdog suppresses the command: it does not count as missed.
            let _ = self.missed.before(tick);
        }
        self.ready = !silent
            && match due {
                true => self.ready && computed.is_none_or(|(source, index)| source.has(index)),
                false => self.held.at(tick).is_some(),
            };
        let measurement = self.measurement.sample().filter(|_| self.ready && due);
        if !self.ready || due && measurement.is_none() {
            self.command.stage_marker(tick);
            return Ok(began_ns);
        }
        let own_estimate = match &self.own_estimate {
            Some(own) => own.sample(),
            None => (self.body == 0).then_some(estimate),
        };
        let (controller, held, sent_ns) = (&mut self.controller, &mut self.held, &mut self.sent_ns);
        self.command.stage(|sample| {
            match measurement {
                None => held.at(tick).into_iter().for_each(|held| repeat(held, estimate.stamp(), sample)),
                Some(measurement) => {
                    controller.step(estimate, own_estimate, measurement, sample);
                    if let Some((source, index)) = computed {
                        source.write(index, sample.words_mut());
                    }
                    held.keep(sample);
                }
            }
            *sent_ns = clock.now_ns();
            sample.stamp_mut().sent_ns = *sent_ns;
        })?;
        self.began_ns = began_ns;
        Ok(self.sent_ns)
    }

    #[inline]
    fn finish_tick(&mut self, stages: Option<&mut Stages>) -> Result<(), NodeError> {
        if let Some(stages) = stages.filter(|_| self.ready) {
            let missed = self.missed.before(stages.tick);
            stages.enter_missed(missed, self.began_ns);
            stages.step.record(self.began_ns, self.sent_ns);
            stages.age.record(stages.origin_ns, self.sent_ns);
            if self.sent_ns.saturating_sub(stages.origin_ns) > stages.late_ns {
                let measured_ns = self.measurement.sample().map_or(0, |measurement| measurement.stamp().sent_ns);
                let own = self.own_estimate.as_ref().and_then(Input::sample);
                let estimated_ns = own.map_or(0, |estimate| estimate.stamp().sent_ns);
                let inputs = [(RoleId::Plant(self.body), measured_ns), (RoleId::Observer(self.body), estimated_ns)];
                stages.enter_late(inputs, self.sent_ns);
            }
        }
        self.finish_command()
    }

    fn enter_rest(&mut self, tick: u64, stages: &mut Stages) {
        let (missed, until_ns) = self.missed.rest(tick);
        stages.enter_missed(missed, until_ns);
    }

    fn warm_up(&mut self) -> Result<(), NodeError> {
        self.measurement.warm_up()?;
        if let Some(own) = &mut self.own_estimate {
            own.warm_up()?;
        }
        Ok(self.command.warm_up()?)
    }

    fn refresh(&mut self) -> Result<(), NodeError> {
        self.measurement.refresh();
        self.own_estimate.iter_mut().for_each(Input::refresh);
        Ok(self.command.refresh()?)
    }
}

/// The latency distributions, and the tick that is recorded.
#[derive(Default)]
pub struct Stages {
    /// The age beyond which a tick is late, ns.
    pub late_ns: u64,
    /// The late command of this tick, if one was late.
    pub late: Option<LateRecord>,
    /// True if a command of this tick was not computed.
    pub starved: bool,
    pub tick: u64,
    /// Origin and sending of the current estimate, and arrival of the last input, ns.
    pub origin_ns: u64,
    pub estimate_sent_ns: u64,
    pub received_ns: u64,
    pub missed: MissedTicks,
    pub hop: Latency,
    pub step: Latency,
    pub age: Latency,
}

impl Stages {
    /// Records a late command, sent at `sent_ns`, and the senders and instants of its other inputs; of several commands the last one.
    #[cold]
    fn enter_late(&mut self, inputs: [(RoleId, u64); 2], sent_ns: u64) {
        let estimate = (RoleId::Observer(0).number(), self.estimate_sent_ns);
        let mut last = self.late.map_or(estimate, |late| (late.sender, late.input_ns));
        for (sender, input_ns) in inputs {
            if input_ns > last.1 {
                last = (sender.number(), input_ns);
            }
        }
        let ((sender, input_ns), tick, due_ns, began_ns) = (last, self.tick, self.origin_ns, self.received_ns);
        let late = LateRecord { tick, sender, due_ns, input_ns, began_ns, done_ns: sent_ns, ..LateRecord::default() };
        self.late = Some(late);
    }

    /// Records missed commands from their due instants.
    #[inline]
    pub fn enter_missed(&mut self, due_ns: impl Iterator<Item = u64>, until_ns: u64) {
        for due_ns in due_ns {
            self.step.record_missed(due_ns, until_ns);
            self.age.record_missed(due_ns, until_ns);
        }
    }
}
