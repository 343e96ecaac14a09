//! What follows when a role misses a tick: `realtime.overrun` and `realtime.start_grace_ticks`.

use crate::common::{Bench, Done, shipped};
use serde_json::Value;

/// Runs `rigid-pair` for two seconds with an observer that sleeps for four periods before tick 60.
fn run(bench: &Bench, realtime: &str) -> Done {
    let stall = "--set=fault=[{kind=\"stall\", role=\"observer\", from_tick=60, ticks=1, stall_ms=40}]";
    let realtime = format!("--set=realtime={{{realtime}}}");
    let scenario = shipped("rigid-pair");
    let common =
        ["run", scenario.to_str().unwrap(), "--clock", "realtime", "--tick-hz", "100", "--duration", "2", "--json"];
    bench.run(
        &[
            &common[..],
            &["--out", "out", "--overwrite", "--set", "accept={missed_ticks_max={observer=0}}", stall, &realtime],
        ]
        .concat(),
    )
}

fn missed_ticks(summary: &Value) -> (u64, u64) {
    let ticks = &summary["books"]["roles"]["observer"];
    (ticks["missed"].as_u64().unwrap(), ticks["excused"]["missed"].as_u64().unwrap_or(0))
}

#[test]
fn by_default_an_overrun_is_counted_and_judged() {
    let bench = Bench::new();
    let done = run(&bench, "");
    let (missed, excused) = missed_ticks(&done.json());
    assert!(done.code == Some(3) && missed >= 2 && excused == 0, "{done:?}");
}

#[test]
fn an_overrun_ends_the_run_in_order_if_that_is_the_policy() {
    let bench = Bench::new();
    let done = run(&bench, "overrun='stop'");
    assert_eq!(done.code, Some(4), "{done:?}");
    let summary = done.json();
    let incidents = summary["incidents"].as_array().unwrap();
    assert!(
        incidents.iter().any(|incident| incident["code"] == "overrun" && incident["action"] == "stopped"),
        "{incidents:?}"
    );
    let elapsed = summary["books"]["roles"]["leader"]["elapsed"].as_u64().unwrap();
    assert!((60..201).contains(&elapsed), "{elapsed}");
}

#[test]
fn an_overrun_applies_the_safe_command_if_that_is_the_policy() {
    let bench = Bench::new();
    let summary = run(&bench, "overrun='safe'").json();
    let changes = summary["inputs"].as_array().unwrap();
    assert!(
        changes.len() == 1 && changes[0]["key"] == "actuator.safe" && changes[0]["received"] == true,
        "{changes:?}"
    );
    let safe = summary["score"]["statuses"]["follower/truth"]["safe"].as_u64().unwrap();
    assert!(safe > 50 && summary["signal"] == 0, "{summary:#}");
}

#[test]
fn the_first_ticks_are_not_judged_within_the_grace() {
    let bench = Bench::new();
    // On a loaded machine, later ticks may be missed too.
    let done = run(&bench, "overrun='stop', start_grace_ticks=201");
    assert_eq!(done.code, Some(0), "{done:?}");
    let (missed, excused) = missed_ticks(&done.json());
    assert!(missed >= 2 && excused == missed, "{missed} {excused}");
    let latencies = done.json()["latencies"].as_array().unwrap().clone();
    let age = latencies.iter().find(|row| row["role"] == "controller" && row["stage"] == "age");
    assert!(age.is_none_or(|age| age["count"].as_u64() < Some(3)), "{age:?}");
}
