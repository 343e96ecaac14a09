//! An observer on a bus: reads the measurement of its body, sends the estimate.

use super::context::{LOOK_NS, NodeContext};
use super::contract::{Node, Poll, RunCondition, counted};
use super::held::{Held, repeat};
use super::missed::MissedTicks;
use super::persistent::{Inherited, Persistent, commit, commit_last, restore};
use crate::bus::{Bus, BusError, Signal};
use crate::clock::{Clock, Grid, monotonic_ns, sleep_until};
use crate::config::InputUser;
use crate::rig::{Estimate, Measurement, Rig, further_observer, observer};
use crate::role::Observer;
use crate::runtime::disturb::Interruptions;
use crate::runtime::error::NodeError;
use crate::runtime::hooks::{self, Failpoint};
use crate::runtime::link::{AcceptedTicks, Input, Output, Seek};
use crate::runtime::role_id::RoleId;
use crate::runtime::role_inputs::RoleInputs;
use crate::runtime::sample_source::{Progress, SampleSource};
use crate::sample::Message;
use crate::serial::LineCounters;
use crate::state::{NumberWords, Persist, Words};
use crate::telemetry::{LateRecord, Latency, Ledger, LedgerError, Outage, StageReport, TickCounters};

/// The instants of one executed tick, ns.
#[derive(Debug, Clone, Copy, Default)]
struct Instants {
    tick: u64,
    origin: u64,
    sent: u64,
    received: u64,
    done: u64,
}

/// An observer with its links and counters.
pub struct ObserverNode<R: Rig, B: Bus> {
    /// The index of its body.
    body: usize,
    observer: Observer<R::Estimator>,
    measurement: Input<B, Measurement<R>, R::MeasurementGuard>,
    estimate: Output<B, Estimate<R>>,
    held: Held<Estimate<R>>,
    clock: Clock,
    counters: TickCounters,
    interruptions: Interruptions,
    inputs: RoleInputs,
    ledger: Ledger,
    /// The source of the estimate, if not the observer.
    source: Option<SampleSource>,
    instants: Instants,
    missed: MissedTicks,
    late_ns: u64,
    hop: Latency,
    step: Latency,
    age: Latency,
}

impl<R: Rig, B: Bus> ObserverNode<R, B> {
    /// Opens the observer of the body with index `body`.
    pub fn open(
        rig: &R,
        body: usize,
        context: &NodeContext<'_, B>,
        source: Option<SampleSource>,
    ) -> Result<Self, BusError> {
        let info = &rig.bodies()[body];
        let estimate = context.output(info, Signal::Estimate)?;
        Ok(Self {
            body,
            observer: further_observer(rig, body, context.scenario).unwrap_or_else(|| observer(rig, context.scenario)),
            measurement: context.input(info, Signal::Measurement, rig.measurement_guard(body, false))?,
            estimate,
            held: Held::new(context.scenario.rates.observer_ticks, 1),
            clock: context.clock,
            counters: TickCounters::new(context.scenario.realtime.start_grace_ticks),
            interruptions: context.interruptions(),
            inputs: context.inputs(|user| user == InputUser::Observer),
            ledger: context.ledger.reopened(),
            source,
            instants: Instants::default(),
            missed: MissedTicks::default(),
            late_ns: context.scenario.realtime.late_ns(context.scenario.period_ns),
            hop: Latency::default(),
            step: Latency::default(),
            age: Latency::default(),
        })
    }

    #[inline]
    fn execute(&mut self) -> Result<Poll, NodeError> {
        let mut received = self.clock.now_ns();
        let (measurement, rejected) = (self.measurement.sample(), self.measurement.rejected());
        let Some(stamp) = measurement.map(Message::stamp).or(rejected).copied() else { return self.pass_over() };
        if self.interruptions.misses(stamp.tick) {
            return self.miss(stamp.tick);
        }
        let due = self.observer.is_due(stamp.tick);
        if let Some(source) = self.source.as_mut().filter(|_| due) {
            match source.tick(stamp.tick, [measurement.map(Message::words)].into_iter())? {
                Progress::Done => received = source.asked_ns(stamp.tick).unwrap_or(received),
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
            let observer = &mut self.observer;
            self.inputs.advance(stamp.tick, |new| observer.set_input(new.by.port, new.values));
        }
        if !due && self.held.at(stamp.tick).is_none() {
            return self.pass_over();
        }
        let (observer, source, held, clock) = (&mut self.observer, &self.source, &mut self.held, self.clock);
        let mut done = 0;
        self.estimate.stage(|sample| {
            match measurement {
                _ if !due => held.at(stamp.tick).into_iter().for_each(|held| repeat(held, &stamp, sample)),
                Some(measurement) => observer.step(measurement, sample),
                None => observer.reject(&stamp, sample),
            }
            if due {
                if let Some(source) = source {
                    source.write(0, sample.words_mut());
                }
                held.keep(sample);
            }
            done = clock.now_ns();
            sample.stamp_mut().sent_ns = done;
        })?;
        self.instants = Instants { tick: stamp.tick, origin: stamp.origin_ns, sent: stamp.sent_ns, received, done };
        self.skip_to(stamp.tick);
        self.counters.executed();
        commit(self);
        self.estimate.dispatch()?;
        Ok(Poll::Executed)
    }

    /// Passes over ticks without measurement.
    #[cold]
    fn pass_over(&mut self) -> Result<Poll, NodeError> {
        let next = self.counters.next();
        for tick in next..=self.measurement.last_tick().unwrap_or(next) {
            self.counters.pass(self.interruptions.misses(tick));
            self.send_marker(tick)?;
        }
        Ok(Poll::Waiting)
    }

    /// Skips a tick, and those before it, for a scripted fault.
    #[cold]
    fn miss(&mut self, tick: u64) -> Result<Poll, NodeError> {
        self.skip_to(tick);
        self.counters.pass(true);
        self.send_marker(tick)?;
        Ok(Poll::Missed)
    }

    /// Records missed ticks in every stage from their due instants.
    #[inline]
    fn enter_missed(&mut self, due_ns: impl Iterator<Item = u64>, until_ns: u64) {
        for due_ns in due_ns {
            for stage in [&mut self.hop, &mut self.step, &mut self.age] {
                stage.record_missed(due_ns, until_ns);
            }
        }
    }

    fn send_marker(&mut self, tick: u64) -> Result<(), NodeError> {
        self.estimate.stage_marker(tick);
        commit(self);
        self.estimate.dispatch()?;
        Ok(self.estimate.finish()?)
    }
}

impl<R: Rig, B: Bus> Node for ObserverNode<R, B> {
    counted!();

