//! `corotate doctor` as a user runs it: on this machine, whatever that is.

use crate::common::{self, Bench, await_some};
use serde_json::Value;

const SIGKILL: i32 = 9;
const SIGSTOP: i32 = 19;

fn checks(report: &Value) -> Vec<(&str, &str)> {
    let text = |check: &'static str, of: &Value| of[check].as_str().unwrap().to_owned();
    let checks = report["checks"].as_array().unwrap();
    checks.iter().for_each(|check| assert!(!text("found", check).is_empty(), "{check}"));
    checks.iter().map(|check| (check["name"].as_str().unwrap(), check["verdict"].as_str().unwrap())).collect()
}

/// The exit code is the verdict, and the verdict that of the lines.
#[test]
fn every_line_has_a_verdict_and_the_exit_code_is_theirs() {
    let bench = Bench::new();
    let done = bench.run(&["doctor", "--seconds", "1", "--json"]);
    let report: Value = serde_json::from_str(&done.stdout).unwrap_or_else(|error| panic!("{error}: {done:?}"));
    let checks = checks(&report);
    let bad = checks.iter().any(|(_, verdict)| *verdict == "bad");
    assert_eq!((report["fit"].as_bool(), done.code), (Some(!bad), Some(if bad { 3 } else { 0 })), "{done:?}");
    for name in [
        "kernel preemption",
        "rtprio limit",
        "memlock limit",
        "real-time throttling",
        "cpu_dma_latency",
        "cpufreq governor",
        "isolated cores",
        "cores",
        "clock source",
        "/dev/shm",
        "leftover domains",
        "lateness",
    ] {
        assert_eq!(checks.iter().filter(|(check, _)| *check == name).count(), 1, "{name}: {checks:?}");
    }
    let remedied = |check: &Value| check["verdict"] == "ok" || check["remedy"].is_string();
    assert!(report["checks"].as_array().unwrap().iter().all(remedied), "{report}");
    assert_eq!(report["lateness"]["percentiles"]["count"], 1000, "a wake per period of 1 ms");
    let text = bench.run(&["doctor", "--seconds", "0"]);
    assert!(!text.stdout.contains("lateness") && text.stdout.contains("for rigid-pair in real time"), "{text:?}");
}

#[test]
fn an_ordinary_user_is_told_too() {
    let bench = Bench::unprivileged();
    let done = bench.run(&["doctor", "--seconds", "0", "--json"]);
    let report: Value = serde_json::from_str(&done.stdout).unwrap_or_else(|error| panic!("{error}: {done:?}"));
    assert!(checks(&report).len() > 10 && matches!(done.code, Some(0 | 3)), "{done:?}");
}

/// A whole run that was killed, janitor and all, stays until somebody cleans up; a running one is left alone.
#[test]
fn what_a_killed_run_left_is_told_and_removed_on_demand() {
    let bench = Bench::new();
    let domain =
        |bench: &Bench| await_some(|| bench.domains().pop().filter(|path| path.join("scenario.toml").exists()));
    let killed = bench.start(&["run", "--duration", "60"]);
    let dead = domain(&bench);
    bench.await_role("controller");
    let processes = bench.processes();
    // All are stopped before the first is killed, so that nobody cleans up after another.
    for signal in [SIGSTOP, SIGKILL] {
        processes.iter().for_each(|pid| common::send_signal(*pid, signal));
    }
    drop(killed);
    await_some(|| bench.processes().is_empty().then_some(()));
    let told = bench.run(&["doctor", "--seconds", "0"]);
    assert!(told.stdout.contains("1 of dead runs") && told.stdout.contains("doctor --clean"), "{told:?}");
    assert!(dead.exists(), "nothing is removed unasked");
    let cleaned = bench.run(&["doctor", "--seconds", "0", "--clean"]);
    assert!(cleaned.stdout.contains("leftover domains     none (0 running)"), "{cleaned:?}");
    let running = bench.start(&["run", "--duration", "60"]);
    let alive = domain(&bench);
    let told = bench.run(&["doctor", "--seconds", "0", "--clean"]);
    assert!(told.stdout.contains("none (1 running)") && alive.exists(), "{told:?}");
    running.signal(15);
    running.wait();
    bench.assert_clean(&[dead, alive]);
}

#[test]
fn a_scenario_that_is_none_is_refused() {
    let bench = Bench::new();
    let done = bench.run(&["doctor", "none.toml"]);
    assert_eq!(done.code, Some(2), "{done:?}");
    assert_eq!(bench.run(&["doctor", "--seconds", "-1"]).code, Some(2));
}
