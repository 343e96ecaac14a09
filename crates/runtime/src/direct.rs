//! Runs a scenario in one thread: calls the roles one after the other, on samples that stay in place.
//!
//! This is valid while every sample is present and accepted, because all counters are then known. At the first sample that is
//! not, the run starts again with the nodes, which handle that case; the same roles give the same bits up to there. Must not do
//! anything that a node would not have done, nor continue where a node would have had a choice.

use crate::bus::Signal;
use crate::clock::Grid;
use crate::config::{BodyInfo, Settings};
use crate::control::WatchBounds;
use crate::rig::{Estimate, Rig, RigLoopBody, further_observer, loop_body, observer};
use crate::role::{Guard, Observer, command_index, cycle};
use crate::runtime::{RoleId, ports};
use crate::sample::{Message, Stamp};
use crate::score::{Score, Scoring};
use crate::telemetry::{Checkpoints, CommonCheckpoints, LinkRead, LinkWritten, RoleReport, Ticks, chained};
use std::hint::black_box;
use std::time::Instant;

/// Ticks between two checks of signals and two progress reports.
pub const TURN_TICKS: u64 = 1024;

/// The guards and hashes of a body's samples.
struct Judge<R: Rig> {
    measurement_guard: R::MeasurementGuard,
    command_guard: R::CommandGuard,
    /// The state hashes of the measurements, the truths and the commands.
    hashes: [u64; 3],
    estimates: Option<EstimateJudge<R>>,
}

/// The guards and the hash of the estimates of another body than the first.
struct EstimateJudge<R: Rig> {
    measurement_guard: R::MeasurementGuard,
    estimate_guard: R::EstimateGuard,
    hash: u64,
}

/// Returns true if a run of this scenario may be a direct one.
fn is_plain(scenario: &Settings) -> bool {
    let watch = WatchBounds { from_tick: scenario.watch.from_tick, ..WatchBounds::NONE };
    let single = scenario.bodies.iter().all(|body| body.fleet.is_none());
    single && scenario.faults.is_empty() && scenario.inputs.is_constant() && scenario.watch.max == watch.max
}

/// Runs a scenario without a recording. Returns `None` if the nodes must run it. Every [`TURN_TICKS`] ticks it calls `proceed`
/// with the last tick and the latest value of the first metric; the run ends if that returns false.
pub(crate) fn run_rig<R: Rig>(
    rig: &R,
    scenario: &Settings,
    checkpoints: bool,
    proceed: &mut dyn FnMut(u64, f64) -> bool,
) -> Option<(Vec<RoleReport>, Score)> {
    if !is_plain(scenario) {
        return None;
    }
    let run = Run::new(rig, scenario, checkpoints);
    if run.further_observed() { run.run::<true>(proceed) } else { run.run::<false>(proceed) }
}

struct Run<'a, R: Rig> {
    scenario: &'a Settings,
    grid: Grid,
    bodies: Vec<RigLoopBody<R>>,
    judges: Vec<Judge<R>>,
    observer: Observer<R::Estimator>,
    measurement_guard: R::MeasurementGuard,
    estimate: Estimate<R>,
    estimate_hash: u64,
    /// Of the first body's estimates, then of each body as in [`Judge`], then of the other estimates.
    checkpoints: CommonCheckpoints,
    /// One guard for controller and scorer: both judge the same samples.
    estimate_guard: R::EstimateGuard,
    scoring: Scoring<R>,
}

impl<'a, R: Rig> Run<'a, R> {
    fn new(rig: &R, scenario: &'a Settings, checkpoints: bool) -> Self {
        let further_observers = scenario.bodies.iter().skip(1).filter(|body| body.observer.is_some()).count();
        let body = |(index, info): (usize, &BodyInfo)| {
            loop_body(rig, index, info.driven, scenario.actuation(info.driven), scenario)
        };
        let judge = |index| Judge {
            measurement_guard: rig.measurement_guard(index, true),
            command_guard: rig.command_guard(index),
            hashes: [0; 3],
            estimates: further_observer(rig, index, scenario).map(|_| EstimateJudge {
                measurement_guard: rig.measurement_guard(index, false),
                estimate_guard: rig.estimate_guard(),
                hash: 0,
            }),
        };
        Self {
            scenario,
            grid: Grid { epoch_ns: 0, period_ns: scenario.period_ns },
            bodies: rig.bodies().iter().enumerate().map(body).collect(),
            judges: (0..rig.bodies().len()).map(judge).collect(),
            observer: observer(rig, scenario),
            measurement_guard: rig.measurement_guard(0, false),
            estimate: Estimate::<R>::default(),
            estimate_hash: 0,
            checkpoints: CommonCheckpoints::new(
                1 + 3 * rig.bodies().len() + further_observers,
                checkpoints.then_some(scenario.last_tick),
            ),
            estimate_guard: rig.estimate_guard(),
            scoring: Scoring::new(rig, scenario, false),
        }
    }

    /// Returns true if bodies other than the first have observers.
    fn further_observed(&self) -> bool {
        self.judges.iter().any(|judge| judge.estimates.is_some())
    }

