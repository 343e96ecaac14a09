//! Measures the system overhead per tick in the steady state of a real run: the kernel's counts of faults and context switches per
//! process, system calls by perf or strace, and allocations by a preloaded counter.
//!
//! Counts that do not disturb each other come from one run; system calls are counted in a separate run.

use super::board::Board;
use super::session::{Bench, BenchError};
use super::watch::{Process, Watch, status_word};
use crate::runtime::{RoleId, ports};
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// The counting allocator.
const ALLOCATIONS: &str = include_str!("allocations.c");
/// The time between two heartbeats of a role, s; each is a sample too.
const HEARTBEAT_S: f64 = 0.02;

/// The counts of a process so far, by the kernel and the allocator.
#[derive(Debug, Clone, Copy)]
struct Counts {
    faults: u64,
    voluntary: u64,
    involuntary: u64,
    allocations: Option<u64>,
}

impl Counts {
    fn read(pid: i32, allocations: &Path) -> Option<Self> {
        let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
        // After the name in parentheses, which may hold any text: state is field 3, minor faults 10, major faults 12.
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        let field = |number: usize| fields.get(number - 3)?.parse::<u64>().ok();
        let counted = fs::read(allocations.join(pid.to_string())).ok();
        Some(Self {
            faults: field(10)? + field(12)?,
            voluntary: status_word(pid, "voluntary_ctxt_switches:")?,
            involuntary: status_word(pid, "nonvoluntary_ctxt_switches:")?,
            allocations: counted.and_then(|bytes| Some(u64::from_ne_bytes(bytes.try_into().ok()?))),
        })
    }
}

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let (rounds, window) = (bench.size(3, 1), bench.size(Duration::from_secs(2), Duration::from_millis(300)));
    for round in 1..=rounds {
        bench.next(&format!("overhead: counts, round {round} of {rounds}"))?;
        count(bench, board, window)?;
        bench.next(&format!("overhead: system calls, round {round} of {rounds}"))?;
        calls(bench, board, window)?;
    }
    Ok(())
}

