//! Devices behind a serial line: the bridge as a process, the device in a thread, and between them a cable of two ptys that may be
//! faulty, unplugged and plugged in again.

mod cable;
mod device;
mod failures;
mod flight_computer;
mod refusals;
#[path = "../../../examples/serial_device.rs"]
pub(super) mod serial_device;

use crate::common::{Bench, Done, Running, shipped};
use cable::{CLEAN, Cable, FAULTY};
use corotate::scenario::Scenario;
use device::Powered;
use libc::SIGKILL;
use rand_pcg::Pcg64;
use rand_pcg::rand_core::{Rng, SeedableRng};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::Duration;

const NAP: Duration = Duration::from_micros(50);

/// Starts a run with an external follower. Returns it with its domain.
pub(super) fn start(bench: &Bench, file: &Path, arguments: &[&str]) -> (Running, PathBuf) {
    start_without(bench, file, &["follower"], arguments)
}

/// Starts a run with external roles. Returns it with its domain.
fn start_without(bench: &Bench, file: &Path, roles: &[&str], arguments: &[&str]) -> (Running, PathBuf) {
    let common = ["run", file.to_str().unwrap(), "--json", "--out", "out", "--overwrite"];
    let external: Vec<&str> = roles.iter().flat_map(|role| ["--external", *role]).collect();
    let running = bench.start(&[&common[..], &external, arguments].concat());
    bench.await_role("leader");
    (running, bench.domains().remove(0))
}

fn bridge(bench: &Bench, path: &Path, domain: &Path, arguments: &[&str]) -> Running {
    bridge_of(bench, "follower", path, domain, arguments)
}

fn bridge_of(bench: &Bench, roles: &str, path: &Path, domain: &Path, arguments: &[&str]) -> Running {
    let (path, domain) = (path.to_str().unwrap(), domain.to_str().unwrap());
    let common = ["bridge", "--serial", path, "--role", roles, "--domain", domain];
    bench.start(&[&common[..], arguments].concat())
}

/// Runs a shipped scenario with the device at `path` as the follower.
fn run_with(bench: &Bench, scenario: &str, path: &Path, arguments: &[&str]) -> Value {
    let (run, domain) = start(bench, &shipped(scenario), arguments);
    let bridge = bridge(bench, path, &domain, &[]);
    let (run, bridge) = (run.wait(), bridge.wait());
    let sent = number(&run.json()["lines"]["follower"]["frames_sent"]);
    assert!(bridge.stderr.contains(&format!("{sent} frames")), "{sent}: {bridge:?}");
    bench.assert_clean(&[domain]);
    summary_of(&run, &bridge)
}

/// Returns the summary of a run. On a loaded machine the device may be absent for a while; run and bridge then both report it.
fn summary_of(run: &Done, bridge: &Done) -> Value {
    let summary = run.json();
    assert_eq!(run.code, Some(0), "{run:?}");
    let absent = incidents(&summary, "continued").iter().any(|incident| incident["replaced_by"].is_null());
    assert_eq!(bridge.code, Some(if absent { 4 } else { 0 }), "{bridge:?} {run:?}");
    assert!(!absent || summary["clock"] == "realtime", "{summary:#}");
    summary
}

/// Returns the incidents of a run with the given action.
fn incidents(summary: &Value, action: &str) -> Vec<Value> {
    let all = summary["incidents"].as_array().unwrap();
    all.iter().filter(|incident| incident["action"] == action).cloned().collect()
}

fn number(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value} is not a count"))
}

/// Returns the first metric at the end of a run.
fn sync_error(summary: &Value) -> f64 {
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    summary["score"]["metrics"][0]["last"].as_f64().unwrap()
}

fn short(scenario: &str, arguments: &[&str]) -> Scenario {
    let overrides: Vec<String> = arguments.iter().map(|argument| (*argument).to_owned()).collect();
    Scenario::parse(&std::fs::read_to_string(shipped(scenario)).unwrap(), "test", &overrides).unwrap()
}

