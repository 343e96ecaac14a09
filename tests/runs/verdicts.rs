//! No run passes without evidence for its criteria: after missed, starved, safe or unscored ticks, with a lost role, or if
//! it is too short.

use crate::common::{ANY_TICKS, Bench, Done, await_some, send_signal};
use corotate::config::SHIPPED;
use corotate::scenario::Scenario;
use libc::{SIGCONT, SIGKILL, SIGSTOP};
use serde_json::Value;

fn criterion<'a>(summary: &'a Value, name: &str) -> &'a Value {
    let mut criteria = summary["criteria"].as_array().unwrap().iter();
    criteria.find(|criterion| criterion["name"] == name).unwrap_or_else(|| panic!("{name}: {summary:#}"))
}

/// Returns the last line of stderr, which has the verdict if stdout is JSON.
fn last_line(done: &Done) -> &str {
    done.stderr.lines().last().unwrap_or_default()
}

/// Runs in one thread with these criteria; an injected fault makes the controller miss 100 consecutive ticks.
fn with_misses(accept: &str) -> Done {
    let fault = r#"--set=fault=[{kind="miss", role="controller", from_tick=2000, ticks=100}]"#;
    let accept = format!("--set=accept={{{accept}}}");
    Bench::new().run(&["run", "rigid-pair", "--clock=in-process", "--duration=5", "--json", fault, &accept])
}

#[test]
fn a_number_limits_all_ticks_and_a_percentage_excludes_injected_ones() {
    let settled = "settled_by_s=4.5, sync_error_rad_s_max=1.0";
    // The controller misses 100 ticks; the follower starves in 100 and is safe in 81.
    for (limits, code, name, value, limit) in [
        ("", 0, "missed_ticks_max", 100, 150),
        ("", 0, "starved_ticks_max", 100, 150),
        ("", 0, "safe_ticks_max", 81, 100),
        (", missed_ticks_max=200", 0, "missed_ticks_max", 200, 200),
        (", missed_ticks_max=199", 3, "missed_ticks_max", 200, 199),
        (", missed_ticks_max={controller=99}", 3, "missed_ticks_max.controller", 100, 99),
        (", missed_ticks_max={observer=0}", 0, "missed_ticks_max.observer", 0, 0),
        (", starved_ticks_max={follower=99}", 3, "starved_ticks_max.follower", 100, 99),
        (", starved_ticks_max={follower=\"0 %\"}", 0, "starved_ticks_max.follower", 100, 100),
        (", safe_ticks_max=81", 0, "safe_ticks_max", 81, 81),
        (", safe_ticks_max=80", 3, "safe_ticks_max", 81, 80),
        (", unscored_ticks_max=0", 0, "unscored_ticks_max", 0, 0),
    ] {
        let done = with_misses(&format!("{settled}{limits}"));
        assert_eq!(done.code, Some(code), "{limits}: {done:?}");
        let summary = done.json();
        let found = criterion(&summary, name);
        assert_eq!((&found["value"], &found["limit"]), (&(value as f64).into(), &(limit as f64).into()), "{limits}");
        assert_eq!(found["default"], if limits.is_empty() { true.into() } else { Value::Null }, "{limits}");
        assert_eq!((&found["holds"], &summary["accepted"]), (&(code == 0).into(), &(code == 0).into()), "{limits}");
        assert!(last_line(&done).ends_with("; missed: controller 100; starved: follower 100; safe: follower 81"));
    }
}

