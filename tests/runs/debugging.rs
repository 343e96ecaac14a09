//! Roles stopped by a signal or a debugger.

use crate::common::{self, Bench, Done, await_some, send_signal};
use libc::SIGINT;
use serde_json::Value;
use std::process::{Child, Stdio};
use std::time::Duration;

const STOP: i32 = 19;
const CONT: i32 = 18;
/// A lockstep run, long enough to stop a role in it, with a heartbeat timeout shorter than a stop.
const LOCKSTEP: [&str; 9] = [
    "run",
    "rigid-pair",
    "--clock",
    "lockstep",
    "--duration",
    "30",
    "--set",
    "supervision.heartbeat_timeout_s=0.5",
    "--json",
];
/// The same, until it is stopped: attaching a debugger may take longer than a short run.
const ENDLESS: [&str; 9] = {
    let mut line = LOCKSTEP;
    line[5] = "100000";
    line
};
/// Duration of a stop: longer than the heartbeat timeout.
const STOPPED: Duration = Duration::from_millis(1500);

/// Asserts an exit code and that there was no incident; returns the summary.
fn undisturbed(done: &Done, code: i32) -> Value {
    let summary = done.json();
    assert_eq!((done.code, &summary["incidents"]), (Some(code), &serde_json::json!([])), "{}", done.stderr);
    summary
}

/// There is no incident, and the hash is that of an undisturbed run.
#[test]
fn lockstep_waits_for_a_stopped_role() {
    let bench = Bench::new();
    let plain = bench.run(&[&LOCKSTEP[..2], &["--clock", "in-process", "--duration", "30", "--json"]].concat());
    for role in ["controller", "leader"] {
        let run = bench.start(&LOCKSTEP);
        let pid = bench.await_ticks(role);
        send_signal(pid, STOP);
        std::thread::sleep(STOPPED);
        send_signal(pid, CONT);
        let done = run.wait();
        let summary = undisturbed(&done, 0);
        assert_eq!(summary["state"]["hash"], plain.json()["state"]["hash"]);
        // One line when it stops, one when it continues.
        let lines = done.stderr.lines().filter(|line| line.contains(role)).count();
        assert_eq!(lines, 2, "{}", done.stderr);
    }
    bench.assert_clean(&[]);
}

#[test]
fn in_real_time_a_stopped_role_is_replaced_and_the_stop_is_named() {
    let bench = Bench::new();
    let options = ["--clock", "realtime", "--duration", "600", "--tick-hz", "100", "--json"];
    let relaxed = ["--set", "accept={}", "--set", "supervision.heartbeat_timeout_s=3"];
    let run = bench.start(&[&["run", "rigid-pair"], &options[..], &relaxed].concat());
    let pid = bench.await_ticks("controller");
    send_signal(pid, STOP);
    await_some(|| bench.role("controller").filter(|successor| *successor != pid));
    run.signal(SIGINT);
    let done = run.wait();
    let summary = done.json();
    let cause = summary["incidents"][0]["cause"].as_str().unwrap_or_default();
    assert!(done.code == Some(130) && cause.contains("stopped"), "{done:?}");
    bench.assert_clean(&[]);
}

#[test]
fn ctrl_c_ends_a_run_with_a_stopped_role_in_order() {
    let bench = Bench::new();
    let run = bench.start(&ENDLESS);
    let pid = bench.await_ticks("controller");
    send_signal(pid, STOP);
    std::thread::sleep(STOPPED);
    run.signal(SIGINT);
    let done = run.wait();
    assert_eq!(undisturbed(&done, 130)["books"]["balanced"], true);
    bench.assert_clean(&[]);
}

/// gdb attached to a process; killed at the end of the test.
struct Gdb(Child);

impl Gdb {
    /// Attaches, runs commands, and stays at its prompt.
    fn attach(bench: &Bench, pid: u32, commands: &[&str]) -> Self {
        let mut gdb = bench.command_of("gdb".as_ref());
        gdb.args(["-nx", "-q", "-p", &pid.to_string()]).args(commands.iter().flat_map(|command| ["-ex", command]));
        gdb.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
        Self(gdb.spawn().expect("gdb is missing: tests/run installs it (Debian: apt install gdb)"))
    }
}

impl Drop for Gdb {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns true if a debugger has stopped a process.
fn in_debugger(pid: u32) -> bool {
    common::status_of(pid, "State").starts_with('t')
}

#[test]
fn with_debug_a_role_waits_for_a_debugger_before_the_first_tick() {
    let bench = Bench::new();
    let run = bench.start(&[&LOCKSTEP[..], &["--debug", "controller"]].concat());
    let pid = bench.await_role("controller");
    std::thread::sleep(STOPPED);
    assert_eq!(bench.commits("controller"), 0, "no tick runs before a debugger is attached");
    // Stopped for longer than the heartbeat timeout, then continued.
    let gdb = Gdb::attach(&bench, pid, &["shell sleep 1.5", "continue"]);
    let done = run.wait();
    undisturbed(&done, 0);
    assert!(done.stderr.contains(&format!("gdb -p {pid}")), "{}", done.stderr);
    drop(gdb);
    bench.assert_clean(&[]);
}

#[test]
fn lockstep_waits_for_a_debugged_role_and_ctrl_c_ends_the_run() {
    let bench = Bench::new();
    let run = bench.start(&ENDLESS);
    let pid = bench.await_ticks("controller");
    let gdb = Gdb::attach(&bench, pid, &[]);
    await_some(|| in_debugger(pid).then_some(()));
    std::thread::sleep(STOPPED);
    assert_eq!(bench.role("controller"), Some(pid), "it is not killed");
    run.signal(SIGINT);
    let done = run.wait();
    undisturbed(&done, 130);
    assert!(done.stderr.contains("debugger"), "{}", done.stderr);
    drop(gdb);
    bench.assert_clean(&[]);
}

#[test]
fn an_invalid_debug_option_is_refused() {
    let bench = Bench::new();
    for (line, code) in [
        (&["--clock", "lockstep", "--debug", "controler"][..], "unknown-role"),
        (&["--clock", "in-process", "--debug", "controller"], "one-process"),
        (&["--clock", "lockstep", "--external", "observer", "--debug", "observer,controller"], "debugged-and-external"),
        (&["--clock", "lockstep", "--set", "launch.debug=[\"lead\"]"], "unknown-role"),
    ] {
        let refused = bench.run(&[&["run", "rigid-pair"], line].concat());
        assert!(refused.code == Some(2) && refused.says(code), "{line:?}: {refused:?}");
    }
}
