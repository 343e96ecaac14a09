//! A loop with an observer for more than its first body: the rig of `tests/data/carts.rs`.

use super::own_rig::built;
use crate::common::Bench;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// The slowest mode of follower, observers, law and held command, 1/s, from the powers of their one-tick transition, computed by an
/// independent program.
const RATE_PER_S: f64 = 1.724_616;
const OBSERVERS: [&str; 2] = ["observer", "observer-follower"];

pub(super) fn program() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        built("carts", include_str!("../data/carts.rs"), ("carts.toml", include_str!("../data/carts.toml")))
    })
}

fn run(bench: &Bench, clock: &str, out: &str, options: &[&str]) -> Value {
    let fixed = ["run", "carts", "--clock", clock, "--set", "accept={}", "--out", out, "--json"];
    bench.run(&[&fixed[..], options].concat()).succeeded().json()
}

fn hash(summary: &Value) -> &str {
    summary["state"]["hash"].as_str().unwrap()
}

/// Returns the value of a metric.
fn metric<'a>(summary: &'a Value, name: &str) -> &'a Value {
    let metrics = summary["score"]["metrics"].as_array().unwrap();
    &metrics.iter().find(|metric| metric["name"] == name).unwrap()["last"]
}

#[test]
fn every_clock_and_the_replay_give_the_same_bits() {
    let bench = Bench::with_program(program());
    let judged = bench.run(&["run", "carts", "--clock", "in-process", "--json"]).succeeded().json();
    // Alone, the roles are called one after the other; with a recording they are nodes with links.
    let linked = run(&bench, "in-process", "linked", &["--record"]);
    let lockstep = run(&bench, "lockstep", "lockstep", &["--record"]);
    for (out, summary) in [("linked", &linked), ("lockstep", &lockstep)] {
        assert_eq!(hash(summary), hash(&judged), "{out}");
        assert_eq!(summary["books"]["balanced"], true, "{out}: {:#}", summary["books"]);
        assert_eq!(bench.run(&["replay", out, "--json"]).succeeded().roles_replayed(), (6, 6), "{out}");
    }
    assert_eq!(bench.run(&["replay", "lockstep", "--role", "observer-follower"]).code, Some(0));
    for processes in [
        r#"launch.processes=[["observer","observer-follower","controller"]]"#,
        r#"launch.processes=[["follower","observer-follower"],["leader","observer"]]"#,
        r#"launch.processes=[["follower","other","observer-follower","controller"]]"#,
    ] {
        let grouped = run(&bench, "lockstep", "grouped", &["--overwrite", "--set", processes]);
        assert_eq!(hash(&grouped), hash(&judged), "{processes}");
    }
    // Slower observers hold their estimates.
    let slower = ["--set", "observer.every_ticks=2", "--set", "controller.every_ticks=3"];
    let expected = run(&bench, "in-process", "slow", &slower);
    assert_eq!(hash(&run(&bench, "lockstep", "slow-lockstep", &slower)), hash(&expected));
    assert_ne!(hash(&expected), hash(&judged));
    // An input of the observers reaches both.
    let tuned = r#"input=[{ at_s = 2.0, key = "cart.correction", value = [0.1, 0.5] }]"#;
    let expected = run(&bench, "in-process", "tuned", &["--set", tuned]);
    assert_eq!(hash(&run(&bench, "lockstep", "tuned-lockstep", &["--set", tuned])), hash(&expected));
    let first = bench.run(&["export", "linked", "--csv", "tables"]).succeeded();
    assert!(bench.path("tables").join("follower.estimate.csv").exists(), "{first:?}");
}

#[test]
fn a_live_run_has_the_bits_of_the_others_up_to_its_first_missed_tick() {
    let bench = Bench::with_program(program());
    run(&bench, "in-process", "expected", &[]);
    run(&bench, "realtime", "live", &["--record"]);
    let hashes = |out: &str| {
        let text = std::fs::read_to_string(bench.path(out).join("hashes.txt")).unwrap();
        text.lines().filter(|line| !line.starts_with('#')).map(str::to_owned).collect::<Vec<_>>()
    };
    let (expected, live) = (hashes("expected"), hashes("live"));
    let summary = bench.summary_in("live");
    let clean = summary["state"]["clean_ticks"].as_u64().unwrap() as usize;
    let same = expected.iter().zip(&live).take_while(|(expected, live)| expected == live).count();
    assert!(same >= clean.min(live.len()), "{same} hashes are the same, {clean} ticks were clean");
    assert!(bench.run(&["replay", "live", "--json"]).succeeded().roles_replayed().0 == 6);
    let stages = summary["latencies"].as_array().unwrap();
    for role in OBSERVERS {
        let step = stages.iter().find(|row| row["role"] == role && row["stage"] == "step");
        assert!(step.is_some_and(|row| row["count"].as_u64().unwrap() > 0), "{role}: {stages:?}");
    }
}

