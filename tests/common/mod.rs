//! Runs the real program as a user would, in private directories and under a watchdog.

#![allow(dead_code, reason = "some features exclude the tests that use an item")]

mod bench;
mod in_thread;
mod process;
mod recording;

pub use bench::Bench;
pub use in_thread::{Loop, next};
pub use process::{Done, Running, WATCHDOG, await_some, catches, code_of, processes_marked, send_signal, status_of};
pub use recording::{rewrite, rewrite_metadata};

use proptest::test_runner::{Config, RngSeed};
use serde_json::Value;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Removes the limits on ticks, for tests in real time that are not about missed ticks.
pub const ANY_TICKS: &str =
    "missed_ticks_max={}, starved_ticks_max={}, safe_ticks_max={}, unscored_ticks_max=\"100 %\"";

/// The same as options, for a scenario that has criteria.
pub const WITHOUT_TICK_LIMITS: [&str; 4] = [
    "--set=accept.missed_ticks_max={}",
    "--set=accept.starved_ticks_max={}",
    "--set=accept.safe_ticks_max={}",
    "--set=accept.unscored_ticks_max=\"100 %\"",
];

/// Returns the directory of the project.
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Reports a skipped check on stderr, which the harness does not capture here; `tests/run` collects these lines.
pub fn skipped(what: &str, why: &str) {
    std::io::stderr().write_all(format!("SKIPPED: {what} because {why}\n").as_bytes()).unwrap();
}

/// Returns the file of a shipped scenario.
pub fn shipped(name: &str) -> PathBuf {
    root().join("config").join(format!("{name}.toml"))
}

/// Returns the Python interpreter with the requirements of a directory of `tests`. The script `venv` there creates it.
pub fn python(directory: &str) -> PathBuf {
    let created = Command::new(root().join("tests").join(directory).join("venv")).output().unwrap();
    assert!(created.status.success(), "{}", String::from_utf8_lossy(&created.stderr));
    PathBuf::from(String::from_utf8(created.stdout).unwrap().trim())
}

/// Returns the error codes that the manual lists.
pub fn documented_codes() -> Vec<String> {
    let page = std::fs::read_to_string(root().join("docs/commands.md")).unwrap();
    let (_, list) = page.split_once("\nCodes of incidents:\n").unwrap();
    let (list, _) = list.split_once("\n## ").unwrap();
    list.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// Returns the `summary.json` of a results directory.
#[track_caller]
pub fn summary_in(directory: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(directory.join("summary.json")).unwrap()).unwrap()
}

/// Configures this number of random cases: the same in every run, and nothing is written if one fails.
pub fn cases(cases: u32) -> Config {
    Config { cases, failure_persistence: None, rng_seed: RngSeed::Fixed(0x0c0e_7a7e), ..Config::default() }
}

/// Returns the rows of a reference file in `tests/data`, without the header.
pub fn reference(name: &str) -> Vec<Vec<f64>> {
    let path = root().join("tests/data").join(name);
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().skip(1).map(|line| line.split(',').map(|word| word.parse().unwrap()).collect()).collect()
}
