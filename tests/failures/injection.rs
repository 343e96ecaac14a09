//! Injected system-call failures: each system call that a command makes in its own code fails once with each plausible
//! error. The command then names cause and remedy, exits in time with the right code, and leaves nothing behind.
//!
//! By default one cell of each system call. `COROTATE_INJECT=N` runs all targets with all errors, at N places of each
//! system call's sequence; `COROTATE_INJECT=run:openat:EMFILE:120,...` runs these cells and prints the output.

use crate::common::{self, Bench, Done, Running, WATCHDOG, await_some, send_signal};
use libc::{SIGCONT, SIGKILL, SIGSTOP, SIGTERM};
use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// System calls with the errors that a system returns in practice.
const ERRORS: [(&str, &[&str]); 38] = [
    ("openat", &["EMFILE", "ENFILE", "ENOSPC", "EACCES", "EIO", "ENOMEM", "EINTR"]),
    ("ftruncate", &["ENOSPC", "EIO", "EINTR"]),
    ("fallocate", &["ENOSPC", "EOPNOTSUPP", "EINTR"]),
    ("mmap", &["ENOMEM", "EAGAIN"]),
    ("flock", &["ENOLCK", "EINTR"]),
    ("fcntl", &["ENOLCK", "EAGAIN", "EINTR"]),
    ("clone3", &["EAGAIN", "ENOMEM"]),
    ("rename", &["EIO", "ENOSPC", "EACCES"]),
    ("write", &["ENOSPC", "EIO", "EINTR"]),
    ("read", &["EIO", "EINTR"]),
    ("mkdir", &["ENOSPC", "EACCES", "EIO"]),
    ("mkdirat", &["ENOSPC", "EACCES", "EIO"]),
    ("symlink", &["ENOSPC", "EIO"]),
    ("readlink", &["EIO", "ENOMEM"]),
    ("fstat", &["EIO"]),
    ("fstatfs", &["EIO"]),
    ("getrandom", &["ENOSYS", "EINTR"]),
    ("execve", &["ENOMEM", "EACCES"]),
    ("poll", &["EINTR", "ENOMEM"]),
    ("unlink", &["EIO", "EPERM"]),
    ("unlinkat", &["EIO", "EPERM"]),
    ("rmdir", &["EIO", "EBUSY"]),
    ("ppoll", &["EINTR", "ENOMEM"]),
    ("pidfd_open", &["EMFILE", "ENOSYS"]),
    ("futex", &["EINTR"]),
    ("clock_nanosleep", &["EINTR"]),
    ("prctl", &["EPERM"]),
    ("prlimit64", &["EPERM"]),
    ("statx", &["EIO", "EACCES"]),
    ("newfstatat", &["EIO", "EACCES"]),
    ("statfs", &["EIO"]),
    ("getdents64", &["EIO", "ENOENT"]),
    ("fchmod", &["EPERM", "EIO"]),
    ("chmod", &["EPERM"]),
    ("pipe2", &["EMFILE", "ENFILE"]),
    ("sched_setscheduler", &["EPERM"]),
    ("mlockall", &["ENOMEM", "EPERM"]),
    ("fdatasync", &["EIO", "ENOSPC"]),
];

/// Words of the transport or of a debug dump that do not help a user.
const RAW: [&str; 7] =
    ["InternalError", "HangsInCreation", "panicked", "Os {", "FailedTo", "UnableTo", "InsufficientPerm"];

/// Time limit of a command with a failure on an otherwise idle machine.
const LIMIT: Duration = Duration::from_secs(10);

const PROGRAM: &str = env!("CARGO_BIN_EXE_corotate");

/// Number of sleeps after which a recorder or role counts as being in its loop.
const LOOP_CALLS: usize = 60;

/// The process whose system calls fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Target {
    /// The launcher of a recorded lockstep run.
    Run,
    /// The launcher of a run in real time.
    Realtime,
    /// Launcher, janitor, roles and recorder of a lockstep run, each at its own n-th call.
    Tree,
    /// A recorder that joins a running loop.
    Record,
    /// A watcher that joins a running loop.
    Watch,
    /// An external role.
    Role,
}

const TARGETS: [Target; 6] = [Target::Run, Target::Realtime, Target::Tree, Target::Record, Target::Watch, Target::Role];

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Run => "run",
            Self::Realtime => "realtime",
            Self::Tree => "tree",
            Self::Record => "record",
            Self::Watch => "watch",
            Self::Role => "role",
        })
    }
}

