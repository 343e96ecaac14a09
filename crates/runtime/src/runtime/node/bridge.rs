//! A device as a plant: reads the command, sends it over the line, and publishes the answer as measurement and truth.
//!
//! Must not invent anything: a tick without an answer in time has no samples and counts as missed.

use super::context::{LOOK_NS, NodeContext};
use super::contract::{Node, Poll, RunCondition, counted};
use super::missed::MissedTicks;
use super::persistent::{Inherited, Persistent, commit, commit_last, restore};
use crate::bus::{Bus, BusError, Signal};
use crate::clock::{Clock, Grid, monotonic_ns, sleep_until};
use crate::rig::{Command, Measurement, Rig, Sensors, Truth};
use crate::role::CommandEvent;
use crate::runtime::device::DeviceLink;
use crate::runtime::disturb::Interruptions;
use crate::runtime::error::NodeError;
use crate::runtime::link::{AcceptedTicks, Input, Output, Seek};
use crate::runtime::role_id::RoleId;
use crate::sample::{Message, Sample, Stamp, content_length, copy_fields};
use crate::serial::{Answer, LineCounters, Samples};
use crate::state::{Persist, Words};
use crate::telemetry::{LateRecord, Latency, Ledger, LedgerError, Outage, PaceReport, StageReport, TickCounters};

/// A device with its links and counters.
pub struct BridgeNode<R: Rig, B: Bus> {
    link: Box<DeviceLink>,
    command: Input<B, Command<R>, R::CommandGuard>,
    measurement: Output<B, Measurement<R>>,
    truth: Output<B, Truth<R>>,
    clock: Clock,
    grid: Grid,
    last_tick: u64,
    counters: TickCounters,
    interruptions: Interruptions,
    ledger: Ledger,
    /// True once the next tick is requested; the time of the request and the origin of its command, ns.
    asked: bool,
    asked_ns: u64,
    command_origin_ns: Option<u64>,
    /// Origin of the command applied last, ns. The plant may still hold that command.
    acting_ns: Option<u64>,
    missed: MissedTicks,
    reply: Reply<R>,
    sensors: Sensors,
    lateness: Latency,
    late_ns: u64,
    serial: Latency,
    age: Latency,
}

/// The device's last answer.
struct Reply<R: Rig> {
    event: CommandEvent,
    measurement: Measurement<R>,
    truth: Truth<R>,
}

impl<R: Rig> Reply<R> {
    /// Stores an answer. Its lengths match the agreed ones: the host's end drops others.
    fn take(&mut self, answer: &Answer<'_>) {
        self.event = answer.event;
        let (measurement, truth) = answer.outputs.bytes.split_at(content_length::<Measurement<R>>());
        self.measurement.set_content(measurement);
        // The truth without content takes the measured values.
        if !self.truth.set_content(truth) {
            copy_fields(&self.measurement, &mut self.truth);
        }
    }
}

impl<R: Rig, B: Bus> BridgeNode<R, B> {
    pub fn open(rig: &R, index: usize, link: Box<DeviceLink>, context: &NodeContext<'_, B>) -> Result<Self, BusError> {
        let (scenario, body) = (context.scenario, &rig.bodies()[index]);
        let measurement = context.output(body, Signal::Measurement)?;
        let truth = context.output(body, Signal::Truth)?;
        let command = context.input(body, Signal::Command, rig.command_guard(index))?;
        Ok(Self {
            link,
            command,
            measurement,
            truth,
            clock: context.clock,
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            last_tick: scenario.last_tick,
            counters: TickCounters::new(context.scenario.realtime.start_grace_ticks),
            interruptions: context.interruptions(),
            ledger: context.ledger.reopened(),
            asked: false,
            asked_ns: 0,
            command_origin_ns: None,
            acting_ns: None,
            missed: MissedTicks::default(),
            reply: Reply {
                event: CommandEvent::NotDue,
                measurement: Measurement::<R>::default(),
                truth: Truth::<R>::default(),
            },
            sensors: Sensors::new::<Measurement<R>>(scenario, &body.name),
            lateness: Latency::default(),
            late_ns: scenario.realtime.late_ns(scenario.period_ns),
            serial: Latency::default(),
            age: Latency::default(),
        })
    }

    fn inputs_ready(&mut self) -> Result<bool, NodeError> {
        let next = self.counters.next();
        Ok(next == 0 || self.command.seek(next - 1)? != Seek::NotYet)
    }

