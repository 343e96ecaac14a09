//! A controller on a bus: reads the first body's estimate, and measurement and own estimate of every driven body; sends a command to each.

use super::channel::{AnyChannel, Channel, Channels, Single, Stages};
use super::context::{LOOK_NS, NodeContext};
use super::contract::{Node, Poll, RunCondition, counted};
use super::persistent::{Inherited, Persistent, commit, commit_last, restore};
use super::ports::{driven, is_self_observed};
use crate::bus::{Bus, BusError, Signal};
use crate::clock::{Clock, Grid, monotonic_ns, sleep_until};
use crate::config::InputUser;
use crate::control::Watchdog;
use crate::rig::{BodyInfo, Command, Estimate, Fleet, FleetCommand, Rig, Watched};
use crate::runtime::disturb::Interruptions;
use crate::runtime::error::NodeError;
use crate::runtime::hooks::{self, Failpoint};
use crate::runtime::link::{AcceptedTicks, Input, Output, Seek};
use crate::runtime::role_id::RoleId;
use crate::runtime::role_inputs::RoleInputs;
use crate::runtime::sample_source::{Progress, SampleSource};
use crate::sample::Message;
use crate::serial::LineCounters;
use crate::state::{Persist, Words};
use crate::telemetry::{Latency, Ledger, LedgerError, Outage, StageReport, TickCounters};

/// A controller with its links and counters.
pub struct ControllerNode<R: Rig, B: Bus> {
    rig: R,
    estimate: Input<B, Estimate<R>, R::EstimateGuard>,
    channels: Channels<R, B>,
    clock: Clock,
    counters: TickCounters,
    watchdog: Watchdog,
    interruptions: Interruptions,
    inputs: RoleInputs,
    ledger: Ledger,
    /// The source of the commands, if not the laws.
    source: Option<SampleSource>,
    every_ticks: u64,
    /// The channel, counted over bodies and fleets, that the next idle poll reads.
    look: usize,
    stages: Stages,
}

impl<R: Rig, B: Bus> ControllerNode<R, B> {
    pub fn open(rig: &R, context: &NodeContext<'_, B>, source: Option<SampleSource>) -> Result<Self, BusError> {
        let bodies = |fleets: bool| driven(rig.bodies()).filter(move |(_, body)| body.fleet.is_some() == fleets);
        // In the order of the counters: all outputs, then all inputs; fleets last.
        let written = |(_, body)| context.output(body, Signal::Command);
        let commands: Vec<Output<B, Command<R>>> = bodies(false).map(written).collect::<Result<_, _>>()?;
        let written = |(_, body)| context.output(body, Signal::Command);
        let fleet_commands: Vec<Output<B, FleetCommand<R>>> = bodies(true).map(written).collect::<Result<_, _>>()?;
        let estimate = context.input(&rig.bodies()[0], Signal::Estimate, rig.estimate_guard())?;
        let channel = |((index, body), command): ((usize, &BodyInfo), _)| {
            Channel::open(index, (body, command), rig.law(index), rig.measurement_guard(index, true), context)
        };
        let mut single = bodies(false).zip(commands).map(channel).collect::<Result<Vec<Single<R, B>>, BusError>>()?;
        let channel = |((index, body), command): ((usize, &BodyInfo), _)| {
            let fleet = rig.fleet(index)?;
            Some(Channel::open(index, (body, command), fleet.law(), fleet.measurement_guard(), context))
        };
        let fleets = bodies(true).zip(fleet_commands).filter_map(channel).collect::<Result<_, BusError>>()?;
        for (channel, (index, body)) in single.iter_mut().zip(bodies(false)) {
            if is_self_observed(index, &context.scenario.bodies[index]) {
                channel.own_estimate = Some(context.input(body, Signal::Estimate, rig.estimate_guard())?);
            }
        }
        Ok(Self {
            rig: rig.clone(),
            estimate,
            channels: Channels { single, fleets },
            clock: context.clock,
            counters: TickCounters::new(context.scenario.realtime.start_grace_ticks),
            watchdog: Watchdog::new(context.scenario.watch),
            interruptions: context.interruptions(),
            inputs: context.inputs(|user| matches!(user, InputUser::Law(_) | InputUser::Reference)),
            ledger: context.ledger.reopened(),
            source,
            every_ticks: context.scenario.rates.controller_ticks,
            look: 0,
            stages: Stages {
                late_ns: context.scenario.realtime.late_ns(context.scenario.period_ns),
                ..Stages::default()
            },
        })
    }

    /// Returns true while the estimate of the next tick may still arrive.
    pub fn lacks_estimate(&self) -> bool {
        !self.estimate.knows(self.counters.next())
    }

