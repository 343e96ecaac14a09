//! Version 1 of the protocol, as its hosts spoke it: a device of that version may still be a driven body.
//!
//! Must not know anything but that body's three samples: version 1 had no other role, and no hashes of layouts.

use super::frame::{MAX_PAYLOAD, TooLong};
use super::message::{Answer, Hello, MAX_CONTENT, Message, ParseError, Refuse, Samples, Tick, Welcome};
use crate::role::CommandEvent;
use crate::sample::type_name_of;
use serde::{Deserialize, Serialize};

/// The first byte of its payloads.
pub const VERSION: u8 = 1;
/// The longest payload that its devices take, bytes, and the longest content of a sample.
const MAX_OWN_PAYLOAD: usize = 508;
const MAX_OWN_CONTENT: usize = 240;

#[derive(Serialize, Deserialize)]
pub(super) struct Envelope<'a> {
    pub version: u8,
    pub sequence: u32,
    #[serde(borrow)]
    pub said: Said<'a>,
}

#[derive(Serialize, Deserialize)]
pub(super) enum Said<'a> {
    #[serde(borrow)]
    Hello(Greeting<'a>),
    Welcome(Welcome<'a>),
    Refuse(Refuse<'a>),
    Tick {
        tick: u64,
        #[serde(borrow)]
        command: Option<&'a [u8]>,
    },
    Answer {
        echo: u32,
        tick: u64,
        event: CommandEvent,
        measurement: &'a [u8],
        truth: &'a [u8],
    },
    Stop,
}

#[derive(Serialize, Deserialize)]
pub(super) struct Greeting<'a> {
    pub run: u64,
    pub realtime: bool,
    pub period_ns: u64,
    pub last_tick: u64,
    pub timeout_ticks: u64,
    pub manual_rearm: bool,
    pub body: &'a str,
    pub command: &'a str,
    pub measurement: &'a str,
    pub truth: &'a str,
}

/// Whether a device of this version could be a body whose samples have these lengths, bytes: command, measurement, truth.
pub fn fits(inputs: &[usize], outputs: &[usize]) -> bool {
    let short = |lengths: &[usize]| lengths.iter().all(|length| *length <= MAX_OWN_CONTENT);
    inputs.len() == 1 && outputs.len() == 2 && short(inputs) && short(outputs)
}

/// Writes what a host says to a body.
pub fn write<'a>(sequence: u32, message: Message<'_>, payload: &'a mut [u8; MAX_PAYLOAD]) -> Result<&'a [u8], TooLong> {
    let said = match message {
        Message::Hello(hello) => {
            let (measurement, truth) = hello.writes.split_once(' ').unwrap_or((hello.writes, ""));
            let Hello { run, realtime, period_ns, last_tick, timeout_ticks, manual_rearm, role, reads, .. } = hello;
            Said::Hello(Greeting {
                run,
                realtime,
                period_ns,
                last_tick,
                timeout_ticks,
                manual_rearm,
                body: role,
                command: type_name_of(reads),
                measurement: type_name_of(measurement),
                truth: type_name_of(truth),
            })
        }
        Message::Tick(Tick { tick, inputs }) => {
            Said::Tick { tick, command: (inputs.present & 1 == 1).then_some(inputs.bytes) }
        }
        // A host says nothing else.
        _ => Said::Stop,
    };
    let payload = payload.first_chunk_mut::<MAX_OWN_PAYLOAD>().ok_or(TooLong)?;
    let envelope = Envelope { version: VERSION, sequence, said };
    postcard::to_slice(&envelope, payload).map(|payload| &*payload).map_err(|_| TooLong)
}

/// Reads what a device says. Its samples are put together in `room`.
pub fn parse<'a>(payload: &'a [u8], room: &'a mut [u8; MAX_CONTENT]) -> Result<(u32, Message<'a>), ParseError> {
    match payload.first() {
        Some(&VERSION) => {}
        Some(&version) => return Err(ParseError::Version(version)),
        None => return Err(ParseError::Malformed),
    }
    let Ok((Envelope { sequence, said, .. }, [])) = postcard::take_from_bytes::<Envelope<'_>>(payload) else {
        return Err(ParseError::Malformed);
    };
    let message = match said {
        Said::Welcome(welcome) => Message::Welcome(welcome),
        Said::Refuse(refuse) => Message::Refuse(refuse),
        Said::Answer { echo, tick, event, measurement, truth } => {
            let (first, both) = (measurement.len(), measurement.len() + truth.len());
            room.get_mut(..first).ok_or(ParseError::Malformed)?.copy_from_slice(measurement);
            room.get_mut(first..both).ok_or(ParseError::Malformed)?.copy_from_slice(truth);
            let present = if truth.is_empty() { 0b01 } else { 0b11 };
            Message::Answer(Answer { echo, tick, event, outputs: Samples { present, bytes: &room[..both] } })
        }
        // The host's own words, come back.
        Said::Hello(_) | Said::Tick { .. } | Said::Stop => Message::Stop,
    };
    Ok((sequence, message))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The bytes that version 1 had for them.
    #[test]
    fn a_host_speaks_as_it_did() {
        let mut payload = [0; MAX_PAYLOAD];
        let hello = Hello {
            run: 1,
            realtime: true,
            period_ns: 2,
            last_tick: 3,
            timeout_ticks: 4,
            manual_rearm: false,
            role: "b",
            reads: "c#1",
            writes: "m#2 t#3",
        };
        let expected = [1, 9, 0, 1, 1, 2, 3, 4, 0, 1, b'b', 1, b'c', 1, b'm', 1, b't'];
        assert_eq!(write(9, Message::Hello(hello), &mut payload).unwrap(), expected);
        let tick = |present, bytes| Message::Tick(Tick { tick: 300, inputs: Samples { present, bytes } });
        let expected = [1, 9, 3, 0xac, 0x02, 1, 3, 9, 8, 7];
        assert_eq!(write(9, tick(1, &[9, 8, 7]), &mut payload).unwrap(), expected);
        assert_eq!(write(9, tick(0, &[]), &mut payload).unwrap(), [1, 9, 3, 0xac, 0x02, 0]);
        assert_eq!(write(9, Message::Stop, &mut payload).unwrap(), [1, 9, 5]);
    }

    #[test]
    fn a_device_is_understood() {
        let mut room = [0; MAX_CONTENT];
        let with_truth = [1, 0, 4, 1, 2, 5, 2, 4, 4, 1, 6];
        let outputs = Samples { present: 0b11, bytes: &[4, 4, 6] };
        let answer = Message::Answer(Answer { echo: 1, tick: 2, event: CommandEvent::Safe, outputs });
        assert_eq!(parse(&with_truth, &mut room), Ok((0, answer)));
        let outputs = Samples { present: 0b01, bytes: &[4, 4] };
        let answer = Message::Answer(Answer { echo: 1, tick: 2, event: CommandEvent::Safe, outputs });
        assert_eq!(parse(&[1, 0, 4, 1, 2, 5, 2, 4, 4, 0], &mut room), Ok((0, answer)));
        assert_eq!(parse(&[1, 0, 1, 7, 3, 1, b'd'], &mut room).unwrap().1, {
            Message::Welcome(Welcome { run: 7, next_tick: 3, device: "d" })
        });
        assert_eq!(parse(&[2, 0, 5], &mut room), Err(ParseError::Version(2)));
        assert_eq!(parse(&[1, 0, 5], &mut room).unwrap().1, Message::Stop);
    }

    proptest! {
        #[test]
        fn no_payload_makes_it_fail(payload in prop::collection::vec(any::<u8>(), 0..MAX_PAYLOAD)) {
            let _ = parse(&payload, &mut [0; MAX_CONTENT]);
            let _ = parse(&[&[VERSION][..], &payload].concat(), &mut [0; MAX_CONTENT]);
        }
    }
}