    /// Counts the ticks before `tick` as missed, and records their lateness.
    fn catch_up(&mut self, tick: u64, now_ns: u64) {
        for missed in self.counters.next()..tick {
            self.lateness.record_missed(self.grid.due_ns(missed), now_ns);
        }
        self.skip_to(tick);
    }

    /// Requests the next tick from the device, with its command if present.
    #[inline]
    fn ask(&mut self, now_ns: u64) -> Result<(), NodeError> {
        let tick = self.counters.next();
        let found = tick > 0 && self.command.seek(tick - 1)? == Seek::Found;
        // A device that was lost applies its safe command until the grid follows it again.
        let command = self.command.sample().filter(|_| found && !self.link.withholds_commands());
        self.command_origin_ns = command.map(|command| command.stamp().origin_ns);
        let samples = command.map_or(Samples::default(), |command| Samples { present: 1, bytes: command.content() });
        self.link.request(tick, samples, now_ns);
        (self.asked, self.asked_ns) = (true, now_ns);
        Ok(())
    }

    /// Serves the line; publishes the samples if the answer has arrived.
    #[inline]
    fn look(&mut self) -> Result<Poll, NodeError> {
        let (now_ns, reply) = (monotonic_ns(), &mut self.reply);
        let mut answered = false;
        self.link.turn(now_ns, |answer| {
            reply.take(answer);
            answered = true;
        })?;
        if answered { self.publish(now_ns) } else { Ok(Poll::Waiting) }
    }

    fn publish(&mut self, now_ns: u64) -> Result<Poll, NodeError> {
        let (tick, clock) = (self.counters.next(), self.clock);
        let origin_ns = self.grid.due_ns(tick);
        self.sensors.hold(tick, self.reply.measurement.words_mut());
        let Reply { event, measurement, truth } = &self.reply;
        let stamp = Stamp { tick, origin_ns, sent_ns: clock.now_ns(), ..Stamp::default() };
        self.measurement.stage(|sample| {
            *sample = *measurement;
            *sample.stamp_mut() = stamp;
        })?;
        // Staged now, because a successor could not request this tick again.
        self.truth.stage(|sample| {
            *sample = *truth;
            *sample.stamp_mut() = stamp;
        })?;
        if event.missed() {
            self.counters.starved(tick, RoleId::Controller.number());
        } else if clock == Clock::Monotonic && self.asked_ns.saturating_sub(origin_ns) > self.late_ns {
            let (due_ns, asked_ns) = (origin_ns, self.asked_ns);
            self.counters.late(LateRecord {
                tick,
                due_ns,
                began_ns: asked_ns,
                done_ns: asked_ns,
                ..LateRecord::default()
            });
        }
        if self.link.counters().restarts > 0 {
            self.counters.disturbed(tick);
        }
        if matches!(event, CommandEvent::Expired | CommandEvent::Safe) {
            self.counters.safe();
        }
        if self.clock == Clock::Monotonic {
            let (event, missed) = (*event, self.missed.before(tick));
            self.enter_missed(missed, now_ns);
            self.serial.record(self.asked_ns, now_ns);
            match (event, self.command_origin_ns) {
                (CommandEvent::Applied, Some(origin_ns)) => {
                    self.acting_ns = Some(origin_ns);
                    self.age.record(origin_ns, now_ns);
                }
                _ => self.acting_ns.iter().for_each(|acting_ns| self.age.record_missed(*acting_ns, now_ns)),
            }
        }
        self.asked = false;
        self.counters.executed();
        commit(self);
        self.measurement.dispatch()?;
        Ok(Poll::Executed)
    }

    /// Records missed ticks in the stages from their due instants; the previous command acted on them.
    fn enter_missed(&mut self, due_ns: impl Iterator<Item = u64>, until_ns: u64) {
        for due_ns in due_ns {
            self.serial.record_missed(due_ns, until_ns);
            self.acting_ns.iter().for_each(|acting_ns| self.age.record_missed(*acting_ns, due_ns));
        }
    }

    /// Skips the next tick for a scripted fault; the device is not asked either.
    #[cold]
    fn miss(&mut self) -> Result<Poll, NodeError> {
        let tick = self.counters.next();
        self.measurement.stage_marker(tick);
        self.truth.stage_marker(tick);
        self.counters.pass(true);
        commit(self);
        self.measurement.dispatch()?;
        self.finish_tick()?;
        Ok(Poll::Missed)
    }

