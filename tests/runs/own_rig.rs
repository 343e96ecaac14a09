//! A user's program with its own rig, `examples/motor-pair`: every command works with a rig that this crate does not know.

use crate::common::{self, Bench, Running, await_some, python, root};
use libc::SIGKILL;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

const TICKS: u64 = 10_001;

pub(super) fn program() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| example("motor-pair"))
}

/// Builds an example in the same target directory, which has its dependencies.
pub fn example(name: &str) -> PathBuf {
    build(name, &root().join("examples").join(name), "--locked")
}

/// Builds the program of a crate in this profile; without optimisation, as `tests/run`, because that takes seconds instead of minutes.
fn build(name: &str, directory: &Path, flag: &str) -> PathBuf {
    let profile = Path::new(env!("CARGO_BIN_EXE_corotate")).parent().unwrap();
    let mut command = Command::new(env!("CARGO"));
    command.args(["build", flag, "--config", &format!("profile.release.package.{name}.opt-level=0"), "--target-dir"]);
    command.arg(profile.parent().unwrap()).arg("--manifest-path").arg(directory.join("Cargo.toml"));
    command.args((!cfg!(debug_assertions)).then_some("--release"));
    let built = command.output().unwrap();
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    profile.join(name)
}

/// Returns the printed hashes, and the number of ticks before the first missed one.
fn hashes(bench: &Bench, out: &str) -> (Vec<String>, usize) {
    let text = std::fs::read_to_string(bench.path(out).join("hashes.txt")).unwrap();
    let clean = bench.summary_in(out)["state"]["clean_ticks"].as_u64().unwrap();
    let hashes = text.lines().filter(|line| !line.starts_with('#')).map(str::to_owned);
    (hashes.collect(), clean as usize)
}

#[test]
fn all_clocks_give_the_same_hash() {
    let bench = Bench::with_program(program());
    for clock in ["in-process", "lockstep", "realtime"] {
        // A loaded machine may miss ticks in real time, so there the criteria are removed.
        let relaxed = if clock == "realtime" { "accept={}" } else { "seed=1" };
        let done = bench.run(&["run", "--clock", clock, "--out", clock, "--set", relaxed]);
        assert_eq!(done.code, Some(0), "{clock}: {done:?}");
        assert_eq!(bench.summary_in(clock)["state"]["elapsed_ticks"], TICKS, "{clock}");
        assert_eq!(bench.summary_in(clock)["books"]["balanced"], true, "{clock}");
    }
    let (expected, clean_ticks) = hashes(&bench, "in-process");
    assert_eq!(clean_ticks as u64, TICKS);
    assert_eq!(hashes(&bench, "lockstep"), (expected.clone(), clean_ticks));
    let (live, clean_live) = hashes(&bench, "realtime");
    let common = expected.iter().zip(&live).take_while(|(expected, live)| expected == live).count();
    assert!(common >= clean_live.min(live.len()), "{common} hashes are the same, {clean_live} ticks were clean");
}

#[test]
fn errors_in_a_scenario_are_located_as_for_shipped_rigs() {
    let bench = Bench::with_program(program());
    let shipped = bench.run(&["init", "motor-pair"]).succeeded();
    let listed = bench.run(&["init", "--list"]).stdout;
    assert!(listed.starts_with("motor-pair  Two DC motors.") && listed.lines().count() == 1, "{listed}");
    let by_name = bench.run(&["check", "motor-pair"]);
    assert!(by_name.code == Some(0) && by_name.stdout.starts_with("motor-pair: "), "{by_name:?}");
    let schema: Value = serde_json::from_str(&bench.run(&["schema"]).stdout).unwrap();
    assert_eq!(schema["properties"]["rig"]["enum"], serde_json::json!(["motor-pair"]));
    assert_eq!(schema["properties"]["motor"]["properties"]["inertia_kg_m2"]["type"], "number");
    let line = |key: &str| 1 + shipped.stdout.lines().position(|line| line.starts_with(key)).unwrap();
    for (from, to, expected) in [
        ("inertia_kg_m2 = 1e-3", "inertia_kg_m2 = -1", "[not-positive]"),
        ("inertia_kg_m2 = 1e-3", "inertia_kg_m2 = \"a\"", "motor.inertia_kg_m2: "),
        ("gain_per_s", "gian_per_s", "gain_per_s"),
        ("speed_error_rad_s_max", "sped_error_rad_s_max", "speed_error_rad_s_max"),
    ] {
        let file = bench.path("wrong.toml");
        std::fs::write(&file, shipped.stdout.replace(from, to)).unwrap();
        let refused = bench.run(&["check", file.to_str().unwrap()]);
        let place = format!("wrong.toml:{}", line(from.split(' ').next().unwrap()));
        assert_eq!(refused.code, Some(2), "{to}: {refused:?}");
        assert!(refused.stderr.contains(&place) && refused.stderr.contains(expected), "{to}: {refused:?}");
    }
    std::fs::write(bench.path("other.toml"), shipped.stdout.replace("rig = \"motor-pair\"", "rig = \"rigid-body\""))
        .unwrap();
    let refused = bench.run(&["check", "other.toml"]);
    assert!(refused.code == Some(2) && refused.stderr.contains("motor-pair"), "{refused:?}");
}

