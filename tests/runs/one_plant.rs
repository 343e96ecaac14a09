//! A loop of one plant with a reference, `examples/cart-pole`: clocks, kills, tables, and the rate that `check` computes.

use super::own_rig::example;
use crate::common::Bench;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// The slowest mode of the linearised loop of plant, observer, law and held command, 1/s, from the eigenvalues of its one-tick
/// transition, computed by an independent program.
const RATE_PER_S: f64 = 2.029_456;

fn program() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| example("cart-pole"))
}

/// Returns a bench with the scenario in which `[reference]` is replaced by other tables.
fn bench_with(tables: &str) -> Bench {
    let bench = Bench::with_program(program());
    let text = bench.run(&["init", "cart-pole"]).succeeded().stdout;
    let (before, rest) = text.split_once("[reference]").unwrap();
    let (_, after) = rest.split_once("\n\n").unwrap();
    std::fs::write(bench.path("cart.toml"), format!("{before}{tables}\n\n{after}")).unwrap();
    bench
}

fn run(bench: &Bench, clock: &str, options: &[&str]) -> Value {
    let fixed = ["run", "cart.toml", "--clock", clock, "--set", "accept={}", "--overwrite", "--out", clock, "--json"];
    bench.run(&[&fixed[..], options].concat()).succeeded().json()
}

fn hash(summary: &Value) -> &str {
    summary["state"]["hash"].as_str().unwrap()
}

const STEP: &str = "[reference]\nposition_m = { shape = \"step\", at_s = 5.0, value = 0.5 }";

#[test]
fn clocks_kills_and_replay_give_the_same_bits() {
    let bench = bench_with(STEP);
    let expected = run(&bench, "in-process", &[]);
    let lockstep = run(&bench, "lockstep", &["--record"]);
    assert_eq!(hash(&lockstep), hash(&expected));
    assert!(bench.run(&["replay", "lockstep", "--json"]).succeeded().roles_replayed().0 > 0);
    bench.run(&["report", "lockstep", "--out", "page.html"]).succeeded();
    let page = std::fs::read_to_string(bench.path("page.html")).unwrap();
    for line in ["force asked for", "force applied"] {
        assert_eq!(page.matches(&format!("data-label=\"{line}\"")).count(), 1, "{line}");
    }
    for role in ["cart", "observer", "controller"] {
        let fault = format!("fault=[{{ kind = \"kill\", role = \"{role}\", from_tick = 500 }}]");
        let killed = run(&bench, "lockstep", &["--set", &fault]);
        assert_eq!(killed["incidents"].as_array().map(Vec::len), Some(1), "{role}: {killed}");
        assert_eq!(hash(&killed), hash(&expected), "{role}");
    }
    let response = &expected["score"]["responses"][0];
    assert_eq!((response["key"].as_str(), response["to"].as_f64()), (Some("reference.position_m"), Some(0.5)));
    assert!(response["settling_time_s"].as_f64().is_some_and(|time_s| (1.0..4.0).contains(&time_s)), "{response}");
    assert!(response["command_max"].as_f64().is_some_and(|command| command > 1.0), "{response}");
}

#[test]
fn rows_a_file_and_inputs_are_the_same_reference() {
    let ramp = "[reference]\nposition_m = 0.1\n\n[[input]]\nat_s = 2.0\nkey = \"reference.position_m\"\nvalue = 0.6\nshape = \
                \"ramp\"\nduration_s = 4.0";
    let expected = run(&bench_with(ramp), "lockstep", &[]);
    let rows = bench_with("[reference]\nposition_m = { rows = [[2.0, 0.1], [6.0, 0.6]] }");
    assert_eq!(hash(&run(&rows, "lockstep", &["--record"])), hash(&expected));
    let file = bench_with("[reference]\nposition_m = { file = \"way.csv\" }");
    std::fs::write(file.path("way.csv"), "time_s,position_m\n2,0.1\n6,0.6\n").unwrap();
    let summary = run(&file, "lockstep", &["--record"]);
    assert_eq!(hash(&summary), hash(&expected));
    assert_eq!(summary["inputs"].as_array().map(Vec::len), Some(1), "rows are not listed as changes: {summary}");
    // The results have the rows: they need the file no more.
    std::fs::remove_file(file.path("way.csv")).unwrap();
    assert!(file.run(&["replay", "lockstep", "--json"]).succeeded().roles_replayed().0 > 0);
    let lost = file.run(&["check", "cart.toml"]);
    assert!(lost.code == Some(2) && lost.says("bad-table"), "{lost:?}");
}

#[test]
fn the_claimed_rate_is_that_of_the_linearised_loop() {
    let bench = bench_with(STEP);
    let claim = bench.run(&["check", "cart-pole", "--json"]).succeeded().json();
    let rate_per_s = claim["followers"][0]["loop_rate_per_s"].as_f64().unwrap();
    assert!((rate_per_s / RATE_PER_S - 1.0).abs() < 0.01, "{rate_per_s}");
    let unstable = bench.run(&["check", "cart-pole", "--json", "--set", "cart.gain=[0,0,0,0]", "--set", "accept={}"]);
    assert_eq!(unstable.json()["followers"][0]["loop_rate_per_s"], Value::Null, "{unstable:?}");
    let tunable = bench.run(&["check", "cart-pole", "--tunable"]).succeeded().stdout;
    assert!(tunable.contains("reference.position_m") && tunable.contains("cart.push_n"), "{tunable}");
}
