//! What a step of each filter costs on the same noisy samples, relation included. Run by hand: `cargo bench --bench filters`.
//!
//! Compare figures of one run with one another, never with another machine's or another day's.

#[path = "../tests/peer/ekf.rs"]
mod ekf;
#[path = "../tests/peer/recording.rs"]
mod recording;

use corotate::observe::{
    Filter, GuardedKalman, HiddenRate, InvariantFilter, KalmanFilter, Observation, RateNoise, SecondOrderFilter,
};
use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use ekf::Ekf;
use nalgebra::Vector1;
use recording::{CASES, Recording};
use std::f64::consts::FRAC_1_SQRT_2;
use std::hint::black_box;

const TICK_S: f64 = 1e-3;
const DEVIATION: f64 = 2e-3;
const DENSITY: f64 = 1e-8;

fn relation_filters(guess: f64) -> [(&'static str, Filter<1>); 3] {
    let guess = Vector1::new(guess);
    [
        ("first order", Filter::First(InvariantFilter::new(Vector1::new(5.0), guess))),
        ("second order", Filter::Second(SecondOrderFilter::new(Vector1::new(0.7), FRAC_1_SQRT_2, guess))),
        ("Kalman on phi", Filter::Kalman(KalmanFilter::new(Vector1::new(DENSITY), guess, Vector1::new(1.0)))),
    ]
}

/// A second of samples through each filter; the throughput's unit is one step.
fn filters(criterion: &mut Criterion) {
    for case in &CASES[..3] {
        let recording = Recording::new(case, TICK_S, 1.0, DEVIATION, 1);
        let mut group = criterion.benchmark_group(case.name);
        group.throughput(Throughput::Elements(recording.truth.len() as u64 - 1));
        for (name, filter) in relation_filters(case.start[2]) {
            let relation = match filter {
                Filter::Kalman(_) => recording.relation(),
                _ => HiddenRate::new(&recording.coefficients, 3, 1e-6).expect("the case has a relation"),
            };
            group.bench_function(name, |bencher| {
                let run = |mut filter: Filter<1>| {
                    for index in 1..recording.truth.len() {
                        let (from, to) = (recording.sample(index - 1), black_box(recording.sample(index)));
                        match relation.observe(&from, &to, recording.tick_s, filter.estimate().x) {
                            Observation::Seen(increment) => filter.step(&increment),
                            Observation::Unobservable { drift } => filter.predict(&drift, recording.tick_s),
                        }
                    }
                    filter
                };
                bencher.iter_batched(|| filter, run, BatchSize::SmallInput);
            });
        }
        group.bench_function("guarded Kalman", |bencher| {
            bencher.iter(|| {
                let noise = RateNoise {
                    sensor_deviation_rad_s: recording.sensors(),
                    density: DENSITY,
                    guess_deviation_rad_s: 1.0,
                };
                let first = recording.sample(0);
                let mut filter = GuardedKalman::new(&recording.coefficients, 3, 1e-6, noise, &first, case.start[2])
                    .expect("the case has a relation");
                for index in 1..recording.truth.len() {
                    filter.step(&recording.sample(index - 1), &black_box(recording.sample(index)), recording.tick_s);
                }
                filter
            });
        });
        group.bench_function("extended Kalman", |bencher| {
            bencher.iter(|| {
                let start = [case.start[2], 1.0];
                let mut peer =
                    Ekf::new(&recording.coefficients, 3, [DEVIATION, DENSITY], &recording.measured[0], start);
                for measured in &recording.measured[1..] {
                    peer.step(recording.tick_s, black_box(measured));
                }
                peer.state
            });
        });
        group.finish();
    }
}

criterion_group!(benches, filters);
criterion_main!(benches);
