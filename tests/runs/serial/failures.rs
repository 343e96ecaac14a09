//! Devices and bridges that fail, are unplugged or replaced during a run.

use super::cable::{Adapter, CLEAN, Cable};
use super::device::Powered;
use super::serial_device::{Follower, NAME};
use super::{
    LONG, NAP, REALTIME, bridge, bridge_of, continue_after_a_killed_bridge, incidents, number, short, start,
    start_without, sync_error,
};
use crate::common::{Bench, await_some, shipped};
use corotate::runtime::Line;
use corotate::serial::Device;
use libc::SIGINT;
use serde_json::Value;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

#[test]
fn a_device_that_is_unplugged_and_plugged_in_again_continues() {
    let bench = Bench::new();
    let adapter = Adapter::plug_in(&bench);
    let _device = Powered::reference(&bench.path("tty-device"));
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &REALTIME);
    let bridge = bridge(&bench, &bench.path("tty-host"), &domain, &["--patience", "60"]);
    adapter.cable.await_ticks();
    drop(adapter);
    std::thread::sleep(Duration::from_millis(500));
    let _adapter = Adapter::plug_in(&bench);
    let (run, bridge) = (run.wait(), bridge.wait());
    // A command expires after 50 ms, and the cable was unplugged for longer.
    assert_eq!(bridge.code, Some(4), "{bridge:?} {run:?}");
    let summary = run.succeeded().json();
    let absent = incidents(&summary, "continued");
    let is_long = |incident: &&Value| incident["outage_s"].as_f64().is_some_and(|outage_s| outage_s > 0.3);
    let outage = absent.iter().find(is_long).unwrap_or_else(|| panic!("{absent:?}"));
    assert_eq!(outage["role"], "follower", "{outage}");
    let (error, ticks) = (sync_error(&summary), &summary["books"]["roles"]["follower"]);
    let line = &summary["lines"]["follower"];
    println!("{error:e} rad/s; follower {ticks}; line {line}");
    assert!(number(&line["reopened"]) >= 1 && number(&line["handshakes"]) >= 2, "{line}");
    assert!(number(&ticks["missed"]) >= 30 && number(&ticks["executed"]) > 0, "{ticks}");
    let limit = if number(&summary["books"]["missed_ticks"]) < 300 { 1e-3 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    bench.assert_clean(&[domain]);
}

#[test]
fn a_bridge_whose_device_stays_unplugged_ends_with_a_reason() {
    let bench = Bench::new();
    let adapter = Adapter::plug_in(&bench);
    let _device = Powered::reference(&bench.path("tty-device"));
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &["--clock", "lockstep", "--duration", "100000"]);
    let bridge = bridge(&bench, &bench.path("tty-host"), &domain, &["--patience", "0.5"]);
    adapter.cable.await_ticks();
    drop(adapter);
    let bridge = bridge.wait();
    assert_eq!(bridge.code, Some(4), "{bridge:?}");
    assert!(bridge.says("device-silent"), "{bridge:?}");
    run.signal(SIGINT);
    run.wait();
}

/// The run goes on without it.
#[test]
fn a_controller_that_stays_unplugged_is_an_incident_with_tick_and_time() {
    let bench = Bench::new();
    let adapter = Adapter::plug_in(&bench);
    let scenario = short("rigid-pair", &["duration_s=8", "tick_hz=100", "accept={}"]);
    let _device = Powered::of_rig(&bench.path("tty-device"), scenario, "controller");
    let (run, domain) = start_without(&bench, &shipped("rigid-pair"), &["controller"], &REALTIME);
    let bridge = bridge_of(&bench, "controller", &bench.path("tty-host"), &domain, &["--patience", "60", "--json"]);
    adapter.cable.await_ticks();
    drop(adapter);
    let (run, bridge) = (run.wait(), bridge.wait());
    assert_eq!(bridge.code, Some(4), "{bridge:?} {run:?}");
    let report = bridge.json();
    let summary = run.json();
    let absent = incidents(&summary, "continued");
    let last = absent.last().unwrap_or_else(|| panic!("{summary:#}"));
    assert_eq!((&last["role"], &last["outage_s"]), (&Value::from("controller"), &Value::Null), "{last}");
    assert!((last["time_s"].as_f64().unwrap() - number(&last["tick"]) as f64 / 100.0).abs() < 1e-9, "{last}");
    let outage = report["outages"].as_array().unwrap().last().unwrap();
    assert_eq!((&outage["tick"], &outage["back_at_tick"]), (&last["tick"], &Value::Null));
    assert!(outage["seconds"].as_f64().unwrap() > 0.5, "{outage}");
    bench.assert_clean(&[domain]);
}