#[test]
fn a_killed_observer_costs_no_bit() {
    let bench = Bench::with_program(program());
    let expected = run(&bench, "in-process", "expected", &[]);
    for role in ["observer", "observer-follower", "controller", "follower"] {
        let fault = format!("fault=[{{ kind = \"kill\", role = \"{role}\", from_tick = 500 }}]");
        let killed = run(&bench, "lockstep", "killed", &["--overwrite", "--set", &fault]);
        assert_eq!(killed["incidents"].as_array().map(Vec::len), Some(1), "{role}: {killed}");
        assert_eq!(killed["incidents"][0]["role"], role);
        assert_eq!(hash(&killed), hash(&expected), "{role}");
    }
}

#[test]
fn a_missing_own_estimate_is_a_missing_input_of_its_body_alone() {
    let bench = Bench::with_program(program());
    let whole = run(&bench, "in-process", "whole", &[]);
    for (fault, rejected) in [
        (r#"{ kind = "drop", role = "observer-follower", from_tick = 300, ticks = 10 }"#, 0),
        (
            r#"{ kind = "out-of-range", role = "observer-follower", field = "position_m", value = 1e9, from_tick = 300, ticks = 10 }"#,
            10,
        ),
        (r#"{ kind = "drop", role = "follower", from_tick = 300, ticks = 10 }"#, 0),
    ] {
        let set = ["--set", &format!("fault=[{fault}]"), "--overwrite"];
        let done = run(&bench, "in-process", "one", &set);
        assert_eq!(done["books"]["rejected_samples"], rejected, "the controller: {fault}: {:#}", done["books"]);
        let statuses = &done["score"]["statuses"];
        assert_eq!(statuses["follower/truth"]["holding"], 10, "{fault}: {statuses:#}");
        assert_eq!(statuses["other/truth"], Value::Null, "{fault}: {statuses:#}");
        assert_eq!(done["books"]["roles"]["controller"]["starved"], 10, "{fault}: {:#}", done["books"]["roles"]);
        assert_ne!(hash(&done), hash(&whole), "{fault}");
        assert_eq!(hash(&run(&bench, "lockstep", "two", &set)), hash(&done), "{fault}");
    }
}

#[test]
fn score_report_and_seat_tell_each_estimate() {
    let bench = Bench::with_program(program());
    let both = run(&bench, "lockstep", "both", &["--record"]);
    assert!(metric(&both, "own_estimate_error_m").as_f64().is_some_and(|error_m| error_m < 0.05), "{both:#}");
    let alone = run(&bench, "lockstep", "alone", &["--set", "observed=[\"leader\"]"]);
    assert_eq!(metric(&alone, "own_estimate_error_m"), &Value::Null);
    let default = bench.run(&["check", "carts", "--resolved", "--set", "observed=[\"leader\"]"]).succeeded().stdout;
    let plain = default.replace("observed = [\"leader\"]\n", "");
    assert_ne!(plain, default);
    std::fs::write(bench.path("plain.toml"), plain).unwrap();
    let plain = bench.run(&["run", "plain.toml", "--clock", "lockstep", "--set", "accept={}", "--json"]).succeeded();
    assert_eq!(hash(&plain.json()), hash(&alone), "the first body alone is the default");
    bench.run(&["report", "both", "--out", "page.html"]).succeeded();
    let page = std::fs::read_to_string(bench.path("page.html")).unwrap();
    assert!(page.contains(">observer-follower<"), "{}", page.len());
    let seat: Value = serde_json::from_str(&bench.run(&["seat", "both/scenario.toml", "controller"]).stdout).unwrap();
    let reads: Vec<&str> =
        seat["reads"].as_array().unwrap().iter().map(|signal| signal["service"].as_str().unwrap()).collect();
    let service = |name: &str| format!("corotate/carts/{name}");
    assert_eq!(
        reads,
        ["leader/estimate", "follower/measurement", "other/measurement", "follower/estimate"].map(service)
    );
    let seat = bench.run(&["seat", "both/scenario.toml", "observer-follower"]).succeeded();
    let seat: Value = serde_json::from_str(&seat.stdout).unwrap();
    assert_eq!(
        (&seat["kind"], seat["reads"][0]["service"].as_str()),
        (&json!("observer"), Some(&*service("follower/measurement")))
    );
}

#[test]
fn the_guide_shows_a_part_of_the_rig() {
    let guide = include_str!("../../docs/your-own-rig.md").split("### Observers of other bodies").nth(1).unwrap();
    let shown = guide.split("```").nth(1).unwrap().trim_start_matches("rust\n");
    assert!(shown.contains("own_estimate") && include_str!("../data/carts.rs").contains(shown), "{shown}");
}

/// Any role may be another program, under the name of its body.
#[test]
fn an_observer_can_be_started_by_hand() {
    let bench = Bench::with_program(program());
    let expected = run(&bench, "in-process", "expected", &[]);
    let running = bench.start(&[
        "run",
        "carts",
        "--clock",
        "lockstep",
        "--external",
        "observer-follower",
        "--json",
        "--out",
        "out",
    ]);
    let seat = bench.await_seat("observer-follower");
    let observer =
        bench.start(&["observer", "--body", "follower", "--domain", seat.parent().unwrap().to_str().unwrap()]);
    let (done, observer) = (running.wait(), observer.wait());
    assert_eq!((done.code, observer.code), (Some(0), Some(0)), "{done:?} {observer:?}");
    assert!(done.stderr.contains("observer --body follower --domain"), "{done:?}");
    assert_eq!(hash(&done.json()), hash(&expected));
}

#[test]
fn the_claimed_rate_is_that_of_the_loop_with_its_own_observer() {
    let bench = Bench::with_program(program());
    let check = |set: &str| bench.run(&["check", "carts", "--json", "--set", "accept={}", "--set", set]).json();
    let rate = |claim: &Value, body: usize| claim["followers"][body]["loop_rate_per_s"].as_f64();
    let claim = check("seed=1");
    assert!(rate(&claim, 0).is_some_and(|rate| (rate / RATE_PER_S - 1.0).abs() < 0.01), "{claim:#}");
    assert_eq!(rate(&claim, 1), None, "without a speed its error does not fall: {claim:#}");
    let claim = check(r#"observed=["other","leader"]"#);
    let floors = claim["followers"][1]["floors"].as_array().unwrap();
    assert_eq!(floors.len(), 2, "the metric of an absent estimate has no floor: {claim:#}");
    assert!(rate(&claim, 1).is_some_and(|rate| (rate / RATE_PER_S - 1.0).abs() < 0.01), "{claim:#}");
}

#[test]
fn a_wrong_list_is_refused_with_its_place() {
    let bench = Bench::with_program(program());
    let text = include_str!("../data/carts.toml");
    let line = 1 + text.lines().position(|line| line.starts_with("observed")).unwrap();
    for (observed, key, code) in [
        (r#"["leader", "folower"]"#, "observed[1]", "unknown-body"),
        (r#"["leader", "follower", "leader"]"#, "observed[2]", "given-twice"),
        (r#"["follower"]"#, "observed", "first-unobserved"),
        ("[]", "observed", "first-unobserved"),
    ] {
        let changed = text.replace(r#"["leader", "follower"]"#, observed);
        std::fs::write(bench.path("wrong.toml"), changed).unwrap();
        let refused = bench.run(&["check", "wrong.toml"]);
        assert_eq!(refused.code, Some(2), "{observed}: {refused:?}");
        let place = format!("wrong.toml:{line}");
        assert!(refused.says(code) && refused.stderr.contains(key) && refused.stderr.contains(&place), "{refused:?}");
    }
    let fleet = bench.run(&["check", "rigid-fleet"]);
    assert_eq!(fleet.code, Some(2), "this program has no such scenario: {fleet:?}");
    let bridge = ["run", "carts", "--clock", "lockstep", "--external", "controller", "--out", "out"];
    let running = bench.start(&bridge);
    let seat = bench.await_seat("controller");
    let domain = seat.parent().unwrap().to_str().unwrap();
    let refused = bench.run(&["bridge", "--serial", "/dev/null", "--role", "controller", "--domain", domain]);
    assert!(refused.code == Some(2) && refused.says("device-reads-own"), "{refused:?}");
    let controller = bench.start(&["controller", "--domain", domain]);
    let (done, controller) = (running.wait(), controller.wait());
    assert_eq!((done.code, controller.code), (Some(0), Some(0)), "{done:?} {controller:?}");
}

/// The estimators of the shipped rigs are made for their first body.
#[test]
fn fleets_and_bodies_without_estimator_are_refused() {
    let bench = Bench::new();
    for (scenario, body, code) in [
        ("rigid-pair", "follower", "no-estimator"),
        ("orbit-rendezvous", "follower", "no-estimator"),
        ("rigid-fleet", "fleet", "fleet-observer"),
    ] {
        let refused = bench.run(&["check", scenario, "--set", &format!("observed=[\"leader\",\"{body}\"]")]);
        assert!(refused.code == Some(2) && refused.says(code), "{scenario}: {refused:?}");
        bench.run(&["check", scenario, "--set", "observed=[\"leader\"]"]).succeeded();
    }
}
