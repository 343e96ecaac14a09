//! Runs the real program as a user would, in a directory and a runtime directory of its own, under a watchdog.

#![allow(dead_code, reason = "features leave out tests that use a part of this")]

mod bench;
mod process;
mod recording;

pub use bench::Bench;
pub use process::{Done, Running, WATCHDOG, await_some, catches, code_of, processes_marked, send_signal, status_of};
pub use recording::{rewrite, rewrite_metadata};

use proptest::test_runner::{Config, RngSeed};
use serde_json::Value;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Limits nothing but metrics: for a run in real time that is not about missed ticks.
pub const ANY_TICKS: &str =
    "missed_ticks_max={}, starved_ticks_max={}, safe_ticks_max={}, unscored_ticks_max=\"100 %\"";

/// Such a run of a scenario that has criteria.
pub const WITHOUT_TICK_LIMITS: [&str; 4] = [
    "--set=accept.missed_ticks_max={}",
    "--set=accept.starved_ticks_max={}",
    "--set=accept.safe_ticks_max={}",
    "--set=accept.unscored_ticks_max=\"100 %\"",
];

/// The directory of the project.
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Says that something is not tested here, past the harness, which keeps what a test prints: `tests/run` collects it.
pub fn skipped(what: &str, why: &str) {
    std::io::stderr().write_all(format!("SKIPPED: {what} because {why}\n").as_bytes()).unwrap();
}

/// A scenario that ships with the program.
pub fn shipped(name: &str) -> PathBuf {
    root().join("config").join(format!("{name}.toml"))
}

/// The interpreter that has what the programs in a directory of `tests` require; made by the script there, which names what is missing if it fails.
pub fn python(directory: &str) -> PathBuf {
    let made = Command::new(root().join("tests").join(directory).join("venv")).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    PathBuf::from(String::from_utf8(made.stdout).unwrap().trim())
}

/// The codes of errors that the manual lists.
pub fn documented_codes() -> Vec<String> {
    let page = std::fs::read_to_string(root().join("docs/commands.md")).unwrap();
    let (_, list) = page.split_once("\nCodes of incidents:\n").unwrap();
    let (list, _) = list.split_once("\n## ").unwrap();
    list.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// The `summary.json` of a directory of results.
#[track_caller]
pub fn summary_in(directory: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(directory.join("summary.json")).unwrap()).unwrap()
}

/// So many random cases: the same ones in every run, and nothing written when one fails.
pub fn cases(cases: u32) -> Config {
    Config { cases, failure_persistence: None, rng_seed: RngSeed::Fixed(0x0c0e_7a7e), ..Config::default() }
}

/// The rows of a reference file in `tests/data`, its header left out.
pub fn reference(name: &str) -> Vec<Vec<f64>> {
    let path = root().join("tests/data").join(name);
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().skip(1).map(|line| line.split(',').map(|word| word.parse().unwrap()).collect()).collect()
}