/// One failure: a target's n-th call of a kind, and its error.
#[derive(Debug, Clone)]
struct Cell {
    target: Target,
    call: String,
    error: String,
    when: usize,
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}:{}:{}", self.target, self.call, self.error, self.when)
    }
}

/// The result of a target, and of the run beside it.
struct Ended {
    done: Done,
    beside: Option<Done>,
    took: Duration,
}

impl Target {
    fn scenario(self, bench: &Bench) -> Vec<String> {
        let clock = match self {
            Self::Run | Self::Tree => ["--clock", "lockstep", "--duration", "0.05"],
            Self::Realtime => ["--clock", "realtime", "--duration", "0.2"],
            Self::Record | Self::Watch | Self::Role => ["--clock", "realtime", "--duration", "3600"],
        };
        let file = bench.path("pair.toml").to_str().unwrap().to_owned();
        std::fs::copy(common::shipped("rigid-pair"), &file).unwrap();
        let set = ["--set", "accept={}", "--set", "tick_hz=200", "--set", "launch.startup_timeout_s=5"];
        let out = bench.path("out").to_str().unwrap().to_owned();
        let mut words = vec!["run".to_owned(), file];
        words.extend(clock.iter().chain(&set).map(ToString::to_string));
        words.extend(["--out".to_owned(), out, "--overwrite".to_owned()]);
        if matches!(self, Self::Run | Self::Tree) {
            words.push("--record".to_owned());
        }
        if self == Self::Role {
            words.extend(["--external".to_owned(), "observer".to_owned()]);
        }
        words
    }

    /// Runs the target under strace with these options, besides those that log the calls.
    fn trace(self, bench: &Bench, options: &[&str]) -> Ended {
        let scenario = self.scenario(bench);
        let scenario: Vec<&str> = scenario.iter().map(String::as_str).collect();
        let log = bench.path("strace.log");
        let mut options = [&["-o", log.to_str().unwrap()], options].concat();
        if self == Self::Tree {
            options.push("-f");
        }
        let beside = match self {
            Self::Run | Self::Realtime | Self::Tree => None,
            Self::Record | Self::Watch | Self::Role => Some(bench.start(&scenario)),
        };
        let domain = beside
            .as_ref()
            .map(|_| await_some(|| bench.domains().into_iter().find(|domain| domain.join("scenario.toml").exists())));
        if matches!(self, Self::Record | Self::Watch) {
            bench.await_role("controller");
        }
        let domain = domain.as_ref().map_or("", |domain| domain.to_str().unwrap());
        let file = bench.path("part.mcap");
        let words = match self {
            Self::Run | Self::Realtime | Self::Tree => scenario,
            Self::Record => vec!["record", "--domain", domain, "--out", file.to_str().unwrap(), "--overwrite"],
            Self::Watch => vec!["watch", domain, "--once", "1"],
            Self::Role => vec!["observer", "--domain", domain],
        };
        let began = Instant::now();
        let mut target = Running::new(bench.command_of(Path::new("strace")).args(options).arg(PROGRAM).args(words));
        let beside = beside.map(|beside| {
            // Until it has ended, or is in its loop.
            let calls = || std::fs::read_to_string(&log).unwrap_or_default().matches("clock_nanosleep").count();
            await_some(|| (target.has_ended() || (self != Self::Watch && calls() > LOOP_CALLS)).then_some(()));
            beside.signal(SIGTERM);
            beside.wait()
        });
        let done = target.wait();
        Ended { done, beside, took: began.elapsed() }
    }
}

fn calls() -> String {
    ERRORS.map(|(call, _)| call).join(",")
}

/// Returns the numbers of the calls of each kind that a target makes in its own code and that may fail.
fn sites(target: Target) -> Vec<(&'static str, Vec<usize>)> {
    let bench = Bench::new();
    let trace = format!("trace={},sigaltstack", calls());
    let ended = target.trace(&bench, &["-e", &trace, "-s", "200"]);
    assert!(ended.done.signal.is_none() && ended.done.code.is_some_and(|code| code < 2), "{target}: {:?}", ended.done);
    let log = std::fs::read_to_string(bench.path("strace.log")).unwrap();
    let lines: Vec<&str> = match target {
        // The log of a plant.
        Target::Tree => {
            let plant = log.lines().find(|line| line.contains("execve(") && line.contains("\"plant\"")).unwrap();
            let pid = plant.split_whitespace().next().unwrap();
            log.lines().filter_map(|line| Some(line.strip_prefix(pid)?.trim_start())).collect()
        }
        _ => log.lines().collect(),
    };
    bench.assert_clean(&[]);
    // The program's own code begins once the standard library has set up its signal stack; before that it is the
    // loader.
    let begin = lines.iter().position(|line| line.starts_with("sigaltstack({")).unwrap();
    let numbers_of = |call: &'static str| {
        let start = format!("{call}(");
        let all = lines.iter().enumerate().filter(|(_, line)| line.starts_with(&start)).enumerate();
        let own = all.filter(|(_, (line, text))| *line > begin && may_fail(call, text));
        (call, own.map(|(index, _)| index + 1).collect::<Vec<_>>())
    };
    ERRORS.map(|(call, _)| numbers_of(call)).into_iter().filter(|(_, numbers)| !numbers.is_empty()).collect()
}

