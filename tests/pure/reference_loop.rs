//! The closed loop against an implementation that shares no code with it, and the three clocks against each other.

use crate::common::{Bench, Loop, next, reference, shipped};
use corotate::bus::Signal;
use corotate::sample::{RateEstimate, RateTruth};
use corotate::scenario::Scenario;
use serde_json::Value;

/// The tolerance of the columns of `let_pair*.csv`.
pub(super) const TOLERANCE: f64 = 1e-9;

/// Returns the overrides that turn a shipped scenario into the case of a reference file.
fn case(file: &str) -> (&'static str, Vec<String>) {
    let (scenario, decay, gain) = match file {
        "let_pair_100hz.csv" => ("rigid-pair", "5.0", "[2.0, 2.0, 2.0]"),
        "let_pair_hyperbolic_100hz.csv" => ("rigid-pair-hyperbolic", "6.0", "[2.0, 3.0, 4.0]"),
        _ => unreachable!("no such case"),
    };
    let overrides = [
        "tick_hz=100".to_owned(),
        format!("observer.decay_rate_per_s={decay}"),
        format!("controller.gain_per_s={gain}"),
        "accept={}".to_owned(),
    ];
    (scenario, overrides.into())
}

/// Runs a scenario in this thread and returns ω, p, ω̂3 and u per tick, like the reference.
pub(super) fn columns(scenario: &Scenario) -> Vec<Vec<f64>> {
    let mut all = Loop::open(scenario);
    let (mut leader, mut follower) =
        (all.input::<RateTruth>("leader", Signal::Truth), all.input::<RateTruth>("follower", Signal::Truth));
    let mut estimate = all.input::<RateEstimate>("leader", Signal::Estimate);
    let mut rows = Vec::new();
    all.run(|tick| {
        let (leader, follower) = (next(&mut leader), next(&mut follower));
        let hidden = next(&mut estimate).omega_rad_s[2];
        let row = [&leader.omega_rad_s[..], &follower.omega_rad_s, &[hidden], &follower.applied_rad_s2].concat();
        rows.push([&[tick as f64, scenario.time_s(tick)][..], &row].concat());
    });
    rows
}

fn agrees_with(file: &str) {
    let (name, overrides) = case(file);
    let scenario = Scenario::load(&shipped(name), &overrides).unwrap();
    let (rows, expected) = (columns(&scenario), reference(file));
    assert_eq!(rows.len(), expected.len());
    let mut worst = vec![0.0_f64; expected[0].len()];
    for (row, expected) in rows.iter().zip(&expected) {
        for ((worst, value), expected) in worst.iter_mut().zip(row).zip(expected) {
            let deviation = (value - expected).abs();
            assert!(deviation <= TOLERANCE, "{file} tick {}: {value} instead of {expected}", row[0]);
            *worst = worst.max(deviation);
        }
    }
    let worst = worst.into_iter().fold(0.0, f64::max);
    println!("{file}: worst deviation {worst:e}");
}

#[test]
fn the_loop_follows_the_reference_with_an_elliptic_leader() {
    agrees_with("let_pair_100hz.csv");
}

#[test]
fn the_loop_follows_the_reference_with_a_hyperbolic_leader() {
    agrees_with("let_pair_hyperbolic_100hz.csv");
}

/// Lockstep processes publish the bits of the in-process run, so they reproduce the reference too.
#[test]
fn lockstep_processes_reproduce_the_reference_bit_by_bit() {
    for file in ["let_pair_100hz.csv", "let_pair_hyperbolic_100hz.csv"] {
        let (scenario, overrides) = case(file);
        let set: Vec<&str> = overrides.iter().flat_map(|argument| ["--set", argument]).collect();
        let bench = Bench::new();
        let run = |clock: &str| bench.summary(scenario, &[&set[..], &["--clock", clock]].concat());
        let (in_process, lockstep) = (run("in-process"), run("lockstep"));
        assert_eq!(in_process["state"]["hash"], lockstep["state"]["hash"], "{file}");
        assert_eq!(in_process["last_tick"], 1000);
    }
}

