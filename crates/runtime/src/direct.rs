//! Runs a scenario in one thread: calls the roles one after the other, on samples that stay in place.
//!
//! This is valid while every sample is present and accepted, because all counters are then known. At the first sample that is
//! not, the run starts again with the nodes, which handle that case; the same roles give the same bits up to there. Must not do
//! anything that a node would not have done, nor continue where a node would have had a choice.

use crate::bus::Signal;
use crate::clock::Grid;
use crate::config::{BodyInfo, Settings};
use crate::control::WatchBounds;
use crate::rig::{Command, Estimate, Measurement, Rig, Truth};
use crate::role::{Body, CommandEvent, Controller, Guard, Observer, Plant};
use crate::runtime::{RoleId, ports};
use crate::sample::{Message, Stamp};
use crate::score::{Score, Scoring};
use crate::telemetry::{Checkpoints, Ledger, LinkRead, LinkWritten, RoleReport, StateHash, Ticks};
use std::hint::black_box;
use std::time::Instant;

/// Ticks between two checks of signals and two progress reports.
pub const TURN_TICKS: u64 = 1024;

/// A body, its latest samples, and the controller that drives it, if any.
struct Driven<R: Rig> {
    plant: Plant<R::Body>,
    measurement: Measurement<R>,
    truth: Truth<R>,
    command: Option<Controlled<R>>,
    hashes: [StateHash; 2],
}

/// A body's control law with its commands and the guards of both readers.
struct Controlled<R: Rig> {
    controller: Controller<R::Law>,
    measurement_guard: R::MeasurementGuard,
    command_guard: R::CommandGuard,
    /// The commands in flight, indexed by their tick modulo the delay.
    commands: Vec<Command<R>>,
    hash: StateHash,
}

/// Returns true if a run of this scenario may be a direct one.
fn is_plain(scenario: &Settings) -> bool {
    let watch = WatchBounds { from_tick: scenario.watch.from_tick, ..WatchBounds::NONE };
    let single = scenario.bodies.iter().all(|body| body.fleet.is_none());
    single && scenario.faults.is_empty() && scenario.watch.max == watch.max
}

/// Runs a scenario without a recording. Returns `None` if the nodes must run it. Every [`TURN_TICKS`] ticks it calls `proceed`
/// with the last tick and the latest value of the first metric; the run ends if that returns false.
pub(crate) fn run_rig<R: Rig>(
    rig: &R,
    scenario: &Settings,
    checkpoints: bool,
    proceed: &mut dyn FnMut(u64, f64) -> bool,
) -> Option<(Vec<RoleReport>, Score)> {
    is_plain(scenario).then(|| Run::new(rig, scenario, checkpoints).run(proceed)).flatten()
}

/// Returns the index of a tick's command, which is also that of the command applied at this tick. Usually needs no division.
fn command_index(tick: u64, delay_ticks: u64) -> usize {
    if delay_ticks == 1 { 0 } else { (tick % delay_ticks) as usize }
}

struct Run<'a, R: Rig> {
    scenario: &'a Settings,
    grid: Grid,
    bodies: Vec<Driven<R>>,
    observer: Observer<R::Estimator>,
    measurement_guard: R::MeasurementGuard,
    estimate: Estimate<R>,
    estimate_hash: StateHash,
    /// One guard for controller and scorer: both judge the same samples.
    estimate_guard: R::EstimateGuard,
    scoring: Scoring<R>,
}