/// Kills the bridge of a device during a run and starts another. Asserts that the run has the bits of an undisturbed one, and
/// returns its summary.
fn continue_after_a_killed_bridge(roles: &[&str], device: impl FnOnce(&Path) -> Powered) -> Value {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = device(&cable.device.path);
    let (run, domain) = start_without(&bench, &shipped("rigid-pair"), roles, &LONG);
    let first = bridge_of(&bench, &roles.join(","), &cable.host.path, &domain, &[]);
    cable.await_ticks();
    first.signal(SIGKILL);
    assert_eq!(first.wait().signal, Some(SIGKILL));
    let second = bridge_of(&bench, &roles.join(","), &cable.host.path, &domain, &[]);
    let (run, second) = (run.wait(), second.wait());
    assert_eq!(second.code, Some(0), "{second:?} {run:?}");
    let with_device = run.succeeded().json();
    assert_eq!(with_device["state"]["hash"], bench.summary("rigid-pair", &LONG)["state"]["hash"]);
    bench.assert_clean(&[domain]);
    with_device
}

const LOCKSTEP: [&str; 6] = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "10"];
/// Long enough for a disturbance during the run.
const LONG: [&str; 8] = ["--clock", "lockstep", "--tick-hz", "100", "--duration", "60", "--set", "accept={}"];
/// On a loaded machine a bridge may send no heartbeat for seconds.
const PATIENT: &str = "--set=supervision.heartbeat_timeout_s=60";
const REALTIME: [&str; 9] =
    ["--clock", "realtime", "--tick-hz", "100", "--duration", "8", "--set", "accept={}", PATIENT];

#[test]
fn in_lockstep_a_device_gives_the_bits_of_the_built_in_follower() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let device = Powered::reference(&cable.device.path);
    let with_device = run_with(&bench, "rigid-pair", &cable.host.path, &LOCKSTEP);
    let built_in = bench.summary("rigid-pair", &LOCKSTEP);
    assert_eq!(with_device["state"]["hash"], built_in["state"]["hash"]);
    assert_eq!(with_device["books"]["roles"], built_in["books"]["roles"]);
    let line = &with_device["lines"]["follower"];
    assert_eq!((number(&line["restarts"]), number(&line["crc_errors"]), number(&line["malformed"])), (0, 0, 0));
    assert!(number(&line["frames_received"]) >= 1002, "{line}");
    drop(device);
}

/// The bridge holds the fields of a device's measurement as a simulated body's.
#[test]
fn in_lockstep_a_device_with_a_slower_sensor_gives_the_same_bits() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = Powered::reference(&cable.device.path);
    let sensor = r#"sensor=[{body="follower",field="omega_rad_s",every_ticks=4,phase_ticks=1}]"#;
    let slow = [&LOCKSTEP[..], &["--set", sensor, "--set", "accept={}"]].concat();
    let with_device = run_with(&bench, "rigid-pair", &cable.host.path, &slow);
    assert_eq!(with_device["state"]["hash"], bench.summary("rigid-pair", &slow)["state"]["hash"]);
    assert_ne!(with_device["state"]["hash"], bench.summary("rigid-pair", &LOCKSTEP)["state"]["hash"]);
}

/// Requests are repeated until they are answered, and no tick is executed twice.
#[test]
fn in_lockstep_a_faulty_line_gives_the_same_bits() {
    let bench = Bench::new();
    let cable = Cable::new(FAULTY);
    let _device = Powered::reference(&cable.device.path);
    let with_device = run_with(&bench, "rigid-pair", &cable.host.path, &LOCKSTEP);
    assert_eq!(with_device["state"]["hash"], bench.summary("rigid-pair", &LOCKSTEP)["state"]["hash"]);
    let line = &with_device["lines"]["follower"];
    println!("{line}");
    assert!(number(&line["repeats"]) > 20 && number(&line["crc_errors"]) > 5 && number(&line["resyncs"]) > 5, "{line}");
    assert_eq!(number(&line["unanswered"]), 0, "{line}");
}