    /// Gives up the current tick at its cutoff.
    fn give_up(&mut self) -> Poll {
        self.link.give_up();
        self.asked = false;
        self.counters.skip_to(self.counters.next() + 1);
        Poll::Missed
    }
}

impl<R: Rig, B: Bus> Node for BridgeNode<R, B> {
    counted!();

    fn time_triggered(&self) -> bool {
        true
    }

    fn restore(&mut self) -> Result<(), LedgerError> {
        if restore(self)? == Inherited::Counters {
            self.counters.restarted_without_state();
        }
        self.command.expect_repeats();
        Ok(())
    }

    /// The device keeps its own state and needs nothing from a predecessor.
    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), NodeError> {
        self.grid = grid;
        self.missed.start(self.clock, grid, self.counters.next());
        if self.clock == Clock::Monotonic {
            self.command.expect(AcceptedTicks::Due(grid));
        }
        self.link.start(grid, monotonic_ns())?;
        self.measurement.dispatch()?;
        self.measurement.finish()?;
        self.truth.dispatch()?;
        self.truth.finish()?;
        self.skip_to(first_tick);
        Ok(())
    }

    #[inline]
    fn poll(&mut self, condition: RunCondition) -> Result<Poll, NodeError> {
        match condition {
            RunCondition::Inputs { up_to } => {
                if !self.asked && self.counters.next() <= up_to && self.inputs_ready()? {
                    if self.interruptions.misses(self.counters.next()) {
                        return self.miss();
                    }
                    self.ask(monotonic_ns())?;
                }
            }
            RunCondition::Now { tick, now_ns } => {
                self.catch_up(tick.min(self.last_tick + 1), now_ns);
                if self.counters.next() > self.last_tick {
                    return Ok(Poll::Waiting);
                }
                self.lateness.record(self.grid.due_ns(tick), now_ns);
                if self.interruptions.misses(self.counters.next()) {
                    return self.miss();
                }
                self.ask(now_ns)?;
            }
            RunCondition::Arrived | RunCondition::Overdue => {}
        }
        let polled = if self.asked { self.look()? } else { Poll::Waiting };
        let overdue = self.asked && condition == RunCondition::Overdue;
        Ok(if overdue { self.give_up() } else { polled })
    }

    fn awaits(&self) -> Option<RoleId> {
        None
    }

    /// Waits for the line or for a command.
    fn sleep(&mut self, until_ns: u64) -> Result<bool, NodeError> {
        if self.asked {
            sleep_until(until_ns.min(monotonic_ns() + LOOK_NS));
        } else {
            self.command.sleep(until_ns)?;
        }
        Ok(true)
    }

    #[inline]
    fn finish_tick(&mut self) -> Result<(), NodeError> {
        self.truth.dispatch()?;
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
        if self.counters.skip_to(tick) > 0 && self.asked {
            self.link.give_up();
            self.asked = false;
        }
    }

    fn warm_up(&mut self) -> Result<(), NodeError> {
        self.command.warm_up()?;
        self.measurement.warm_up()?;
        Ok(self.truth.warm_up()?)
    }

    fn refresh(&mut self) -> Result<(), NodeError> {
        self.command.refresh();
        self.measurement.refresh()?;
        Ok(self.truth.refresh()?)
    }

    fn stages(&self) -> Vec<StageReport> {
        StageReport::all(&[("lateness", &self.lateness), ("serial", &self.serial), ("age", &self.age)])
    }

    fn clear_stages(&mut self) {
        [&mut self.lateness, &mut self.serial, &mut self.age].into_iter().for_each(Latency::clear);
    }

    fn line(&self) -> Option<LineCounters> {
        Some(self.link.counters())
    }

    fn outages(&self) -> Vec<Outage> {
        self.link.outages()
    }

    fn pace(&self) -> Option<PaceReport> {
        self.link.pace()
    }
}

/// In the order of a simulated plant, so that readers of the counters need not distinguish the two.
impl<R: Rig, B: Bus> Persistent for BridgeNode<R, B> {
    fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    fn counters<W: Words>(&mut self, words: &mut W) {
        self.counters.persist(words);
        self.measurement.persist(words);
        self.truth.persist(words);
        self.command.counters().persist(words);
    }

    fn state<W: Words>(&mut self, words: &mut W) {
        self.command.persist(words);
        self.acting_ns.persist(words);
        self.sensors.persist(words);
        self.measurement.persist_late(words);
    }
}
