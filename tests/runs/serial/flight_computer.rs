//! Devices that are observer, controller or both; the plants are simulated.

use super::cable::{CLEAN, Cable, FAULTY};
use super::device::Powered;
use super::{
    LOCKSTEP, NAP, REALTIME, bridge_of, continue_after_a_killed_bridge, incidents, number, short, start_without,
    summary_of, sync_error,
};
use crate::common::{Bench, shipped};
use corotate::rig::Rig;
use corotate::runtime::Line;
use corotate::serial::{Device, DeviceFlightComputer, Hello};
use corotate::with_shipped_rig;
use serde_json::Value;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// The roles that a device can have besides a body, as on the command line and as in the greeting.
const COMPUTERS: [(&[&str], &str); 3] = [
    (&["observer"], "observer"),
    (&["controller"], "controller"),
    (&["observer", "controller"], "observer controller"),
];

/// Runs a shipped scenario with a device that has the given roles.
fn run_roles(bench: &Bench, scenario: &str, roles: &[&str], path: &Path, arguments: &[&str]) -> Value {
    let (run, domain) = start_without(bench, &shipped(scenario), roles, arguments);
    let bridge = bridge_of(bench, &roles.join(","), path, &domain, &[]);
    let (run, bridge) = (run.wait(), bridge.wait());
    bench.assert_clean(&[domain]);
    summary_of(&run, &bridge)
}

/// Processor in the loop: the plants are simulated.
#[test]
fn in_lockstep_a_device_may_be_observer_or_controller_or_both_in_any_rig() {
    let bench = Bench::new();
    for name in ["rigid-pair", "orbit-rendezvous"] {
        let arguments = ["--clock", "lockstep", "--duration", "1", "--set", "accept={}"];
        let built_in = bench.summary(name, &arguments);
        for (roles, role) in COMPUTERS {
            let cable = Cable::new(CLEAN);
            let _device = Powered::of_rig(&cable.device.path, short(name, &["duration_s=1", "accept={}"]), role);
            let with_device = run_roles(&bench, name, roles, &cable.host.path, &arguments);
            assert_eq!(with_device["state"]["hash"], built_in["state"]["hash"], "{name}: {role}");
            assert_eq!(with_device["books"]["roles"], built_in["books"]["roles"], "{name}: {role}");
            // All roles of a line share one handshake. A late device is greeted again after 8 requests, 7 of them repeated.
            let line = &with_device["lines"][roles[0]];
            let (handshakes, repeats) = (number(&line["handshakes"]), number(&line["repeats"]));
            assert!(handshakes >= 1 && 7 * (handshakes - 1) <= repeats, "{line:#}");
        }
    }
}

/// Dropped and out-of-range measurements are injected as well.
#[test]
fn in_lockstep_a_flight_computer_on_a_faulty_line_gives_the_same_bits() {
    let bench = Bench::new();
    let cable = Cable::new(FAULTY);
    let lost = "fault=[{kind=\"drop\", role=\"leader\", from_tick=100, ticks=3}, {kind=\"out-of-range\", value=1e3, role=\"leader\", \
                from_tick=300, ticks=2}, {kind=\"drop\", role=\"follower\", from_tick=200, ticks=30}]";
    let arguments = [&LOCKSTEP[..], &["--set", "accept={}", "--set", lost]].concat();
    let scenario = short("rigid-pair", &["duration_s=10", "tick_hz=100", "accept={}"]);
    let _device = Powered::of_rig(&cable.device.path, scenario, "observer controller");
    let with_device = run_roles(&bench, "rigid-pair", &["observer", "controller"], &cable.host.path, &arguments);
    let built_in = bench.summary("rigid-pair", &arguments);
    assert_eq!(with_device["state"]["hash"], built_in["state"]["hash"]);
    assert_eq!(with_device["books"]["roles"], built_in["books"]["roles"]);
    assert!(number(&built_in["books"]["injected_faults"]) >= 33, "{}", built_in["books"]);
    let line = &with_device["lines"]["observer"];
    println!("{line}");
    assert!(number(&line["repeats"]) > 20 && number(&line["crc_errors"]) > 5, "{line}");
}