impl<'a, R: Rig> Run<'a, R> {
    fn new(rig: &R, scenario: &'a Settings, checkpoints: bool) -> Self {
        let hash = || match checkpoints {
            true => StateHash::open(&Ledger::private(StateHash::words(scenario.last_tick)), scenario.last_tick),
            false => StateHash::without_checkpoints(),
        };
        let body = |(index, info): (usize, &BodyInfo)| Driven {
            plant: Plant::new(rig.body(index), scenario.actuation(info.driven), scenario.tick_s()),
            measurement: Measurement::<R>::default(),
            truth: Truth::<R>::default(),
            command: info.driven.then(|| Controlled {
                controller: Controller::new(rig.law(index)),
                measurement_guard: rig.measurement_guard(index, true),
                command_guard: rig.command_guard(index),
                commands: vec![Command::<R>::default(); scenario.actuation_delay_ticks as usize],
                hash: hash(),
            }),
            hashes: [hash(), hash()],
        };
        let bodies: Vec<Driven<R>> = rig.bodies().iter().enumerate().map(body).collect();
        Self {
            scenario,
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            bodies,
            observer: Observer::new(rig.estimator(), scenario.tick_s()),
            measurement_guard: rig.measurement_guard(0, false),
            estimate: Estimate::<R>::default(),
            estimate_hash: hash(),
            estimate_guard: rig.estimate_guard(),
            scoring: Scoring::new(rig, scenario),
        }
    }

    fn run(mut self, proceed: &mut dyn FnMut(u64, f64) -> bool) -> Option<(Vec<RoleReport>, Score)> {
        let mut ticks = 0;
        for tick in 0..=self.scenario.last_tick {
            if !self.tick(tick) {
                return None;
            }
            ticks = tick + 1;
            if tick.is_multiple_of(TURN_TICKS) && !proceed(tick, self.scoring.latest()) {
                break;
            }
        }
        let score = self.scoring.finish(core::iter::repeat_n(ticks, self.bodies.len() + 1));
        let reports = RoleId::all(self.scenario).into_iter().map(|role| self.report(role, ticks)).collect();
        Some((reports, score))
    }

    /// Runs one tick of all roles. Returns false if a node would have had a choice.
    #[inline]
    fn tick(&mut self, tick: u64) -> bool {
        let stamp = Stamp { tick, origin_ns: self.grid.due_ns(tick), ..Stamp::default() };
        let delay = self.scenario.actuation_delay_ticks;
        for body in &mut self.bodies {
            let applied = match &mut body.command {
                Some(controlled) if tick > 0 => {
                    let (newest, due) = (command_index(tick - 1, delay), command_index(tick, delay));
                    let expected = if tick < delay { CommandEvent::NotDue } else { CommandEvent::Applied };
                    controlled.command_guard.accepts(&controlled.commands[newest])
                        && body.plant.command(tick, Some(&controlled.commands[due])) == expected
                }
                _ => body.plant.command(tick, None) == CommandEvent::NotDue,
            };
            if !applied {
                return false;
            }
            body.plant.measure(&stamp, &mut body.measurement);
            body.measurement.stamp_mut().generation = 1;
            body.plant.truth(&stamp, &mut body.truth);
            body.truth.stamp_mut().generation = 1;
            body.plant.advance(1);
            body.hashes[0].absorb(tick, body.measurement.content());
            body.hashes[1].absorb(tick, body.truth.content());
        }
        let observed = &self.bodies[0].measurement;
        if !self.measurement_guard.accepts(observed) {
            return false;
        }
        self.observer.step(observed, &mut self.estimate);
        (self.estimate.stamp_mut().generation, self.estimate.stamp_mut().sent_ns) = (1, 0);
        self.estimate_hash.absorb(tick, self.estimate.content());
        if !self.estimate_guard.accepts(&self.estimate) {
            return false;
        }
        for Driven { measurement, command, .. } in &mut self.bodies {
            let Some(controlled) = command else { continue };
            if !controlled.measurement_guard.accepts(measurement) {
                return false;
            }
            let command = &mut controlled.commands[command_index(tick, delay)];
            controlled.controller.step(&self.estimate, measurement, command);
            let stamp = command.stamp_mut();
            (stamp.generation, stamp.sent_ns) = (1, 0);
            controlled.hash.absorb(tick, command.content());
        }
        let bodies = &self.bodies;
        self.scoring.take(|body| Some(&bodies[body].truth), |_| None, Some(&self.estimate), true);
        true
    }