#[test]
fn record_replay_diff_export_and_report_work() {
    let bench = Bench::with_program(program());
    let fault = "fault=[{kind=\"not-a-number\",role=\"leader\",field=\"speed_rad_s\",from_tick=100,ticks=5},\
                 {kind=\"drop\",role=\"controller\",from_tick=300,ticks=30},{kind=\"kill\",role=\"observer\",from_tick=500}]";
    let run = |out: &str, clock: &str, fault: &str| {
        let junit = format!("{out}.xml");
        let options = ["--clock", clock, "--record", "--out", out, "--junit", &junit, "--set", fault];
        bench.run(&[&["run"], &options[..]].concat()).succeeded();
        assert!(std::fs::read_to_string(bench.path(&junit)).unwrap().contains("load_error_n_m"));
        bench.path(out).join("run.mcap").display().to_string()
    };
    let (in_process, lockstep) = (run("one", "in-process", fault), run("other", "lockstep", fault));
    let quiet = run("quiet", "in-process", "fault=[]");
    let summary = bench.summary_in("one");
    assert_eq!(summary["books"]["rejected_samples"], 5, "{:#}", summary["books"]);
    assert!(summary["score"]["statuses"].to_string().contains("holding"), "{:#}", summary["score"]["statuses"]);
    assert_eq!(bench.run(&["replay", &in_process]).code, Some(0));
    assert_eq!(bench.run(&["replay", &lockstep, "--role", "controller"]).code, Some(0));
    assert_eq!(bench.run(&["diff", &in_process, &lockstep]).code, Some(0));
    let differs = bench.run(&["diff", &in_process, &quiet]);
    assert!(differs.code == Some(3) && differs.stdout.contains("speed_rad_s"), "{differs:?}");
    bench.run(&["export", &quiet, "--csv", "tables"]).succeeded();
    let tables = std::fs::read_dir(bench.path("tables")).unwrap().map(|entry| entry.unwrap().path());
    let tables: Vec<String> = tables.map(|path| std::fs::read_to_string(path).unwrap()).collect();
    assert!(tables.iter().any(|table| table.contains("rise_rad_s2")), "{}", tables.len());
    bench.run(&["report", bench.path("one").to_str().unwrap(), "--out", "page.html"]).succeeded();
    let html = std::fs::read_to_string(bench.path("page.html")).unwrap();
    for drawn in ["speed, rad/s", "load, N m", "current, A", "speed_error_rad_s"] {
        assert!(html.contains(drawn), "{drawn}");
    }
    // One chart for each unit of an error, and no charts that only other rigs request.
    for (drawn, count) in
        [(">error, rad/s<", 1), (">error, N m<", 1), ("error, in the unit", 0), ("logarithm of time", 0)]
    {
        // Each chart has a wide and a narrow version.
        assert_eq!(html.matches(drawn).count(), 2 * count, "{drawn}");
    }
}

/// The hashes are those of a run without a kill.
#[test]
fn a_run_can_be_watched_and_a_killed_role_is_restarted() {
    let bench = Bench::with_program(program());
    bench.run(&["run", "--clock", "in-process", "--duration", "100", "--out", "whole"]).succeeded();
    let running = bench.start(&["run", "--clock", "lockstep", "--duration", "100", "--out", "killed"]);
    // Wait until the screen shows a tick.
    let screen = await_some(|| {
        let screen = bench.run(&["watch", "--once", "1"]);
        let tick =
            screen.stdout.split("tick ").nth(1).and_then(|rest| rest.split('/').next()?.trim().parse::<u64>().ok());
        tick.is_some_and(|tick| tick > 0).then_some(screen)
    });
    common::send_signal(bench.await_role("controller"), SIGKILL);
    running.wait().succeeded();
    assert!(screen.code == Some(0) && screen.stdout.contains("speed_error_rad_s"), "{screen:?}");
    assert!(!bench.summary_in("killed")["incidents"].as_array().unwrap().is_empty());
    assert_eq!(hashes(&bench, "killed"), hashes(&bench, "whole"));
}

