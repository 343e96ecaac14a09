//! The filters on noisy measurements, compared with the textbook's extended Kalman filter on the same data.
//!
//! `cargo test --release --test all noise:: -- --nocapture` prints every figure.

use crate::contestants::ekf::Ekf;
use crate::contestants::recording::{CASES, Case, Recording};
use corotate::observe::{
    Filter, GuardedKalman, HiddenRate, InvariantFilter, KalmanFilter, Observation, RateNoise, SecondOrderFilter,
};
use nalgebra::Vector1;
use std::f64::consts::FRAC_1_SQRT_2;

/// The time after which the filters' transients are over, s; the recordings are twice as long.
const SETTLED_S: f64 = 20.0;

const ELLIPTIC: &Case = &CASES[0];

/// The error of the initial guess of the hidden component, except in tests of the guess, rad/s.
const GUESS_ERROR: f64 = 0.1;

fn first(rate: f64, guess: f64) -> Filter<1> {
    Filter::First(InvariantFilter::new(Vector1::new(rate), Vector1::new(guess)))
}

fn second(bandwidth: f64, guess: f64) -> Filter<1> {
    Filter::Second(SecondOrderFilter::new(Vector1::new(bandwidth), FRAC_1_SQRT_2, Vector1::new(guess)))
}

fn kalman(density: f64, guess: f64, deviation: f64) -> Filter<1> {
    Filter::Kalman(KalmanFilter::new(Vector1::new(density), Vector1::new(guess), Vector1::new(deviation)))
}

/// Returns ω_k − ω̂_k at each sample for a filter on the invariant relation.
fn by_relation(recording: &Recording, mut filter: Filter<1>) -> Vec<f64> {
    let relation = recording.relation();
    let mut errors = vec![recording.truth[0].z - filter.estimate().x];
    for index in 1..recording.truth.len() {
        let (from, to) = (recording.sample(index - 1), recording.sample(index));
        match relation.observe(
            &relation.regressor(&from),
            &relation.regressor(&to),
            recording.tick_s,
            filter.estimate().x,
        ) {
            Observation::Seen(increment) => filter.step(&increment),
            Observation::Unobservable { drift } => filter.predict(&drift, recording.tick_s),
        }
        errors.push(recording.truth[index].z - filter.estimate().x);
    }
    errors
}

/// Returns ω_k − ω̂_k at each sample for the extended Kalman filter.
fn by_ekf(recording: &Recording, density: f64, [guess, deviation]: [f64; 2]) -> Vec<f64> {
    let noise = [recording.deviation, density];
    let mut peer = Ekf::new(&recording.coefficients, 3, noise, &recording.measured[0], [guess, deviation]);
    let errors = recording.measured[1..].iter().zip(&recording.truth[1..]).map(|(measured, truth)| {
        peer.step(recording.tick_s, measured);
        truth.z - peer.state.z
    });
    std::iter::once(recording.truth[0].z - guess).chain(errors).collect()
}

/// Returns ω_k − ω̂_k at each sample for the guarded Kalman filter of the whole state.
fn by_guarded(recording: &Recording, density: f64, [guess, deviation]: [f64; 2]) -> Vec<f64> {
    let mut filter = guarded(recording, density, 1e-6, [guess, deviation]);
    let errors = (1..recording.truth.len()).map(|index| {
        filter.step(&recording.sample(index - 1), &recording.sample(index), recording.tick_s);
        recording.truth[index].z - filter.estimate().z
    });
    std::iter::once(recording.truth[0].z - guess).chain(errors).collect()
}

fn guarded(recording: &Recording, density: f64, floor: f64, [guess, deviation]: [f64; 2]) -> GuardedKalman {
    let noise = RateNoise { sensor_deviation_rad_s: recording.sensors(), density, guess_deviation_rad_s: deviation };
    GuardedKalman::new(&recording.coefficients, 3, floor, noise, &recording.sample(0), guess).unwrap()
}

/// Returns the root mean square after the settling time; infinite for a NaN.
fn rms(recording: &Recording, errors: &[f64]) -> f64 {
    let late = &errors[(SETTLED_S / recording.tick_s) as usize..];
    let mean = late.iter().map(|error| error * error).sum::<f64>() / late.len() as f64;
    if mean.is_nan() { f64::INFINITY } else { mean.sqrt() }
}

fn row(values: &[f64]) -> String {
    values.iter().map(|value| format!("{value:9.2e}")).collect::<Vec<_>>().join(" ")
}

/// Returns the root mean square over several recordings.
fn pooled(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt()
}

fn record(case: &Case, tick_s: f64, deviation: f64, seed: u64) -> Recording {
    Recording::new(case, tick_s, 2.0 * SETTLED_S, deviation, seed)
}

