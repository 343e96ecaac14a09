//! Every role, killed or stopped at every failpoint: the run ends as it should, or recovers.
//!
//! Needs the feature `hooks`, which compiles the failpoints into the program; `tests/run` turns it on.

use crate::common::{ANY_TICKS, Bench, Done, Running, shipped};
use serde_json::Value;

const ROLES: [&str; 4] = ["leader", "follower", "observer", "controller"];
/// The failpoints while ticks run, with the number of passes before the failure.
const RUNNING: [&str; 6] = ["staged 901", "committing 903", "in-commit 904", "committed 905", "sent 902", "waiting 40"];

/// Starts a run whose `role` fails at a failpoint by a signal.
fn start(bench: &Bench, role: &str, place: &str, signal: &str, more: &[&str]) -> Running {
    let file = shipped("rigid-pair");
    let common = [
        "run",
        file.to_str().unwrap(),
        "--json",
        "--out",
        "out",
        "--overwrite",
        "--set",
        "launch.startup_timeout_s=20",
    ];
    let mut command = bench.command();
    command.args([&common[..], more].concat()).env("COROTATE_HOOK", format!("{role} {place} {signal}"));
    Running::new(&mut command)
}

/// Asserts what holds after every survived failure: no hang, the role is named, the counters balance, nothing is left.
fn assert_survived(bench: &Bench, done: &Done, role: &str, case: &str) -> Value {
    assert_eq!(done.code, Some(0), "{case}: {done:?}");
    let summary = done.json();
    let first = &summary["incidents"][0];
    assert_eq!((first["role"].as_str(), first["action"].as_str()), (Some(role), Some("restarted")), "{case}: {first}");
    assert!(first["outage_s"].as_f64().unwrap() > 0.0, "{case}: {first}");
    assert_eq!(summary["books"]["balanced"], true, "{case}: {:#}", summary["books"]);
    bench.assert_clean(&[]);
    summary
}

/// A sample that a killed role had sent and its successor sends again is one sample in a replay too.
#[test]
fn the_recording_of_a_run_with_a_killed_role_is_replayed() {
    let bench = Bench::new();
    for role in ROLES {
        for place in RUNNING {
            let done = start(
                &bench,
                role,
                place,
                "KILL",
                &["--clock", "lockstep", "--record", "--duration", "2", "--set=accept={}"],
            );
            assert_eq!(done.wait().code, Some(0), "{role} {place}");
            let replay = bench.run(&["replay", "out", "--json"]);
            assert_eq!((replay.code, replay.roles_replayed()), (Some(0), (4, 4)), "{role} {place}: {replay:?}");
        }
    }
}

/// Lockstep waits for a dead role, and its successor has its committed state: not a bit is lost.
#[test]
fn in_lockstep_a_killed_role_costs_nothing() {
    let lockstep = ["--clock", "lockstep"];
    let bench = Bench::new();
    let undisturbed = bench.summary("rigid-pair", &lockstep);
    for role in ROLES {
        for place in RUNNING {
            let case = format!("{role} {place}");
            let done = start(&bench, role, place, "KILL", &lockstep).wait();
            let summary = assert_survived(&bench, &done, role, &case);
            assert!(done.says("killed"), "{case}: {done:?}");
            assert_eq!(summary["books"]["missed_ticks"], 0, "{case}");
            assert_eq!(summary["score"]["unscored_ticks"], 0, "{case}");
            assert!(summary["incidents"][0]["recovery_s"].is_number(), "{case}");
            for pointer in ["/state/hash", "/books/roles", "/books/links", "/score/metrics"] {
                assert_eq!(summary.pointer(pointer), undisturbed.pointer(pointer), "{case}: {pointer}");
            }
        }
    }
}

#[test]
fn in_lockstep_a_hanging_role_is_killed_and_restarted() {
    for role in ROLES {
        let bench = Bench::new();
        let more = ["--clock", "lockstep", "--set", "supervision.heartbeat_timeout_s=0.5"];
        let done = start(&bench, role, "sent 902", "HANG", &more).wait();
        assert_survived(&bench, &done, role, role);
        assert!(done.says("silent"), "{done:?}");
    }
}

/// In real time the other roles continue: missed ticks are counted, and the command timeout bounds the follower.
#[test]
fn in_real_time_a_killed_or_stopped_role_is_restarted_and_the_follower_stays_bounded() {
    let accept = format!("--set=accept={{settled_by_s=0,sync_error_rad_s_max=3,{ANY_TICKS}}}");
    let more = ["--tick-hz=200", "--duration=3", &accept, "--set=supervision.heartbeat_timeout_s=0.5"];
    // At 200 Hz these counts fall into the second half of the run's first second.
    let places = ["staged 150", "in-commit 153", "committed 152", "sent 151", "waiting 150"];
    let cases = ROLES.iter().flat_map(|role| places.iter().flat_map(move |p| ["KILL", "STOP"].map(|s| (*role, *p, s))));
    let cases: Vec<_> = cases.collect();
    for group in cases.chunks(4) {
        let started: Vec<_> = group
            .iter()
            .map(|case| {
                let bench = Bench::new();
                let running = start(&bench, case.0, case.1, case.2, &more);
                (bench, running, case)
            })
            .collect();
        for (bench, running, case) in started {
            assert_survived(&bench, &running.wait(), case.0, &format!("{case:?}"));
        }
    }
}

/// A role that fails before the ticks run is not restarted.
#[test]
fn a_role_that_fails_before_it_is_ready_ends_the_run() {
    for role in ROLES {
        for place in ["opening 1", "ready 1"] {
            for (signal, clock) in [("KILL", "realtime"), ("KILL", "lockstep"), ("HANG", "lockstep")] {
                let bench = Bench::new();
                // A hang is found by a time limit, which the other roles must meet on a loaded machine.
                let limit_s = if signal == "HANG" { 4 } else { 30 };
                let limits =
                    ["launch.startup", "supervision.heartbeat"].map(|key| format!("--set={key}_timeout_s={limit_s}"));
                let limits = limits.each_ref().map(String::as_str);
                let done = start(&bench, role, place, signal, &[&["--clock", clock][..], &limits].concat()).wait();
                let case = format!("{role} {place} {signal} {clock}");
                assert_eq!(done.code, Some(4), "{case}: {done:?}");
                assert!(done.stderr.contains(role), "{case}: {done:?}");
                bench.assert_clean(&[]);
            }
        }
    }
}

/// A role that dies repeatedly is given up, and all results so far are reported.
#[test]
fn the_number_of_restarts_is_limited() {
    let bench = Bench::new();
    let more = ["--clock=lockstep", "--set=supervision.restarts_max=0"];
    let done = start(&bench, "controller", "sent 902", "KILL", &more).wait();
    assert_eq!(done.code, Some(4), "{done:?}");
    let summary = done.json();
    assert_eq!(summary["incidents"][0]["action"], "stopped");
    assert_eq!(summary["books"]["balanced"], true, "{:#}", summary["books"]);
    assert_eq!(summary["books"]["roles"]["controller"]["executed"], 902, "committed ticks of dead roles count");
    bench.assert_clean(&[]);
}
