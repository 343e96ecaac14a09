//! `corotate watch` in a real terminal (tmux) during a run.

use crate::common::{self, Bench, WATCHDOG, await_some};
use libc::{SIGINT, SIGKILL, SIGTERM};
use std::process::Command;
use std::time::Instant;

/// A tmux server with a window of 80 by 24 characters in which a shell runs.
struct Terminal<'a> {
    bench: &'a Bench,
    socket: String,
}

impl<'a> Terminal<'a> {
    fn open(bench: &'a Bench) -> Self {
        let socket = bench.path("tmux").to_str().unwrap().to_owned();
        let terminal = Self { bench, socket };
        terminal.tmux(&["-f", "/dev/null", "new-session", "-d", "-x", "80", "-y", "24", "sh"]);
        terminal.tmux(&["set-option", "-g", "status", "off"]);
        // A known prompt replaces the shell's own.
        terminal.enter("PS1='ready> '; clear");
        terminal.await_text("ready>");
        terminal
    }

    fn tmux(&self, arguments: &[&str]) -> String {
        let mut command = self.bench.command_of("tmux".as_ref());
        // A tmux around the test must not be found.
        let output = command.env_remove("TMUX").args(["-S", &self.socket]).args(arguments).output();
        let output = output.expect("tmux is missing: tests/run installs it (Debian: apt install tmux)");
        assert!(output.status.success(), "tmux {arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    }

    fn enter(&self, line: &str) {
        self.tmux(&["send-keys", line, "Enter"]);
    }

    fn press(&self, key: &str) {
        self.tmux(&["send-keys", key]);
    }

    fn screen(&self) -> String {
        self.tmux(&["capture-pane", "-p"])
    }

    /// Waits until the screen satisfies `wanted`, and returns it.
    fn await_screen(&self, what: &str, wanted: impl Fn(&str) -> bool) -> String {
        let end = Instant::now() + WATCHDOG;
        loop {
            let screen = self.screen();
            if wanted(&screen) {
                return screen;
            }
            assert!(Instant::now() < end, "there never was {what}:\n{screen}");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
    }

    fn await_text(&self, text: &str) -> String {
        self.await_screen(text, |screen| screen.contains(text))
    }

    /// Returns true if a tmux flag of the window is set, for example of the alternate screen or the cursor.
    fn flag(&self, name: &str) -> bool {
        self.tmux(&["display-message", "-p", &format!("#{{{name}}}")]).trim() == "1"
    }

    fn assert_restored(&self) {
        self.await_screen("the shell's screen", |_| !self.flag("alternate_on"));
        assert!(self.flag("cursor_flag"), "the cursor is visible again");
        self.enter("stty -a | grep -o ' icanon\\| echo ' | tr -d '\\n'; echo \"=$?\"");
        self.await_text("icanon echo =0");
    }
}

impl Drop for Terminal<'_> {
    fn drop(&mut self) {
        // Ends only the server of this socket.
        let _ = Command::new("tmux").env_remove("TMUX").args(["-S", &self.socket, "kill-server"]).output();
    }
}

/// Returns the words of the line that begins with the word `first`.
fn line(screen: &str, first: &str) -> Vec<String> {
    let lines = screen.lines().map(|line| line.split_whitespace().map(str::to_owned).collect::<Vec<_>>());
    lines.into_iter().find(|words| words.first().is_some_and(|word| word == first)).unwrap_or_default()
}

fn tick(screen: &str, role: &str) -> Option<u64> {
    line(screen, role).get(3)?.parse().ok()
}

/// Returns the number below the name of a metric.
fn value(screen: &str, metric: &str) -> Option<f64> {
    screen.lines().skip_while(|line| !line.starts_with(metric)).nth(1)?.split_whitespace().next()?.parse().ok()
}

const RUN: [&str; 7] = ["run", "--duration", "60", "--tick-hz", "100", "--set", "realtime.lock_memory=false"];

#[test]
fn the_screen_shows_the_loop_and_restores_the_terminal() {
    let bench = Bench::new();
    let run = bench.start(&[&RUN[..], &["--json"]].concat());
    let domain = bench.await_domain();
    let terminal = Terminal::open(&bench);
    terminal.enter(&format!("{} watch", env!("CARGO_BIN_EXE_corotate")));

    let running = |screen: &str| ["leader", "follower", "observer", "controller"].map(|role| line(screen, role));
    let first = terminal.await_screen("four running roles with a rate", |screen| {
        running(screen).iter().all(|words| words.get(1).is_some_and(|state| state == "running") && words[4] != "-")
            && value(screen, "estimate_error_rad_s").is_some()
    });
    assert!(first.contains("corotate rigid-pair  realtime 100 Hz"), "{first}");
    for words in running(&first) {
        let rate: f64 = words[4].parse().unwrap();
        assert!((20.0..200.0).contains(&rate), "{words:?} at 100 Hz, however loaded the machine is");
        assert_eq!(words[2], "1", "the first life: {words:?}");
        assert!(words[6].contains('/'), "lateness: {words:?}");
    }
    assert!(running(&first)[2][7].contains('/') && running(&first)[0][7] == "-", "the leader has no input: {first}");

    // Ticks continue, and the errors fall at the design rate, more than a decade per second.
    let started = tick(&first, "leader").unwrap();
    let later =
        terminal.await_screen("later ticks", |screen| tick(screen, "leader").is_some_and(|t| t > started + 300));
    for metric in ["sync_error_rad_s", "estimate_error_rad_s"] {
        let (before, after) = (value(&first, metric).unwrap(), value(&later, metric).unwrap());
        assert!(after < before.max(1e-9), "{metric}: {before:e}, then {after:e}\n{later}");
    }
    assert!(later.contains(">leader/measurement"), "{later}");

    // A signal is selected; the paused screen does not change while the loop runs.
    terminal.press("Up");
    terminal.await_text(">follower/command");
    terminal.await_text("acceleration_rad_s2");
    terminal.press("Space");
    let paused = terminal.await_text("paused");
    std::thread::sleep(std::time::Duration::from_millis(500));
    let still = terminal.screen();
    assert_eq!(tick(&paused, "leader"), tick(&still, "leader"));
    terminal.press("Space");
    terminal.await_screen("later ticks", |screen| tick(screen, "leader") > tick(&still, "leader"));

    // Below the names are the fields of the selected signal.
    let marked = terminal.screen();
    assert!(line(&marked, "acceleration_rad_s2").len() == 4 && line(&marked, "omega_rad_s").is_empty(), "{marked}");

    // The screen follows the window's size.
    terminal.tmux(&["resize-window", "-x", "100", "-y", "40"]);
    terminal.await_screen("a screen of 40 lines", |screen| {
        screen.lines().count() == 40 && screen.lines().nth(39).is_some_and(|l| l.contains("q quit"))
    });

    terminal.press("q");
    terminal.assert_restored();
    terminal.enter("echo code=$?");

    // The loop is undisturbed: it ends in order, and its counters balance.
    run.signal(SIGINT);
    let done = run.wait();
    let summary = done.json();
    assert_eq!((done.code, summary["books"]["balanced"].as_bool()), (Some(130), Some(true)), "{}", done.stderr);
    drop(terminal);
    bench.assert_clean(&[domain]);
}

#[test]
fn a_signal_restores_the_terminal_and_the_end_of_the_run_is_shown() {
    let bench = Bench::new();
    let run = bench.start(&RUN);
    let domain = bench.await_domain();
    let terminal = Terminal::open(&bench);
    let program = env!("CARGO_BIN_EXE_corotate");
    terminal.enter(&format!("{program} watch {}; echo code=$?", domain.display()));
    terminal
        .await_screen("running roles", |screen| line(screen, "leader").get(1).is_some_and(|state| state == "running"));
    let watchers =
        || bench.processes().into_iter().filter(|pid| arguments(*pid).get(1).is_some_and(|word| word == "watch"));
    watchers().for_each(|pid| common::send_signal(pid, SIGTERM));
    terminal.await_text("code=143");
    terminal.assert_restored();

    terminal.enter(&format!("clear; {program} watch; echo code=$?"));
    terminal
        .await_screen("running roles", |screen| line(screen, "leader").get(1).is_some_and(|state| state == "running"));
    run.signal(SIGTERM);
    assert_eq!(run.wait().code, Some(143));
    let ended = terminal.await_text("ended");
    assert!(tick(&ended, "controller").is_some_and(|tick| tick > 0), "the last values stay: {ended}");
    terminal.press("q");
    terminal.await_text("code=0");
    drop(terminal);
    bench.assert_clean(&[domain]);
}

/// As when a connection breaks, and q cannot be pressed.
#[test]
fn a_watcher_ends_with_its_terminal() {
    let bench = Bench::new();
    let run = bench.start(&RUN);
    let domain = bench.await_domain();
    bench.await_role("controller");
    let terminal = Terminal::open(&bench);
    terminal.enter(&format!("{} watch", env!("CARGO_BIN_EXE_corotate")));
    terminal.await_text("controller");
    let watches = |pid: &u32| arguments(*pid).get(1).is_some_and(|word| word == "watch");
    assert!(bench.processes().iter().any(watches));
    drop(terminal);
    await_some(|| (!bench.processes().iter().any(watches)).then_some(()));
    run.signal(SIGTERM);
    assert_eq!(run.wait().code, Some(143));
    bench.assert_clean(&[domain]);
}

/// Nothing of it outlives the run.
#[test]
fn a_killed_watcher_leaves_no_files() {
    let bench = Bench::new();
    let run = bench.start(&RUN);
    let domain = bench.await_domain();
    bench.await_role("controller");
    let watcher = bench.start(&["watch", "--once", "60"]);
    let node = || std::fs::read_dir("/proc/self/fd").is_ok() && maps(watcher.pid()).contains("corotate_");
    await_some(|| node().then_some(()));
    watcher.signal(SIGKILL);
    watcher.wait();
    run.signal(SIGTERM);
    assert_eq!(run.wait().code, Some(143));
    bench.assert_clean(&[domain]);
}

/// The run waits for its observer, and the watcher for the run.
#[test]
fn a_watcher_that_waits_for_a_run_ends_on_sigterm() {
    let bench = Bench::new();
    let run = bench.start(&["run", "--clock", "lockstep", "--external", "observer"]);
    let domain = bench.await_domain();
    bench.await_role("controller");
    // A run without its scenario has only just begun, so there is something to wait for.
    let (there, aside) = (domain.join("scenario.toml"), domain.join("aside"));
    await_some(|| std::fs::rename(&there, &aside).ok());
    let watcher = bench.start(&["watch", domain.to_str().unwrap(), "--once", "1"]);
    await_some(|| common::catches(watcher.pid(), 15).then_some(()));
    let signalled = Instant::now();
    watcher.signal(SIGTERM);
    let done = watcher.wait();
    assert_eq!(done.code, Some(143), "{done:?}");
    assert!(done.stdout.is_empty() && done.stderr.is_empty(), "{done:?}");
    println!("ended after {:.1} s", signalled.elapsed().as_secs_f64());
    std::fs::rename(&aside, &there).unwrap();
    run.signal(SIGTERM);
    run.wait();
    bench.assert_clean(&[domain]);
}

#[test]
fn once_prints_a_screen_without_a_terminal() {
    let bench = Bench::new();
    let run = bench.start(&["run", "--duration", "60", "--clock", "realtime", "--tick-hz", "200"]);
    let domain = bench.await_domain();
    let done = bench.run(&["watch", domain.to_str().unwrap(), "--once", "3"]).succeeded();
    assert_eq!(done.stdout.lines().count(), 24);
    assert_eq!(line(&done.stdout, "observer")[1], "running", "{}", done.stdout);
    let refused = bench.run(&["watch", domain.to_str().unwrap()]);
    assert!(refused.code == Some(2) && refused.says("no-terminal") && refused.stderr.contains("--once"), "{refused:?}");
    run.signal(SIGTERM);
    run.wait();
    bench.assert_clean(&[domain]);
}

/// Finds each of two runs by its results directory, without its domain.
#[test]
fn a_run_is_found_by_its_results_directory() {
    let bench = Bench::new();
    let start = |out: &str, hz: &str| {
        let quiet = ["--tick-hz", hz, "--duration", "600", "--set", "accept={}", "--set", "limits={}"];
        bench.start(&[&["run", "rigid-pair", "--out", out][..], &quiet].concat())
    };
    let runs = [start("slow", "100"), start("other", "200")];
    for (out, ticks) in [("slow", 60_000), ("other", 120_000)] {
        // The run may not have begun.
        let watched: serde_json::Value = await_some(|| {
            let done = bench.run(&["watch", out, "--once", "0.5", "--json"]);
            (done.code == Some(0)).then(|| done.json())
        });
        assert_eq!(
            (&watched["schema"], &watched["last_tick"]),
            (&"corotate/watch/v1".into(), &ticks.into()),
            "{watched}"
        );
        let (roles, errors) = (watched["roles"].as_array().unwrap(), watched["errors"].as_object().unwrap());
        assert!(roles.len() == 4 && roles.iter().all(|role| role["tick"].is_u64()), "{watched}");
        assert!(
            errors.contains_key("sync_error_rad_s") && !watched["signals"].as_object().unwrap().is_empty(),
            "{watched}"
        );
    }
    for run in runs {
        run.signal(SIGTERM);
        assert_eq!(run.wait().code, Some(128 + SIGTERM));
    }
    let over = bench.run(&["watch", "slow"]);
    assert!(over.code == Some(2) && over.says("run-over"), "{over:?}");
}

#[test]
fn without_a_run_watch_is_refused() {
    let bench = Bench::new();
    let idle = bench.run(&["watch", "--once"]);
    assert!(idle.code == Some(2) && idle.says("no-run"), "{idle:?}");
    let directory = bench.run(&["watch", "/tmp", "--once"]);
    assert!(directory.code == Some(2) && directory.says("not-a-domain"), "{directory:?}");
}

fn arguments(pid: u32) -> Vec<String> {
    let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    line.split(|byte| *byte == 0).map(|word| String::from_utf8_lossy(word).into_owned()).collect()
}

fn maps(pid: u32) -> String {
    std::fs::read_to_string(format!("/proc/{pid}/maps")).unwrap_or_default()
}

/// With the kernel's trace the tracing process names the cause, without it the counters tell its kind.
#[test]
fn the_screen_shows_the_last_late_tick() {
    let bench = Bench::new();
    // Every tick is late.
    let late = ["--clock", "realtime", "--set", "realtime.late_us=0"];
    for trace in ["auto", "counters"] {
        let run = bench.start(&[&RUN[..], &late, &["--set", &format!("realtime.trace=\"{trace}\"")]].concat());
        bench.await_ticks("controller");
        let object = bench.run(&["watch", "--once", "2", "--json"]).succeeded().json();
        let (late, last) = (&object["late"], &object["late"]["last"]);
        assert!(late["count"].as_u64().unwrap() > 100 && late["only_counted"].is_boolean(), "{late}");
        assert!(last["tick"].as_u64().unwrap() > 50 && last["late_us"].as_f64().unwrap() > 0.0, "{late}");
        assert!(last["role"].is_string() && last["kind"].is_string() && last.get("cause").is_some(), "{late}");
        let screen = bench.run(&["watch", "--once", "0.5"]).succeeded().stdout;
        let line = screen.lines().find(|line| line.contains(" late ticks, last")).unwrap_or_else(|| panic!("{screen}"));
        assert!(line.contains(" us: "), "{line}");
        run.signal(SIGTERM);
        assert_eq!(run.wait().code, Some(143));
    }
    let run = bench.start(&[&RUN[..], &["--clock", "lockstep"]].concat());
    bench.await_ticks("controller");
    assert!(bench.run(&["watch", "--once", "0.5", "--json"]).succeeded().json()["late"].is_null());
    run.signal(SIGTERM);
    run.wait();
}