/// The Python program reads everything about the rig from the seat file.
#[test]
fn a_python_program_takes_the_role_of_a_motor() {
    let bench = Bench::with_program(program());
    let described = bench.run(&["seat", "motor-pair.toml", "follower"]);
    assert_eq!(described.code, Some(2), "there is no such file here: {described:?}");
    let running = bench.start(&["run", "--clock", "lockstep", "--external", "follower", "--out", "out", "--json"]);
    let (seat, motor) = (bench.await_seat("follower"), root().join("tests/hil/motor.py"));
    let follower = bench.start_program(&python("hil"), &[motor.to_str().unwrap(), seat.to_str().unwrap()]);
    let (done, follower) = (running.wait(), follower.wait());
    assert_eq!((done.code, follower.code), (Some(0), Some(0)), "{done:?} {follower:?}");
    assert_eq!(bench.summary_in("out")["books"]["balanced"], true);
}

/// The targets hold for corotate's own scenario only.
#[test]
fn bench_measures_the_own_scenario_without_targets() {
    let bench = Bench::with_program(program());
    let done = bench
        .run(&["bench", "chain", "tick", "lockstep", "overhead", "--quick", "--json", "--out", "results"])
        .succeeded();
    bench.assert_clean(&[]);
    let results = done.json();
    assert_eq!(results["scenario"], "motor-pair");
    let figures = results["figures"].as_array().unwrap();
    for (row, name) in [
        ("chain", "ours, 1000 Hz"),
        ("chain", "observer with controller, 1000 Hz"),
        ("chain", "all in one process, 1000 Hz"),
        ("chain", "step of the controller, 1000 Hz"),
        ("tick", "ours, in a run"),
        ("tick", "rate error of a run"),
        ("lockstep", "lockstep"),
        ("lockstep", "in one thread, motor-pair"),
        ("lockstep", "the roles alone, motor-pair"),
        ("overhead", "page faults, follower"),
        ("overhead", "allocations beyond iceoryx2's one per sample, worst role"),
    ] {
        let found = figures.iter().find(|figure| figure["row"] == row && figure["name"] == name);
        assert!(found.is_some_and(|figure| figure["median"].as_f64().unwrap() >= 0.0), "{row}: {name}: {done:?}");
    }
    assert!(results["targets"].as_array().unwrap().is_empty(), "{done:?}");
    assert!(done.stderr.contains("rigid-pair"), "{done:?}");
    let checked = bench.run(&["bench", "chain", "--check"]);
    assert!(checked.code == Some(2) && checked.says("nothing-to-judge"), "{checked:?}");
}

#[test]
fn corotate_new_writes_an_example_under_another_name() {
    let bench = Bench::new();
    for (name, original, options) in
        [("two-motors", "motor-pair", &[][..]), ("broom", "cart-pole", &["--template", "cart-pole"])]
    {
        bench.run(&[&["new", name], options].concat()).succeeded();
        for (file, written) in
            [("src/main.rs", "src/main.rs"), ("ORIGINAL.toml", "NAME.toml"), ("tests/clocks.rs", "tests/clocks.rs")]
        {
            let written = std::fs::read_to_string(bench.path(name).join(written.replace("NAME", name))).unwrap();
            let file = root().join("examples").join(original).join(file.replace("ORIGINAL", original));
            assert_eq!(written, std::fs::read_to_string(&file).unwrap().replace(original, name), "{file:?}");
        }
    }
    bench.run(&["new", "nothing", "--template", "empty"]).succeeded();
    assert!(std::fs::read_to_string(bench.path("nothing/src/main.rs")).unwrap().contains("\"../nothing.toml\""));
    assert_eq!(bench.run(&["new", "other", "--template", "other"]).code, Some(2));
    let manifest = std::fs::read_to_string(bench.path("two-motors/Cargo.toml")).unwrap();
    assert!(manifest.contains("name = \"two-motors\"") && manifest.contains("corotate = {"), "{manifest}");
    assert_eq!(bench.run(&["new", "two-motors"]).code, Some(2), "it exists already");
    for name in ["Two", "1st", "a_b", "corotate", "x", "../x", "a-"] {
        let refused = bench.run(&["new", name]);
        assert!(refused.code == Some(2) && refused.says("bad-name"), "{name}: {refused:?}");
    }
}

/// Builds a program from a source and the file of its scenario. The crate is otherwise that of the example.
pub fn built(name: &str, source: &str, scenario: (&str, &str)) -> PathBuf {
    let example = root().join("examples/motor-pair");
    let profile = Path::new(env!("CARGO_BIN_EXE_corotate")).parent().unwrap();
    let directory = profile.join(format!("{name}-crate"));
    std::fs::create_dir_all(directory.join("src")).unwrap();
    let crate_path = format!("path = \"{}\"", root().display());
    for file in ["Cargo.toml", "Cargo.lock"] {
        let text = std::fs::read_to_string(example.join(file)).unwrap();
        let text = text.replace("motor-pair", name).replace("path = \"../..\"", &crate_path);
        std::fs::write(directory.join(file), text).unwrap();
    }
    std::fs::write(directory.join(scenario.0), scenario.1).unwrap();
    std::fs::write(directory.join("src/main.rs"), source).unwrap();
    build(name, &directory, "--offline")
}

