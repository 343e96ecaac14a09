//! Directories of results, and the names by which a run is found.

use crate::common::{Bench, Done, await_some};
use libc::SIGTERM;
use rustix::fs::{CWD, Mode, mkfifoat};
use std::fs;
use std::os::unix::fs::symlink;
use std::process::Stdio;

const SHORT: [&str; 7] = ["run", "rigid-pair", "--clock", "in-process", "--duration=1", "--set=accept={}", "--out"];

fn short(bench: &Bench, out: &str, more: &[&str]) -> Done {
    bench.run(&[&SHORT[..], &[out], more].concat())
}

fn run_of(bench: &Bench, out: &str) -> String {
    let summary = bench.summary_in(out);
    summary["run"].as_str().unwrap().to_owned()
}

#[test]
fn a_directory_in_use_by_a_run_is_refused_to_another() {
    for clock in ["lockstep", "in-process"] {
        let bench = Bench::new();
        let endless = ["run", "rigid-pair", "--clock", clock, "--duration=100000", "--set=accept={}", "--out", "out"];
        let first = bench.start(&endless);
        let lock = await_some(|| fs::read_to_string(bench.path("out/run.lock")).ok().filter(|text| !text.is_empty()));
        symlink("out", bench.path("link")).unwrap();
        for out in ["out", "link", "./out/"] {
            let second = short(&bench, out, &["--overwrite"]);
            let pid = lock.trim().rsplit(' ').next().unwrap();
            assert!(second.code == Some(2) && second.stderr.contains(pid), "{clock} {out}: {second:?}");
        }
        first.signal(SIGTERM);
        assert_eq!(first.wait().code, Some(128 + SIGTERM), "{clock}");
        assert!(!bench.path("out/run.lock").exists());
    }
}

#[test]
fn results_are_replaced_only_with_overwrite() {
    let bench = Bench::new();
    fs::create_dir(bench.path("out")).unwrap();
    fs::write(bench.path("out/notes.txt"), "mine").unwrap();
    assert_eq!(short(&bench, "out", &["--record"]).code, Some(0));
    let first = run_of(&bench, "out");
    assert_eq!(bench.run(&["report", "out"]).code, Some(0));
    assert_eq!(short(&bench, "out", &[]).code, Some(2));
    assert_eq!(run_of(&bench, "out"), first);
    assert!(bench.path("out/run.mcap").exists() && bench.path("out/report.html").exists());
    // A killed run may have left only its recording.
    fs::remove_file(bench.path("out/summary.json")).unwrap();
    assert_eq!(short(&bench, "out", &[]).code, Some(2));
    let over = short(&bench, "out", &["--overwrite"]).succeeded();
    assert!(over.stderr.contains("run.mcap") && over.stderr.contains("report.html"), "{over:?}");
    assert!(!bench.path("out/run.mcap").exists() && !bench.path("out/report.html").exists());
    assert_eq!(fs::read(bench.path("out/notes.txt")).unwrap(), b"mine");
    // A campaign's directory is never overwritten by a run.
    for name in ["campaign.toml", "journal"] {
        fs::create_dir_all(bench.path("map")).unwrap();
        fs::write(bench.path("map").join(name), "").unwrap();
    }
    assert_eq!(short(&bench, "map", &["--overwrite"]).code, Some(2));
}

