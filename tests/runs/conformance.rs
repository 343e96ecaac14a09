//! Requirements on every rig and every shipped scenario. New scenarios are found in the list of shipped ones.

use crate::common::{Bench, shipped};
use corotate::config::SHIPPED;
use corotate::scenario::Scenario;
use serde_json::Value;

#[test]
fn every_shipped_scenario_is_accepted_and_equal_in_process_and_in_lockstep() {
    for (name, _) in SHIPPED {
        let bench = Bench::new();
        let run = |clock: &str| bench.summary(name, &["--clock", clock]);
        let (in_process, lockstep) = (run("in-process"), run("lockstep"));
        assert_eq!(in_process["state"]["hash"], lockstep["state"]["hash"], "{name}");
        for summary in [&in_process, &lockstep] {
            assert_eq!(summary["accepted"], true, "{name}: {summary:#}");
            assert!(!summary["criteria"].as_array().unwrap().is_empty(), "{name} has no criteria");
            assert_eq!(summary["books"]["balanced"], true, "{name}");
            // An injected fault removes the same samples under every clock.
            let expected = if name == "faults" { &in_process["books"]["missed_ticks"] } else { &Value::from(0) };
            assert_eq!(summary["books"]["missed_ticks"], *expected, "{name}");
            let rejected = summary["books"]["rejected_samples"].as_u64().unwrap();
            assert_eq!(rejected > 0, name == "faults", "{name}: {rejected} samples rejected");
        }
        println!("{name}: {}", in_process["score"]["metrics"]);
        bench.assert_clean(&[]);
    }
}

#[test]
fn the_seed_alone_determines_the_noise() {
    let bench = Bench::new();
    let hash = |scenario: &str, seed: u64| -> Value {
        let seed = format!("seed={seed}");
        let short = ["--clock", "in-process", "--duration", "0.5", "--set", "accept={}", "--set", &seed];
        bench.summary(scenario, &short)["state"]["hash"].clone()
    };
    assert_eq!(hash("noisy-pair", 7), hash("noisy-pair", 7));
    assert_ne!(hash("noisy-pair", 7), hash("noisy-pair", 8));
    assert_eq!(hash("rigid-pair", 7), hash("rigid-pair", 8));
}

/// The controller publishes the bound of [D](18); a miss may break it.
#[test]
fn the_live_certificate_holds_at_every_undisturbed_step() {
    for name in ["rigid-pair", "rigid-pair-hyperbolic", "rigid-trio", "gyro-loss"] {
        let bench = Bench::new();
        for clock in ["in-process", "realtime"] {
            let run = ["--clock", clock, "--duration", "5", "--set", "accept={}", "--set", "leader.outage=[]"];
            let outage = if name == "gyro-loss" { &run[..] } else { &run[..6] };
            let certificate = bench.summary(name, outage)["score"]["certificate"].clone();
            let count = |key: &str| certificate[key].as_u64().unwrap();
            assert_eq!(count("broken"), 0, "{name} {clock}: {certificate}");
            assert!(count("held") > 0, "{name} {clock}: {certificate}");
        }
    }
}

/// The theorem assumes that follower and leader have the same inertia.
#[test]
fn the_live_certificate_breaks_if_its_assumption_is_violated() {
    let bench = Bench::new();
    let run = ["--clock", "in-process", "--set", "controller.adaptation_gain=0", "--set", "accept={}"];
    let summary = bench.summary("mismatched-follower", &run);
    assert!(summary["score"]["certificate"]["broken"].as_u64().unwrap() > 1000, "{summary:#}");
}

#[test]
fn a_resolved_scenario_resolves_to_itself() {
    for (name, _) in SHIPPED {
        let first = Scenario::load(&shipped(name), &[]).unwrap().to_toml();
        assert_eq!(first, Scenario::parse(&first, name, &[]).unwrap().to_toml(), "{name}");
    }
}

/// The remaining error is proportional to the tick's length.
#[test]
fn adaptation_removes_an_inertia_mismatch_down_to_the_floor_of_the_tick() {
    let bench = Bench::new();
    let error = |gain: &str, tick_hz: &str| {
        let gain = format!("controller.adaptation_gain={gain}");
        let limit = "accept.sync_error_rad_s_max=10";
        let run = ["--clock", "in-process", "--tick-hz", tick_hz, "--set", &gain, "--set", limit];
        let summary = bench.summary("mismatched-follower", &run);
        summary["score"]["metrics"][0]["settled_max"].as_f64().unwrap()
    };
    let (without, coarse, fine) = (error("0", "1000"), error("50", "1000"), error("50", "2000"));
    println!("without {without:.2e}, with {coarse:.2e} at 1 kHz and {fine:.2e} at 2 kHz");
    assert!(without > 0.1 && coarse < 1e-3, "{without:e} {coarse:e}");
    assert!((fine / coarse - 0.5).abs() < 0.05, "{fine:e} {coarse:e}");
}

