//! A controller on a bus: the estimate and every driven body's measurement in, every driven body's command out.

use super::{Gate, Node, Poll, RoleId, Seat};
use crate::bus::{Bus, BusError, Signal};
use crate::clock::{Clock, Grid};
use crate::control::{Watchdog, Watched};
use crate::rig::{BodyInfo, Command, Estimate, Measurement, Rig};
use crate::role::Controller;
use crate::runtime::disturb::Interruptions;
use crate::runtime::link::{Horizon, Input, Output, Seek};
use crate::sample::Sample;
use crate::telemetry::{Latency, StageReport, TickBook, Ticks, WatchBook};

/// One driven body, seen from the controller.
struct Channel<R: Rig, B: Bus> {
    /// The body's index.
    body: usize,
    controller: Controller<R::Law>,
    measurement: Input<B, Measurement<R>, R::MeasurementGuard>,
    command: Output<B, Command<R>>,
    /// Whether the measurement of the tick at hand is there, and a command is to be sent.
    ready: bool,
    /// When the command at hand was begun and sent, ns; sent at 0 if there is none.
    began_ns: u64,
    sent_ns: u64,
}

/// A controller with its links and books.
pub struct ControllerNode<R: Rig, B: Bus> {
    rig: R,
    estimate: Input<B, Estimate<R>, R::EstimateGuard>,
    channels: Vec<Channel<R, B>>,
    clock: Clock,
    book: TickBook,
    watchdog: Watchdog,
    watch_book: WatchBook,
    interruptions: Interruptions,
    /// When the estimate at hand was due at its origin and sent, and when all inputs were there, ns.
    origin_ns: u64,
    estimate_sent_ns: u64,
    received_ns: u64,
    hop: Latency,
    step: Latency,
    age: Latency,
}

impl<R: Rig, B: Bus> ControllerNode<R, B> {
    pub fn open(rig: &R, seat: &Seat<'_, B>) -> Result<Self, BusError> {
        let book = TickBook::go_on(seat.ledger);
        let driven = || rig.bodies().iter().enumerate().filter(|(_, body)| body.driven);
        // In the order of the books: everything written, then everything read.
        let commands: Vec<Output<B, Command<R>>> =
            driven().map(|(_, body)| seat.output(&body.name, Signal::Command)).collect::<Result<_, _>>()?;
        let estimate = seat.input(&rig.bodies()[0].name, Signal::Estimate, rig.estimate_guard())?;
        let channel = |((index, body), command): ((usize, &BodyInfo), _)| {
            Ok(Channel {
                body: index,
                controller: Controller::new(rig.law(index)),
                measurement: seat.input(&body.name, Signal::Measurement, rig.measurement_guard(index, true))?,
                command,
                ready: false,
                began_ns: 0,
                sent_ns: 0,
            })
        };
        let channels = driven().zip(commands).map(channel).collect::<Result<_, BusError>>()?;
        let watch_book = WatchBook::open(seat.ledger);
        Ok(Self {
            rig: rig.clone(),
            estimate,
            channels,
            clock: seat.clock,
            book,
            watchdog: watch_book.watchdog(seat.scenario.watch),
            watch_book,
            interruptions: seat.interruptions(),
            origin_ns: 0,
            estimate_sent_ns: 0,
            received_ns: 0,
            hop: Latency::default(),
            step: Latency::default(),
            age: Latency::default(),
        })
    }

    /// Looks for all inputs of the next tick, or of the first later one that has an estimate.
    #[inline]
    fn gather(&mut self, overdue: bool) -> Result<bool, BusError> {
        if self.estimate.seek(self.book.next())? == Seek::NotYet {
            if self.clock == Clock::Monotonic {
                // Meanwhile the others, so that the newest are at hand when the estimate comes, which is the last as a rule.
                self.channels.iter_mut().try_for_each(|channel| channel.measurement.seek(u64::MAX).map(drop))?;
            }
            return Ok(false);
        }
        let Some(tick) = self.estimate.sample().map(|estimate| estimate.stamp().tick) else {
            self.pass_over()?;
            return Ok(false);
        };
        let mut complete = true;
        for channel in &mut self.channels {
            let found = channel.measurement.seek(tick)?;
            channel.ready = found == Seek::Found;
            complete &= found != Seek::NotYet;
        }
        Ok(complete || overdue)
    }

    /// There is no estimate for the next tick that could be used, and so there are no commands.
    #[cold]
    fn pass_over(&mut self) -> Result<(), BusError> {
        let next = self.book.next();
        for tick in next..=self.estimate.last_tick().unwrap_or(next) {
            for channel in &mut self.channels {
                // What is not used now will never be, and must not fill the link.
                channel.measurement.seek(tick)?;
                channel.command.pass_over(tick)?;
            }
            self.skip_to(tick + 1);
        }
        Ok(())
    }