#[test]
fn every_command_finds_a_run_by_the_same_names() {
    let bench = Bench::new();
    let record = |name: &str| short(&bench, &format!("runs/{name}"), &["--record"]);
    assert_eq!(record("pair").code, Some(0));
    let alone = bench.run(&["diff", "runs/pair"]);
    assert_eq!(alone.code, Some(2), "only one run has a recording: {alone:?}");
    assert_eq!(record("again").code, Some(0));
    // The newest run has no recording.
    assert_eq!(short(&bench, "runs/bare", &[]).code, Some(0));
    let diff = bench.run(&["diff", "runs/pair", "--json"]).succeeded();
    assert_eq!(diff.json()["b"], "runs/again/run.mcap");
    let replay = bench.run(&["replay", "latest"]);
    assert!(replay.code == Some(2) && replay.stderr.contains("runs/again"), "{replay:?}");
    for run in ["runs/pair", "runs/pair/run.mcap", "runs/latest", "latest"] {
        assert_eq!(bench.run(&["report", run, "--out", "page.html"]).code, Some(0), "{run}");
    }
    // A live run by each of its names: the bridge fails only when it opens the line.
    let words = ["run", "rigid-pair", "--external", "follower", "--duration=100000", "--set=accept={}", "--record"];
    let running = bench.start(&[&words[..], &["--out", "runs/live", "--clock", "lockstep"]].concat());
    bench.await_role("leader");
    let domain = bench.domains().remove(0);
    await_some(|| bench.path("runs/live/run.mcap").exists().then_some(()));
    for run in ["latest", "runs/live", "runs/live/run.mcap", domain.to_str().unwrap()] {
        let named = ["--domain", run];
        let bridge = ["bridge", "--serial", "no-such-line", "--role", "follower"];
        let bridge = bench.run(&[&bridge[..], &named].concat());
        assert!(bridge.stderr.contains("no-such-line"), "{run}: {bridge:?}");
        let scenario = domain.join("scenario.toml");
        let seat = bench.run(&[&["seat", scenario.to_str().unwrap(), "follower"][..], &named].concat());
        assert!(seat.code == Some(0) && seat.stdout.contains(domain.to_str().unwrap()), "{run}: {seat:?}");
    }
    let over = bench.run(&["bridge", "--serial", "no-such-line", "--role", "follower", "--domain", "runs/bare"]);
    assert!(over.code == Some(2) && over.says("run-over") && over.stderr.contains("runs/bare"), "{over:?}");
    running.signal(SIGTERM);
    running.wait();
}

/// The pipe is closed before anything is read, as by `| head -0`.
#[test]
fn a_closed_stdout_changes_neither_results_nor_exit_code() {
    let bench = Bench::new();
    let into_closed_pipe = |arguments: &[&str]| {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let mut command = bench.command();
        command.args(arguments).stdout(Stdio::from(writer)).stderr(Stdio::null());
        command.status().unwrap().code()
    };
    assert_eq!(into_closed_pipe(&[&SHORT[..], &["out"]].concat()), Some(0));
    assert!(bench.path("out/summary.json").exists());
    let unmet = ["--set=accept={sync_error_rad_s_max=1e-9}", "--json"];
    assert_eq!(into_closed_pipe(&[&SHORT[..], &["json"], &unmet].concat()), Some(3));
    for arguments in [&["check", "rigid-pair"][..], &["init", "rigid-pair"], &["report", "out"], &["schema"]] {
        assert_eq!(into_closed_pipe(arguments), Some(0), "{arguments:?}");
    }
}

/// Opening a FIFO like a file blocks until its other end is opened.
#[test]
fn a_fifo_in_place_of_a_file_does_not_block() {
    let bench = Bench::new();
    let base = bench.runtime().join("corotate");
    fs::create_dir(&base).unwrap();
    std::os::unix::fs::chown(&base, None, None).unwrap();
    fs::set_permissions(&base, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let fifo = |path: &std::path::Path| mkfifoat(CWD, path, Mode::RWXU).unwrap();
    fifo(&base.join("x.lock"));
    fifo(&base.join(format!("{:032x}.lock", 1)));
    bench.run(&["run", "rigid-pair", "--clock", "lockstep", "--duration=0.1", "--set=accept={}"]).succeeded();
    assert!(matches!(bench.run(&["doctor", "--seconds=0", "--clean"]).code, Some(0 | 3)));
    for name in ["run.lock", "summary.json", "run.mcap", "scenario.toml"] {
        let out = bench.path(name);
        fs::create_dir(&out).unwrap();
        fifo(&out.join(name));
        let refused = short(&bench, name, &["--overwrite"]);
        assert!(matches!(refused.code, Some(1 | 2)), "{name}: {refused:?}");
    }
    for (command, name) in [("replay", "run.mcap"), ("report", "run.mcap"), ("report", "summary.json")] {
        let refused = bench.run(&[command, bench.path(name).to_str().unwrap()]);
        assert!(matches!(refused.code, Some(1 | 2)), "{command} {name}: {refused:?}");
    }
    fs::remove_dir_all(&base).unwrap();
}
