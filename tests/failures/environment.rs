//! A machine that lacks memory, descriptors, disk, time or cores. A run reports what it lacks or counts what it lost;
//! it never hangs, never panics, and leaves nothing behind.

use crate::common::{Bench, Done, Running, await_some, send_signal, shipped};
use libc::{SIGCONT, SIGSTOP};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::process::Command;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Held by tests that need an idle machine or keep it busy: one at a time.
static CORES: Mutex<()> = Mutex::new(());

/// Starts a shell that runs a line in the bench.
fn start_in_shell(bench: &Bench, line: &str) -> Running {
    let mut shell = Command::new("/bin/sh");
    let like = bench.command();
    shell.current_dir(like.get_current_dir().unwrap()).args(["-c", line]);
    for (key, value) in like.get_envs() {
        shell.env(key, value.unwrap());
    }
    Running::new(&mut shell)
}

/// Returns the shell line of a run of half a second.
fn short_run(clock: &str) -> String {
    let (program, file) = (env!("CARGO_BIN_EXE_corotate"), shipped("rigid-pair"));
    format!("exec {program} run {} --clock {clock} --set accept={{}} --duration 0.5 --out out", file.display())
}

/// Asserts that the program ended by itself, with a reason if it failed.
fn assert_in_order(done: &Done, case: &str) {
    assert!(matches!(done.code, Some(0 | 1 | 4)), "{case}: {done:?}");
    assert!(!done.stderr.contains("panicked"), "{case}: {done:?}");
    assert!(done.code == Some(0) || !done.codes().is_empty(), "{case}: no reason given: {done:?}");
}

#[test]
fn too_little_shared_memory_is_refused_before_the_run() {
    // In its own mount namespace; without root in a user namespace, which the kernel must allow.
    let root = rustix::process::getuid().is_root();
    let unshare = if root { "unshare -m" } else { "unshare -rm" };
    let inside = |size: &str, clock: &str| {
        let bench = Bench::new();
        let line = format!("mount -t tmpfs -o size={size} tmpfs /dev/shm && {}", short_run(clock));
        let done = start_in_shell(&bench, &format!("exec {unshare} /bin/sh -c '{line}'")).wait();
        bench.assert_clean(&[]);
        done
    };
    for clock in ["realtime", "lockstep"] {
        for size in ["4k", "64k", "256k", "1m"] {
            let done = inside(size, clock);
            assert_eq!(done.code, Some(1), "{clock} {size}: {done:?}");
            assert!(done.stderr.contains("/dev/shm"), "{clock} {size}: {done:?}");
        }
        // Near the requirement the run is refused or succeeds.
        for size in ["1500k", "1800k", "2m", "3m"] {
            let done = inside(size, clock);
            assert!(matches!(done.code, Some(0 | 1)), "{clock} {size}: {done:?}");
            assert!(done.code == Some(0) || done.stderr.contains("/dev/shm"), "{clock} {size}: {done:?}");
        }
        let done = inside("16m", clock);
        assert_eq!(done.code, Some(0), "{clock}, enough: {done:?}");
    }
}

/// Without this check, a file without inode or size stays half made, and other processes wait for it.
#[test]
fn too_few_inodes_are_refused_before_the_run() {
    let root = rustix::process::getuid().is_root();
    let unshare = if root { "unshare -m" } else { "unshare -rm" };
    for (inodes, codes) in [(8, [1, 1]), (48, [1, 1]), (150, [0, 1]), (1000, [0, 0])] {
        let bench = Bench::new();
        let mount = format!("mount -t tmpfs -o size=64m,nr_inodes={inodes} tmpfs /dev/shm");
        let line = format!("{mount} && {} --record", short_run("lockstep"));
        let done = start_in_shell(&bench, &format!("exec {unshare} /bin/sh -c '{line}'")).wait();
        assert!(done.code.is_some_and(|code| codes.contains(&code)), "{inodes}: {done:?}");
        assert!(done.code == Some(0) || done.stderr.contains("/dev/shm"), "{inodes}: {done:?}");
        bench.assert_clean(&[]);
    }
}

/// The disk is full for one file of the launcher: the run fails with a reason or does without the file; it never waits
/// for it.
#[test]
fn a_full_disk_for_one_file_of_the_launcher_causes_no_hang() {
    for n in [1, 2, 3, 5, 8, 11, 14] {
        let bench = Bench::new();
        let inject = format!("strace -qq -o /dev/null -e trace=ftruncate -e inject=ftruncate:error=ENOSPC:when={n}");
        let line = short_run("lockstep").replace("exec ", &format!("exec {inject} "));
        let done = start_in_shell(&bench, &format!("{line} --record")).wait();
        assert_in_order(&done, &format!("file {n}"));
        assert!(n > 2 || done.code == Some(1), "file {n}: {done:?}");
        bench.assert_clean(&[]);
    }
}

#[test]
fn a_limit_on_descriptors_is_reported_as_an_error() {
    for limit in [4, 8, 12, 16, 20, 24, 32, 48, 64, 128] {
        let bench = Bench::new();
        let done = start_in_shell(&bench, &format!("ulimit -n {limit}; {}", short_run("lockstep"))).wait();
        assert_in_order(&done, &format!("{limit} descriptors"));
        bench.assert_clean(&[]);
    }
}

