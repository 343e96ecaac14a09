//! `corotate bench`: every row with its floors, result files that other tools read, and no files left behind.
//! Figures are not checked: a smoke run on a loaded machine measures nothing.

use crate::common::{Bench, Done, Running, await_some};
use corotate::bench::ROWS;
use libc::SIGINT;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Runs a command to its end and returns the domains that it used.
fn run_listing_domains(bench: &Bench, arguments: &[&str]) -> (Done, Vec<PathBuf>) {
    let running = bench.start(arguments);
    let pid = running.pid();
    let waiting = std::thread::spawn(move || running.wait());
    let mut domains = BTreeSet::new();
    while !waiting.is_finished() && Path::new(&format!("/proc/{pid}")).exists() {
        domains.extend(bench.domains());
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    (waiting.join().unwrap(), domains.into_iter().collect())
}

fn measure(bench: &Bench, rows: &[&str]) -> Value {
    let (done, domains) =
        run_listing_domains(bench, &[&["bench", "--quick", "--json", "--out", "results"], rows].concat());
    assert_eq!(done.code, Some(0), "{done:?}");
    bench.assert_clean(&domains);
    let printed = done.json();
    let reasons = printed["not_judged"].as_array().unwrap();
    assert_eq!(reasons.len(), if cfg!(debug_assertions) { 2 } else { 1 }, "smoke run, debug build: {printed}");
    let privileges = printed["privileges"].as_array().unwrap().iter().map(|grant| &grant["privilege"]);
    for text in reasons.iter().chain(privileges) {
        assert!(done.stderr.contains(text.as_str().unwrap()), "{text}: {}", done.stderr);
    }
    let written = std::fs::read_to_string(bench.path("results/bench.json")).unwrap();
    assert_eq!(printed, serde_json::from_str::<Value>(&written).unwrap());
    assert!(done.stderr.contains(&std::fs::read_to_string(bench.path("results/bench.txt")).unwrap()));
    printed
}

/// Asserts that the results have exactly these rows, with figures, floors and all targets.
fn assert_rows(bench: &Bench, results: &Value, rows: &[&str]) {
    assert_eq!((results["schema"].as_str(), results["quick"].as_bool()), (Some("corotate/bench/v1"), Some(true)));
    assert!(results["host"]["cores"].as_u64().unwrap() > 0 && !results["privileges"].as_array().unwrap().is_empty());
    let figures = results["figures"].as_array().unwrap();
    let found: BTreeSet<&str> = figures.iter().map(|figure| figure["row"].as_str().unwrap()).collect();
    assert_eq!(found, rows.iter().copied().collect());
    for figure in figures {
        let rounds: Vec<f64> =
            figure["rounds"].as_array().unwrap().iter().map(|round| round.as_f64().unwrap()).collect();
        assert!(!rounds.is_empty() && rounds.iter().all(|round| *round >= 0.0), "{figure}");
        if !figure["latency"].is_null() {
            assert_histogram(bench, figure);
        }
        if let Some(ratio) = figure["beside"]["ratio"].as_f64() {
            assert!(ratio.is_finite() && ratio >= 0.0, "{figure}");
        }
    }
    let expected: usize = ROWS.iter().filter(|row| rows.contains(&row.name)).map(|row| row.targets.len()).sum();
    assert_eq!(results["targets"].as_array().unwrap().len(), expected);
    for target in results["targets"].as_array().unwrap() {
        assert!(target["met"].is_null(), "a smoke run judges no target: {target}");
    }
}

/// Asserts that the figure's histogram file has all of its values.
fn assert_histogram(bench: &Bench, figure: &Value) {
    let name = figure["name"].as_str().unwrap().replace(|letter: char| !letter.is_ascii_alphanumeric(), "-");
    let path = bench.path(&format!("results/latency/{}.{name}.hgrm", figure["row"].as_str().unwrap()));
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let rows: Vec<Vec<f64>> = text
        .lines()
        .skip(2)
        .filter(|line| !line.starts_with('#'))
        .map(|line| line.split_whitespace().map(|word| word.parse().unwrap()).collect())
        .collect();
    let (last, count) = (rows.last().unwrap(), figure["latency"]["count"].as_u64().unwrap());
    assert_eq!((last[1], last[2]), (1.0, count as f64), "{}", path.display());
    assert!((last[0] - figure["latency"]["max_us"].as_f64().unwrap()).abs() <= 1e-3, "{}", path.display());
}

fn has(results: &Value, row: &str, name: &str) -> bool {
    let figures = results["figures"].as_array().unwrap();
    figures.iter().any(|figure| figure["row"] == row && figure["name"] == name)
}

#[test]
fn the_hop_row_measures_every_floor() {
    let bench = Bench::new();
    let results = measure(&bench, &["hop"]);
    assert_rows(&bench, &results, &["hop"]);
    let spinners = ["ours", "iceoryx2", "shared memory"].map(|name| (name, "spin"));
    let sleepers = ["ours", "iceoryx2", "futex", "UDP loopback"];
    let sleepers = sleepers.map(|name| (name, "event"));
    let hybrids = ["ours", "iceoryx2", "futex"].map(|name| (name, "hybrid"));
    for (name, wake) in spinners.into_iter().chain(sleepers).chain(hybrids) {
        for suffix in ["", ", from send", ", back to back"] {
            let figure = format!("{name}, {wake}, 64 B{suffix}");
            assert!(has(&results, "hop", &figure), "{figure}");
        }
    }
}

#[test]
fn rows_of_whole_runs_measure_their_floors() {
    let bench = Bench::new();
    let rows = ["chain", "tick", "lockstep", "run", "overhead", "processor"];
    let results = measure(&bench, &rows);
    assert_rows(&bench, &results, &rows);
    for (row, name) in [
        ("chain", "ours, 1000 Hz"),
        ("chain", "raw hops, 1000 Hz"),
        ("tick", "ours, in a run"),
        ("tick", "bare sleep"),
        ("tick", "rate error of a run"),
        ("lockstep", "lockstep"),
        ("lockstep", "two raw hops back to back"),
        ("lockstep", "in one thread, rigid-pair"),
        ("lockstep", "the roles alone, rigid-pair"),
        ("run", "start to first tick"),
        ("run", "bare iceoryx2 node"),
        ("run", "memory of observer"),
        ("run", "shared memory"),
        ("overhead", "page faults, leader"),
        ("overhead", "allocations, controller"),
        ("overhead", "voluntary context switches, follower"),
        ("processor", "bare sleep"),
        ("processor", "observer, event"),
        ("processor", "controller, spin"),
        ("processor", "leader, auto"),
    ] {
        assert!(has(&results, row, name), "{row}: {name}");
    }
}

#[test]
fn ctrl_c_ends_the_benchmark_and_leaves_no_files() {
    let bench = Bench::new();
    let running: Running = bench.start(&["bench", "hop", "--out", "results"]);
    await_some(|| (bench.processes().len() > 2).then_some(()));
    let domains = bench.domains();
    assert_eq!(domains.len(), 1);
    running.signal(SIGINT);
    let done = running.wait();
    assert_eq!(done.code, Some(130), "{done:?}");
    bench.assert_clean(&domains);
}

#[test]
fn an_unknown_row_is_refused_with_a_list_of_the_rows() {
    let done = Bench::new().run(&["bench", "hops"]);
    assert!(done.code == Some(2) && done.says("unknown-row"), "{done:?}");
    for row in ROWS {
        assert!(done.stderr.contains(row.name), "{}", done.stderr);
    }
}

#[test]
fn check_needs_a_full_run_of_a_release_build() {
    let bench = Bench::new();
    let mut unjudged = vec![(vec!["bench", "hop", "--check", "--quick"], false)];
    if cfg!(debug_assertions) {
        unjudged.push((vec!["bench", "hop", "--check"], true));
    }
    for (arguments, debug_build) in unjudged {
        let done = bench.run(&arguments);
        assert!(done.code == Some(2) && done.says("nothing-to-judge"), "{done:?}");
        assert_eq!(done.stderr.contains("--release"), debug_build, "{done:?}");
        assert!(!bench.path("runs").exists());
    }
}