    /// Holds the estimate against the physics. Whatever comes of it is up to the watchdog.
    #[inline]
    fn watch(&mut self) {
        let Some(estimate) = self.estimate.sample() else { return };
        let tick = estimate.stamp().tick;
        if let Some(values) = self.rig.invariants(estimate) {
            self.watchdog.invariants(tick, values);
        }
        self.watchdog.magnitude(Watched::Innovation, tick, R::innovation(estimate));
    }

    #[inline]
    fn execute(&mut self) -> Result<Poll, BusError> {
        self.received_ns = self.clock.now_ns();
        if self.watchdog.active() {
            self.watch();
        }
        let Some(estimate) = self.estimate.sample() else { return Ok(Poll::Waiting) };
        let stamp = *estimate.stamp();
        let silent = self.watchdog.latched_at().is_some();
        let clock = self.clock;
        let mut began_ns = self.received_ns;
        let mut starved = false;
        for Channel { controller, measurement, command, ready, began_ns: began, sent_ns, .. } in &mut self.channels {
            starved |= !*ready;
            *ready &= !silent;
            let Some(measurement) = measurement.sample().filter(|_| *ready) else {
                command.pass_over(stamp.tick)?;
                continue;
            };
            command.send(|sample| {
                controller.step(estimate, measurement, sample);
                *sent_ns = clock.now_ns();
                sample.stamp_mut().sent_ns = *sent_ns;
            })?;
            *began = began_ns;
            began_ns = *sent_ns;
            if let (true, Some((v, _))) = (self.watchdog.active(), R::lyapunov(command.sent())) {
                self.watchdog.magnitude(Watched::Lyapunov, stamp.tick, v);
            }
        }
        (self.origin_ns, self.estimate_sent_ns) = (stamp.origin_ns, stamp.sent_ns);
        self.skip_to(stamp.tick);
        if starved {
            self.book.starved(stamp.tick);
        }
        Ok(Poll::Executed)
    }
}

impl<R: Rig, B: Bus> Node for ControllerNode<R, B> {
    fn time_triggered(&self) -> bool {
        false
    }

    fn next_tick(&self) -> u64 {
        self.book.next()
    }

    fn start(&mut self, grid: Grid, first_tick: u64) {
        if self.clock == Clock::Monotonic {
            self.estimate.expect(Horizon::Due(grid));
            self.channels.iter_mut().for_each(|channel| channel.measurement.expect(Horizon::Due(grid)));
        }
        self.skip_to(first_tick);
    }

    #[inline]
    fn before_tick(&mut self) -> bool {
        let suffered = self.interruptions.before(self.book.next());
        self.book.stalled(suffered.stalls);
        suffered.killed
    }

    #[inline]
    fn poll(&mut self, gate: Gate) -> Result<Poll, BusError> {
        let allowed = !matches!(gate, Gate::Inputs { up_to } if self.book.next() > up_to);
        if allowed && self.gather(gate == Gate::Overdue)? { self.execute() } else { Ok(Poll::Waiting) }
    }

    fn awaits(&self) -> Option<RoleId> {
        let late = self.channels.iter().find(|channel| !channel.measurement.knows(self.book.next()));
        Some(late.map_or(RoleId::Observer, |channel| RoleId::Plant(channel.body)))
    }

    /// The estimate is nearly always the last to come: whoever waits for it finds the others there.
    fn sleep(&mut self, until_ns: u64) -> Result<bool, BusError> {
        let tick = self.book.next();
        if !self.estimate.knows(tick) {
            self.estimate.sleep(until_ns)?;
        } else if let Some(late) = self.channels.iter_mut().find(|channel| !channel.measurement.knows(tick)) {
            late.measurement.sleep(until_ns)?;
        } else {
            return Ok(false);
        }
        Ok(true)
    }

    #[inline]
    fn settle(&mut self) -> Result<(), BusError> {
        let timed = self.clock == Clock::Monotonic;
        if timed {
            self.hop.record(self.estimate_sent_ns, self.received_ns);
        }
        for channel in self.channels.iter_mut().filter(|channel| channel.ready) {
            if timed {
                self.step.record(channel.began_ns, channel.sent_ns);
                self.age.record(self.origin_ns, channel.sent_ns);
            }
            channel.command.settle()?;
        }
        if self.watchdog.active() {
            self.watch_book.store(&self.watchdog);
        }
        self.book.executed();
        Ok(())
    }

    fn skip_to(&mut self, tick: u64) {
        self.book.skip_to(tick);
    }

    fn warm_up(&mut self) -> Result<(), BusError> {
        self.estimate.warm_up()?;
        for channel in &mut self.channels {
            channel.measurement.warm_up()?;
            channel.command.warm_up()?;
        }
        Ok(())
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        self.estimate.refresh();
        self.channels.iter_mut().try_for_each(|channel| {
            channel.measurement.refresh();
            channel.command.refresh()
        })
    }

    fn ticks(&self) -> Ticks {
        self.book.report()
    }

    fn stages(&self) -> Vec<StageReport> {
        StageReport::all(&[("hop", &self.hop), ("step", &self.step), ("age", &self.age)])
    }
}