    /// Looks for all inputs of the next tick, or of the first later one with an estimate.
    #[inline]
    fn gather(&mut self, overdue: bool) -> Result<bool, NodeError> {
        if self.estimate.seek(self.counters.next())? == Seek::NotYet {
            if let Some(tick) = self.source.as_ref().and_then(SampleSource::lacks) {
                self.offer(tick, overdue)?;
            } else if self.clock == Clock::Monotonic {
                // Meanwhile read one measurement, so that all are there when the estimate arrives, usually last.
                self.look_ahead()?;
            }
            return Ok(false);
        }
        let Some(tick) = self.estimate.sample().map(|estimate| estimate.stamp().tick) else {
            // In lockstep the counters must not depend on the order of arrival.
            if self.clock == Clock::Monotonic || self.gather_measurements(self.counters.next())? {
                self.pass_over()?;
            }
            return Ok(false);
        };
        Ok(self.gather_measurements(tick)? || overdue)
    }

    /// Looks for the measurements of a tick; returns true once each has arrived or is known to be missing.
    #[inline]
    fn gather_measurements(&mut self, tick: u64) -> Result<bool, NodeError> {
        let mut complete = true;
        for channel in self.channels.iter_mut() {
            complete &= channel.gather(tick)?;
        }
        Ok(complete)
    }

    /// Passes the measurements of a tick to a device that also computes the estimate, once each has arrived or is known
    /// to be missing.
    fn offer(&mut self, tick: u64, overdue: bool) -> Result<(), NodeError> {
        let complete = self.gather_measurements(tick)?;
        if let Some(source) = self.source.as_mut().filter(|_| complete || overdue) {
            source.offer(std::iter::once(None).chain(self.channels.iter().map(AnyChannel::words)));
        }
        Ok(())
    }

    /// Reads one channel, the next one at each call.
    #[inline]
    fn look_ahead(&mut self) -> Result<(), NodeError> {
        let all = self.channels.iter().count();
        self.look = if self.look + 1 < all { self.look + 1 } else { 0 };
        if let Some(channel) = self.channels.iter_mut().nth(self.look) {
            channel.gather(u64::MAX)?;
        }
        Ok(())
    }

    /// Passes over ticks without a usable estimate.
    #[cold]
    fn pass_over(&mut self) -> Result<(), NodeError> {
        let next = self.counters.next();
        for tick in next..=self.estimate.last_tick().unwrap_or(next) {
            self.counters.pass(self.interruptions.misses(tick));
            self.send_nothing(tick)?;
        }
        Ok(())
    }

    /// Skips a tick, and those before it, for a scripted fault.
    #[cold]
    fn miss(&mut self, tick: u64) -> Result<Poll, NodeError> {
        self.skip_to(tick);
        self.counters.pass(true);
        self.send_nothing(tick)?;
        Ok(Poll::Missed)
    }

    /// Passes over a tick on every channel, with no-sample markers where readers wait.
    fn send_nothing(&mut self, tick: u64) -> Result<(), NodeError> {
        self.channels.iter_mut().try_for_each(|channel| channel.pass_over(tick))?;
        commit(self);
        self.dispatch()?;
        self.finish_commands()
    }

    /// Sends the staged commands.
    #[inline]
    fn dispatch(&mut self) -> Result<(), NodeError> {
        self.channels.iter_mut().try_for_each(AnyChannel::dispatch)
    }

    fn finish_commands(&mut self) -> Result<(), NodeError> {
        self.channels.iter_mut().try_for_each(AnyChannel::finish_command)
    }

    /// Passes the estimate's monitored quantities to the watchdog.
    #[inline]
    fn watch(&mut self) {
        let Some(estimate) = self.estimate.sample() else { return };
        let tick = estimate.stamp().tick;
        for (quantity, monitor) in R::monitors().iter().enumerate() {
            match monitor.watched {
                Watched::Constant(quantity_of) if self.watchdog.watches(quantity, tick) => {
                    self.watchdog.check_constant(quantity, tick, quantity_of(&self.rig, estimate));
                }
                Watched::Small(quantity_of) if self.watchdog.watches(quantity, tick) => {
                    self.watchdog.check_magnitude(quantity, tick, quantity_of(&self.rig, estimate));
                }
                _ => {}
            }
        }
    }

    /// Passes a command's monitored quantities to the watchdog.
    #[inline]
    fn watch_command(watchdog: &mut Watchdog, tick: u64, command: &Command<R>) {
        for (quantity, monitor) in R::monitors().iter().enumerate() {
            if let Watched::Commanded(quantity_of) = monitor.watched
                && watchdog.watches(quantity, tick)
                && let Some(value) = quantity_of(command)
            {
                watchdog.check_magnitude(quantity, tick, value);
            }
        }
    }

