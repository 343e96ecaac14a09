//! `corotate doctor` on the machine that runs the tests.

use crate::common::{self, Bench, await_some};
use libc::{SIGINT, SIGKILL, SIGSTOP, SIGTERM};
use serde_json::Value;
use std::fs;

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
    let domain = Bench::await_domain;
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

/// Runs a hunt of a second, checks what holds on every machine, and returns the report.
fn hunt(bench: &Bench, options: &[&str], rate_hz: u64) -> Value {
    let running = bench.start(&[&["doctor", "--hunt", "1", "--json"], options].concat());
    let instance = format!("corotate-{}-", running.pid());
    let report = running.wait().succeeded().json();
    assert_eq!((&report["schema"], report["rate_hz"].as_u64()), (&Value::from("corotate/hunt/v1"), Some(rate_hz)));
    let cores = report["cores"].as_array().unwrap();
    assert_eq!(cores.len(), corotate::runtime::usable_cores().len(), "{report}");
    let late = &report["late"];
    let number = |value: &Value| value.as_u64().unwrap();
    for core in cores {
        let (figures, [wakes, missed]) = (&core["lateness"], ["wakes", "missed"].map(|key| number(&core[key])));
        assert_eq!((wakes + missed, &figures["count"], &figures["missed"]), (rate_hz, &rate_hz.into(), &missed.into()));
        let values =
            ["min_us", "p50_us", "p90_us", "p99_us", "p999_us", "max_us"].map(|key| figures[key].as_f64().unwrap());
        assert!(values[0] >= 0.0 && values.is_sorted(), "{core}");
        // The longest delay is a late tick if it exceeds the limit by more than the histogram resolves.
        assert!(number(&core["late"]) > 0 || values[5] <= 1.01 * late["late_us"].as_f64().unwrap(), "{report}");
    }
    let counted: u64 = cores.iter().map(|core| number(&core["late"])).sum();
    assert_eq!((late["schema"].as_str(), number(&late["counted"])), (Some("corotate/late/v1"), counted));
    assert!(number(&late["examined"]) <= counted, "{late}");
    // Only the trace knows a task's thread.
    let has_thread = |tick: &&Value| tick["causes"].as_array().unwrap().iter().any(|cause| cause.get("tid").is_some());
    let named = late["ticks"].as_array().unwrap().iter().filter(has_thread).map(|tick| number(&tick["ticks"])).sum();
    let most = if late["source"] == "kernel" { number(&late["examined"]) } else { 0 };
    assert!((named..=most).contains(&number(&late["traced"])), "{late}");
    let explained = |tick: &Value| {
        let causes = tick["causes"].as_array().unwrap().iter();
        causes.map(|cause| cause["us"].as_f64().unwrap()).sum::<f64>() <= tick["late_us"].as_f64().unwrap() + 1e-6
    };
    assert!(late["ticks"].as_array().unwrap().iter().all(explained), "{late}");
    // Without the kernel's trace there is a reason, and a remedy.
    assert_eq!(
        (late["source"] == "counters", late["tracer"].is_null()),
        (late["note"].is_string(), late["note"].is_string())
    );
    let instances = fs::read_dir("/sys/kernel/tracing/instances").into_iter().flatten().flatten();
    let left: Vec<_> = instances.map(|entry| entry.file_name()).collect();
    assert!(!left.iter().any(|name| name.to_string_lossy().starts_with(&instance)), "{left:?}");
    report
}

#[test]
fn a_hunt_measures_every_core_and_leaves_no_trace_behind() {
    let bench = Bench::new();
    hunt(&bench, &[], 1000);
    hunt(&bench, &["--rate", "10"], 10);
    bench.assert_clean(&[]);
}

#[test]
fn an_unprivileged_user_hunts_with_counters() {
    let bench = Bench::unprivileged();
    let report = hunt(&bench, &["--rate", "200"], 200);
    if rustix::process::getuid().is_root() {
        assert_eq!(report["late"]["source"], "counters", "{report}");
    }
    let causes = report["late"]["causes"].as_array().unwrap();
    assert!(report["late"]["source"] == "kernel" || causes.iter().all(|cause| cause["name"] == ""), "{causes:?}");
    let text = bench.run(&["doctor", "--hunt", "1", "--rate", "10"]).succeeded().stdout;
    assert!(text.contains("p99.9 us") && text.contains("core ") && text.contains("causes from "), "{text}");
}

/// A hunt that a signal ends reports what it has measured.
#[test]
fn an_interrupted_hunt_reports() {
    let bench = Bench::new();
    let running = bench.start(&["doctor", "--hunt", "3600", "--json"]);
    std::thread::sleep(std::time::Duration::from_secs(1));
    running.signal(SIGINT);
    let report = running.wait().succeeded().json();
    for core in report["cores"].as_array().unwrap() {
        let [wakes, missed, count] =
            [&core["wakes"], &core["missed"], &core["lateness"]["count"]].map(|count| count.as_u64().unwrap());
        assert!(count < 3_600_000 && wakes + missed == count, "{core}");
    }
    bench.assert_clean(&[]);
}

#[test]
fn a_hunt_takes_no_scenario_and_no_other_measurement() {
    let bench = Bench::new();
    let hunt = ["doctor", "--hunt", "1"];
    for options in [&["rigid-pair"][..], &["--seconds", "1"], &["--clean"], &["--rate", "9"], &["--rate", "20001"]] {
        assert_eq!(bench.run(&[&hunt, options].concat()).code, Some(2), "{options:?}");
    }
    for options in [&["--rate", "100"][..], &["--hunt", "0"], &["--hunt", "1", "--link", "tcp/127.0.0.1:1"]] {
        assert_eq!(bench.run(&[&["doctor"], options].concat()).code, Some(2), "{options:?}");
    }
}

#[test]
fn a_missing_scenario_and_a_negative_duration_are_refused() {
    let bench = Bench::new();
    let done = bench.run(&["doctor", "none.toml"]);
    assert!(done.code == Some(2) && done.says("cannot-read-scenario"), "{done:?}");
    assert_eq!(bench.run(&["doctor", "--seconds", "-1"]).code, Some(2));
}
