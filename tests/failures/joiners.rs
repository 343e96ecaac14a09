//! A process that joins a run may die at any point of joining and leaving: the run continues and ends in order, and
//! another process can take its place.
//!
//! strace kills a joiner at its n-th system call of a kind. `COROTATE_JOINERS=all` tries every call of the kinds below
//! (half an hour), otherwise some of each. The machine's speed does not matter: a role counts as stopped if its
//! launcher missed it for `STILL_S` of the launcher's own running time, and in lockstep no tick may be missed.

use crate::common::{Bench, Done, Running, await_some, catches, python, root, send_signal, shipped, status_of};
use libc::{SIGKILL, SIGTERM};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const CALLS: [&str; 5] = ["openat", "ftruncate", "mmap", "rename", "futex"];
/// Number of calls of each kind that the short form tries.
const FEW: usize = 3;
/// Longest allowed stop of a role, s.
const STILL_S: &str = "1";

/// A command that joins a run, without strace; `n` makes output names unique.
struct Joiner {
    name: &'static str,
    arguments: fn(domain: &Path, n: usize) -> Vec<String>,
    /// True if it stays until it is asked to leave.
    stays: bool,
}

fn words(words: &[&str]) -> Vec<String> {
    words.iter().map(|word| (*word).to_owned()).collect()
}

const WATCH: Joiner = Joiner {
    name: "watch",
    arguments: |domain, _| words(&["watch", domain.to_str().unwrap(), "--once", "1"]),
    stays: false,
};

const RECORD: Joiner = Joiner {
    name: "record",
    arguments: |domain, n| words(&["record", "--domain", domain.to_str().unwrap(), "--out", &format!("{n}.mcap")]),
    stays: true,
};

#[cfg(feature = "foxglove")]
const FOXGLOVE: Joiner = Joiner {
    name: "foxglove",
    arguments: |domain, _| words(&["foxglove", domain.to_str().unwrap(), "--address", "127.0.0.1:0"]),
    stays: true,
};

/// Runs a command under strace with these options.
fn strace(bench: &Bench, options: &[&str], command: &[String]) -> Running {
    let mut strace = bench.command_of("strace".as_ref());
    strace.args(["-f", "-qq"]).args(options).args(command);
    Running::new(&mut strace)
}

fn killed_at(bench: &Bench, call: &str, n: usize, command: &[String]) -> Running {
    let inject = format!("inject={call}:signal=KILL:when={n}");
    strace(bench, &["-o", "/dev/null", "-e", &format!("trace={call}"), "-e", &inject], command)
}

/// Returns the numbers of the calls of each kind that one thread of a traced program made, from the first one that
/// concerns `domain` on. Earlier calls belong to the interpreter or loader.
fn calls(trace: &Path, domain: &Path) -> Vec<(&'static str, std::ops::RangeInclusive<usize>)> {
    let text = std::fs::read_to_string(trace).unwrap();
    let id = domain.file_name().unwrap().to_str().unwrap();
    let joins = text.lines().position(|line| line.contains(id) && !line.contains("execve")).unwrap();
    let range_of = |call: &'static str| {
        let is = |line: &&str| line.split_whitespace().nth(1).is_some_and(|word| word.starts_with(&format!("{call}(")));
        let before = text.lines().take(joins).filter(is).count();
        (call, before + 1..=text.lines().filter(is).count())
    };
    CALLS.map(range_of).into()
}

/// Returns the deaths to try: kind and number of the call.
fn deaths(trace: &Path, domain: &Path) -> Vec<(&'static str, usize)> {
    let all = std::env::var("COROTATE_JOINERS").is_ok_and(|which| which == "all");
    let some = |(call, numbers): (&'static str, std::ops::RangeInclusive<usize>)| {
        let step = if all { 1 } else { numbers.clone().count().div_ceil(FEW).max(1) };
        numbers.step_by(step).map(move |n| (call, n))
    };
    calls(trace, domain).into_iter().flat_map(some).collect()
}

/// Returns true if a process sleeps and handles the signal to leave; `None` if it has ended.
fn is_idle(pid: u32) -> Option<bool> {
    let state = status_of(pid, "State");
    (!state.is_empty() && !state.starts_with('Z')).then(|| state.starts_with('S') && catches(pid, SIGTERM))
}