    fn run<const FURTHER: bool>(
        mut self,
        proceed: &mut dyn FnMut(u64, f64) -> bool,
    ) -> Option<(Vec<RoleReport>, Score)> {
        let mut ticks = 0;
        for tick in 0..=self.scenario.last_tick {
            if !self.tick::<FURTHER>(tick) {
                return None;
            }
            ticks = tick + 1;
            if tick.is_multiple_of(TURN_TICKS) && !proceed(tick, self.scoring.latest()) {
                break;
            }
        }
        let score = self.scoring.finish(core::iter::repeat(ticks));
        let reports = RoleId::all(self.scenario).into_iter().map(|role| self.report(role, ticks)).collect();
        Some((reports, score))
    }

    /// Runs one tick of all roles. Returns false if a node would have had a choice.
    #[inline]
    fn tick<const FURTHER: bool>(&mut self, tick: u64) -> bool {
        let stamp = Stamp { tick, origin_ns: self.grid.due_ns(tick), generation: 1, ..Stamp::default() };
        if !cycle::<FURTHER, _, _, _, _>(&stamp, &mut self.observer, &mut self.estimate, &mut self.bodies)
            || !self.measurement_guard.accepts(&self.bodies[0].measurement)
            || !self.estimate_guard.accepts(&self.estimate)
        {
            return false;
        }
        let keeps = self.checkpoints.is_due(tick);
        self.estimate_hash = chained(self.estimate_hash, tick, self.estimate.content());
        if keeps {
            self.checkpoints.store(&[self.estimate_hash]);
        }
        for (body, judge) in self.bodies.iter().zip(&mut self.judges) {
            let [measurements, truths, commands] = &mut judge.hashes;
            *measurements = chained(*measurements, tick, body.measurement.content());
            *truths = chained(*truths, tick, body.truth.content());
            if let Some(control) = &body.control {
                let command = &control.commands[command_index(tick, control.commands.len())];
                if !judge.measurement_guard.accepts(&body.measurement) || !judge.command_guard.accepts(command) {
                    return false;
                }
                *commands = chained(*commands, tick, command.content());
            }
            if keeps {
                self.checkpoints.store(&judge.hashes);
            }
        }
        if FURTHER && !self.judge_further(tick, keeps) {
            return false;
        }
        let (bodies, first) = (&self.bodies, &self.estimate);
        let estimate = |body: usize| {
            let further = || bodies[body].observed.as_ref().map(|observed| &observed.estimate);
            if body == 0 { Some(first) } else { further().filter(|_| FURTHER) }
        };
        self.scoring.take(|body| Some(&bodies[body].truth), |_| None, estimate, true);
        true
    }

    /// Judges and hashes the estimates of other bodies than the first. Returns false if a node would have had a choice.
    fn judge_further(&mut self, tick: u64, keeps: bool) -> bool {
        for (body, judge) in self.bodies.iter().zip(&mut self.judges) {
            let (Some(observed), Some(judge)) = (&body.observed, &mut judge.estimates) else { continue };
            if !judge.measurement_guard.accepts(&body.measurement) || !judge.estimate_guard.accepts(&observed.estimate)
            {
                return false;
            }
            judge.hash = chained(judge.hash, tick, observed.estimate.content());
            if keeps {
                self.checkpoints.store(&[judge.hash]);
            }
        }
        true
    }

    /// Runs the roles without guards, hashes, counters and score.
    fn roles_alone<const FURTHER: bool>(self) {
        let Run { mut bodies, mut observer, mut estimate, .. } = self;
        for tick in 0..=self.scenario.last_tick {
            let stamp = Stamp { tick, generation: 1, ..Stamp::default() };
            let bodies = black_box(&mut bodies[..]);
            black_box(cycle::<FURTHER, _, _, _, _>(&stamp, &mut observer, &mut estimate, bodies));
        }
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
            ticks: Ticks { elapsed: ticks, executed: ticks, late: Some(0), ..Ticks::default() },
            written: written.collect(),
            read: read.collect(),
            watchdog: None,
            stages: Vec::new(),
            grants: Vec::new(),
            line: None,
            outages: Vec::new(),
            pace: None,
            late_inputs: 0,
            late_ticks: Vec::new(),
        }
    }

    fn checkpoints(&self, name: &str, signal: Signal) -> Checkpoints {
        let index = self.scenario.bodies.iter().position(|body| body.name == name).unwrap_or(0);
        let kind = match signal {
            Signal::Estimate => match &self.judges[index].estimates {
                None => return self.checkpoints.of_signal(0, self.estimate_hash),
                Some(own) => {
                    let before = self.judges[..index].iter().filter(|judge| judge.estimates.is_some()).count();
                    return self.checkpoints.of_signal(1 + 3 * self.judges.len() + before, own.hash);
                }
            },
            Signal::Measurement => 0,
            Signal::Command => 2,
            _ => 1,
        };
        self.checkpoints.of_signal(1 + 3 * index + kind, self.judges[index].hashes[kind])
    }
}

/// Measures the roles of a loop called one after the other, without guards, hashes, counters and score, in ticks per second.
/// Returns `None` for a loop with a fleet.
pub(crate) fn roles_alone<R: Rig>(rig: &R, scenario: &Settings) -> Option<f64> {
    is_plain(scenario).then(|| {
        let run = Run::new(rig, scenario, false);
        let began = Instant::now();
        if run.further_observed() {
            run.roles_alone::<true>()
        } else {
            run.roles_alone::<false>()
        }
        (scenario.last_tick + 1) as f64 / began.elapsed().as_secs_f64()
    })
}