    #[inline]
    fn execute(&mut self) -> Result<Poll, NodeError> {
        self.stages.received_ns = self.clock.now_ns();
        let mut began_ns = self.stages.received_ns;
        let Some(stamp) = self.estimate.sample().map(|estimate| *estimate.stamp()) else { return Ok(Poll::Waiting) };
        if self.interruptions.misses(stamp.tick) {
            return self.miss(stamp.tick);
        }
        let due = stamp.tick.is_multiple_of(self.every_ticks);
        if let Some(source) = self.source.as_mut().filter(|_| due) {
            let estimate = std::iter::once(self.estimate.sample().map(Message::words));
            let own = self.channels.single.iter().filter_map(Channel::own_words);
            match source.tick(stamp.tick, estimate.chain(self.channels.iter().map(AnyChannel::words)).chain(own))? {
                Progress::Done => {
                    began_ns = source.asked_ns(stamp.tick).unwrap_or(began_ns);
                    // A device that also computes the estimate was asked before the estimate was sent.
                    if !source.makes_estimate() {
                        self.stages.received_ns = began_ns;
                    }
                }
                Progress::Waiting => return Ok(Poll::Waiting),
                Progress::Missed => {
                    self.skip_to(stamp.tick + 1);
                    return Ok(Poll::Missed);
                }
            }
            if source.restarted() {
                self.counters.disturbed(stamp.tick);
            }
        }
        hooks::at(Failpoint::Computing);
        if self.inputs.is_due(stamp.tick) {
            let channels = &mut self.channels;
            self.inputs.advance(stamp.tick, |new| channels.set_input(new));
        }
        if self.watchdog.active() {
            self.watch();
        }
        let Some(estimate) = self.estimate.sample() else { return Ok(Poll::Waiting) };
        let silent = self.watchdog.latched_at().is_some();
        let clock = self.clock;
        let mut starved = false;
        let single = self.channels.single.len();
        for (index, channel) in self.channels.iter_mut().enumerate() {
            // A fleet has no device.
            let computed = self.source.as_ref().filter(|_| index < single).map(|source| (source, index));
            began_ns = channel.execute(estimate, silent, (clock, began_ns), &mut starved, computed)?;
        }
        if self.watchdog.active() {
            for channel in self.channels.single.iter().filter(|channel| channel.ready) {
                Self::watch_command(&mut self.watchdog, stamp.tick, channel.command.last());
            }
        }
        (self.stages.origin_ns, self.stages.estimate_sent_ns) = (stamp.origin_ns, stamp.sent_ns);
        (self.stages.tick, self.stages.starved, self.stages.late) = (stamp.tick, starved, None);
        self.skip_to(stamp.tick);
        if starved {
            let absent = self.channels.iter().find_map(AnyChannel::absent);
            self.counters.starved(stamp.tick, absent.map_or(0, RoleId::number));
        }
        self.counters.executed();
        commit(self);
        self.dispatch()?;
        Ok(Poll::Executed)
    }
}

impl<R: Rig, B: Bus> Node for ControllerNode<R, B> {
    counted!();

    fn time_triggered(&self) -> bool {
        false
    }

