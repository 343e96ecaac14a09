//! The estimate-and-control step and the in-process loop. Run by hand: `cargo bench`.
//!
//! Compare figures of one run with one another, never with another machine's or another day's.

use corotate::bus::memory::MemoryBus;
use corotate::config::{SHIPPED, Scenario};
use corotate::rig::{AnyRig, Rig};
use corotate::role::{Body, Controller, Observer};
use corotate::runtime::{RoleId, build, depths, in_turn};
use corotate::sample::{RateCommand, RateEstimate, RateMeasurement};
use corotate::with_rig;
use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use std::hint::black_box;

fn scenario(text: &str, overrides: &[&str]) -> Scenario {
    let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
    Scenario::parse(text, "bench", &overrides).expect("shipped scenarios are valid")
}

/// A second of a leader's measurements, and the follower's.
fn measurements(scenario: &Scenario) -> Vec<[RateMeasurement; 2]> {
    let AnyRig::RigidBody(rig) = &scenario.rig;
    let mut bodies = [rig.body(0), rig.body(1)];
    (0..1000)
        .map(|tick| {
            let mut pair = [RateMeasurement::default(); 2];
            for (body, measurement) in bodies.iter_mut().zip(&mut pair) {
                body.measure(0, measurement);
                (measurement.stamp.tick, measurement.stamp.generation) = (tick, 1);
                body.flow(scenario.tick_s());
            }
            pair
        })
        .collect()
}

/// Measurement in, command out: what stands between the leader's sensor and the follower's actuator.
fn step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("estimate-and-control step");
    for (name, text) in SHIPPED {
        let scenario = scenario(text, &[]);
        let samples = measurements(&scenario);
        let AnyRig::RigidBody(rig) = &scenario.rig;
        group.throughput(Throughput::Elements(samples.len() as u64));
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                let mut observer = Observer::new(rig.estimator(), scenario.tick_s());
                let mut controller = Controller::new(rig.law(1));
                let (mut estimate, mut command) = (RateEstimate::default(), RateCommand::default());
                for [leader, follower] in &samples {
                    observer.step(black_box(leader), &mut estimate);
                    controller.step(&estimate, black_box(follower), &mut command);
                    black_box(&command);
                }
            });
        });
    }
}

/// Whole ticks of all roles in one thread: plants, observer, controller, links, books, hash.
fn in_process(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("in-process loop");
    for (name, text) in SHIPPED {
        let scenario = scenario(text, &["clock=in-process"]);
        group.throughput(Throughput::Elements(scenario.last_tick + 1));
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                let bus = MemoryBus::new(depths(&scenario));
                let mut nodes: Vec<_> = RoleId::all(&scenario)
                    .into_iter()
                    .map(|role| with_rig!(&scenario.rig, rig => build(rig, &scenario, role, &bus, 1)))
                    .collect::<Result<_, _>>()
                    .expect("links in memory open");
                in_turn(&mut nodes, scenario.last_tick, |_| true)
            });
        });
    }
}

criterion_group!(benches, step, in_process);
criterion_main!(benches);