#[test]
fn noise_passes_as_predicted_by_theory() {
    let recordings = [1, 2, 3].map(|seed| record(ELLIPTIC, 1e-3, 2e-3, seed));
    let guess = ELLIPTIC.start[2] + GUESS_ERROR;
    let all = |run: &dyn Fn(&Recording) -> Vec<f64>| {
        let each = recordings.each_ref().map(|recording| rms(recording, &run(recording)));
        println!("{}", row(&each));
        each
    };
    let within = |name: &str, range: [f64; 2], run: &dyn Fn(&Recording) -> Vec<f64>| {
        print!("{name:28}");
        let value = pooled(&all(run));
        // The range is that of two seeds; three others may differ from it by a fifth.
        assert!(value > range[0] / 1.2 && value < range[1] * 1.2, "{name}: {value:e}");
    };
    within("first order, 5/s", [1.4e-2, 1.4e-2], &|data| by_relation(data, first(5.0, guess)));
    // Started at the truth: a wrong guess would still have an effect after 20 s at this rate.
    within("first order, 0.2/s", [5.6e-4, 5.6e-4], &|data| by_relation(data, first(0.2, ELLIPTIC.start[2])));
    within("second order, 0.7 rad/s", [4.2e-5, 4.8e-5], &|data| by_relation(data, second(0.7, guess)));
    within("second order, 2 rad/s", [1.4e-4, 1.6e-4], &|data| by_relation(data, second(2.0, guess)));
    for density in [1e-6, 1e-8, 1e-10, 0.0] {
        print!("{:28}", format!("extended Kalman, q {density:e}"));
        all(&|data| by_ekf(data, density, [guess, 1.0]));
        print!("{:28}", format!("guarded Kalman, q {density:e}"));
        all(&|data| by_guarded(data, density, [guess, 1.0]));
        print!("{:28}", format!("Kalman on phi, q {density:e}"));
        all(&|data| by_relation(data, kalman(density, guess, 1.0)));
    }
}

/// Returns the pooled rms of the extended, the guarded and the relation's Kalman filter on the same recordings,
/// rad/s.
fn compare(case: &Case, recordings: &[Recording], density: f64) -> [f64; 3] {
    let start = [case.start[2] + GUESS_ERROR, 1.0];
    let pool = |run: &dyn Fn(&Recording) -> Vec<f64>| {
        pooled(&recordings.iter().map(|data| rms(data, &run(data))).collect::<Vec<_>>())
    };
    [
        pool(&|data| by_ekf(data, density, start)),
        pool(&|data| by_guarded(data, density, start)),
        pool(&|data| by_relation(data, kalman(density, start[0], start[1]))),
    ]
}

#[test]
fn the_guarded_kalman_filter_equals_the_extended_one_at_every_noise() {
    println!("rms of the extended Kalman filter; guarded and phi alone relative to it");
    let mut worse = Vec::new();
    for case in &CASES {
        for (tick_s, seeds) in [(1e-2, 1..=4), (1e-3, 1..=2)] {
            for deviation in [1e-5, 1e-4, 1e-3, 1e-2] {
                let recordings: Vec<_> = seeds.clone().map(|seed| record(case, tick_s, deviation, seed)).collect();
                for density in [0.0, 1e-10, 1e-8, 1e-6] {
                    let [peer, guarded, alone] = compare(case, &recordings, density);
                    let ratio = guarded / peer;
                    let setting = format!("{:16} tick {tick_s:5} s, sigma {deviation:e}, q {density:5e}", case.name);
                    println!("{setting}: {peer:8.2e} {ratio:6.3} {:6.3}", alone / peer);
                    if ratio.is_nan() || ratio > 1.05 {
                        worse.push((setting, ratio));
                    }
                }
            }
        }
    }
    assert!(worse.is_empty(), "{worse:#?}");
}

/// Returns the time after which the error stays below a bound, s; infinite if it does not.
fn settling_s(recording: &Recording, errors: &[f64], bound: f64) -> f64 {
    match errors.iter().rposition(|error| error.is_nan() || error.abs() > bound) {
        Some(last) if last + 1 == errors.len() => f64::INFINITY,
        Some(last) => (last + 1) as f64 * recording.tick_s,
        None => 0.0,
    }
}

#[test]
fn every_guess_converges() {
    println!("settling time to 2e-2 rad/s, s: extended, guarded, phi alone, second order at 0.7 rad/s");
    let mut peer_failed = 0;
    let mut late = Vec::new();
    for case in &CASES {
        for (tick_s, sigma) in [(1e-2, 2e-3), (1e-2, 1e-4), (1e-2, 1e-5), (1e-3, 1e-3), (0.05, 1e-3), (0.05, 1e-5)] {
            let recording = record(case, tick_s, sigma, 1);
            for factor in [50.0, 20.0, 5.0, 0.0, -1.0, -5.0, -20.0, -50.0] {
                for (certainty, density) in [(1.0, 1e-8), (0.1, 1e-8), (0.01, 1e-8), (0.1, 1e-10), (0.1, 0.0)] {
                    let guess = case.start[2] * factor;
                    let start = [guess, certainty * (guess - case.start[2]).abs()];
                    let times = [
                        by_ekf(&recording, density, start),
                        by_guarded(&recording, density, start),
                        by_relation(&recording, kalman(density, start[0], start[1])),
                        by_relation(&recording, second(0.7, guess)),
                    ]
                    .map(|errors| settling_s(&recording, &errors, 2e-2));
                    let setting = format!(
                        "{:16} tick {tick_s} s, sigma {sigma:e}, guess {factor:3} x, deviation {certainty:4} of its error, q {density:e}",
                        case.name
                    );
                    println!("{setting}: {times:6.2?}");
                    peer_failed += usize::from(times[0] > SETTLED_S);
                    if times[1..].iter().any(|time| *time > SETTLED_S) {
                        late.push((setting, times));
                    }
                }
            }
        }
    }
    println!("the extended Kalman filter took longer than {SETTLED_S} s in {peer_failed} cases");
    assert!(late.is_empty(), "{} {late:#?}", late.len());
}