    fn time_triggered(&self) -> bool {
        false
    }

    fn restore(&mut self) -> Result<(), LedgerError> {
        if restore(self)? == Inherited::Counters {
            self.counters.restarted_without_state();
        }
        self.measurement.expect_repeats();
        Ok(())
    }

    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), NodeError> {
        if self.clock == Clock::Monotonic {
            self.measurement.expect(AcceptedTicks::Due(grid));
            self.source.iter_mut().for_each(|source| source.start(grid));
        }
        let observer = &mut self.observer;
        self.inputs.resume(self.counters.next(), |new| observer.set_input(new.by.port, new.values));
        self.estimate.dispatch()?;
        self.estimate.finish()?;
        self.missed.start(self.clock, grid, self.counters.next());
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
        let there = allowed && self.measurement.seek(self.counters.next())? != Seek::NotYet;
        if there { self.execute() } else { Ok(Poll::Waiting) }
    }

    fn awaits(&self) -> Option<RoleId> {
        Some(RoleId::Plant(self.body))
    }

    fn sleep(&mut self, until_ns: u64) -> Result<bool, NodeError> {
        if self.source.as_ref().is_some_and(SampleSource::pending) {
            // The line delivers the answer.
            sleep_until(until_ns.min(monotonic_ns() + LOOK_NS));
        } else {
            self.measurement.sleep(until_ns)?;
        }
        Ok(true)
    }

    #[inline]
    fn finish_tick(&mut self) -> Result<(), NodeError> {
        if self.clock == Clock::Monotonic {
            let Instants { tick, origin, sent, received, done } = self.instants;
            let missed = self.missed.before(tick);
            self.enter_missed(missed, received);
            self.hop.record(sent, received);
            self.step.record(received, done);
            self.age.record(origin, done);
            if done.saturating_sub(origin) > self.late_ns {
                let sender = RoleId::Plant(self.body).number();
                let (due_ns, input_ns, began_ns, done_ns) = (origin, sent, received, done);
                let instants = LateRecord { due_ns, input_ns, began_ns, done_ns, ..LateRecord::default() };
                self.counters.late(LateRecord { tick, sender, ..instants });
            }
        }
        Ok(self.estimate.finish()?)
    }

    fn finish(&mut self) -> Result<(), NodeError> {
        self.estimate.finish()?;
        let (missed, until_ns) = self.missed.rest(self.counters.next());
        self.enter_missed(missed, until_ns);
        commit_last(self);
        Ok(())
    }

    fn skip_to(&mut self, tick: u64) {
        self.counters.skip_to(tick);
    }

    fn warm_up(&mut self) -> Result<(), NodeError> {
        self.measurement.warm_up()?;
        Ok(self.estimate.warm_up()?)
    }

    fn refresh(&mut self) -> Result<(), NodeError> {
        self.measurement.refresh();
        Ok(self.estimate.refresh()?)
    }

    fn numbers(&mut self, visit: &mut dyn FnMut(&mut f64)) {
        self.observer.persist(&mut NumberWords(visit));
    }

    fn late_inputs(&self) -> u64 {
        self.inputs.late()
    }

    fn clear_stages(&mut self) {
        [&mut self.hop, &mut self.step, &mut self.age].into_iter().for_each(Latency::clear);
    }

    fn stages(&self) -> Vec<StageReport> {
        let mut stages = StageReport::all(&[("hop", &self.hop), ("step", &self.step), ("age", &self.age)]);
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

impl<R: Rig, B: Bus> Persistent for ObserverNode<R, B> {
    fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    #[inline]
    fn counters<W: Words>(&mut self, words: &mut W) {
        self.counters.persist(words);
        self.estimate.persist(words);
        self.measurement.counters().persist(words);
    }

    #[inline]
    fn state<W: Words>(&mut self, words: &mut W) {
        self.observer.persist(words);
        self.held.persist(words);
        self.measurement.persist(words);
        self.estimate.persist_late(words);
    }
}