#[test]
fn in_real_time_a_flight_computer_synchronises() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let scenario = short("rigid-pair", &["duration_s=8", "tick_hz=100", "accept={}"]);
    let _device = Powered::of_rig(&cable.device.path, scenario, "observer controller");
    let summary = run_roles(&bench, "rigid-pair", &["observer", "controller"], &cable.host.path, &REALTIME);
    let (error, roles) = (sync_error(&summary), &summary["books"]["roles"]);
    println!("{error:e} rad/s; {roles}; line {}", summary["lines"]["observer"]);
    for role in ["observer", "controller"] {
        assert_eq!(number(&roles[role]["executed"]) + number(&roles[role]["missed"]), 801);
    }
    let limit = if number(&summary["books"]["missed_ticks"]) < 200 { 1e-6 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    let serial = summary["latencies"].as_array().unwrap().iter().find(|stage| stage["stage"] == "serial").unwrap();
    assert_eq!(
        (&serial["role"], number(&serial["count"]) - number(&serial["missed"])),
        (&Value::from("observer"), number(&roles["observer"]["executed"]))
    );
}

#[test]
fn a_flight_computer_that_pauses_misses_the_ticks_of_its_pause() {
    const PAUSE: Duration = Duration::from_millis(300);
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let (path, scenario) =
        (cable.device.path.clone(), short("rigid-pair", &["duration_s=30", "tick_hz=100", "accept={}"]));
    let _device = Powered::new(move |on| {
        with_shipped_rig!(scenario.rig, rig => {
            let seat = |hello: &Hello<'_>| Some(DeviceFlightComputer::new(rig.estimator(), [rig.law(1)], hello));
            let (mut line, mut device) = (Line::open(&path, None).unwrap(), Device::new("sleepy", seat));
            let (mut bytes, mut answers) = ([0; 512], 0);
            while on.load(Ordering::Relaxed) {
                let count = line.read(&mut bytes);
                device.receive(&bytes[..count], 0, |frame| {
                    answers += 1;
                    if answers == 50 {
                        std::thread::sleep(PAUSE);
                    }
                    line.write(frame);
                });
                std::thread::sleep(NAP);
            }
        })
    });
    let longer = REALTIME.map(|argument| if argument == "8" { "30" } else { argument });
    let summary = run_roles(&bench, "rigid-pair", &["observer", "controller"], &cable.host.path, &longer);
    let books = &summary["books"]["roles"];
    println!("{books}; line {}", summary["lines"]["observer"]);
    assert_eq!(summary["books"]["balanced"], true, "{summary:#}");
    for role in ["observer", "controller"] {
        assert!(number(&books[role]["missed"]) >= 28, "{books}");
        // A loaded machine misses more. A role that stops at the pause has executed at most 50.
        assert!(number(&books[role]["executed"]) > 100, "{books}");
    }
}

#[test]
fn plants_go_safe_while_a_flight_computer_is_silent_and_another_replaces_it() {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let flight = |path: &Path| {
        Powered::of_rig(
            path,
            short("rigid-pair", &["duration_s=16", "tick_hz=100", "accept={}"]),
            "observer controller",
        )
    };
    let device = flight(&cable.device.path);
    let roles = ["observer", "controller"];
    let longer = REALTIME.map(|argument| if argument == "8" { "16" } else { argument });
    let (run, domain) = start_without(&bench, &shipped("rigid-pair"), &roles, &longer);
    // The bridge must not give a late device up before the test removes it.
    let first = bridge_of(&bench, "observer,controller", &cable.host.path, &domain, &["--patience", "5"]);
    cable.await_ticks();
    drop(device);
    let first = first.wait();
    assert_eq!(first.code, Some(4), "{first:?}");
    assert!(first.says("device-silent"), "{first:?}");
    let _device = flight(&cable.device.path);
    let second = bridge_of(&bench, "observer,controller", &cable.host.path, &domain, &[]);
    let (run, second) = (run.wait(), second.wait());
    let summary = summary_of(&run, &second);
    // The second device has replaced the first in both roles.
    let replaced = incidents(&summary, "continued");
    for role in roles {
        let found = replaced.iter().find(|incident| incident["role"] == role && incident["replaced_by"].is_object());
        assert!(found.is_some(), "{role}: {replaced:?}");
    }
    let books = &summary["books"]["roles"];
    println!("{books}");
    assert!(number(&books["follower"]["safe"]) > 0, "{books}");
    assert!(number(&books["controller"]["missed"]) > 20, "{books}");
    let error = sync_error(&summary);
    let limit = if number(&summary["books"]["missed_ticks"]) < 600 { 1e-3 } else { 1.0 };
    assert!(error < limit, "{error:e}: {summary:#}");
    bench.assert_clean(&[domain]);
}

#[test]
fn a_killed_bridge_of_a_flight_computer_can_be_started_again() {
    continue_after_a_killed_bridge(&["observer", "controller"], |path| {
        let scenario = short("rigid-pair", &["duration_s=60", "tick_hz=100", "accept={}"]);
        Powered::of_rig(path, scenario, "observer controller")
    });
}
