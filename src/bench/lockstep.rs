//! Ticks per second where nobody waits for the time: as processes in lockstep, and in one thread; beside the hops and the
//! arithmetic that they cannot do without.

use super::exchange::{Mechanism, Wake};
use super::hop::{Pair, in_the_leaders_place};
use super::{Bench, BenchError, Board, Row};
use crate::bus::domain::OwnedDomain;
use crate::bus::memory::MemoryBus;
use crate::config::{SHIPPED, Scenario};
use crate::launch::{Launch, Progress};
use crate::rig::{Command, Estimate, Measurement, Rig};
use crate::role::{Body, Controller, Observer};
use crate::runtime::{RoleId, build, depths, in_turn, private_ledger};
use crate::sample::Message;
use crate::with_shipped_rig;
use std::hint::black_box;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// What ends a run in order.
const SIGTERM: usize = 15;
/// Hops in a row that a lockstep tick waits for: a follower's measurement to the controller, the command back to it.
const HOPS: f64 = 2.0;

fn scenario(text: &str, overrides: &[&str]) -> Scenario {
    let overrides: Vec<String> = overrides.iter().chain(&["accept={}"]).map(|text| (*text).to_owned()).collect();
    Scenario::parse(text, "bench", &overrides).expect("shipped scenarios are valid")
}

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let rounds = bench.size(5, 1);
    let pair = scenario(SHIPPED[0].1, &["clock=lockstep", "duration_s=100.0"]);
    let limit = bench.size(Duration::from_secs(3), Duration::from_millis(300));
    let shipped: Vec<_> = SHIPPED.iter().map(|(name, text)| (*name, scenario(text, &["clock=in-process"]))).collect();
    let domain = OwnedDomain::create(0)?;
    let mut hop = Pair::open(bench, domain.domain(), Mechanism::Iceoryx, Wake::Spin, 16)?;
    board.granted(hop.grants());
    for round in 1..=rounds {
        bench.next(&format!("lockstep: round {round} of {rounds}"))?;
        let per_second = lockstep(bench, &pair, limit)?;
        board.add(Row::Lockstep, "lockstep", "ticks/s", Some("two raw hops back to back"), per_second);
        let exchanges = bench.size(20_000, 200);
        let one_way_us = in_the_leaders_place(board, |_| hop.back_to_back(exchanges))?;
        board.add(Row::Lockstep, "two raw hops back to back", "ticks/s", None, 1e6 / (HOPS * one_way_us));
        let arithmetic = "arithmetic alone, rigid-pair";
        for (name, scenario) in &shipped {
            bench.next(&format!("lockstep: in one thread, {name}"))?;
            let floor = (*name == SHIPPED[0].0).then_some(arithmetic);
            let per_second = in_one_thread(scenario)?;
            board.add(Row::Lockstep, &format!("in one thread, {name}"), "ticks/s", floor, per_second);
        }
        let per_second = with_shipped_rig!(pair.rig, rig => arithmetic_alone(rig, &pair));
        board.add(Row::Lockstep, arithmetic, "ticks/s", None, per_second);
    }
    Ok(())
}

/// Ticks per second of a lockstep run, between the first tick that its launcher sees and the last; it is ended in order
/// after so long.
fn lockstep(bench: &mut Bench<'_>, scenario: &Scenario, limit: Duration) -> Result<f64, BenchError> {
    let end = AtomicUsize::new(0);
    let mut seen: Option<[(u64, Instant); 2]> = None;
    let mut launch = Launch {
        program: bench.program.clone(),
        external: Vec::new(),
        record: None,
        foxglove: None,
        require_realtime: false,
        signal: &end,
        progress: &mut |progress| {
            if let Progress::Running { tick, .. } = progress {
                let now = (*tick, Instant::now());
                let first = seen.map_or(now, |[first, _]| first);
                seen = Some([first, now]);
                if now.1 > first.1 + limit || bench.interrupted().is_err() {
                    end.store(SIGTERM, Ordering::Relaxed);
                }
            }
        },
    };
    let began = Instant::now();
    crate::launch::run(scenario, &mut launch)?;
    let whole = began.elapsed();
    bench.interrupted()?;
    Ok(match seen {
        Some([(first, from), (last, to)]) if last > first => (last - first) as f64 / (to - from).as_secs_f64(),
        // A run too short to be looked at twice: its start and stop count too.
        _ => scenario.last_tick as f64 / whole.as_secs_f64(),
    })
}

/// Ticks per second of all roles in one thread: plants, observer, controller, links, books, hash.
fn in_one_thread(scenario: &Scenario) -> Result<f64, BenchError> {
    let bus = MemoryBus::new(depths(scenario));
    let node = |role| build(scenario, role, &bus, &private_ledger(scenario, role));
    let mut nodes = RoleId::all(scenario).into_iter().map(node).collect::<Result<Vec<_>, _>>()?;
    let began = Instant::now();
    in_turn(&mut nodes, scenario.last_tick, |_| Ok(None), |_| true)?;
    Ok((scenario.last_tick + 1) as f64 / began.elapsed().as_secs_f64())
}

/// Ticks per second of the mathematics of all roles of a pair, called one after the other.
fn arithmetic_alone<R: Rig>(rig: &R, scenario: &Scenario) -> f64 {
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
    (scenario.last_tick + 1) as f64 / began.elapsed().as_secs_f64()
}