/// The step is the computation alone; the age also has the delay before it.
#[test]
fn a_stall_breaks_the_limit_on_the_age_but_not_on_the_step() {
    const STALL_US: f64 = 80_000.0;
    let run = |role: &str, accept: &str| {
        let fault = format!(r#"--set=fault=[{{kind="stall", role="{role}", from_tick=100, stall_ms=80}}]"#);
        let accept = format!("--set=accept={{missed_ticks_max={{}}, starved_ticks_max={{}}, {accept}}}");
        let rate = ["--clock=realtime", "--tick-hz=100", "--duration=2", "--json"];
        Bench::new().run(&[&["run", "rigid-pair"], &rate[..], &[&fault, &accept]].concat())
    };
    let limits =
        "step_latency_p99_us_max=1e7, age_p999_us_max=1e7, age_max_us=50000, lateness_max_us=1e7, late_ticks_max=0";
    for (role, late) in [("observer", ["observer", "controller"]), ("controller", ["controller", "controller"])] {
        let done = run(role, limits);
        assert_eq!(done.code, Some(3), "{done:?}");
        let summary = done.json();
        let age = criterion(&summary, "age_max_us");
        assert!(age["value"].as_f64().unwrap() >= STALL_US - 10_000.0, "{age}");
        assert!(late.iter().any(|late| age["role"] == *late), "{age}");
        assert_eq!(age["holds"], false, "{age}");
        assert_eq!(summary["late_us"], 1000.0, "a tenth of the period");
        let late_ticks = criterion(&summary, "late_ticks_max");
        assert!(late_ticks["value"].as_f64().unwrap() >= 1.0 && late_ticks["holds"] == false, "{late_ticks}");
        for kept in ["step_latency_p99_us_max", "age_p999_us_max", "lateness_max_us"] {
            assert_eq!(criterion(&summary, kept)["holds"], true, "{summary:#}");
        }
    }
    let done = run("leader", "age_p99_us_max=1e7, lateness_p99_us_max=1e7, lateness_max_us=50000");
    let summary = done.json();
    let lateness = criterion(&summary, "lateness_max_us");
    assert_eq!((done.code, &lateness["role"], &lateness["holds"]), (Some(3), &"leader".into(), &false.into()));
}

/// Without a clock there is no latency.
#[test]
fn latencies_are_not_judged_in_lockstep() {
    let accept = "--set=accept={settled_by_s=4.5, sync_error_rad_s_max=1.0, age_max_us=1, late_ticks_max=0}";
    let done = Bench::new().run(&["run", "rigid-pair", "--clock=in-process", "--duration=5", "--json", accept]);
    let summary = done.json();
    assert_eq!((done.code, &summary["accepted"]), (Some(0), &true.into()), "{done:?}");
    for name in ["age_max_us", "late_ticks_max"] {
        assert_eq!(criterion(&summary, name)["holds"], Value::Null);
    }
}

/// Default limits do not apply to a scenario without criteria.
#[test]
fn without_criteria_the_last_line_still_names_missed_ticks() {
    let done = with_misses("");
    assert_eq!((done.code, &done.json()["criteria"]), (Some(0), &Value::Array(Vec::new())), "{done:?}");
    let line = last_line(&done);
    assert!(line.starts_with("NOT JUDGED"), "{line}");
    assert!(line.ends_with("; missed: controller 100; starved: follower 100; safe: follower 81"), "{line}");
}

/// Even if the metrics meet their limits.
#[test]
fn a_run_whose_external_controller_is_killed_is_not_accepted() {
    let bench = Bench::new();
    let accept = "--set=accept={sync_error_rad_s_max=100.0}";
    let run = ["run", "rigid-pair", "--clock=realtime", "--tick-hz=200", "--duration=4", "--json", "--out=out"];
    let running = bench.start(&[&run[..], &["--external=controller", accept]].concat());
    let domain = bench.await_domain();
    await_some(|| domain.join("controller.seat.json").exists().then_some(()));
    let controller = bench.start(&["controller", "--domain", domain.to_str().unwrap()]);
    bench.await_commits("controller", 100);
    send_signal(controller.pid(), SIGKILL);
    controller.wait();
    let done = running.wait();
    let summary = done.json();
    assert!([Some(3), Some(4)].contains(&done.code), "{done:?}");
    assert_eq!(summary["accepted"], false, "{summary:#}");
    assert!(last_line(&done).starts_with("FAIL"), "{done:?}");
    assert!(summary["books"]["roles"]["follower"]["starved"].as_u64() > Some(0), "{summary:#}");
    assert!(["starved", "follower"].iter().all(|word| last_line(&done).contains(word)), "{done:?}");
    bench.assert_clean(&[domain]);
}

/// While the scorer's process is stopped, its queue overflows; the lost ticks may have been the worst.
#[test]
fn a_peak_is_not_judged_if_ticks_were_not_scored() {
    let bench = Bench::new();
    let limits = "peak_from_s=0.5, sync_error_rad_s_peak=100.0, settled_by_s=3.0, estimate_error_rad_s_max=100.0";
    let roles = ANY_TICKS.rsplit_once(", unscored").unwrap().0;
    let accept = format!("--set=accept={{{limits}, {roles}}}");
    let run = ["run", "rigid-pair", "--clock=realtime", "--tick-hz=200", "--duration=9", "--json", "--out=out"];
    let running = bench.start(&[&run[..], &[&accept]].concat());
    bench.await_commits("leader", 150);
    running.signal(SIGSTOP);
    bench.await_commits("leader", 150 + 800);
    running.signal(SIGCONT);
    let done = running.wait();
    let summary = done.json();
    assert_eq!((done.code, &summary["accepted"]), (Some(0), &Value::Null), "{done:?}");
    let peak = criterion(&summary, "sync_error_rad_s_peak");
    assert!(peak["holds"].is_null() && peak["value"].is_number(), "{peak}");
    assert!(peak["reason"].is_string() && last_line(&done).starts_with("NOT JUDGED: "), "{done:?}");
    bench.assert_clean(&[]);
}

#[test]
fn a_run_that_ends_before_settled_by_s_is_not_judged() {
    let bench = Bench::new();
    for (name, text) in SHIPPED {
        let scenario = Scenario::parse(text, name, &["duration_s=0.3".to_owned()]).unwrap();
        assert!(scenario.warnings[0].starts_with("accept.settled_by_s: "), "{name}: {:?}", scenario.warnings);
    }
    // In a debug build the claims of the other scenarios take long.
    for name in ["rigid-pair", "faults", "inertia"] {
        let short = [
            "run",
            name,
            "--clock=in-process",
            "--duration=0.3",
            "--json",
            "--overwrite",
            "--out=out",
            "--junit=v.xml",
        ];
        let done = bench.run(&short);
        assert_eq!(done.code, Some(0), "{name}: {done:?}");
        let summary = done.json();
        assert_eq!(summary["accepted"], Value::Null, "{name}");
        assert!(
            last_line(&done).starts_with("NOT JUDGED: ") && last_line(&done).contains("settled_by_s"),
            "{name}: {done:?}"
        );
        for criterion in summary["criteria"].as_array().unwrap() {
            let metric = criterion["name"].as_str().unwrap().contains("error");
            assert_eq!(
                (criterion["holds"].is_null(), criterion["reason"].is_string()),
                (metric, metric),
                "{criterion}"
            );
        }
        let verdict = std::fs::read_to_string(bench.path("v.xml")).unwrap();
        assert!(verdict.contains("<skipped") && !verdict.contains("<failure"), "{verdict}");
        let checked = bench.run(&["check", name, "--set=duration_s=0.3", "--json"]);
        let warnings = checked.json()["warnings"].to_string();
        assert!(checked.code == Some(0) && warnings.contains("accept.settled_by_s"), "{name}: {checked:?}");
    }
}

#[test]
fn an_unknown_key_is_suggested_with_its_table() {
    let bench = Bench::new();
    for (set, meant) in [
        ("sync_error_rad_s_max=1", "accept.sync_error_rad_s_max"),
        ("sync_error_rad_s_peak=1", "accept.sync_error_rad_s_peak"),
        ("settled_by_s=1", "accept.settled_by_s"),
        ("gain_per_s=[1,1,1]", "controller.gain_per_s"),
        ("lock_memory=false", "realtime.lock_memory"),
        ("energy_drift_max=1", "watchdog.energy_drift_max"),
        ("tick_herz=1", "tick_hz"),
    ] {
        let done = bench.run(&["check", "rigid-pair", "--set", set]);
        assert!(done.code == Some(2) && done.says("unknown-key"), "{set}: {done:?}");
        assert!(done.stderr.contains(&format!("`{meant}`")), "{set}: {done:?}");
    }
}