fn checkpoints(bench: &Bench, directory: &str) -> Vec<(u64, String)> {
    let text = std::fs::read_to_string(bench.path(directory).join("hashes.txt")).unwrap();
    let entry =
        |line: &str| line.split_once(' ').map(|(ticks, hash)| (ticks.parse().unwrap(), hash.to_owned())).unwrap();
    text.lines().skip(1).map(entry).collect()
}

/// In a long run not every tick has a hash, but the last one has one; `clean_ticks` are all ticks of an undisturbed
/// run.
#[test]
fn a_long_run_has_the_hash_of_its_last_tick() {
    let bench = Bench::new();
    for (ticks, stride) in [(16_384, 1), (16_385, 2), (40_000, 3)] {
        let duration = format!("{}", (ticks - 1) as f64 / 1000.0);
        let options =
            ["--clock=in-process", "--set", "accept={}", "--duration", &duration, "--out", "out", "--overwrite"];
        let summary = bench.summary("rigid-pair", &options);
        let (state, hashes) = (&summary["state"], checkpoints(&bench, "out"));
        assert_eq!((state["elapsed_ticks"].as_u64(), state["clean_ticks"].as_u64()), (Some(ticks), Some(ticks)));
        assert_eq!(state["clean_hash"], state["hash"]);
        let (last, hash) = hashes.last().unwrap();
        assert_eq!((*last, hash.as_str()), (ticks, state["hash"].as_str().unwrap()));
        let strides = hashes[..hashes.len() - 1].iter().enumerate();
        assert!(strides.clone().all(|(index, (at, _))| *at == (index as u64 + 1) * stride), "{ticks}");
    }
}

/// In real time every tick before the first disturbed one has the bits of the in-process run; the summary names that
/// tick.
#[test]
fn realtime_gives_the_same_bits_up_to_the_first_missed_tick() {
    for scenario in ["rigid-pair", "rigid-pair-hyperbolic", "rigid-trio"] {
        let bench = Bench::new();
        let common = ["--duration", "3", "--set", "accept={}", "--out"];
        let run = |clock: &str| bench.summary(scenario, &[&common[..], &[clock, "--clock", clock]].concat());
        let (reference, live, lockstep) = (run("in-process"), run("realtime"), run("lockstep"));
        assert_eq!(reference["state"]["hash"], lockstep["state"]["hash"], "{scenario}");
        let clean = live["state"]["clean_ticks"].as_u64().unwrap();
        println!("{scenario}: {clean} of 3001 ticks undisturbed");
        let (expected, seen) = (checkpoints(&bench, "in-process"), checkpoints(&bench, "realtime"));
        assert_eq!(expected.len(), 3001);
        assert_eq!(expected[..clean as usize], seen[..clean as usize], "{scenario}");
        match live["state"]["first_disturbed_tick"].as_u64() {
            Some(first) => assert_eq!(first, clean, "every tick before the first disturbed one is covered"),
            None => assert_eq!(live["state"]["hash"], reference["state"]["hash"]),
        }
        bench.assert_clean(&[]);
    }
}

/// A difference in any published value changes the hash, so the comparison above can fail.
#[test]
fn runs_that_differ_in_the_last_bit_have_different_hashes() {
    let bench = Bench::new();
    let hash = |rate: f64| -> Value {
        let set = format!("follower.0.initial_rate_rad_s=[{rate:?}, 0.5, 0.2]");
        let arguments = ["--clock", "in-process", "--duration", "0.1", "--set", "accept={}", "--set", &set];
        bench.summary("rigid-pair", &arguments)["state"]["hash"].clone()
    };
    assert_eq!(hash(0.3), hash(0.3));
    assert_ne!(hash(0.3), hash(0.3_f64.next_up()));
}