#[test]
fn without_noise_the_floor_is_that_of_rounding() {
    for case in &CASES {
        let recording = record(case, 1e-3, 0.0, 1);
        let guess = case.start[2] + GUESS_ERROR;
        let errors = by_relation(&recording, second(4.0, guess));
        let worst = errors[(SETTLED_S / recording.tick_s) as usize..].iter().fold(0.0_f64, |w, e| w.max(e.abs()));
        println!("{:16} {worst:.1e} rad/s", case.name);
        assert!(worst < 1e-11 && errors.iter().all(|error| error.is_finite()), "{}: {worst:e}", case.name);
    }
}

/// Returns the errors of every filter on the samples with the given indices only, and the number of unobservable
/// steps.
fn sparse(recording: &Recording, indices: &[usize], floor: f64) -> (Vec<[f64; 5]>, usize) {
    let guess = recording.truth[0].z + GUESS_ERROR;
    let relation = HiddenRate::new(&recording.coefficients, 3, floor).unwrap().with_noise(&recording.sensors());
    let mut filters = [first(0.2, guess), second(0.7, guess), second(2.0, guess), kalman(1e-8, guess, 1.0)];
    let mut guarded = guarded(recording, 1e-8, floor, [guess, 1.0]);
    let (mut errors, mut unseen) = (Vec::new(), 0);
    for pair in indices.windows(2) {
        let (from, to) = (recording.sample(pair[0]), recording.sample(pair[1]));
        let step_s = (pair[1] - pair[0]) as f64 * recording.tick_s;
        for filter in &mut filters {
            match relation.observe(&relation.regressor(&from), &relation.regressor(&to), step_s, filter.estimate().x) {
                Observation::Seen(increment) => filter.step(&increment),
                Observation::Unobservable { drift } => filter.predict(&drift, step_s),
            }
        }
        unseen += usize::from(!guarded.step(&from, &to, step_s));
        let truth = recording.truth[pair[1]].z;
        let [a, b, c, d] = filters.map(|filter| truth - filter.estimate().x);
        errors.push([a, b, c, d, truth - guarded.estimate().z]);
    }
    (errors, unseen)
}

/// Returns the root mean square of every filter's errors over the last half.
fn late_rms(errors: &[[f64; 5]]) -> [f64; 5] {
    let late = &errors[errors.len() / 2..];
    std::array::from_fn(|filter| {
        (late.iter().map(|error| error[filter].powi(2)).sum::<f64>() / late.len() as f64).sqrt()
    })
}

#[test]
fn missed_ticks_only_lengthen_a_step() {
    for case in &CASES {
        let recording = record(case, 1e-3, 1e-3, 5);
        // One to forty-seven ticks from sample to sample, and a gap of half a second.
        let gaps = (0_usize..).map(|k| if k == 700 { 500 } else { 1 + (k * k * 31) % 47 });
        let indices: Vec<_> = gaps
            .scan(0, |at, gap| {
                *at += gap;
                Some(*at)
            })
            .take_while(|&at| at < recording.truth.len())
            .collect();
        let every: Vec<_> = (indices[0]..recording.truth.len()).collect();
        let (missed, whole) =
            (late_rms(&sparse(&recording, &indices, 1e-6).0), late_rms(&sparse(&recording, &every, 1e-6).0));
        println!("{:16} {} of all samples {}", case.name, row(&missed), row(&whole));
        // One of 24 samples: filters of one bandwidth pass up to √24 times as much white noise.
        assert!((1..5).all(|filter| missed[filter] < 12.0 * whole[filter]), "{}", case.name);
    }
}

#[test]
fn the_model_bridges_unobservable_gaps() {
    // Only on a hyperbola do the measured components come near the unobservable set and leave it again.
    let case = &CASES[1];
    for floor in [0.5, 0.6, 0.8] {
        let recording = record(case, 1e-2, 1e-3, 5);
        let indices: Vec<_> = (0..recording.truth.len()).collect();
        let (errors, unseen) = sparse(&recording, &indices, floor);
        let late = late_rms(&errors);
        println!("{:16} blind in {unseen} of {} steps: {}", case.name, errors.len(), row(&late));
        assert!(unseen > errors.len() / 10 && unseen < errors.len() * 9 / 10, "{}: {unseen}", case.name);
        assert!((1..5).all(|filter| late[filter] < 1e-2), "{}: {late:?}", case.name);
    }
}
