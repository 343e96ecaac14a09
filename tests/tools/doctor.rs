//! `corotate doctor` as a user runs it: on this machine, whatever that is.

use crate::common::{self, Bench, await_some};
use libc::{SIGKILL, SIGSTOP, SIGTERM};
use serde_json::Value;

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
    let report = done.json();
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
        "ticks",
    ] {
        assert_eq!(checks.iter().filter(|(check, _)| *check == name).count(), 1, "{name}: {checks:?}");
    }
    let remedied = |check: &Value| check["verdict"] == "ok" || check["remedy"].is_string();
    assert!(report["checks"].as_array().unwrap().iter().all(remedied), "{report}");
    // Every role's ticks are judged, and no others.
    let trial = &report["trial"];
    let number = |value: &Value| value.as_u64().unwrap();
    let roles = trial["roles"].as_object().unwrap();
    assert_eq!((trial["ticks"].as_u64(), roles.len()), (Some(1001), 4), "{trial}");
    assert!(roles.values().all(|ticks| number(&ticks["executed"]) + number(&ticks["missed"]) == 1001), "{trial}");
    let worst = roles.values().map(|ticks| number(&ticks["missed"]) + number(&ticks["starved"])).max();
    assert_eq!(trial["missed"].as_u64(), worst, "{trial}");
    assert_eq!(trial["lateness"]["count"], 2002, "a wake of each body per tick");
    bench.assert_clean(&[]);
}

/// Nothing is called fit that was not measured, and what cannot keep its rate is not fit.
#[test]
fn fit_has_a_number_behind_it() {
    let bench = Bench::new();
    let done = bench.run(&["doctor", "--seconds", "0", "--json"]);
    let report = done.json();
    let bad = checks(&report).iter().any(|(_, verdict)| *verdict == "bad");
    assert_eq!(report["fit"].as_bool(), bad.then_some(false), "{report}");
    assert!(report["trial"].is_null() && done.code == Some(if bad { 3 } else { 0 }), "{done:?}");
    // A period of 10 us is shorter than any tick of four processes.
    let file = bench.path("fast.toml");
    let shipped = corotate::config::SHIPPED.iter().find(|(name, _)| *name == "rigid-pair").unwrap().1;
    let text = shipped.lines().map(|line| if line.starts_with("tick_hz") { "tick_hz = 100000.0" } else { line });
    std::fs::write(&file, text.collect::<Vec<_>>().join("\n")).unwrap();
    let done = bench.run(&["doctor", file.to_str().unwrap(), "--seconds", "1", "--json"]);
    let report = done.json();
    let verdict = checks(&report).into_iter().find(|(name, _)| *name == "ticks").map(|(_, verdict)| verdict);
    assert_eq!((verdict, report["fit"].as_bool(), done.code), (Some("bad"), Some(false), Some(3)), "{report}");
    bench.assert_clean(&[]);
}

#[test]
fn an_ordinary_user_is_told_too() {
    let bench = Bench::unprivileged();
    let done = bench.run(&["doctor", "--seconds", "0", "--json"]);
    let report = done.json();
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
    running.signal(SIGTERM);
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
