//! Ticks per second where nobody waits for the time: as processes in lockstep, and in one thread; beside the hops and the
//! arithmetic that they cannot do without.

use super::exchange::{Mechanism, Wake};
use super::hop::Pair;
use super::{Bench, BenchError, Board, resolve};
use crate::bus::domain::OwnedDomain;
use crate::config::Scenario;
use crate::launch::Progress;
use crate::rig::{BodyInfo, Command, Estimate, Measurement, Rig};
use crate::role::{Body, Controller, Observer};
use crate::runtime::RoleId;
use crate::sample::Message;
use std::hint::black_box;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// What ends a run in order.
const SIGTERM: usize = 15;
/// Hops in a row that a lockstep tick waits for: a follower's measurement to the controller, the command back to it.
const HOPS: f64 = 2.0;

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let (rounds, measured) = (bench.size(5, 1), bench.scenario(&["clock=lockstep", "duration_s=100.0"])?);
    let limit = bench.size(Duration::from_secs(3), Duration::from_millis(300));
    let alone = ["clock=in-process", "launch.external=[]"];
    let all: Result<Vec<_>, _> =
        bench.scenarios.iter().map(|known| Ok::<_, BenchError>((known.0, resolve(*known, &alone)?))).collect();
    let all = all?;
    // Without a controller nobody waits for a command.
    let floor = RoleId::all(&measured).contains(&RoleId::Controller).then_some("two raw hops back to back");
    let arithmetic = format!("arithmetic alone, {}", bench.scenarios[0].0);
    let domain = OwnedDomain::create(0)?;
    let mut hop = Pair::open(domain.domain(), Mechanism::Iceoryx, Wake::Spin, 16)?;
    board.granted(hop.grants());
    for round in 1..=rounds {
        bench.next(&format!("lockstep: round {round} of {rounds}"))?;
        let per_second = ticks_per_second(bench, &measured, limit)?;
        board.add("lockstep", "ticks/s", floor, per_second);
        let exchanges = bench.size(20_000, 200);
        let one_way_us = bench.in_the_leaders_place(board, |_| hop.back_to_back(exchanges))?;
        board.add("two raw hops back to back", "ticks/s", None, 1e6 / (HOPS * one_way_us));
        for (index, (name, scenario)) in all.iter().enumerate() {
            bench.next(&format!("lockstep: in one thread, {name}"))?;
            let floor = (index == 0).then_some(&*arithmetic);
            let per_second = ticks_per_second(bench, scenario, limit)?;
            board.add(&format!("in one thread, {name}"), "ticks/s", floor, per_second);
        }
        match measured.rig.face().arithmetic(&measured) {
            Some(per_second) => board.add(&arithmetic, "ticks/s", None, per_second),
            None => board.remark(format!("{arithmetic}: not measured: only that of a leader and one follower is")),
        }
    }
    Ok(())
}

/// Ticks per second of a run, between the first tick that its launcher sees and the last; it is ended in order after so long.
fn ticks_per_second(bench: &Bench<'_>, scenario: &Scenario, limit: Duration) -> Result<f64, BenchError> {
    let end = AtomicUsize::new(0);
    let mut seen: Option<[(u64, Instant); 2]> = None;
    let mut progress = |progress: &Progress<'_>| {
        if let Progress::Running { tick, .. } = progress {
            let now = (*tick, Instant::now());
            let first = seen.map_or(now, |[first, _]| first);
            seen = Some([first, now]);
            if now.1 > first.1 + limit || bench.interrupted().is_err() {
                end.store(SIGTERM, Ordering::Relaxed);
            }
        }
    };
    let began = Instant::now();
    bench.launch(scenario, &end, &mut progress)?;
    let whole = began.elapsed();
    Ok(match seen {
        Some([(first, from), (last, to)]) if last > first => (last - first) as f64 / (to - from).as_secs_f64(),
        // A run too short to be looked at twice: its start and stop count too.
        _ => scenario.last_tick as f64 / whole.as_secs_f64(),
    })
}

/// Ticks per second of the mathematics of all roles of a leader and a follower, called one after the other; none of others.
pub(crate) fn arithmetic_alone<R: Rig>(rig: &R, scenario: &Scenario) -> Option<f64> {
    let [BodyInfo { driven: false, fleet: None, .. }, BodyInfo { driven: true, fleet: None, .. }] = rig.bodies() else {
        return None;
    };
    let tick_s = scenario.tick_s();
    let (mut leader, mut follower) = (rig.body(0), rig.body(1));
    let (mut observer, mut controller) = (Observer::new(rig.estimator(), tick_s), Controller::new(rig.law(1)));
    let mut measured = [Measurement::<R>::default(); 2];
    let (mut estimate, mut command) = (Estimate::<R>::default(), Command::<R>::default());
    let began = Instant::now();
    for tick in 0..=scenario.last_tick {
        if tick > 0 {
            black_box(follower.apply(&command));
        }
        for (body, measured) in [&mut leader, &mut follower].into_iter().zip(&mut measured) {
            body.measure(0, 0, measured);
            measured.stamp_mut().tick = tick;
            body.flow(tick_s);
        }
        observer.step(&measured[0], &mut estimate);
        controller.step(&estimate, &measured[1], &mut command);
    }
    black_box(&command);
    Some((scenario.last_tick + 1) as f64 / began.elapsed().as_secs_f64())
}