/// Excludes memory for the heap, which the program does not request itself, and output, without which no message is
/// possible.
fn may_fail(call: &str, text: &str) -> bool {
    match call {
        "mmap" => text.contains("MAP_SHARED") || text.contains("MAP_STACK"),
        "fcntl" => text.contains("F_SETLK") || text.contains("F_DUPFD"),
        // A process may always read its own limits.
        "prlimit64" => !text.contains(", NULL, "),
        "write" => !text.starts_with("write(1,") && !text.starts_with("write(2,"),
        _ => true,
    }
}

/// Returns at most `most` of the numbers, evenly spread, with the first and the last.
fn spread(numbers: &[usize], most: usize) -> BTreeSet<usize> {
    let last = numbers.len() - 1;
    (0..most).map(|index| numbers[(last * index).checked_div(most - 1).unwrap_or(last / 2)]).collect()
}

/// Runs a cell; returns the reason if the result is not as it must be.
fn judge(cell: &Cell, limit: Duration, verbose: bool) -> Result<Duration, String> {
    let bench = Bench::new();
    let inject = format!("inject={}:error={}:when={}", cell.call, cell.error, cell.when);
    let trace = format!("trace=openat,clock_nanosleep,{}", cell.call);
    let began = Instant::now();
    let ended = {
        let watchdog = Watchdog::new(&bench);
        let ended = cell.target.trace(&bench, &["-e", &trace, "-e", &inject, "-s", "200"]);
        watchdog.stop();
        ended
    };
    let log = std::fs::read_to_string(bench.path("strace.log")).unwrap();
    let domains = domains(&log);
    let Ended { done, beside, took } = ended;
    if verbose {
        println!("{cell}: {done:?}\nbeside: {beside:?}");
        println!("{}", log.lines().filter(|line| line.contains("INJECTED")).collect::<Vec<_>>().join("\n"));
    }
    if took > limit || began.elapsed() > WATCHDOG {
        return Err(format!("it took {took:?}: {}", done.stderr));
    }
    check_message(&done, &[0, 1, 2, 4, 5])?;
    if let Some(beside) = beside {
        let codes: &[i32] = if cell.target == Target::Role { &[1, 4, 143] } else { &[143] };
        check_message(&beside, codes).map_err(|reason| format!("the run beside it: {reason}"))?;
    }
    if matches!(cell.call.as_str(), "unlink" | "unlinkat" | "rmdir" | "getdents64" | "openat" | "newfstatat" | "statx")
    {
        // The next run of the same user removes what could not be removed.
        bench.run(&["doctor", "--clean"]);
    }
    let left = await_clean(&bench, &domains);
    if left.is_empty() { Ok(took) } else { Err(format!("left behind: {left:?}")) }
}

