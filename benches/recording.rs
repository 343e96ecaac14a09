//! The effect of recording on the latencies of a real-time run: runs with and without a recorder, in turn, on this
//! machine.
//!
//! `cargo bench --bench recording [-- PAIRS SECONDS]` prints, per role and stage, the median over the runs of their
//! p50, p99 and p99.9 with the smallest and the largest value, so that the cost of recording can be compared with the
//! variation between runs.

use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};

const KEYS: [&str; 3] = ["p50_us", "p99_us", "p999_us"];

fn main() {
    let numbers: Vec<u32> = std::env::args().filter_map(|word| word.parse().ok()).collect();
    let pairs = numbers.first().copied().unwrap_or(5);
    let seconds = numbers.get(1).copied().unwrap_or(10).to_string();
    let directory = tempfile::tempdir().unwrap();
    // Role and stage, then without and with, then the percentiles, then the runs.
    let mut figures: BTreeMap<(String, String), [[Vec<f64>; 3]; 2]> = BTreeMap::new();
    let mut missed = [0, 0];
    for pair in 0..pairs {
        for on in if pair % 2 == 0 { [false, true] } else { [true, false] } {
            let summary = run(directory.path(), &seconds, on);
            missed[usize::from(on)] += summary["books"]["missed_ticks"].as_u64().unwrap();
            for stage in summary["latencies"].as_array().unwrap() {
                let name = |key: &str| stage[key].as_str().unwrap().to_owned();
                let entry = figures.entry((name("role"), name("stage"))).or_default();
                for (values, key) in entry[usize::from(on)].iter_mut().zip(KEYS) {
                    values.push(stage[key].as_f64().unwrap());
                }
            }
        }
    }
    println!("{pairs} runs of {seconds} s each way, in turn; us: median over the runs (smallest to largest)");
    println!("missed or starved ticks: {} without, {} with recording", missed[0], missed[1]);
    println!("{:<22} {:>5} {:>28} {:>28}", "role stage", "", "without", "with recording");
    for ((role, stage), ways) in &mut figures {
        for (index, key) in KEYS.iter().enumerate() {
            let name = if index == 0 { format!("{role} {stage}") } else { String::new() };
            let [off, on] = [0, 1].map(|way: usize| words(&mut ways[way][index]));
            println!("{name:<22} {:>5} {off:>28} {on:>28}", key.trim_end_matches("_us"));
        }
    }
}

/// Runs the shipped scenario in real time and returns its summary.
fn run(directory: &Path, seconds: &str, record: bool) -> Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_corotate"));
    command.args(["run", "--clock", "realtime", "--duration", seconds, "--set", "accept={}", "--json", "--out", "out"]);
    command.args(record.then_some("--record")).current_dir(directory).stderr(Stdio::null());
    let output = command.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    serde_json::from_slice(&output.stdout).unwrap()
}

fn words(values: &mut [f64]) -> String {
    values.sort_by(f64::total_cmp);
    match &*values {
        [] => "-".to_owned(),
        [first, .., last] => format!("{:.1} ({first:.1} to {last:.1})", values[values.len() / 2]),
        [value] => format!("{value:.1}"),
    }
}