/// A device with another name is refused, or with --allow-other-device accepted and reported.
#[test]
fn a_device_with_another_name_ends_the_run_unless_allowed() {
    for (options, code) in [(&["--patience", "60"][..], 4), (&["--patience", "60", "--allow-other-device"], 0)] {
        let bench = Bench::new();
        let cable = Cable::new(CLEAN);
        let device = Powered::reference(&cable.device.path);
        let (run, domain) = start(&bench, &shipped("rigid-pair"), &LONG);
        let bridge = bridge(&bench, &cable.host.path, &domain, options);
        cable.await_ticks();
        drop(device);
        let scenario = short("rigid-pair", &["duration_s=60", "tick_hz=100", "accept={}"]);
        let _device = Powered::of_rig(&cable.device.path, scenario, "follower");
        let (run, bridge) = (run.wait(), bridge.wait());
        assert_eq!((bridge.code, run.code), (Some(code), Some(code)), "{bridge:?} {run:?}");
        let summary = run.json();
        let replaced = incidents(&summary, if code == 0 { "continued" } else { "stopped" });
        let text = |incident: &Value| format!("{} {}", incident["cause"], incident["last_words"]);
        assert!(replaced.len() == 1 && text(&replaced[0]).contains("any"), "{replaced:?}");
        assert!(code == 0 || bridge.stderr.contains(NAME), "{bridge:?}");
        bench.assert_clean(&[domain]);
    }
}

/// The next bridge continues with the persistent counters, and the device recognises the run.
#[test]
fn a_killed_bridge_can_be_started_again() {
    let with_device = continue_after_a_killed_bridge(&["follower"], Powered::reference);
    assert_eq!(number(&with_device["books"]["roles"]["follower"]["executed"]), 6001);
}

/// Its body starts again at the initial state, and the run goes on.
#[test]
fn a_restarted_device_is_reported_as_an_incident() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let device = Powered::reference(&cable.device.path);
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &LONG);
    let bridge = bridge(&bench, &cable.host.path, &domain, &["--patience", "60"]);
    cable.await_ticks();
    drop(device);
    let _device = Powered::reference(&cable.device.path);
    let (run, bridge) = (run.wait(), bridge.wait());
    assert_eq!(bridge.code, Some(0), "{bridge:?} {run:?}");
    assert!(run.says("device-restarted"), "{run:?}");
    let summary = run.succeeded().json();
    let lost = incidents(&summary, "continued");
    assert!(lost.len() == 1 && lost[0]["role"] == "follower" && lost[0]["code"] == "device-restarted", "{lost:?}");
    assert!(bridge.stderr.contains("initial state"), "{bridge:?}");
    let line = &summary["lines"]["follower"];
    // A bridge greets a device again after a long silence.
    assert_eq!((number(&line["restarts"]), number(&line["handshakes"]) >= 2), (1, true), "{line}");
    assert!(number(&summary["state"]["first_disturbed_tick"]) > 0, "{}", summary["state"]);
    assert_ne!(summary["state"]["hash"], bench.summary("rigid-pair", &LONG)["state"]["hash"]);
    bench.assert_clean(&[domain]);
}

/// The bridge sends the end of the run, upon which the device goes safe.
#[test]
fn an_interrupted_bridge_leaves_its_device_safe() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let path = cable.device.path.clone();
    let safe = Arc::new(AtomicBool::new(true));
    let flag = safe.clone();
    let _device = Powered::new(move |on| {
        let mut device = Device::new(NAME, Follower::asked_for);
        let mut line = Line::open(&path, None).unwrap();
        let mut bytes = [0; 512];
        while on.load(Ordering::Relaxed) {
            let count = line.read(&mut bytes);
            // The device's clock stands at 0, so it cannot go safe by a timeout.
            device.receive(&bytes[..count], 0, |frame| {
                line.write(frame);
            });
            flag.store(device.is_safe(), Ordering::Relaxed);
            std::thread::sleep(NAP);
        }
    });
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &["--clock", "lockstep", "--duration", "100000"]);
    let bridge = bridge(&bench, &cable.host.path, &domain, &[]);
    await_some(|| (!safe.load(Ordering::Relaxed)).then_some(()));
    bridge.signal(SIGINT);
    bridge.wait().succeeded();
    await_some(|| safe.load(Ordering::Relaxed).then_some(()));
    run.signal(SIGINT);
    run.wait();
}