fn await_clean(bench: &Bench, domains: &[std::path::PathBuf]) -> Vec<std::path::PathBuf> {
    let end = Instant::now() + LIMIT;
    loop {
        let left = bench.left(domains);
        if left.is_empty() || Instant::now() > end {
            return left;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Checks that a failed command names the reason and a remedy.
fn check_message(done: &Done, codes: &[i32]) -> Result<(), String> {
    let Done { code, signal, stderr, .. } = done;
    if !code.is_some_and(|code| codes.contains(&code)) {
        return Err(format!("exit code {code:?}, signal {signal:?}: {stderr}"));
    }
    if let Some(raw) = RAW.iter().find(|raw| stderr.contains(**raw)) {
        return Err(format!("it says `{raw}`: {stderr}"));
    }
    let explained = stderr.lines().any(|line| line.starts_with("corotate: ") && line.contains("; "));
    if *code != Some(0) && *code != Some(143) && !explained {
        return Err(format!("exit code {code:?} without cause and remedy: {stderr}"));
    }
    Ok(())
}

/// Returns the domains in which a traced process has opened a file.
fn domains(log: &str) -> Vec<std::path::PathBuf> {
    let named = log.split("corotate_").skip(1).filter_map(|rest| rest.get(..32));
    let ids: BTreeSet<&str> = named.filter(|id| id.bytes().all(|byte| byte.is_ascii_hexdigit())).collect();
    ids.into_iter().map(Into::into).collect()
}

/// Ends hanging processes, so that their cell is reported.
struct Watchdog {
    stop: std::sync::Arc<std::sync::atomic::AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Watchdog {
    fn new(bench: &Bench) -> Self {
        let stop = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
        let (stopped, mark) = (stop.clone(), bench.mark());
        let thread = std::thread::spawn(move || {
            let end = Instant::now() + WATCHDOG / 4;
            while !stopped.load(Ordering::Relaxed) {
                if Instant::now() > end {
                    common::processes_marked(&mark).into_iter().for_each(|pid| send_signal(pid, SIGKILL));
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        Self { stop, thread: Some(thread) }
    }

    fn stop(mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

/// Judges cells two at a time; returns the failures.
fn judge_all(cells: &[Cell], limit: Duration, verbose: bool) -> Vec<String> {
    let (next, failures) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let slowest = Mutex::new(Duration::ZERO);
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while let Some(cell) = cells.get(next.fetch_add(1, Ordering::Relaxed)) {
                    match judge(cell, limit, verbose) {
                        Ok(took) => {
                            let mut slowest = slowest.lock().unwrap();
                            *slowest = took.max(*slowest);
                        }
                        Err(reason) => {
                            println!("{cell}: {reason}");
                            failures.lock().unwrap().push(format!("{cell}: {reason}"));
                        }
                    }
                }
            });
        }
    });
    let failures = failures.into_inner().unwrap();
    println!(
        "{} cells, {} failures, the slowest took {:?}",
        cells.len(),
        failures.len(),
        slowest.into_inner().unwrap()
    );
    failures
}

fn cells(target: Target, most_errors: usize, most_sites: usize) -> Vec<Cell> {
    let mut cells = Vec::new();
    for (call, numbers) in sites(target) {
        let (_, errors) = ERRORS.iter().find(|(known, _)| *known == call).unwrap();
        for error in errors.iter().take(most_errors) {
            let sites = spread(&numbers, most_sites);
            let cell = |when| Cell { target, call: call.to_owned(), error: (*error).to_owned(), when };
            cells.extend(sites.into_iter().map(cell));
        }
    }
    cells
}

/// Returns one cell of each system call, with the targets in turn.
fn one_of_each_call() -> Vec<Cell> {
    let all: Vec<Cell> = TARGETS.into_iter().flat_map(|target| cells(target, 1, 1)).collect();
    let pick = |(index, (call, _)): (usize, &(&str, &[&str]))| {
        let candidates: Vec<&Cell> = all.iter().filter(|cell| cell.call == *call).collect();
        candidates.get(index % candidates.len().max(1)).map(|cell| (*cell).clone())
    };
    ERRORS.iter().enumerate().filter_map(pick).collect()
}

fn parse(text: &str) -> Cell {
    let mut words = text.split(':');
    let mut word = || words.next().expect("TARGET:CALL:ERROR:N").to_owned();
    let target = word();
    let target = TARGETS.into_iter().find(|known| known.to_string() == target).expect("a target");
    Cell { target, call: word(), error: word(), when: word().parse().expect("a number") }
}

#[test]
fn every_failed_system_call_is_reported_and_leaves_nothing_behind() {
    let asked = std::env::var("COROTATE_INJECT").unwrap_or_default();
    let (cells, limit, verbose) = match asked.as_str() {
        "" => (one_of_each_call(), WATCHDOG, false),
        asked => match asked.parse() {
            Ok(places) => {
                (TARGETS.into_iter().flat_map(|target| cells(target, usize::MAX, places)).collect(), LIMIT, false)
            }
            Err(_) => (asked.split(',').map(parse).collect::<Vec<_>>(), LIMIT, true),
        },
    };
    let failures = judge_all(&cells, limit, verbose);
    assert!(failures.is_empty(), "{} of {} cells:\n{}", failures.len(), cells.len(), failures.join("\n"));
}

/// On a file system without locks, for the results or the domain, the run is refused with the path and leaves no lock
/// file.
#[test]
fn a_file_system_without_locks_is_refused() {
    for (calls, file) in [("1+", "out/run.lock"), ("2+", ".lock")] {
        let bench = Bench::new();
        let scenario = Target::Run.scenario(&bench);
        let scenario: Vec<&str> = scenario.iter().map(String::as_str).collect();
        let inject = format!("inject=flock:error=ENOLCK:when={calls}");
        let options = ["-o", "/dev/null", "-e", &inject, PROGRAM];
        let done = bench.start_program(Path::new("strace"), &[&options, &scenario[..]].concat()).wait();
        check_message(&done, &[1]).unwrap();
        assert!(done.stderr.contains(file), "{done:?}");
        bench.assert_clean(&[]);
    }
}

/// A watcher removes the files it has recreated in a run that no longer exists. A run that it cannot examine counts as
/// existing.
#[test]
fn a_watcher_that_cannot_examine_a_run_removes_nothing() {
    let bench = Bench::new();
    let scenario = Target::Watch.scenario(&bench);
    let run = bench.start(&scenario.iter().map(String::as_str).collect::<Vec<_>>());
    bench.await_role("controller");
    let domains = bench.domains();
    let (domain, lock) = (domains[0].to_str().unwrap(), domains[0].with_extension("lock"));
    // It examines the run three times: when it finds it, and twice when it joins.
    let fails = ["-o", "/dev/null", "-P", lock.to_str().unwrap(), "-e", "inject=statx:error=EACCES:when=4+"];
    let done =
        bench.start_program(Path::new("strace"), &[&fails[..], &[PROGRAM, "watch", domain, "--once", "1"]].concat());
    done.wait().succeeded();
    assert!(lock.exists());
    run.signal(SIGTERM);
    assert_eq!(run.wait().code, Some(128 + SIGTERM));
    bench.assert_clean(&domains);
}

/// A stopped janitor delays no run.
#[test]
fn a_stopped_janitor_delays_no_run() {
    let bench = Bench::new();
    let scenario = Target::Watch.scenario(&bench);
    let run = bench.start(&scenario.iter().map(String::as_str).collect::<Vec<_>>());
    bench.await_role("controller");
    let domains = bench.domains();
    send_signal(bench.await_role("janitor"), SIGSTOP);
    run.signal(SIGTERM);
    assert_eq!(run.wait().code, Some(128 + SIGTERM));
    assert!(bench.path("out/summary.json").exists());
    bench.assert_clean(&domains);
}

/// A run that needs more processes and threads than its user may start is refused with a reason.
#[test]
fn too_few_threads_are_an_error() {
    let bench = Bench::unprivileged();
    let scenario = Target::Run.scenario(&bench);
    let scenario: Vec<&str> = scenario.iter().map(String::as_str).collect();
    let program = bench.command().get_program().to_owned();
    for limit in ["--nproc=1", "--nproc=2", "--nproc=3", "--nproc=4", "--nproc=5", "--nproc=6"] {
        let limited = [&[limit, program.to_str().unwrap()], &scenario[..]].concat();
        let done = bench.start_program(Path::new("prlimit"), &limited).wait();
        check_message(&done, &[1, 4]).unwrap();
        bench.assert_clean(&[]);
    }
}

/// A run continues when its stderr cannot be written.
#[test]
fn a_full_stderr_ends_no_run() {
    let bench = Bench::new();
    let scenario = Target::Role.scenario(&bench).join(" ");
    let run = bench.start_program(Path::new("/bin/sh"), &["-c", &format!("exec {PROGRAM} {scenario} 2>/dev/full")]);
    bench.await_role("controller");
    let domains = bench.domains();
    run.signal(SIGTERM);
    assert_eq!(run.wait().code, Some(128 + SIGTERM));
    bench.assert_clean(&domains);
}

/// A process that dies after its last tick, with its report written, has finished its work.
#[test]
fn a_death_after_the_last_tick_is_recorded_without_loss() {
    let bench = Bench::new();
    let scenario = Target::Realtime.scenario(&bench);
    let scenario = scenario.iter().map(|word| if word == "0.2" { "2" } else { word }).chain(["--record"]);
    let run = bench.start(&scenario.collect::<Vec<_>>());
    let controller = bench.await_role("controller");
    let domains = bench.domains();
    // The recording begins with the ticks. While the launcher is stopped, no role is released.
    await_some(|| std::fs::metadata(bench.path("out/run.mcap")).ok().filter(|file| file.len() > 0));
    run.signal(SIGSTOP);
    let report = domains[0].join("controller.report.json");
    await_some(|| report.exists().then_some(()));
    send_signal(controller, SIGKILL);
    run.signal(SIGCONT);
    run.wait().succeeded();
    let summary = std::fs::read_to_string(bench.path("out/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["incidents"][0]["action"], "noted", "{}", summary["incidents"]);
    assert_eq!(summary["incidents"][0]["role"], "controller");
    bench.assert_clean(&domains);
}