#[test]
fn a_device_may_be_the_body_of_any_rig() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let arguments = ["--clock", "lockstep", "--duration", "5", "--set", "accept={}"];
    let scenario = Scenario::load(&shipped("orbit-rendezvous"), &[]).unwrap();
    let scenario = Scenario::parse(&scenario.to_toml(), "test", &["duration_s=5".to_owned(), "accept={}".to_owned()]);
    let _device = Powered::of_rig(&cable.device.path, scenario.unwrap(), "follower");
    let with_device = run_with(&bench, "orbit-rendezvous", &cable.host.path, &arguments);
    assert_eq!(with_device["state"]["hash"], bench.summary("orbit-rendezvous", &arguments)["state"]["hash"]);
}

#[test]
fn in_real_time_a_device_synchronises() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = Powered::reference(&cable.device.path);
    let summary = run_with(&bench, "rigid-pair", &cable.host.path, &REALTIME);
    let (error, ticks) = (sync_error(&summary), &summary["books"]["roles"]["follower"]);
    let line = &summary["lines"]["follower"];
    println!("{error:e} rad/s; follower {ticks}; line {line}");
    assert_eq!(number(&ticks["executed"]) + number(&ticks["missed"]), 801);
    // A loaded machine misses ticks, and the bodies synchronise later.
    let limit = if number(&summary["books"]["missed_ticks"]) < 200 { 1e-6 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    let serial = summary["latencies"].as_array().unwrap().iter().find(|stage| stage["stage"] == "serial").unwrap();
    println!("round trip {serial}");
    let answered = number(&serial["count"]) - number(&serial["missed"]);
    assert_eq!((&serial["role"], answered), (&Value::from("follower"), number(&ticks["executed"])));
    assert!(bench.path("out/latency/follower.serial.hgrm").is_file());
}

/// Lost ticks count as missed.
#[test]
fn in_real_time_the_bodies_synchronise_over_a_faulty_line() {
    let bench = Bench::new();
    let cable = Cable::new(FAULTY);
    let _device = Powered::reference(&cable.device.path);
    let summary = run_with(&bench, "rigid-pair", &cable.host.path, &REALTIME);
    let (error, ticks) = (sync_error(&summary), &summary["books"]["roles"]["follower"]);
    let line = &summary["lines"]["follower"];
    println!("{error:e} rad/s; follower {ticks}; line {line}");
    assert_eq!(number(&ticks["executed"]) + number(&ticks["missed"]), 801);
    assert!(number(&line["resyncs"]) > 5 && number(&line["crc_errors"]) > 0, "{line}");
    assert!(number(&line["unanswered"]) <= number(&ticks["missed"]), "{line}");
    let limit = if number(&summary["books"]["missed_ticks"]) < 300 { 1e-3 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
}

/// There is noise on the line before the handshake and during the run.
#[test]
fn garbage_before_the_handshake_is_dropped_and_counted() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = Powered::reference(&cable.device.path);
    let host = cable.host.clone();
    let noise = Powered::new(move |on| {
        let mut random = Pcg64::seed_from_u64(3);
        while on.load(Ordering::Relaxed) {
            let garbage: Vec<u8> = (0..100).map(|_| random.next_u64() as u8).collect();
            host.write(&garbage);
            std::thread::sleep(10 * NAP);
        }
    });
    let summary = run_with(&bench, "rigid-pair", &cable.host.path, &LOCKSTEP);
    drop(noise);
    let line = &summary["lines"]["follower"];
    println!("{line}");
    assert!(number(&line["dropped_bytes"]) > 10_000 && number(&line["malformed"]) > 100, "{line}");
    assert_eq!(summary["state"]["hash"], bench.summary("rigid-pair", &LOCKSTEP)["state"]["hash"]);
}