/// Waits for a joiner under strace. A joiner that stays is asked to leave once it has been idle for half a second.
fn await_left(joiner: &Joiner, mut running: Running) -> Done {
    if joiner.stays {
        let children = format!("/proc/{0}/task/{0}/children", running.pid());
        // strace first starts children of its own to test what it can trace; one that has just ended has no name.
        let is_joiner = |pid: &u32| status_of(*pid, "Name") == "corotate";
        let child = await_some(|| {
            let text = std::fs::read_to_string(&children).unwrap_or_default();
            let found = text.split_whitespace().flat_map(str::parse).find(is_joiner).map(Some);
            found.or_else(|| running.has_ended().then_some(None))
        });
        let (mut rested, end) = (0_u32, Instant::now() + Duration::from_secs(60));
        while rested < 50 && Instant::now() < end {
            match child.and_then(is_idle) {
                Some(true) => rested += 1,
                Some(false) => rested = rested.saturating_sub(10),
                None => break,
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        child.iter().for_each(|pid| send_signal(*pid, SIGTERM));
    }
    running.wait()
}

/// Kills joiners of one run, one after the other.
fn joiners_may_die(joiner: &Joiner, clock: &str, more: &[&str]) {
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let still = format!("supervision.heartbeat_timeout_s={STILL_S}");
    let run =
        ["run", file.to_str().unwrap(), "--clock", clock, "--tick-hz=200", "--duration=100000", "--json", "--out=out"];
    let run = bench.start(&[&run[..], &["--set=accept={}", "--set", &still], more].concat());
    let domain = bench.await_domain();
    // The first screen appears once ticks run.
    let look = || bench.run(&["watch", domain.to_str().unwrap(), "--once", "1"]);
    await_some(|| look().stdout.contains("running").then_some(()));

    let command = |n: usize| [words(&[env!("CARGO_BIN_EXE_corotate")]), (joiner.arguments)(&domain, n)].concat();
    let trace = bench.path("trace");
    let traced = strace(&bench, &["-o", trace.to_str().unwrap()], &command(0));
    let lives = await_left(joiner, traced);
    assert!(lives.signal.is_none(), "undisturbed: {lives:?}");
    let deaths = deaths(&trace, &domain);
    let mut killed = 0;
    for (number, (call, n)) in deaths.iter().enumerate() {
        let done = await_left(joiner, killed_at(&bench, call, *n, &command(number + 1)));
        killed += usize::from(done.signal == Some(SIGKILL));
        assert!(done.signal == Some(SIGKILL) || done.code != Some(2), "{} at {call} {n}: {done:?}", joiner.name);
    }
    assert!(killed * 4 >= deaths.len() * 3, "{killed} of {} died: the counts do not fit", deaths.len());

    // Their places are free again.
    await_some(|| look().stdout.contains("running").then_some(()));
    let signalled = Instant::now();
    run.signal(SIGTERM);
    let done = run.wait();
    println!("{}, {clock}: {killed} deaths; the run ended {:?} after the signal", joiner.name, signalled.elapsed());
    assert_eq!(done.code, Some(128 + SIGTERM), "{done:?}");
    let summary = done.json();
    assert_eq!((&summary["incidents"], &summary["books"]["balanced"]), (&Value::Array(vec![]), &Value::Bool(true)));
    if clock == "lockstep" {
        assert_eq!(summary["books"]["missed_ticks"], 0);
    }
    bench.assert_clean(&[domain]);
}

#[test]
fn a_watcher_may_die_anywhere() {
    joiners_may_die(&WATCH, "realtime", &[]);
}

#[test]
fn in_lockstep_a_watcher_may_die_anywhere() {
    joiners_may_die(&WATCH, "lockstep", &[]);
}

#[test]
fn a_recorder_may_die_anywhere() {
    joiners_may_die(&RECORD, "realtime", &[]);
}

/// A second recorder finds the recorder's place taken and leaves again.
#[test]
fn a_second_recorder_may_die_anywhere() {
    joiners_may_die(&RECORD, "realtime", &["--record"]);
}

#[cfg(feature = "foxglove")]
#[test]
fn foxglove_may_die_anywhere() {
    joiners_may_die(&FOXGLOVE, "realtime", &[]);
}

/// Starts a run that waits for the foreign follower; returns its domain and seat description.
fn start_waiting(bench: &Bench) -> (Running, PathBuf, PathBuf) {
    let scenario = root().join("tests/hil/pair.toml");
    let run = ["run", scenario.to_str().unwrap(), "--clock=lockstep", "--duration=0.2", "--set=accept={}"];
    let running = bench.start(&run);
    let seat = bench.await_seat("follower");
    let domain = seat.parent().unwrap().to_owned();
    (running, seat, domain)
}

/// Another process can take an external role wherever its predecessor died.
#[test]
fn the_foreign_follower_may_die_anywhere() {
    let python = python("hil").to_str().unwrap().to_owned();
    let program = root().join("tests/hil/follower.py");
    let command = |seat: &Path| words(&[&python, program.to_str().unwrap(), seat.to_str().unwrap()]);

    let bench = Bench::new();
    let trace = bench.path("trace");
    let (running, seat, domain) = start_waiting(&bench);
    let follower = strace(&bench, &["-o", trace.to_str().unwrap()], &command(&seat)).wait();
    assert_eq!((running.wait().code, follower.code), (Some(0), Some(0)), "undisturbed: {follower:?}");

    let mut killed = 0;
    let mut deaths = deaths(&trace, &domain).into_iter().peekable();
    while deaths.peek().is_some() {
        let (mut running, seat, domain) = start_waiting(&bench);
        // One after the other in the same run, until one lives to the end of the run.
        for (call, n) in deaths.by_ref() {
            let done = killed_at(&bench, call, n, &command(&seat)).wait();
            killed += usize::from(done.signal == Some(SIGKILL));
            // The run may end when one dies while leaving; the next one then comes too late.
            let late = matches!(done.code, Some(1 | 2)) && !seat.is_file();
            assert!(done.signal == Some(SIGKILL) || done.code == Some(0) || late, "at {call} {n}: {done:?}");
            if late || !domain.join("follower.seat.json").is_file() || running.has_ended() {
                break;
            }
        }
        // The last one is not killed.
        if domain.is_dir() && !running.has_ended() {
            let follower = bench.start_program(python.as_ref(), &[program.to_str().unwrap(), seat.to_str().unwrap()]);
            follower.wait();
        }
        let done = running.wait();
        assert!([Some(0), Some(4)].contains(&done.code), "{done:?}");
        assert!(done.code == Some(0) || done.stderr.contains("follower"), "{done:?}");
        // The next run removes files that a late, killed process has recreated.
        let next = shipped("rigid-pair");
        let next =
            ["run", next.to_str().unwrap(), "--clock=lockstep", "--duration=0.01", "--set=accept={}", "--out=out"];
        assert_eq!(bench.run(&next).code, Some(0));
        bench.assert_clean(&[domain]);
    }
    println!("the foreign follower: {killed} deaths");
    assert!(killed > 0);
}
