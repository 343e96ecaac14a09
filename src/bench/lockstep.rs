//! Measures ticks per second without real time: as processes in lockstep, and in one thread. The lower bounds are the raw hops
//! and the roles alone.

use super::board::Board;
use super::exchange::{Mechanism, Wake};
use super::hop::Pair;
use super::session::{Bench, BenchError, resolve};
use crate::bus::domain::OwnedDomain;
use crate::launch::Progress;
use crate::rig::BodyInfo;
use crate::runtime::{RoleId, take_privileges};
use crate::scenario::Scenario;
use std::sync::Barrier;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// The signal that ends a run in an orderly way.
const SIGTERM: usize = 15;
/// Sequential hops per lockstep tick: a follower's measurement to the controller, and the command back.
const HOPS: f64 = 2.0;
/// Words of the bare samples, as in the row `chain`.
const WORDS: usize = 16;

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let (rounds, measured) = (bench.size(5, 1), bench.scenario(&["clock=lockstep", "duration_s=100.0"])?);
    let limit = bench.size(Duration::from_secs(3), Duration::from_millis(300));
    let alone = ["clock=in-process", "launch.external=[]"];
    let all: Result<Vec<_>, _> =
        bench.scenarios.iter().map(|known| Ok::<_, BenchError>((known.0, resolve(*known, &alone)?))).collect();
    let all = all?;
    // Without a controller no role waits for a command.
    let floor = RoleId::all(&measured).contains(&RoleId::Controller).then_some("two raw hops back to back");
    let roles_alone = format!("the roles alone, {}", bench.scenarios[0].0);
    let domain = OwnedDomain::create(0)?;
    let mut hop = Pair::open(domain.domain(), false, Mechanism::Iceoryx, Wake::Spin, WORDS)?;
    board.granted(hop.grants());
    for round in 1..=rounds {
        bench.next(&format!("lockstep: round {round} of {rounds}"))?;
        let per_second = ticks_per_second(bench, &measured, limit)?;
        board.add("lockstep", "ticks/s", floor, per_second);
        let exchanges = bench.size(20_000, 200);
        let one_way_us = bench.in_the_leaders_place(board, |_| hop.back_to_back(exchanges))?;
        board.add("two raw hops back to back", "ticks/s", None, 1e6 / (HOPS * one_way_us));
        if let [BodyInfo { driven: false, .. }, BodyInfo { driven: true, .. }] = measured.rig.bodies() {
            let four = bench.in_the_leaders_place(board, |_| four_raw(&measured, exchanges))?;
            board.add("four raw hops on the same cores", "ticks/s", None, four);
        }
        for (index, (name, scenario)) in all.iter().enumerate() {
            bench.next(&format!("lockstep: in one thread, {name}"))?;
            let floor = (index == 0).then_some(&*roles_alone);
            let per_second = ticks_per_second(bench, scenario, limit)?;
            board.add(&format!("in one thread, {name}"), "ticks/s", floor, per_second);
        }
        match measured.rig.roles_alone(&measured) {
            Some(per_second) => board.add(&roles_alone, "ticks/s", None, per_second),
            None => board.remark(format!("{roles_alone}: not measured: the loop has a fleet, faults or a watchdog")),
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
        // A run that is too short for two observations: its start and stop count too.
        _ => scenario.last_tick as f64 / whole.as_secs_f64(),
    })
}

/// Measures ticks per second of bare processes with the privileges and cores of four roles, without computation: two pairs at once,
/// leader with observer and follower with controller, exchange a sample there and back.
fn four_raw(scenario: &Scenario, exchanges: u64) -> Result<f64, BenchError> {
    let domain = OwnedDomain::create(0)?;
    let domain = domain.domain();
    let open = |observer| {
        let mut pair = Pair::open(domain, observer, Mechanism::Iceoryx, Wake::Spin, WORDS)?;
        pair.enable_yield();
        Ok::<_, BenchError>(pair)
    };
    let ready = Barrier::new(2);
    std::thread::scope(|scope| {
        let follower = scope.spawn(|| {
            take_privileges(scenario, RoleId::Plant(1));
            let pair = open(false);
            ready.wait();
            pair?.back_to_back(exchanges).map(drop)
        });
        let pair = open(true);
        ready.wait();
        let began = Instant::now();
        let leader = pair.and_then(|mut pair| pair.back_to_back(exchanges));
        let follower = follower.join().map_err(|_| BenchError::Peer("a thread panicked".to_owned()))?;
        leader.and(follower)?;
        Ok(exchanges as f64 / began.elapsed().as_secs_f64())
    })
}