/// Runs the scenario with the window in its middle, and with time for the counters to start and to stop.
fn watch(
    bench: &mut Bench<'_>,
    window: Duration,
    environment: Vec<(&'static str, OsString)>,
    midway: &mut dyn FnMut(&[Process], u64),
) -> Result<(), BenchError> {
    let duration = format!("duration_s={:?}", window.as_secs_f64() + bench.size(4.0, 2.0));
    Watch { overrides: &[&duration, "clock=realtime"], environment, midway }.run(bench).map(|_| ())
}

/// Counts faults, context switches and allocations.
fn count(bench: &mut Bench<'_>, board: &mut Board, window: Duration) -> Result<(), BenchError> {
    let scenario = bench.scenario(&[])?;
    let directory = tempfile::tempdir().map_err(BenchError::system("make a temporary directory"))?;
    let mut environment = Vec::new();
    match compile_allocator(directory.path()) {
        Ok(library) => {
            environment.push(("LD_PRELOAD", library.into_os_string()));
            environment.push(("COROTATE_BENCH_ALLOCATIONS", directory.path().as_os_str().to_owned()));
        }
        Err(reason) => board.remark(format!("allocations are not counted: {reason}")),
    }
    let (mut counted, mut heartbeats) = (Vec::new(), 0.0);
    watch(bench, window, environment, &mut |processes, period_ns| {
        heartbeats = period_ns as f64 / 1e9 / HEARTBEAT_S;
        let counts = |process: &Process| Counts::read(process.pid, directory.path());
        let began = Instant::now();
        let before: Vec<_> = processes.iter().map(counts).collect();
        std::thread::sleep(window);
        let ticks = began.elapsed().as_nanos() as f64 / period_ns as f64;
        let after = processes.iter().map(counts);
        let pairs = processes.iter().cloned().zip(before).zip(after);
        counted = pairs.filter_map(|((process, before), after)| Some((process, before?, after?, ticks))).collect();
    })?;
    let (mut worst_faults, mut worst_allocations) = (f64::NAN, f64::NAN);
    for (process, before, after, ticks) in counted {
        let mut add = |what: &str, value: f64| board.add(&format!("{what}, {}", process.name), "per tick", None, value);
        let per_tick = |before: u64, after: u64| (after - before) as f64 / ticks;
        let faults = per_tick(before.faults, after.faults);
        add("page faults", faults);
        add("voluntary context switches", per_tick(before.voluntary, after.voluntary));
        add("involuntary context switches", per_tick(before.involuntary, after.involuntary));
        let Some(role) = RoleId::named(&scenario, &process.name) else { continue };
        // iceoryx2 allocates once per sample.
        let samples = ports(&scenario, role).writes.len() as f64;
        worst_faults = worst_faults.max(faults);
        if let (Some(before), Some(after)) = (before.allocations, after.allocations) {
            let all = per_tick(before, after);
            add("allocations", all);
            worst_allocations = worst_allocations.max((all - samples - heartbeats).max(0.0));
        }
    }
    for (name, value) in [
        ("page faults, worst role", worst_faults),
        ("allocations beyond iceoryx2's one per sample, worst role", worst_allocations),
    ] {
        if !value.is_nan() {
            board.add(name, "per tick", None, value);
        }
    }
    Ok(())
}

/// Compiles the counting allocator, or returns the reason why it cannot.
fn compile_allocator(directory: &Path) -> Result<PathBuf, String> {
    let [input, output] = ["allocations.c", "allocations.so"].map(|name| directory.join(name));
    fs::write(&input, ALLOCATIONS).map_err(|error| format!("cannot write {}: {error}", input.display()))?;
    let mut compiler = Command::new("cc");
    compiler.args(["-O3", "-shared", "-fPIC", "-fvisibility=hidden", "-o"]).arg(&output).arg(&input);
    match compiler.output() {
        Ok(done) if done.status.success() => Ok(output),
        Ok(done) => Err(format!("cc failed: {}", String::from_utf8_lossy(&done.stderr).trim())),
        Err(error) => Err(format!("there is no C compiler `cc` ({error}); install one (Debian: apt install gcc)")),
    }
}

/// Counts system calls with perf if it works here, else with strace.
fn calls(bench: &mut Bench<'_>, board: &mut Board, window: Duration) -> Result<(), BenchError> {
    let (mut counted, by_perf) = (Vec::new(), perf_works());
    watch(bench, window, Vec::new(), &mut |processes, period_ns| {
        let ticks = window.as_nanos() as f64 / period_ns as f64;
        let watchers: Vec<_> =
            processes.iter().map(|process| (process.clone(), Watcher::start(process.pid, window, by_perf))).collect();
        counted = watchers
            .into_iter()
            .map(|(process, watcher)| (process, watcher.and_then(Watcher::finish), ticks))
            .collect();
    })?;
    let mut worst = f64::NAN;
    for (process, calls, ticks) in counted {
        match calls {
            Ok(Calls { all, waits }) => {
                // The counters of a process do not start at exactly the same time.
                let beyond_waits = all.saturating_sub(waits) as f64 / ticks;
                let all = all as f64 / ticks;
                board.add(&format!("system calls, {}", process.name), "per tick", None, all);
                let beyond = format!("system calls beyond its waits, {}", process.name);
                board.add(&beyond, "per tick", None, beyond_waits);
                if process.name != "launcher" {
                    worst = worst.max(beyond_waits);
                }
            }
            Err(reason) => board.remark(format!("system calls are not counted: {reason}")),
        }
    }
    if !worst.is_nan() {
        board.add("system calls beyond its waits, worst role", "per tick", None, worst);
    }
    Ok(())
}

/// The number of system calls of a process, and of those that wait or wake.
struct Calls {
    all: u64,
    waits: u64,
}

/// System calls that wait for a time or another role, or wake one.
const WAITS: [&str; 3] = ["clock_nanosleep", "futex", "sched_yield"];

/// Returns the events for perf to count.
fn events() -> String {
    let waits = WAITS.iter().map(|call| format!(",syscalls:sys_enter_{call}"));
    std::iter::once("raw_syscalls:sys_enter".to_owned()).chain(waits).collect()
}

/// Returns true if perf is installed and may count system calls.
fn perf_works() -> bool {
    let tried = Command::new("perf").args(["stat", "-e", &events(), "true"]).stdin(Stdio::null()).output();
    tried.is_ok_and(|done| done.status.success())
}

/// A program that counts the system calls of a process for some time.
enum Watcher {
    Perf(std::process::Child),
    Strace(std::process::Child),
}

impl Watcher {
    /// Starts perf, which hardly disturbs the process, or strace, which does.
    fn start(pid: i32, window: Duration, by_perf: bool) -> Result<Self, String> {
        let (seconds, pid) = (format!("{:?}", window.as_secs_f64()), pid.to_string());
        let mut command = Command::new(if by_perf { "perf" } else { "timeout" });
        match by_perf {
            true => command.args(["stat", "-x,", "-e", &events(), "-p", &pid, "--", "sleep", &seconds]),
            false => command.args(["-s", "INT", &seconds, "strace", "-c", "-f", "-p", &pid]),
        };
        let started = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
        let started = started.map(if by_perf { Self::Perf } else { Self::Strace });
        started.map_err(|error| format!("neither perf with tracepoints nor strace is there ({error})"))
    }

    fn finish(self) -> Result<Calls, String> {
        let (child, parse): (_, fn(&str) -> Option<Calls>) = match self {
            Self::Perf(child) => (child, parse_perf),
            Self::Strace(child) => (child, parse_strace),
        };
        let done = child.wait_with_output().map_err(|error| error.to_string())?;
        let text = String::from_utf8_lossy(&done.stderr);
        parse(&text).ok_or_else(|| format!("what the counting program says cannot be read: {}", text.trim()))
    }
}

/// Parses lines of `count,,event,…`.
fn parse_perf(text: &str) -> Option<Calls> {
    let counts = text.lines().filter_map(|line| {
        let mut fields = line.split(',');
        let count = fields.next()?.parse::<u64>().ok()?;
        Some((count, fields.nth(1)?.to_owned()))
    });
    let counts: Vec<(u64, String)> = counts.collect();
    let all = counts.iter().find(|(_, event)| event.starts_with("raw_syscalls"))?.0;
    let waits = counts.iter().filter(|(_, event)| event.starts_with("syscalls:")).map(|(count, _)| count).sum();
    Some(Calls { all, waits })
}

/// Parses lines of `% time seconds usecs/call calls [errors] syscall`.
fn parse_strace(text: &str) -> Option<Calls> {
    let mut calls = Calls { all: 0, waits: 0 };
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        let (Some(count), Some(name)) = (words.get(3).and_then(|word| word.parse::<u64>().ok()), words.last()) else {
            continue;
        };
        if *name != "total" {
            calls.all += count;
            calls.waits += if WAITS.contains(name) { count } else { 0 };
        }
    }
    text.contains("syscall").then_some(calls)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn perf_and_strace_are_read() {
        let perf = "2017,,raw_syscalls:sys_enter,2001000,100.00,,\n2001,,syscalls:sys_enter_clock_nanosleep,1,100,,\n\
                    7,,syscalls:sys_enter_futex,1,100,,\n<not counted>,,syscalls:sys_enter_sched_yield,0,0,,\n";
        let Calls { all, waits } = parse_perf(perf).unwrap();
        assert_eq!((all, waits), (2017, 2008));
        assert!(parse_perf("Error: no such event").is_none());
        let strace = "% time     seconds  usecs/call     calls    errors syscall\n------ ----------- ----------- \
                      --------- --------- ------\n 90.00    0.1           2      1000         3 clock_nanosleep\n 10.00    \
                      0.1           2        20           read\n100.00    0.2           2      1020         3 total\n";
        let Calls { all, waits } = parse_strace(strace).unwrap();
        assert_eq!((all, waits), (1020, 1000));
        assert!(parse_strace("strace: no such process").is_none());
    }
}