/// Builds a copy of the example whose law panics at tick 500 in the way that the variable `PANIC` selects.
fn panicking() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let example = root().join("examples/motor-pair");
        let text = |file: &str| std::fs::read_to_string(example.join(file)).unwrap();
        let (source, law) = (text("src/main.rs"), "let rise = leader.rise_rad_s2");
        assert!(source.contains(law));
        let source = source.replace(law, &format!("fail(own.stamp.tick);\n        {law}")) + PANICS;
        built("motor-panics", &source, ("motor-pair.toml", &text("motor-pair.toml")))
    })
}

const PANICS: &str = r#"
struct Bomb;
impl Drop for Bomb {
    fn drop(&mut self) {
        panic!("the second panic");
    }
}
fn fail(tick: u64) {
    if tick < 500 {
        return;
    }
    match std::env::var("PANIC").as_deref() {
        Ok("lines") => panic!("the rate is NaN\n  at tick {tick}"),
        Ok("long") => panic!("the rate is NaN{}", "é".repeat(100_000)),
        Ok("any") => std::panic::panic_any(tick),
        Ok("nested") => {
            let _bomb = Bomb;
            panic!("the rate is NaN");
        }
        Ok("index") => {
            let rates = vec![0.0; tick as usize - 500];
            assert!(rates[tick as usize] > 0.0);
        }
        _ => {}
    }
}
"#;

/// A panic that repeats at the same tick ends the run.
#[test]
fn a_panic_of_a_law_is_reported_with_its_message_and_place() {
    let bench = Bench::with_program(panicking());
    for (kind, message, starts) in [
        ("lines", "the rate is NaN\n  at tick 500", 2),
        ("long", "the rate is NaNé", 2),
        ("any", "a value that is not text", 2),
        ("nested", "the rate is NaN", 2),
        ("index", "index out of bounds: the len is 0 but the index is 500", 2),
    ] {
        let run = |line: &[&str], backtrace: &str| {
            let mut command = bench.command();
            Running::new(command.args(line).env("PANIC", kind).env("RUST_BACKTRACE", backtrace)).wait()
        };
        for (clock, starts) in [("lockstep", starts), ("in-process", 1), ("realtime", 3)] {
            if clock == "realtime" && kind != "lines" {
                continue;
            }
            let out = format!("{kind}-{clock}");
            if clock == "in-process" && kind == "nested" {
                // A panic during a panic ends the only process; the first message is printed nevertheless.
                let done = run(&["run", "--clock", clock, "--out", &out], "0");
                assert!(done.stderr.contains("src/main.rs:") && done.stderr.contains(message), "{done:?}");
                continue;
            }
            let line =
                ["run", "--clock", clock, "--out", &out, "--set", "accept={}", "--set", "realtime.lock_memory=false"];
            let done = run(&line, "1");
            assert_eq!(done.code, Some(4), "{out}: {done:?}");
            assert!(!done.stderr.contains("defect"), "{out}: {done:?}");
            let first = done.stderr.lines().find(|line| line.contains("panicked at")).unwrap();
            assert!(first.contains("src/main.rs:"), "{out}: {done:?}");
            let summary = bench.summary_in(&out);
            let incidents = summary["incidents"].as_array().unwrap();
            assert_eq!(incidents.len(), starts, "{out}: {incidents:#?}");
            for (index, incident) in incidents.iter().enumerate() {
                assert_eq!(incident["role"], "controller", "{out}");
                let panic = &incident["panic"];
                assert!(
                    panic["message"].as_str().unwrap().starts_with(message) || clock == "realtime",
                    "{out}: {panic}"
                );
                assert!(panic["place"].as_str().unwrap().starts_with("src/main.rs:"), "{out}: {panic}");
                assert!(incident["cause"].as_str().unwrap().contains("src/main.rs:"), "{out}: {incident}");
                assert_eq!(incident["last_words"], "", "{out}");
                assert_eq!(incident["action"] == "stopped", index + 1 == starts, "{out}: {incident}");
                assert!(clock == "realtime" || incident["tick"] == 500, "{out}: {incident}");
            }
            assert_eq!(summary["books"]["balanced"], true, "{out}");
        }
    }
    bench.assert_clean(&[]);
}