/// A full disk or a removed directory: the results cannot be written, but the screen shows them.
#[test]
fn results_that_cannot_be_written_are_reported_and_still_shown() {
    for file in ["summary.json", "scenario.toml", "hashes.txt"] {
        let bench = Bench::new();
        let run = shipped("rigid-pair");
        let running = bench.start(&["run", run.to_str().unwrap(), "--duration=2", "--set=accept={}", "--out=out"]);
        // Earlier the directory would be refused because of a foreign file.
        bench.await_role("follower");
        symlink("/dev/full", bench.path("out").join(file)).unwrap();
        let done = running.wait();
        assert_eq!(done.code, Some(1), "{file}: {done:?}");
        assert!(done.stderr.contains(file) && done.says("cannot-write"), "{file}: {done:?}");
        assert!(done.stdout.contains("hash"), "{file}: {done:?}");
        bench.assert_clean(&[]);
    }
    let bench = Bench::new();
    let run = shipped("rigid-pair");
    let running = bench.start(&[
        "run",
        run.to_str().unwrap(),
        "--duration=1",
        "--set=accept={}",
        "--out=out",
        "--clock=realtime",
    ]);
    bench.await_role("controller");
    std::fs::remove_dir_all(bench.path("out")).unwrap();
    let done = running.wait();
    assert_eq!(done.code, Some(1), "{done:?}");
    assert!(done.says("cannot-write") && done.stdout.contains("hash"), "{done:?}");
}

#[test]
fn a_directory_that_may_not_be_written_is_refused_before_the_run() {
    // Root may write everywhere: this test is for other users.
    let bench = Bench::unprivileged();
    std::fs::create_dir(bench.path("locked")).unwrap();
    std::fs::set_permissions(bench.path("locked"), std::fs::Permissions::from_mode(0o555)).unwrap();
    let file = bench.path("pair.toml");
    std::fs::copy(shipped("rigid-pair"), &file).unwrap();
    let done = bench.run(&["run", file.to_str().unwrap(), "--out=locked/out"]);
    assert_eq!(done.code, Some(1), "{done:?}");
    assert!(done.stderr.contains("locked/out") && done.stderr.contains("--out"), "{done:?}");
}

/// As when a host pauses a virtual machine: all processes stop for two seconds while the clock continues.
#[test]
fn a_pause_of_two_seconds_is_counted_without_incidents() {
    let _cores = CORES.lock().unwrap_or_else(PoisonError::into_inner);
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let running =
        bench.start(&["run", file.to_str().unwrap(), "--json", "--duration=5", "--set=accept={}", "--out=out"]);
    bench.await_ticks("controller");
    let processes = bench.processes();
    processes.iter().for_each(|pid| send_signal(*pid, SIGSTOP));
    std::thread::sleep(Duration::from_secs(2));
    processes.iter().for_each(|pid| send_signal(*pid, SIGCONT));
    let done = running.wait().succeeded();
    let summary = done.json();
    assert_eq!(summary["incidents"].as_array().unwrap().len(), 0, "{summary:#}");
    assert_eq!(summary["books"]["balanced"], true, "{:#}", summary["books"]);
    for role in ["leader", "follower"] {
        let missed = summary["books"]["roles"][role]["missed"].as_u64().unwrap();
        assert!(missed > 1900, "{role} missed {missed}: too few for this test");
    }
    let sync = summary["score"]["metrics"][0]["last"].as_f64().unwrap();
    assert!(sync < 2.0, "the follower is bounded: {sync}");
    bench.assert_clean(&[]);
}

/// A role that stops for less than the limit is not replaced: the plant's command timeout covers the gap.
#[test]
fn a_short_stop_is_covered_by_the_command_timeout() {
    let _cores = CORES.lock().unwrap_or_else(PoisonError::into_inner);
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let running =
        bench.start(&["run", file.to_str().unwrap(), "--json", "--duration=3", "--set=accept={}", "--out=out"]);
    let controller = bench.await_ticks("controller");
    send_signal(controller, SIGSTOP);
    std::thread::sleep(Duration::from_millis(300));
    send_signal(controller, SIGCONT);
    let done = running.wait().succeeded();
    let summary = done.json();
    assert_eq!(summary["incidents"].as_array().unwrap().len(), 0, "{summary:#}");
    let (follower, controller) = (&summary["books"]["roles"]["follower"], &summary["books"]["roles"]["controller"]);
    assert!(controller["missed"].as_u64().unwrap() > 250, "{controller}");
    assert!(follower["safe"].as_u64().unwrap() > 200, "{follower}");
    bench.assert_clean(&[]);
}

/// A process of higher priority occupies one core for more than a second.
#[test]
fn a_busy_core_costs_only_ticks() {
    let _cores = CORES.lock().unwrap_or_else(PoisonError::into_inner);
    let bench = Bench::new();
    let file = shipped("rigid-pair");
    let running =
        bench.start(&["run", file.to_str().unwrap(), "--json", "--duration=3", "--set=accept={}", "--out=out"]);
    bench.await_ticks("controller");
    let core = std::thread::available_parallelism().unwrap().get() - 1;
    let priority = if rustix::process::getuid().is_root() { "chrt -f 90" } else { "nice -n 0" };
    // The process that ends it must have at least its priority.
    let hog = format!("timeout -s KILL 1.2 {priority} taskset -c {core} sh -c 'while :; do :; done'");
    let mut hog = Command::new("/bin/sh").args(["-c", &hog]).spawn().unwrap();
    let done = running.wait();
    await_some(|| hog.try_wait().unwrap());
    assert_eq!(done.code, Some(0), "{done:?}");
    let summary = done.json();
    assert_eq!(summary["books"]["balanced"], true, "{:#}", summary["books"]);
    assert!(summary["score"]["metrics"][0]["last"].as_f64().unwrap() < 2.0, "{:#}", summary["score"]);
    bench.assert_clean(&[]);
}
