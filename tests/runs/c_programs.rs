//! Programs in C and C++ that take roles with libcorotate: `examples/c`, and every misuse under sanitizers.

use super::{observed, own_rig};
use crate::common::{Bench, Running, root};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// The programs, and the directory of their headers.
struct Programs {
    directory: PathBuf,
    library: PathBuf,
}

/// Runs a command that must succeed.
fn succeed(command: &mut Command) {
    let done = command.output().unwrap();
    assert!(
        done.status.success(),
        "{command:?}: {}{}",
        String::from_utf8_lossy(&done.stdout),
        String::from_utf8_lossy(&done.stderr)
    );
}

/// Builds library and programs, as the guide does.
fn programs() -> &'static Programs {
    static PROGRAMS: OnceLock<Programs> = OnceLock::new();
    PROGRAMS.get_or_init(|| {
        let library = Path::new(env!("CARGO_BIN_EXE_corotate")).parent().unwrap().to_owned();
        let target = library.parent().unwrap().to_owned();
        let mut command = Command::new(env!("CARGO"));
        command
            .current_dir(root())
            .args(["build", "--locked", "--package", "corotate-capi", "--target-dir"])
            .arg(&target);
        succeed(command.args((!cfg!(debug_assertions)).then_some("--release")));
        let directory = target.join("examples-c");
        let make = |name: &str, value: &Path| format!("{name}={}", value.display());
        let mut command = Command::new("make");
        command.current_dir(root().join("examples/c")).arg("--always-make");
        command.args([make("LIBRARY", &library), make("MOTOR_PAIR", own_rig::program()), make("OUT", &directory)]);
        succeed(&mut command);
        Programs { directory, library }
    })
}

/// Builds a program of `tests/c`, which includes headers of `directory`.
fn compile(source: &str, flags: &[&str], program: &Path) {
    let Programs { directory, library } = programs();
    let mut command = Command::new("cc");
    command.args(["-std=c11", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off"]).args(flags);
    command.arg("-I").arg(root().join("capi/include")).arg("-I").arg(directory);
    command.arg(root().join("tests/c").join(source)).arg("-o").arg(program);
    command.arg("-L").arg(library).args(["-lcorotate", "-lpthread"]);
    succeed(command.arg(format!("-Wl,-rpath,{}", library.display())));
}

/// Runs a rig's scenario with these programs in the seats of roles.
fn run(bench: &Bench, rig: &str, clock: &str, roles: &[(&str, &Path)]) -> (Value, Vec<crate::common::Done>) {
    let mut line = vec!["run", rig, "--clock", clock, "--out", clock, "--json", "--overwrite"];
    line.extend(roles.iter().flat_map(|(role, _)| ["--external", role]));
    let running = bench.start(&line);
    let start = |(role, program): &(&str, &Path)| {
        let seat = bench.await_seat(role);
        Running::new(bench.command_of(program).arg(seat))
    };
    let programs: Vec<Running> = roles.iter().map(start).collect();
    let ended = programs.into_iter().map(Running::wait).collect();
    (running.wait().json(), ended)
}

#[test]
fn a_controller_in_c_and_a_follower_in_cpp_give_the_bits_of_the_built_in_roles() {
    let bench = Bench::with_program(own_rig::program());
    let Programs { directory, .. } = programs();
    let (controller, follower) = (directory.join("controller"), directory.join("follower"));
    let built_in = bench.run(&["run", "motor-pair", "--clock", "in-process", "--json"]).succeeded().json();
    for roles in [
        &[("controller", &*controller)][..],
        &[("follower", &*follower)],
        &[("controller", &*controller), ("follower", &*follower)],
    ] {
        let (summary, ended) = run(&bench, "motor-pair", "lockstep", roles);
        assert!(ended.iter().all(|program| program.code == Some(0)), "{ended:?}");
        assert_eq!(summary["state"]["hash"], built_in["state"]["hash"], "{roles:?}");
        assert_eq!(summary["accepted"], true, "{roles:?}");
    }
}

/// The estimate of its own body is a sample like others, to programs that are no part of the rig.
#[test]
fn a_law_in_c_reads_the_estimates_of_two_bodies() {
    let bench = Bench::with_program(observed::program());
    let header = bench.run(&["seat", "carts", "controller", "--header"]).succeeded().stdout;
    std::fs::write(programs().directory.join("carts.h"), header).unwrap();
    let law = bench.path("law");
    compile("carts.c", &["-O2"], &law);
    let built_in = bench.run(&["run", "carts", "--clock", "in-process", "--json"]).succeeded().json();
    let (summary, ended) = run(&bench, "carts", "lockstep", &[("controller", &law)]);
    assert_eq!((ended[0].code, &summary["accepted"]), (Some(0), &Value::Bool(true)), "{ended:?}");
    assert_eq!(summary["state"]["hash"], built_in["state"]["hash"]);
}

#[test]
fn in_real_time_they_take_part_at_1_khz() {
    let bench = Bench::with_program(own_rig::program());
    let Programs { directory, .. } = programs();
    let (controller, follower) = (directory.join("controller"), directory.join("follower"));
    let (summary, ended) =
        run(&bench, "motor-pair", "realtime", &[("controller", &controller), ("follower", &follower)]);
    assert!(ended.iter().all(|program| program.code == Some(0)), "{ended:?}");
    assert_eq!(summary["state"]["elapsed_ticks"], 10_001);
    // A loaded machine may miss ticks; the loop must settle all the same.
    assert!(summary["score"]["metrics"][0]["last"].as_f64().is_some_and(|error| error < 1.0), "{summary}");
}

#[test]
fn every_misuse_is_refused_without_undefined_behaviour() {
    for (name, sanitizers) in [("memory", "-fsanitize=address,undefined"), ("threads", "-fsanitize=thread")] {
        let program = programs().directory.join(format!("misuse-{name}"));
        compile("misuse.c", &["-g", "-O1", "-fno-sanitize-recover=all", sanitizers], &program);
        let bench = Bench::with_program(own_rig::program());
        let (summary, ended) = run(&bench, "motor-pair", "lockstep", &[("controller", &program)]);
        assert_eq!(ended[0].code, Some(0), "{name}: {:?}", ended[0]);
        assert!(summary["incidents"][0]["last_words"].as_str().unwrap().contains("the end of the trial"), "{summary}");
    }
}