/// The estimates differ, so the filters are different ones.
#[test]
fn every_filter_settles_with_noisy_sensors_in_every_rig() {
    let bench = Bench::new();
    let noise = "spacecraft.noise={radius_du=1e-4, angle_rad=1e-4}";
    let orbit = ["accept={}", noise, "observer={decay_rate_per_s=[4.0, 4.0]}"];
    let cases = [
        ("noisy-pair", ["accept={}", "seed=3", "observer={decay_rate_per_s=6.0}"]),
        ("noisy-pair", ["accept={}", "seed=3", "observer={bandwidth_rad_s=1.0}"]),
        ("noisy-pair", ["accept={}", "seed=3", "observer={process_noise_rad2_s3=1e-8}"]),
        ("orbit-hold", orbit),
        ("orbit-hold", [orbit[0], orbit[1], "observer={bandwidth_rad_s=[3.0, 3.0]}"]),
        ("orbit-hold", [orbit[0], orbit[1], "observer={process_noise_du2_s3=1e-6}"]),
    ];
    let mut errors = Vec::new();
    for (scenario, sets) in cases {
        let arguments: Vec<&str> =
            sets.iter().flat_map(|set| ["--set", set]).chain(["--clock", "in-process"]).collect();
        let summary = bench.summary(scenario, &arguments);
        let metrics = summary["score"]["metrics"].as_array().unwrap();
        let estimate = metrics.iter().find(|m| m["name"].as_str().unwrap().starts_with("estimate_error")).unwrap();
        errors.push(estimate["last"].as_f64().unwrap());
    }
    println!("errors of the estimate at the end: {errors:?}");
    assert!(errors.iter().all(|error| *error < 0.1 && *error > 0.0), "{errors:?}");
    assert!(errors.windows(2).all(|pair| pair[0] != pair[1]), "{errors:?}");
}

#[test]
fn a_second_order_identifier_finds_the_inertia() {
    let bench = Bench::new();
    let bandwidth = "observer.identifier_bandwidth=[8.0, 8.0, 8.0]";
    for (scenario, observer) in [
        ("inertia", "observer={kind=\"inertia\", decay_rate_per_s=6.0}"),
        ("inertia-axisymmetric", "observer={kind=\"axisymmetric-inertia\", symmetry_axis=3, decay_rate_per_s=6.0}"),
    ] {
        let summary = bench.summary(scenario, &["--clock", "in-process", "--set", observer, "--set", bandwidth]);
        let error = summary["score"]["metrics"][0]["settled_max"].as_f64().unwrap();
        println!("{scenario}: {error:e}");
        assert!(error < 1e-9, "{scenario}: {error:e}");
    }
}

#[test]
fn an_observer_that_cannot_converge_is_refused_by_check() {
    for (scenario, set, code) in [
        ("inertia-axisymmetric", "leader.initial_rate_rad_s=[0.5, 0.2, 0.0]", "no-spin"),
        ("inertia-axisymmetric", "leader.inertia_kg_m2=[1.0, 1.1, 1.6]", "not-symmetric"),
        ("inertia", "observer.identifier_decay=[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]", "not-hurwitz"),
        ("inertia", "observer.identifier_decay=[5.0, -5.0, 5.0]", "not-positive"),
        ("inertia", "leader.measured_axes=[1, 2]", "bad-axes"),
        ("inertia", "observer.identifier_bandwidth=[1.0, 1.0, 1.0]", "conflicting-keys"),
        ("inertia-axisymmetric", "observer.symmetry_axis=7", "no-such-axis"),
        ("gyro-loss", "leader.outage.0.axis=4", "no-such-axis"),
        ("gyro-loss", "leader.outage.0.until_s=1.0", "wrong-order"),
        ("noisy-pair", "leader.noise_rad_s=[0.0, 0.0, 0.0]", "no-noise"),
        ("noisy-pair", "leader.noise_rad_s=[1e-3, -1e-3, 0.0]", "negative"),
        ("noisy-pair", "observer.bandwidth_rad_s=1.0", "conflicting-keys"),
        ("mismatched-follower", "follower.0.inertia_factor=[1.0, 1.0, 3.0]", "triangle-inequality"),
        ("mismatched-follower", "controller.adaptation_gain=-1.0", "negative"),
    ] {
        let done = Bench::new().run(&["check", shipped(scenario).to_str().unwrap(), "--set", set]);
        assert!(done.code == Some(2) && done.says(code), "{set}: {done:?}");
    }
}

/// The JSON has the theorem's rate and the sampled loop's rate under their own names.
#[test]
fn check_reports_a_claim_or_a_reason_for_every_follower() {
    let bench = Bench::new();
    for (name, _) in SHIPPED {
        let done = bench.run(&["check", "--json", shipped(name).to_str().unwrap()]);
        assert_eq!(done.code, Some(0), "{name}: {done:?}");
        let checked = done.json();
        assert_eq!((checked["schema"].as_str(), checked["scenario"].as_str()), (Some("corotate/check/v1"), Some(name)));
        let followers = checked["followers"].as_array().unwrap();
        assert_eq!(
            followers.is_empty(),
            name.starts_with("inertia"),
            "{name}: only the inertia scenarios have no follower"
        );
        for follower in followers {
            let rate = &follower["loop_rate_per_s"];
            assert_eq!(rate.is_null(), follower["reason"].is_string(), "{name}: {follower:#}");
            assert!(rate.is_null() || rate.as_f64().unwrap() > 0.0, "{name}: {follower:#}");
            assert_eq!(rate.is_number(), follower["floor"].is_number(), "{name}: {follower:#}");
            assert!(follower["warnings"].is_array(), "{name}: {follower:#}");
            let close = ["rigid-pair", "rigid-pair-hyperbolic", "rigid-trio", "rigid-fleet", "faults"].contains(&name);
            let continuous = follower["continuous_rate_per_s"].as_f64();
            let near = || (rate.as_f64().unwrap() / continuous.unwrap() - 1.0).abs() < 0.02;
            assert!(!close || near(), "{name}: at this tick both rates are nearly equal: {follower:#}");
        }
    }
}
