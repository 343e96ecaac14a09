//! Devices, lines and roles that a bridge refuses.

use super::cable::{CLEAN, Cable, Port};
use super::device::{Powered, scripted};
use super::{REALTIME, bridge, start};
use crate::common::{Bench, shipped};
use corotate::runtime::Line;
use corotate::sample::{RateCommand, Sample};
use corotate::scenario::Scenario;
use corotate::serial::{MAX_FRAME, MAX_PAYLOAD, Message, Reason, Refuse, Welcome, encode, parse, write};
use libc::SIGINT;
use std::path::Path;

fn framed(payload: &[u8]) -> Vec<u8> {
    encode(payload, &mut [0; MAX_FRAME]).unwrap().to_vec()
}

/// Asserts that a bridge to `device` ends with this exit code and prints all `words`.
fn refused(device: impl FnOnce(&Path) -> Option<Powered>, arguments: &[&str], code: i32, words: &[&str]) {
    let bench = Bench::new();
    let cable = Cable::new(CLEAN);
    let _device = device(&cable.device.path);
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &REALTIME);
    let done = bridge(&bench, &cable.host.path, &domain, arguments).wait();
    assert_eq!(done.code, Some(code), "{done:?}");
    for word in words {
        assert!(done.stderr.contains(word), "{word}: {done:?}");
    }
    run.signal(SIGINT);
    run.wait();
    bench.assert_clean(&[domain]);
}

#[test]
fn a_device_with_another_protocol_version_is_refused_naming_both_versions() {
    let outdated = |path: &Path| Some(scripted(path, |_| framed(&[1, 0, 2, 0, 0])));
    refused(outdated, &[], 2, &["version 1", "version 2"]);
}

#[test]
fn a_device_of_another_rig_is_refused_naming_both_sample_types() {
    let orbit = |path: &Path| {
        let scenario = Scenario::load(&shipped("orbit-rendezvous"), &[]).unwrap();
        Some(Powered::of_rig(path, scenario, "follower"))
    };
    refused(orbit, &[], 2, &["corotate/orbit/command/v1", "corotate/rigid-body/command/v2"]);
}

/// Returns the frame of a message from a device.
fn frame(message: Message<'_>) -> Vec<u8> {
    framed(write(0, message, &mut [0; MAX_PAYLOAD]).unwrap())
}

const COMMAND: &str = "corotate/rigid-body/command/v2";
/// Another layout under the same type name.
const SWAPPED: &str = "corotate/rigid-body/command/v2#00000000";

#[test]
fn a_device_with_other_fields_under_the_same_type_name_is_refused() {
    let reply = |_: &[u8]| frame(Message::Refuse(Refuse { reason: Reason::Samples, detail: SWAPPED }));
    refused(|path: &Path| Some(scripted(path, reply)), &[], 2, &[SWAPPED, RateCommand::LAYOUT]);
}

/// Devices of protocol version 2 from before layouts had hashes. This one falls silent after the greeting.
#[test]
fn a_device_without_layout_hashes_is_greeted_without_them() {
    let bare = |path: &Path| {
        let reply = |payload: &[u8]| match parse(payload) {
            Ok((_, Message::Hello(hello))) if hello.reads == COMMAND && !hello.writes.contains('#') => {
                frame(Message::Welcome(Welcome { run: hello.run, next_tick: 0, device: "old 1" }))
            }
            Ok((_, Message::Hello(_))) => frame(Message::Refuse(Refuse { reason: Reason::Samples, detail: COMMAND })),
            _ => Vec::new(),
        };
        Some(scripted(path, reply))
    };
    refused(bare, &["--patience", "2"], 4, &["old 1", "[device-silent]"]);
}

#[test]
fn a_bridge_to_a_device_that_never_answers_ends() {
    refused(|_| None, &["--patience", "0.5"], 1, &["[device-silent]"]);
}

#[test]
fn a_looped_line_is_named_as_the_cause() {
    let echo = |path: &Path| Some(scripted(path, framed));
    refused(echo, &["--patience", "5"], 1, &["[device-silent]", "looped"]);
}

#[test]
fn a_line_at_another_speed_is_named_as_the_cause() {
    let noise = |path: &Path| Some(scripted(path, |payload| vec![0x55; payload.len()]));
    refused(noise, &["--patience", "5"], 1, &["[device-silent]", "--baud"]);
}

#[test]
fn a_line_too_slow_for_the_tick_is_refused() {
    refused(|_| None, &["--baud", "9600"], 2, &["9600", "--baud", "tick_hz"]);
}

#[test]
fn a_bridge_refuses_wrong_roles_domains_and_files_that_are_not_lines() {
    let bench = Bench::new();
    let port = Port::new();
    let (run, domain) = start(&bench, &shipped("rigid-pair"), &REALTIME);
    let file = bench.path("file");
    std::fs::write(&file, "text").unwrap();
    let assert_refused = |path: &Path, role: &str, domain: &Path, code: &str| {
        let (path, domain) = (path.to_str().unwrap(), domain.to_str().unwrap());
        let done = bench.run(&["bridge", "--serial", path, "--role", role, "--domain", domain]);
        assert!(done.code == Some(2) && done.codes() == [code], "{path} {role} {domain}: {done:?}");
    };
    for path in [&file, &domain, Path::new("/dev/null")] {
        assert_refused(path, "follower", &domain, "not-a-terminal");
    }
    assert_refused(&bench.path("missing"), "follower", &domain, "cannot-open-line");
    assert_refused(&port.path, "leader", &domain, "no-device-role");
    assert_refused(&port.path, "moon", &domain, "no-such-role");
    assert_refused(&port.path, "follower", &bench.path("missing"), "not-a-domain");
    let _held = Line::open(&port.path, None).unwrap();
    assert_refused(&port.path, "follower", &domain, "line-in-use");
    run.signal(SIGINT);
    run.wait();
}

#[test]
fn a_body_on_a_device_needs_an_actuation_delay_of_one_tick() {
    let bench = Bench::new();
    let port = Port::new();
    let (run, domain) =
        start(&bench, &shipped("rigid-pair"), &[&REALTIME[..], &["--set=actuation_delay_ticks=2"]].concat());
    let done = bridge(&bench, &port.path, &domain, &[]).wait();
    assert_eq!(done.code, Some(2), "{done:?}");
    for word in ["[device-delay]", "actuation_delay_ticks = 2"] {
        assert!(done.stderr.contains(word), "{word}: {done:?}");
    }
    run.signal(SIGINT);
    run.wait();
    bench.assert_clean(&[domain]);
}
