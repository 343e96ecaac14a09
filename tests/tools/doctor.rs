//! `corotate doctor` on the machine that runs the tests.

use crate::common::{self, Bench, await_some};
use libc::{SIGKILL, SIGSTOP, SIGTERM};
use serde_json::Value;

fn checks(report: &Value) -> Vec<(&str, &str)> {
    let checks = report["checks"].as_array().unwrap();
    assert!(checks.iter().all(|check| !check["found"].as_str().unwrap().is_empty()), "{report}");
    checks.iter().map(|check| (check["name"].as_str().unwrap(), check["verdict"].as_str().unwrap())).collect()
}

/// Runs `doctor --json` without a trial, and returns its check of leftover domains.
fn leftover_domains(bench: &Bench, options: &[&str]) -> Value {
    let report = bench.run(&[&["doctor", "--seconds", "0", "--json"], options].concat()).json();
    report["checks"].as_array().unwrap().iter().find(|check| check["name"] == "leftover domains").unwrap().clone()
}

/// The exit code is the worst verdict of the lines.
#[test]
fn the_exit_code_is_the_worst_verdict() {
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
        "processor quota",
        "cpuset",
        "hardware threads",
        "device interrupts",
        "clock source",
        "/dev/shm",
        "kernel trace",
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

/// Without a trial the machine is never called fit; a machine that misses ticks is unfit.
#[test]
fn only_a_measured_machine_is_fit() {
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
fn an_unprivileged_user_gets_a_report() {
    let bench = Bench::unprivileged();
    let done = bench.run(&["doctor", "--seconds", "0", "--json"]);
    let report = done.json();
    assert!(checks(&report).len() > 10 && matches!(done.code, Some(0 | 3)), "{done:?}");
}

/// The files of a run whose processes were all killed, janitor included, stay until `--clean`; a running one is left alone.
#[test]
fn clean_removes_the_files_of_killed_runs_only() {
    let bench = Bench::new();
    let domain =
        |bench: &Bench| await_some(|| bench.domains().pop().filter(|path| path.join("scenario.toml").exists()));
    let killed = bench.start(&["run", "--duration", "60"]);
    let dead = domain(&bench);
    bench.await_role("controller");
    let processes = bench.processes();
    // All are stopped before the first is killed, so that none cleans up after another.
    for signal in [SIGSTOP, SIGKILL] {
        processes.iter().for_each(|pid| common::send_signal(*pid, signal));
    }
    drop(killed);
    await_some(|| bench.processes().is_empty().then_some(()));
    let found = leftover_domains(&bench, &[]);
    assert!(found["verdict"] == "warn" && found["found"].as_str().unwrap().starts_with("1 "), "{found}");
    assert!(found["remedy"].as_str().unwrap().contains("--clean"), "{found}");
    assert!(dead.exists(), "removed without --clean");
    let cleaned = leftover_domains(&bench, &["--clean"]);
    assert!(cleaned["verdict"] == "ok" && cleaned["found"].as_str().unwrap().contains("(0 "), "{cleaned}");
    assert!(!dead.exists());
    let running = bench.start(&["run", "--duration", "60"]);
    let alive = domain(&bench);
    let found = leftover_domains(&bench, &["--clean"]);
    assert!(found["verdict"] == "ok" && found["found"].as_str().unwrap().contains("(1 "), "{found}");
    assert!(alive.exists());
    running.signal(SIGTERM);
    running.wait();
    bench.assert_clean(&[dead, alive]);
}

#[test]
fn a_missing_scenario_and_a_negative_duration_are_refused() {
    let bench = Bench::new();
    let done = bench.run(&["doctor", "none.toml"]);
    assert!(done.code == Some(2) && done.says("cannot-read-scenario"), "{done:?}");
    assert_eq!(bench.run(&["doctor", "--seconds", "-1"]).code, Some(2));
}