    /// Returns the report of a role that executed every tick on every input.
    fn report(&self, role: RoleId, ticks: u64) -> RoleReport {
        let ports = ports(self.scenario, role);
        let written = ports.writes.iter().map(|port| LinkWritten {
            service: port.topic.to_string(),
            published: ticks,
            skipped: 0,
            void: 0,
            extra: 0,
            injected: 0,
            last_tick: ticks.checked_sub(1),
            hash: Some(self.checkpoints(&port.topic.body, port.topic.signal)),
        });
        let read = ports.reads.iter().map(|port| {
            // The last command is due after the last tick.
            let received = if port.topic.signal == Signal::Command { ticks.saturating_sub(1) } else { ticks };
            LinkRead {
                service: port.topic.to_string(),
                received,
                gaps: 0,
                stale: 0,
                void: 0,
                rejected: 0,
                rejected_by: std::collections::BTreeMap::new(),
                last_tick: received.checked_sub(1),
            }
        });
        RoleReport {
            role: role.name(self.scenario).to_owned(),
            ticks: Ticks { elapsed: ticks, executed: ticks, ..Ticks::default() },
            written: written.collect(),
            read: read.collect(),
            watchdog: None,
            stages: Vec::new(),
            grants: Vec::new(),
            line: None,
            outages: Vec::new(),
        }
    }

    fn checkpoints(&self, name: &str, signal: Signal) -> Checkpoints {
        let index = self.scenario.bodies.iter().position(|body| body.name == name).unwrap_or(0);
        let body = &self.bodies[index];
        let hash = match (signal, &body.command) {
            (Signal::Measurement, _) => &body.hashes[0],
            (Signal::Estimate, _) => &self.estimate_hash,
            (Signal::Command, Some(controlled)) => &controlled.hash,
            _ => &body.hashes[1],
        };
        hash.checkpoints()
    }
}

/// Measures the mathematics of all roles of a leader and a follower, called one after the other, in ticks per second. Returns
/// `None` for other rigs. `hashed` adds what every run needs besides: the truths, and the hash of each sample.
pub(crate) fn arithmetic_alone<R: Rig>(rig: &R, scenario: &Settings, hashed: bool) -> Option<f64> {
    let [BodyInfo { driven: false, fleet: None, .. }, BodyInfo { driven: true, fleet: None, .. }] = rig.bodies() else {
        return None;
    };
    let tick_s = scenario.tick_s();
    let (mut leader, mut follower) = (rig.body(0), rig.body(1));
    let (mut observer, mut controller) = (Observer::new(rig.estimator(), tick_s), Controller::new(rig.law(1)));
    let mut measured = [Measurement::<R>::default(); 2];
    let (mut estimate, mut command) = (Estimate::<R>::default(), Command::<R>::default());
    let (mut truth, mut hashes) = (Truth::<R>::default(), [(); 6].map(|()| StateHash::without_checkpoints()));
    let began = Instant::now();
    for tick in 0..=scenario.last_tick {
        if tick > 0 {
            black_box(follower.apply(&command));
        }
        let bodies = [&mut leader, &mut follower].into_iter().zip(&mut measured).zip(hashes.chunks_exact_mut(2));
        for ((body, measured), hashes) in bodies {
            body.measure(0, 0, measured);
            measured.stamp_mut().tick = tick;
            if hashed {
                body.truth(0, &mut truth);
                hashes[0].absorb(tick, measured.content());
                hashes[1].absorb(tick, truth.content());
            }
            body.flow(tick_s);
        }
        observer.step(&measured[0], &mut estimate);
        controller.step(&estimate, &measured[1], &mut command);
        if hashed {
            hashes[4].absorb(tick, estimate.content());
            hashes[5].absorb(tick, command.content());
        }
    }
    black_box((&command, &hashes));
    Some((scenario.last_tick + 1) as f64 / began.elapsed().as_secs_f64())
}
