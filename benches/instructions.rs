//! Instructions per estimate-and-control step and per tick of a run in one thread, counted by callgrind: detects
//! regressions on noisy machines too.
//!
//! `cargo bench --bench instructions` compares with `benches/instructions.json` and fails beyond its tolerance; `-- --save` updates the
//! file. With other features inlining may differ. Needs valgrind. The figures belong to one compiler, see `compiler` in the file: with
//! another one they are shown and not compared.

#[path = "contest/product.rs"]
#[allow(dead_code, reason = "the contest uses all of it")]
mod product;

use corotate::config::SHIPPED;
use corotate::launch::{Launch, run};
use corotate::scenario::Scenario;
use product::{KINDS, pass, scenario};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::sync::atomic::AtomicUsize;

/// The passes over a second of samples in the two runs; only the difference between the runs counts.
const PASSES: [u64; 2] = [1, 51];
const STEPS_PER_PASS: u64 = product::SAMPLES as u64;
/// A tick of `rigid-pair` through all roles in one thread: hashes, guards, counters and score included.
const TICK: &str = "in-process tick";
/// The tolerated increase of the instructions, %.
const TOLERANCE_PERCENT: f64 = 5.0;

/// The stored figures.
#[derive(Debug, Serialize, Deserialize)]
struct Kept {
    compiler: String,
    tolerance_percent: f64,
    instructions_per_step: BTreeMap<String, f64>,
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let done = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["--repeat", kind, passes] => passes.parse().map(|n| repeat(kind, n)).map_err(|error| error.to_string()),
        ["--save"] => save(),
        [] => compare(),
        _ => Err("give no argument, or --save".to_owned()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("instructions: {reason}");
            ExitCode::FAILURE
        }
    }
}

fn repeat(kind: &str, passes: u64) {
    if let Some((_, name, overrides)) = KINDS.iter().find(|(known, ..)| *known == kind) {
        let scenario = scenario(name, overrides);
        let mut pass = pass(&scenario);
        return (0..passes).for_each(|_| _ = pass());
    }
    // At 1 kHz a pass is a second.
    let overrides = ["clock=in-process", "accept={}", &format!("duration_s={passes}")].map(str::to_owned);
    let scenario = Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &overrides).expect("shipped scenarios are valid");
    run(&scenario, &mut Launch::new(&AtomicUsize::new(0), &mut |_| {})).expect("a run in one thread does not fail");
}

fn path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/instructions.json")
}

fn count_all() -> Result<BTreeMap<String, f64>, String> {
    KINDS.map(|(kind, ..)| kind).into_iter().chain([TICK]).map(|kind| Ok((kind.to_owned(), per_step(kind)?))).collect()
}

/// Returns the instructions per step of a kind, to a tenth.
fn per_step(kind: &str) -> Result<f64, String> {
    let [few, many] = PASSES.map(|passes| collected(kind, passes));
    let exact = (many? as f64 - few? as f64) / ((PASSES[1] - PASSES[0]) * STEPS_PER_PASS) as f64;
    Ok((exact * 10.0).round() / 10.0)
}

/// Returns the instructions of a whole process.
fn collected(kind: &str, passes: u64) -> Result<u64, String> {
    let program = std::env::current_exe().map_err(|error| error.to_string())?;
    let done = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(program)
        .args(["--repeat", kind, &passes.to_string()])
        .output()
        .map_err(|error| format!("valgrind is missing ({error}); install it (Debian: apt install valgrind)"))?;
    let text = String::from_utf8_lossy(&done.stderr);
    let count = text.lines().find_map(|line| line.split_once("Collected :")?.1.trim().parse().ok());
    count.filter(|_| done.status.success()).ok_or_else(|| format!("valgrind failed: {}", text.trim()))
}

fn compiler() -> String {
    let asked = Command::new("rustc").arg("--version").output();
    asked.map_or("unknown".to_owned(), |done| String::from_utf8_lossy(&done.stdout).trim().to_owned())
}

fn save() -> Result<(), String> {
    let instructions_per_step = count_all()?;
    let kept = Kept { compiler: compiler(), tolerance_percent: TOLERANCE_PERCENT, instructions_per_step };
    let text = serde_json::to_string_pretty(&kept).map_err(|error| error.to_string())?;
    println!("{text}");
    std::fs::write(path(), format!("{text}\n")).map_err(|error| error.to_string())
}

fn compare() -> Result<(), String> {
    let text = std::fs::read_to_string(path()).map_err(|error| format!("{error}; create it with -- --save"))?;
    let kept: Kept = serde_json::from_str(&text).map_err(|error| error.to_string())?;
    let same = kept.compiler == compiler();
    if !same {
        let kept = &kept.compiler;
        eprintln!(
            "SKIPPED: the instruction counts, because the stored figures are of {kept}, and this is {}",
            compiler()
        );
    }
    let mut worse = Vec::new();
    println!("{:>14} {:>10} {:>10} {:>8}", "instructions", "kept", "now", "change");
    for (kind, now) in &count_all()? {
        let before = kept.instructions_per_step.get(kind).copied().unwrap_or(f64::NAN);
        let change = 100.0 * (now / before - 1.0);
        println!("{kind:>14} {before:>10.1} {now:>10.1} {change:>+7.2}%");
        // A figure without a stored one is NaN, and not within the tolerance.
        let within = change <= kept.tolerance_percent;
        if !within {
            worse.push(kind.clone());
        }
    }
    match worse.is_empty() || !same {
        true => Ok(()),
        false => Err(format!("more than {} % above the stored figures: {}", kept.tolerance_percent, worse.join(", "))),
    }
}
