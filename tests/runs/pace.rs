//! A device that sets the pace of a run: the reference device in C, whose timer is off and whose frames are late at times.

use super::serial::start;
use super::udp::Service;
use crate::common::{Bench, Running, root, shipped};
use libc::{SIGINT, SIGKILL, SIGTERM};
use serde_json::Value;
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// Compiles `firmware/c/paced.c`, once.
fn paced() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let program = Path::new(env!("CARGO_BIN_EXE_corotate")).with_file_name("paced");
        let flags = ["-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-lm", "-o"];
        let mut command = Command::new(std::env::var_os("CC").unwrap_or_else(|| "cc".into()));
        let done = command.arg(root().join("firmware/c/paced.c")).args(flags).arg(&program).output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        program
    })
}

/// Starts the device at a free port. Returns it with its address.
fn device(bench: &Bench, ppm: &str) -> (Running, String) {
    let port = UdpSocket::bind("[::]:0").unwrap().local_addr().unwrap().port().to_string();
    let device = Running::new(bench.command_of(paced()).args(["udp", &port, ppm, "200"]));
    (device, format!("127.0.0.1:{port}"))
}

fn bridge(bench: &Bench, address: &str, domain: &Path, arguments: &[&str]) -> Running {
    let domain = domain.to_str().unwrap();
    let common = ["bridge", "--udp", address, "--role", "follower", "--domain", domain, "--pace", "device"];
    bench.start(&[&common[..], arguments].concat())
}

const REALTIME: [&str; 6] =
    ["--tick-hz", "200", "--set", "supervision.heartbeat_timeout_s=60", "--set", "actuator.command_timeout_ticks=200"];

/// Returns the counts that the device prints at its end: of cycles, and of those that slipped.
fn counted(device: Running) -> [u64; 2] {
    device.signal(SIGTERM);
    let done = device.wait();
    let counts: Value = serde_json::from_str(done.stdout.lines().last().unwrap()).unwrap();
    ["cycles", "slips"].map(|key| counts[key].as_u64().unwrap())
}

#[test]
fn the_run_follows_a_device_whose_timer_is_off() {
    let bench = Bench::new();
    let (device, address) = device(&bench, "100");
    let accept = "accept={phase_error_p99_us_max=2000, slips_max=500}";
    let arguments = ["--duration", "8", "--set", accept, "--record", "--junit", "verdict.xml"];
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &[&REALTIME[..], &arguments].concat());
    let bridge = bridge(&bench, &address, &domain, &["--patience", "60"]).wait();
    // On a loaded machine the device may be absent for a while.
    assert!(matches!(bridge.code, Some(0 | 4)) && bridge.stderr.contains("pace of follower"), "{bridge:?}");
    let (run, [cycles, slips]) = (run.wait(), counted(device));
    let summary = run.json();
    let pace = &summary["pace"]["follower"];
    println!("{pace} {cycles} {slips}");
    assert_eq!(pace["state"], "locked", "{bridge:?} {run:?}");
    let number = |key: &str| pace[key].as_f64().unwrap_or_else(|| panic!("{key}: {pace}"));
    assert!((number("drift_ppm") - 100.0).abs() < 50.0 && number("steepest_ppm") <= 10_000.0, "{pace}");
    assert!(number("locked_after_s") < 5.0 && number("corrections") > 20.0, "{pace}");
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    for name in ["phase_error_p99_us_max", "slips_max"] {
        let criterion = summary["criteria"].as_array().unwrap().iter().find(|criterion| criterion["name"] == name);
        assert!(criterion.is_some_and(|criterion| criterion["value"].is_number() && criterion["role"] == "follower"));
    }
    // The device's count of its cycles is the number of the tick, but for cycles in which the machine held it up.
    assert!(cycles + slips >= 1500, "{cycles} cycles, {slips} slips");
    let junit = std::fs::read_to_string(bench.path("verdict.xml")).unwrap();
    assert!(junit.contains("pace drift_ppm of follower") && junit.contains("\"slips_max\""), "{junit}");
    // Tick numbers are the truth: whatever the clock did, the bits of the other roles are repeated.
    // The device integrates in another way than the built-in body.
    for role in ["leader", "observer", "controller"] {
        bench.run(&["replay", bench.path("out").to_str().unwrap(), "--role", role]).succeeded();
    }
    bench.assert_clean(&[domain]);
}

/// Waits until the device is followed and ticks run, then kills the device.
fn lose(bench: &Bench, policy: &str) -> (crate::common::Done, crate::common::Done) {
    let (device, address) = device(bench, "0");
    let arguments = [&REALTIME[..], &["--duration", "30", "--set", "accept={}"]].concat();
    let (run, domain) = start(bench, &shipped("rigid-pair"), &arguments);
    let bridge = bridge(bench, &address, &domain, &["--holdover", "1", "--on-lost", policy, "--patience", "3"]);
    bench.await_commits("follower", 200);
    device.signal(SIGKILL);
    device.wait();
    let bridge = bridge.wait();
    if policy == "safe" {
        run.signal(SIGINT);
    }
    let run = run.wait();
    bench.assert_clean(&[domain]);
    (run, bridge)
}

#[test]
fn a_lost_device_ends_the_run_in_order_if_that_is_the_policy() {
    let bench = Bench::new();
    let (run, bridge) = lose(&bench, "stop");
    assert_eq!((run.code, bridge.code), (Some(4), Some(4)), "{run:?} {bridge:?}");
    assert_eq!(bridge.codes(), ["pace-lost"], "{bridge:?}");
}

#[test]
fn a_lost_device_does_not_end_the_run_otherwise() {
    let bench = Bench::new();
    let (run, bridge) = lose(&bench, "safe");
    assert_eq!((run.code, bridge.code), (Some(130), Some(4)), "{run:?} {bridge:?}");
    assert_eq!(bridge.codes(), ["device-silent"], "{bridge:?}");
}

#[test]
fn only_a_body_with_a_timer_in_real_time_sets_the_pace() {
    let bench = Bench::new();
    let asking = Service::device("127.0.0.1:0");
    let address = asking.address.to_string();
    let arguments = [&REALTIME[..], &["--duration", "60", "--set", "accept={}"]].concat();
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &arguments);
    let done = bridge(&bench, &address, &domain, &[]).wait();
    assert!(done.code == Some(2) && done.codes() == ["no-pace"], "{done:?}");
    run.signal(SIGINT);
    run.wait();
    let bench = Bench::new();
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &["--clock", "lockstep"]);
    let done = bridge(&bench, &address, &domain, &[]).wait();
    assert!(done.code == Some(2) && done.codes() == ["no-pace-clock"], "{done:?}");
    run.signal(SIGINT);
    run.wait();
}
