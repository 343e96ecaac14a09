//! The scenario is accepted, and every clock gives the same bits.

use std::path::Path;
use std::process::Command;

/// Runs the scenario by a clock; its verdict must be good. Returns the hash after every tick.
fn hashes(clock: &str) -> Vec<String> {
    let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join(clock);
    let program = env!("CARGO_BIN_EXE_cart-pole");
    let options = ["run", "--clock", clock, "--overwrite", "--out"];
    let ended = Command::new(program).args(options).arg(&out).output().unwrap();
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
    let hashes = std::fs::read_to_string(out.join("hashes.txt")).unwrap();
    hashes.lines().filter(|line| !line.starts_with('#')).map(str::to_owned).collect()
}

#[test]
fn in_one_thread_and_as_processes() {
    let in_process = hashes("in-process");
    assert!(in_process.len() > 1 && in_process == hashes("lockstep"));
}
