//! The estimate-and-control step and the in-process loop. Run by hand: `cargo bench`.
//!
//! Compare figures of one run with one another, never with another machine's or another day's.

use corotate::bus::memory::MemoryBus;
use corotate::config::{SHIPPED, Scenario};
use corotate::rig::{Command, Estimate, Measurement, Rig};
use corotate::role::{Body, Controller, Guard, Observer};
use corotate::runtime::{RoleId, build, depths, in_turn, private_ledger};
use corotate::sample::Message;
use corotate::with_rig;
use criterion::{Bencher, Criterion, Throughput, criterion_group, criterion_main};
use std::hint::black_box;

fn scenario(text: &str, overrides: &[&str]) -> Scenario {
    let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
    Scenario::parse(text, "bench", &overrides).expect("shipped scenarios are valid")
}

/// A second of the observed body's measurements, and those of the first driven body: the same one in some rigs.
fn measurements<R: Rig>(rig: &R, driven: usize, scenario: &Scenario) -> Vec<[Measurement<R>; 2]> {
    let mut bodies = [rig.body(0), rig.body(driven)];
    (0..1000)
        .map(|tick| {
            let mut pair = [Measurement::<R>::default(); 2];
            for (body, measurement) in bodies.iter_mut().zip(&mut pair) {
                body.measure(0, measurement);
                (measurement.stamp_mut().tick, measurement.stamp_mut().generation) = (tick, 1);
                body.flow(scenario.tick_s());
            }
            pair
        })
        .collect()
}

/// Measurement in, command out: what stands between the sensor and the actuator.
fn step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("estimate-and-control step");
    for (name, text) in SHIPPED {
        let scenario = scenario(text, &[]);
        if !scenario.rig.bodies().iter().any(|body| body.driven) {
            continue;
        }
        group.throughput(Throughput::Elements(1000));
        group.bench_function(name, |bencher| with_rig!(&scenario.rig, rig => step_of(rig, &scenario, bencher)));
    }
}

fn step_of<R: Rig>(rig: &R, scenario: &Scenario, bencher: &mut Bencher<'_>) {
    let driven = rig.bodies().iter().position(|body| body.driven).expect("somebody is driven");
    let samples = measurements(rig, driven, scenario);
    bencher.iter(|| {
        let mut observer = Observer::new(rig.estimator(), scenario.tick_s());
        let mut controller = Controller::new(rig.law(driven));
        let (mut estimate, mut command) = (Estimate::<R>::default(), Command::<R>::default());
        for [observed, own] in &samples {
            observer.step(black_box(observed), &mut estimate);
            controller.step(&estimate, black_box(own), &mut command);
            black_box(&command);
        }
    });
}

/// What the receiving ends check before any of it: the observed body's measurement, and a driven body's.
fn guards(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("guards of the step's two measurements");
    for (name, text) in SHIPPED {
        let scenario = scenario(text, &[]);
        if scenario.rig.bodies().iter().any(|body| body.driven) {
            group.throughput(Throughput::Elements(1000));
            group.bench_function(name, |bencher| with_rig!(&scenario.rig, rig => guards_of(rig, &scenario, bencher)));
        }
    }
}

fn guards_of<R: Rig>(rig: &R, scenario: &Scenario, bencher: &mut Bencher<'_>) {
    let driven = rig.bodies().iter().position(|body| body.driven).expect("somebody is driven");
    let samples = measurements(rig, driven, scenario);
    bencher.iter(|| {
        let mut guards = [rig.measurement_guard(0, false), rig.measurement_guard(driven, true)];
        for pair in &samples {
            for (guard, measurement) in guards.iter_mut().zip(pair) {
                assert!(guard.accepts(black_box(measurement)), "a shipped scenario's samples are possible");
            }
        }
    });
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
                    .map(|role| with_rig!(&scenario.rig, rig => build(rig, &scenario, role, &bus, &private_ledger(&scenario, role))))
                    .collect::<Result<_, _>>()
                    .expect("links in memory open");
                in_turn(&mut nodes, scenario.last_tick, |_| Ok(None), |_| true)
            });
        });
    }
}

criterion_group!(benches, step, guards, in_process);
criterion_main!(benches);
