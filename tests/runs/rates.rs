//! Controllers and observers that compute at every n-th tick only: one hash in every clock, after kills and in replays.

use super::own_rig;
use crate::common::Bench;
use serde_json::Value;

/// Both bodies measure their rates at ticks of their own.
const SENSORS: &str = r#"sensor=[{body="leader",field="omega_rad_s",every_ticks=4},{body="follower",field="omega_rad_s",every_ticks=3,phase_ticks=1}]"#;

fn run(bench: &Bench, scenario: &str, clock: &str, set: &[&str]) -> Value {
    let mut line = vec!["run", scenario, "--clock", clock, "--duration", "1.5", "--record", "--overwrite", "--json"];
    line.extend(["--out", clock, "--set", "accept={}"]);
    set.iter().for_each(|set| line.extend(["--set", set]));
    bench.run(&line).succeeded().json()
}

#[test]
fn every_clock_and_replay_give_one_hash() {
    let bench = Bench::new();
    for (scenario, set) in [
        ("rigid-pair", &["controller.every_ticks=5"][..]),
        ("rigid-pair", &["observer.every_ticks=4"]),
        ("rigid-pair", &["controller.every_ticks=6", "observer.every_ticks=4", "actuation_delay_ticks=3"]),
        ("rigid-trio", &["controller.every_ticks=7", "substeps=3"]),
        ("orbit-hold", &["controller.every_ticks=10", "observer.every_ticks=2"]),
        ("noisy-pair", &["controller.every_ticks=2", "substeps=2"]),
        ("rigid-pair", &[SENSORS]),
        ("noisy-pair", &[SENSORS, "controller.every_ticks=3", "observer.every_ticks=2"]),
        ("gyro-loss", &[r#"sensor=[{body="leader",field="omega_rad_s",every_ticks=5}]"#]),
        (
            "orbit-hold",
            &[
                r#"sensor=[{body="spacecraft",field="radius_du",every_ticks=4},{body="spacecraft",field="angle_rad",every_ticks=6}]"#,
            ],
        ),
        ("rigid-fleet", &["controller.every_ticks=5", "follower.0.count=3"]),
    ] {
        let expected = run(&bench, scenario, "in-process", set);
        let every_tick = run(&bench, scenario, "lockstep", &set[set.len()..]);
        assert_ne!(expected["state"]["hash"], every_tick["state"]["hash"], "{set:?}");
        assert_eq!(run(&bench, scenario, "lockstep", set)["state"]["hash"], expected["state"]["hash"], "{set:?}");
        let books = &expected["books"];
        let ticks = expected["last_tick"].as_u64().unwrap() + 1;
        assert_eq!((&books["balanced"], &books["roles"]["controller"]["executed"]), (&true.into(), &ticks.into()));
        assert_eq!(books["roles"]["controller"]["starved"], 0);
        let realtime = run(&bench, scenario, "realtime", set);
        if realtime["state"]["first_disturbed_tick"].is_null() {
            assert_eq!(realtime["state"]["hash"], expected["state"]["hash"], "{set:?}");
        }
        for clock in ["in-process", "lockstep", "realtime"] {
            bench.run(&["replay", clock, "--json"]).succeeded();
        }
    }
}

/// Each role is killed at a tick at which the slower roles compute, and at one at which they do not.
#[test]
fn a_kill_costs_no_bit() {
    let bench = Bench::new();
    for set in [&["controller.every_ticks=5", "observer.every_ticks=2", "actuation_delay_ticks=2"][..], &[SENSORS]] {
        kill_each(&bench, set);
    }
}

fn kill_each(bench: &Bench, set: &[&str]) {
    let expected = run(bench, "rigid-pair", "in-process", set)["state"]["hash"].clone();
    for role in ["leader", "follower", "observer", "controller"] {
        for tick in [500, 501, 504] {
            let kill = format!("fault=[{{kind=\"kill\",role=\"{role}\",from_tick={tick}}}]");
            for clock in ["in-process", "lockstep"] {
                let killed = run(bench, "rigid-pair", clock, &[set, &[&kill]].concat());
                assert_eq!(killed["incidents"].as_array().unwrap().len(), 1);
                assert_eq!(killed["state"]["hash"], expected, "{role} at {tick}, {clock}");
            }
        }
    }
}

/// Without the measurement of a tick at which it computes, the controller sends nothing until the next one; without that of a tick in
/// between nothing changes.
#[test]
fn only_ticks_at_which_a_role_computes_need_samples() {
    let bench = Bench::new();
    let starved = |tick: u64| {
        let drop = format!("fault=[{{kind=\"drop\",role=\"follower\",from_tick={tick}}}]");
        let set = ["controller.every_ticks=5", &drop];
        let [in_process, lockstep] = ["in-process", "lockstep"].map(|clock| run(&bench, "rigid-pair", clock, &set));
        assert_eq!(in_process["state"]["hash"], lockstep["state"]["hash"]);
        let missed = |role: &str| in_process["books"]["roles"][role]["starved"].as_u64().unwrap();
        (missed("controller"), missed("follower"))
    };
    assert_eq!(starved(500), (1, 5));
    assert_eq!(starved(501), (0, 0));
}

#[test]
fn the_rates_of_a_rig_of_ones_own_need_no_tables_of_the_rig() {
    let bench = Bench::with_program(own_rig::program());
    let set = ["controller.every_ticks=4", "observer.every_ticks=2"];
    let [expected, lockstep] = ["in-process", "lockstep"].map(|clock| run(&bench, "motor-pair", clock, &set));
    assert_eq!(expected["state"]["hash"], lockstep["state"]["hash"]);
    let checked = bench.run(&["check", "motor-pair", "--resolved", "--set", set[0], "--set", set[1]]).succeeded();
    std::fs::write(bench.path("resolved.toml"), &checked.stdout).unwrap();
    let again = run(&bench, bench.path("resolved.toml").to_str().unwrap(), "in-process", &[]);
    let set = [
        r#"sensor=[{body="leader",field="speed_rad_s",every_ticks=4},{body="follower",field="speed_rad_s",every_ticks=2}]"#,
    ];
    let [sensed, lockstep] = ["in-process", "lockstep"].map(|clock| run(&bench, "motor-pair", clock, &set));
    assert_eq!(sensed["state"]["hash"], lockstep["state"]["hash"]);
    assert_ne!(sensed["state"]["hash"], expected["state"]["hash"]);
    assert_eq!(again["state"]["hash"], expected["state"]["hash"]);
}

#[test]
fn impossible_rates_are_refused() {
    let bench = Bench::new();
    for (set, code) in [
        ("controller.every_ticks=0", "out-of-range"),
        ("observer.every_ticks=100001", "out-of-range"),
        ("substeps=0", "out-of-range"),
        ("controller.every_ticks=-1", "wrong-type"),
        ("controller.every_ticks=2.5", "wrong-type"),
        ("controller.every_tick=2", "unknown-key"),
        ("leader.every_ticks=2", "unknown-key"),
        (r#"sensor=[{body="leader",field="omega_rad_s",every_ticks=0}]"#, "out-of-range"),
        (r#"sensor=[{body="leader",field="omega_rad_s",every_ticks=3,phase_ticks=3}]"#, "out-of-range"),
        (r#"sensor=[{body="leader",field="omega_rad_s",every_ticks=-1}]"#, "wrong-type"),
        (r#"sensor=[{body="leader",field="omega_rad_s"}]"#, "missing-key"),
        (r#"sensor=[{body="leader",field="omega_rad_s",every_tick=2}]"#, "unknown-key"),
        (r#"sensor=[{body="absent",field="omega_rad_s",every_ticks=2}]"#, "unknown-body"),
        (r#"sensor=[{body="leader",field="omega",every_ticks=2}]"#, "unknown-field"),
        (r#"sensor=[{body="leader",field="status",every_ticks=2}]"#, "unknown-field"),
        (r#"sensor=[{body="leader",field="tick",every_ticks=2}]"#, "unknown-field"),
        (
            r#"sensor=[{body="leader",field="omega_rad_s",every_ticks=2},{body="leader",field="omega_rad_s",every_ticks=3}]"#,
            "given-twice",
        ),
    ] {
        let done = bench.run(&["check", "rigid-pair", "--set", set]);
        assert!(done.code == Some(2) && done.says(code), "{set}: {done:?}");
    }
    let fleet = r#"sensor=[{body="fleet",field="omega_rad_s",every_ticks=2}]"#;
    let done = bench.run(&["check", "rigid-fleet", "--set", fleet]);
    assert!(done.code == Some(2) && done.says("fleet-sensor"), "{done:?}");
    let own = Bench::with_program(own_rig::program());
    let done = own.run(&["check", "motor-pair", "--set", "controller.every_tick=2"]);
    assert!(done.code == Some(2) && done.says("unknown-key"), "{done:?}");
}