    fn restore(&mut self) -> Result<(), LedgerError> {
        if restore(self)? == Inherited::Counters {
            self.counters.restarted_without_state();
        }
        self.estimate.expect_repeats();
        self.channels.iter_mut().for_each(AnyChannel::expect_repeats);
        Ok(())
    }

    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), NodeError> {
        if self.clock == Clock::Monotonic {
            self.estimate.expect(AcceptedTicks::Due(grid));
            self.source.iter_mut().for_each(|source| source.start(grid));
        }
        let channels = &mut self.channels;
        self.inputs.resume(self.counters.next(), |new| channels.set_input(new));
        self.dispatch()?;
        self.finish_commands()?;
        let next = self.counters.next();
        self.stages.missed.start(self.clock, grid, next);
        self.channels.iter_mut().for_each(|channel| channel.start(self.clock, grid, next));
        self.skip_to(first_tick);
        Ok(())
    }

    #[inline]
    fn poll(&mut self, condition: RunCondition) -> Result<Poll, NodeError> {
        let inputs = if let RunCondition::Inputs { up_to } = condition { Some(up_to) } else { None };
        let allowed = inputs.is_none_or(|up_to| self.counters.next() <= up_to);
        // In real time a skipped tick does not wait for its inputs.
        if inputs.is_none() && self.interruptions.misses(self.counters.next()) {
            return self.miss(self.counters.next());
        }
        if allowed && self.gather(condition == RunCondition::Overdue)? { self.execute() } else { Ok(Poll::Waiting) }
    }

    fn awaits(&self) -> Option<RoleId> {
        let next = self.counters.next();
        let late = self.channels.iter().find_map(|channel| channel.late(next));
        Some(late.unwrap_or(RoleId::Observer(0)))
    }

    /// The estimate usually arrives last; the other inputs are there by then.
    fn sleep(&mut self, until_ns: u64) -> Result<bool, NodeError> {
        let tick = self.counters.next();
        if self.source.as_ref().is_some_and(SampleSource::pending) {
            // The line delivers the answer.
            sleep_until(until_ns.min(monotonic_ns() + LOOK_NS));
        } else if self.lacks_estimate() {
            self.estimate.sleep(until_ns)?;
        } else if let Some(late) = self.channels.iter_mut().find(|channel| channel.late(tick).is_some()) {
            late.sleep(tick, until_ns)?;
        } else {
            return Ok(false);
        }
        Ok(true)
    }

    #[inline]
    fn finish_tick(&mut self) -> Result<(), NodeError> {
        let mut stages = (self.clock == Clock::Monotonic).then_some(&mut self.stages);
        if let Some(Stages { tick, estimate_sent_ns, received_ns, missed, hop, .. }) = stages.as_deref_mut() {
            missed.before(*tick).for_each(|due_ns| hop.record_missed(due_ns, *received_ns));
            hop.record(*estimate_sent_ns, *received_ns);
        }
        self.channels.iter_mut().try_for_each(|channel| channel.finish_tick(stages.as_deref_mut()))?;
        if let Some(late) = self.stages.late.take().filter(|_| !self.stages.starved) {
            self.counters.late(late);
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), NodeError> {
        self.finish_commands()?;
        let (next, stages) = (self.counters.next(), &mut self.stages);
        let (missed, until_ns) = stages.missed.rest(next);
        missed.for_each(|due_ns| stages.hop.record_missed(due_ns, until_ns));
        self.channels.iter_mut().for_each(|channel| channel.enter_rest(next, stages));
        commit_last(self);
        Ok(())
    }

    fn skip_to(&mut self, tick: u64) {
        self.counters.skip_to(tick);
    }

    fn warm_up(&mut self) -> Result<(), NodeError> {
        self.estimate.warm_up()?;
        self.channels.iter_mut().try_for_each(AnyChannel::warm_up)
    }

    fn refresh(&mut self) -> Result<(), NodeError> {
        self.estimate.refresh();
        self.channels.iter_mut().try_for_each(AnyChannel::refresh)
    }

    fn late_inputs(&self) -> u64 {
        self.inputs.late()
    }

    fn clear_stages(&mut self) {
        let Stages { hop, step, age, .. } = &mut self.stages;
        [hop, step, age].into_iter().for_each(Latency::clear);
    }

    fn stages(&self) -> Vec<StageReport> {
        let Stages { hop, step, age, .. } = &self.stages;
        let mut stages = StageReport::all(&[("hop", hop), ("step", step), ("age", age)]);
        let line = self.source.as_ref().and_then(SampleSource::line);
        stages.extend(line.into_iter().flat_map(|(_, serial)| StageReport::all(&[("serial", &serial)])));
        stages
    }

    fn line(&self) -> Option<LineCounters> {
        self.source.as_ref().and_then(SampleSource::line).map(|(counters, _)| counters)
    }

    fn outages(&self) -> Vec<Outage> {
        self.source.as_ref().map_or_else(Vec::new, SampleSource::outages)
    }
}

impl<R: Rig, B: Bus> Persistent for ControllerNode<R, B> {
    fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    #[inline]
    fn counters<W: Words>(&mut self, words: &mut W) {
        self.counters.persist(words);
        self.channels.single.iter_mut().for_each(|channel| channel.command.persist(words));
        self.channels.fleets.iter_mut().for_each(|fleet| fleet.command.persist(words));
        self.estimate.counters().persist(words);
        self.channels.single.iter_mut().for_each(|channel| channel.measurement.counters().persist(words));
        self.channels.fleets.iter_mut().for_each(|fleet| fleet.measurement.counters().persist(words));
        let own = self.channels.single.iter_mut().filter_map(|channel| channel.own_estimate.as_mut());
        own.for_each(|own| own.counters().persist(words));
        self.watchdog.persist(words);
    }

    #[inline]
    fn state<W: Words>(&mut self, words: &mut W) {
        self.estimate.persist(words);
        self.channels.single.iter_mut().for_each(|channel| channel.state(words));
        self.channels.fleets.iter_mut().for_each(|fleet| fleet.state(words));
    }
}
