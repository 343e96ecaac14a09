//! The frames in `docs/serial-protocol.md` are compared with those of this module.

use super::*;
use crate::role::CommandEvent;
use crate::sample::{Message as _, RateCommand, RateMeasurement, RateTruth};
use std::fmt::Write;

const DOCUMENT: &str = include_str!("../../../../docs/serial-protocol.md");
const READS: &str = "corotate/rigid-body/command/v2#ff8ce508";
const WRITES: &str = "corotate/rigid-body/measurement/v1#bcfd8b41 corotate/rigid-body/truth/v1#6b083b5d";

fn bytes(text: &str) -> Vec<u8> {
    text.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

fn dump(bytes: &[u8]) -> String {
    let line = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(" ");
    bytes.chunks(32).map(line).collect::<Vec<_>>().join("\n         ")
}

/// Returns every frame of the document: its title, payload and frame.
fn shown() -> Vec<(String, Vec<u8>, Vec<u8>)> {
    let blocks = DOCUMENT.split("```").skip(1).step_by(2);
    let frame = |block: &str| {
        let (title, rest) = block.trim_start_matches("text\n").split_once("\npayload ").unwrap();
        let (payload, frame) = rest.split_once("\nframe ").unwrap();
        (title.to_owned(), bytes(payload), bytes(frame))
    };
    blocks.map(frame).collect()
}

/// Returns every message of the document.
fn messages() -> Vec<(&'static str, Vec<u8>)> {
    let (omega_rad_s, applied_rad_s2) = ([1.0, -0.5, 0.0], [0.5, -1.0, 0.25]);
    let command = RateCommand { acceleration_rad_s2: applied_rad_s2, ..RateCommand::default() };
    let measurement = RateMeasurement { omega_rad_s, applied_rad_s2, valid: 7, ..RateMeasurement::default() };
    let truth = RateTruth { omega_rad_s, applied_rad_s2, ..RateTruth::default() };
    let whole = [measurement.content(), truth.content()].concat();
    let hello = Hello {
        run: 300,
        realtime: true,
        period_ns: 10_000_000,
        last_tick: 1000,
        timeout_ticks: 20,
        manual_rearm: false,
        role: "follower",
        reads: READS,
        writes: WRITES,
    };
    let tick = |present, bytes| Message::Tick(Tick { tick: 200, inputs: Samples { present, bytes } });
    let answer = |present, event, bytes| {
        Message::Answer(Answer { echo: 129, tick: 200, event, outputs: Samples { present, bytes } })
    };
    let welcome = Message::Welcome(Welcome { run: 300, next_tick: 0, device: "board 1" });
    let refuse = Message::Refuse(Refuse { reason: Reason::NotGreeted, detail: "greet me first" });
    let payload = |sequence, message| write(sequence, message, &mut [0; MAX_PAYLOAD]).unwrap().to_vec();
    let applied = CommandEvent::Applied;
    vec![
        ("Hello to a body, sequence 0", payload(0, Message::Hello(hello))),
        ("Welcome, sequence 0: it begins", payload(0, welcome)),
        ("Refuse, sequence 0: it was not greeted", payload(0, refuse)),
        ("Tick 200 with a command of 0.5, -1, 0.25 rad/s^2, sequence 129", payload(129, tick(1, command.content()))),
        ("Tick 200 without a command, sequence 129", payload(129, tick(0, &[]))),
        ("Answer to it, sequence 1: applied, measurement and truth", payload(1, answer(3, applied, &whole))),
        (
            "Answer to it, sequence 1: held, without a truth",
            payload(1, answer(1, CommandEvent::Held, measurement.content())),
        ),
        ("Stop, sequence 130", payload(130, Message::Stop)),
    ]
}

#[test]
fn the_documented_frames_are_those_on_the_line() {
    let mut expected = String::new();
    let mut all = Vec::new();
    for (title, payload) in messages() {
        let frame = encode(&payload, &mut [0; MAX_FRAME]).unwrap().to_vec();
        write!(expected, "```text\n{title}\npayload  {}\nframe    {}\n```\n\n", dump(&payload), dump(&frame)).unwrap();
        all.push((title.to_owned(), payload, frame));
    }
    assert!(shown() == all, "docs/serial-protocol.md does not show these frames:\n\n{expected}");
}
