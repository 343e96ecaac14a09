//! Roles that stand still because a signal or a debugger has stopped them.

use crate::common::{self, Bench, Done, await_some, send_signal};
use libc::SIGINT;
use serde_json::Value;
use std::process::{Child, Stdio};
use std::time::Duration;

const STOP: i32 = 19;
const CONT: i32 = 18;
/// A run in lockstep that is not over before it is stopped; silence is limited to less than a stop lasts.
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
/// Longer than the limit on silence.
const STOPPED: Duration = Duration::from_millis(1500);

/// Returns the summary of a run that ended with an exit code, without an incident.
fn undisturbed(done: &Done, code: i32) -> Value {
    let told = done.json();
    assert_eq!((done.code, &told["incidents"]), (Some(code), &serde_json::json!([])), "{}", done.stderr);
    told
}

/// Without an incident, and with the bits of a run that nobody stopped.
#[test]
fn a_stopped_role_is_waited_for_in_lockstep() {
    let bench = Bench::new();
    let plain = bench.run(&[&LOCKSTEP[..2], &["--clock", "in-process", "--duration", "30", "--json"]].concat());
    for role in ["controller", "leader"] {
        let run = bench.start(&LOCKSTEP);
        let pid = bench.await_ticks(role);
        send_signal(pid, STOP);
        std::thread::sleep(STOPPED);
        send_signal(pid, CONT);
        let done = run.wait();
        let told = undisturbed(&done, 0);
        assert_eq!(told["state"]["hash"], plain.json()["state"]["hash"]);
        let lines = |words: &str| done.stderr.lines().filter(|line| line.contains(words)).count();
        assert_eq!((lines("stopped by a signal"), lines("goes on after")), (1, 1), "{}", done.stderr);
    }
    bench.assert_clean(&[]);
}

#[test]
fn in_real_time_a_stop_is_the_cause() {
    let bench = Bench::new();
    let options = ["--clock", "realtime", "--duration", "600", "--tick-hz", "100", "--json"];
    let relaxed = ["--set", "accept={}", "--set", "supervision.heartbeat_timeout_s=0.5"];
    let run = bench.start(&[&["run", "rigid-pair"], &options[..], &relaxed].concat());
    let pid = bench.await_ticks("controller");
    send_signal(pid, STOP);
    await_some(|| bench.role("controller").filter(|other| *other != pid));
    run.signal(SIGINT);
    let done = run.wait();
    let told = done.json();
    let cause = told["incidents"][0]["cause"].as_str().unwrap_or_default();
    assert!(done.code == Some(130) && cause.contains("stopped by a signal"), "{done:?}");
    bench.assert_clean(&[]);
}

#[test]
fn ctrl_c_ends_a_run_with_a_stopped_role_in_order() {
    let bench = Bench::new();
    let run = bench.start(&LOCKSTEP);
    let pid = bench.await_ticks("controller");
    send_signal(pid, STOP);
    std::thread::sleep(STOPPED);
    run.signal(SIGINT);
    let done = run.wait();
    assert_eq!(undisturbed(&done, 130)["books"]["balanced"], true);
    bench.assert_clean(&[]);
}

/// gdb on a process; ended with the test.
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

/// True if a process stands at a debugger's stop.
fn held(pid: u32) -> bool {
    common::status_of(pid, "State").starts_with('t')
}

#[test]
fn a_role_is_debugged_from_before_the_first_tick() {
    let bench = Bench::new();
    let run = bench.start(&[&LOCKSTEP[..], &["--debug", "controller"]].concat());
    let pid = bench.await_role("controller");
    std::thread::sleep(STOPPED);
    assert_eq!(bench.commits("controller"), 0, "no tick runs before a debugger is there");
    // Attached, stopped for longer than silence may last, let go on.
    let gdb = Gdb::attach(&bench, pid, &["shell sleep 1.5", "continue"]);
    let done = run.wait();
    undisturbed(&done, 0);
    assert!(done.stderr.contains(&format!("gdb -p {pid}")), "{}", done.stderr);
    drop(gdb);
    bench.assert_clean(&[]);
}

#[test]
fn a_role_that_a_debugger_holds_is_waited_for_and_ctrl_c_ends_the_run() {
    let bench = Bench::new();
    let run = bench.start(&LOCKSTEP);
    let pid = bench.await_ticks("controller");
    let gdb = Gdb::attach(&bench, pid, &[]);
    await_some(|| held(pid).then_some(()));
    std::thread::sleep(STOPPED);
    assert_eq!(bench.role("controller"), Some(pid), "it is not killed");
    run.signal(SIGINT);
    let done = run.wait();
    undisturbed(&done, 130);
    assert!(done.stderr.contains("stopped by a debugger"), "{}", done.stderr);
    drop(gdb);
    bench.assert_clean(&[]);
}

#[test]
fn what_cannot_be_debugged_is_refused() {
    let bench = Bench::new();
    for line in [
        &["--clock", "lockstep", "--debug", "controler"][..],
        &["--clock", "in-process", "--debug", "controller"],
        &["--clock", "lockstep", "--external", "observer", "--debug", "observer,controller"],
        &["--clock", "lockstep", "--set", "launch.debug=[\"lead\"]"],
    ] {
        let refused = bench.run(&[&["run", "rigid-pair"], line].concat());
        assert!(refused.code == Some(2) && refused.stderr.contains("debug"), "{line:?}: {refused:?}");
    }
}
