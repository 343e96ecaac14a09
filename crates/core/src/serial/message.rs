//! The messages and their encoding in a payload, as in the tables of `docs/serial-protocol.md`.
//!
//! A sample is sent as the bytes after its stamp, so that no message depends on a rig. Messages must not depend on
//! the medium.

use super::frame::{MAX_PAYLOAD, TooLong};
use crate::role::CommandEvent;
use serde::{Deserialize, Serialize};

/// The version of this protocol: the first byte of every payload, in all versions.
pub const VERSION: u8 = 2;
/// The maximum size of the samples in a [`Tick`] or an [`Answer`], bytes: 120 fields.
pub const MAX_CONTENT: usize = 960;
/// The maximum number of samples in a [`Tick`] or an [`Answer`].
pub const MAX_SAMPLES: usize = 32;
/// The maximum length of a name or reason in a message, bytes.
pub const MAX_TEXT: usize = 64;
/// The maximum length of a list of layouts in a message, bytes.
pub const MAX_NAMES: usize = 448;

/// A message of the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Message<'a> {
    /// From the host: the greeting with the parameters of the run.
    #[serde(borrow)]
    Hello(Hello<'a>),
    /// From the device: it takes part.
    Welcome(Welcome<'a>),
    /// From the device: it does not take part, or not yet.
    Refuse(Refuse<'a>),
    /// From the host: the request for a tick.
    Tick(Tick<'a>),
    /// From the device: the answer to a tick.
    Answer(Answer<'a>),
    /// From the host: apply the safe command now.
    Stop,
}

/// The host's greeting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello<'a> {
    /// The identifier of the run. A device that knows it continues; another device begins at its initial state.
    pub run: u64,
    /// True if ticks follow the clock. Otherwise each comes as soon as the last is answered, and there is no timeout.
    pub realtime: bool,
    /// The period h, ns.
    pub period_ns: u64,
    /// The last tick of the run; the first is 0.
    pub last_tick: u64,
    /// The number of consecutive ticks without a command after which a body applies its safe command. At least 1.
    pub timeout_ticks: u64,
    /// True if the safe command holds until the next run; otherwise the next command ends it.
    pub manual_rearm: bool,
    /// The role of the device: a body's name, `observer`, `controller`, or `observer controller` for both.
    pub role: &'a str,
    /// The layout names of the samples in [`Tick::inputs`], in order, separated by blanks: versioned type names with
    /// hashes, or without hashes for a device that has none.
    pub reads: &'a str,
    /// The layout names of the samples in [`Answer::outputs`].
    pub writes: &'a str,
}

/// The acceptance of a run by a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome<'a> {
    /// The value of [`Hello::run`].
    pub run: u64,
    /// The first tick that the device can still answer; 0 if it has just started.
    pub next_tick: u64,
    /// The name of the device: kind and version, for display.
    pub device: &'a str,
}

/// The reason why a device does not take part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reason {
    /// The payload's first byte is not the device's version.
    Version,
    /// The layouts of the samples differ.
    Samples,
    /// The device has another role, or does not support the parameters.
    Role,
    /// The device has not been greeted since its start.
    NotGreeted,
}

/// The refusal of a device. This message is the same in all versions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refuse<'a> {
    /// The kind of reason.
    pub reason: Reason,
    /// Details for the user.
    pub detail: &'a str,
}

/// Samples of the agreed layouts, each as the bytes after its stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Samples<'a> {
    /// Bit i is set if sample i is present.
    pub present: u32,
    /// The bytes of the present samples, in order.
    pub bytes: &'a [u8],
}

/// The request for a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tick<'a> {
    /// The tick k.
    pub tick: u64,
    /// The inputs that arrived in time and were accepted. For a body the command computed from measurement k − 1,
    /// which acts from k on; for other roles the samples of tick k.
    #[serde(borrow)]
    pub inputs: Samples<'a>,
}

/// The answer to a tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Answer<'a> {
    /// The sequence number of the frame that is answered.
    pub echo: u32,
    /// The tick.
    pub tick: u64,
    /// The outcome of a body's command; `NotDue` for other roles.
    pub event: CommandEvent,
    /// The outputs of the tick; for a body the state at k under the command that now acts.
    #[serde(borrow)]
    pub outputs: Samples<'a>,
}

#[derive(Serialize, Deserialize)]
struct Envelope<'a> {
    version: u8,
    /// The number of the sender's frame, from 0, including repeated ones.
    sequence: u32,
    #[serde(borrow)]
    message: Message<'a>,
}

/// The reason why a payload is invalid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ParseError {
    /// The payload is of this other version of the protocol.
    Version(u8),
    /// The payload is of this version, but malformed.
    Malformed,
}

/// Writes a message into a payload and returns the bytes written.
///
/// # Errors
/// [`TooLong`] if the names in the message are too long.
pub fn write<'a>(sequence: u32, message: Message<'_>, payload: &'a mut [u8; MAX_PAYLOAD]) -> Result<&'a [u8], TooLong> {
    let envelope = Envelope { version: VERSION, sequence, message };
    postcard::to_slice(&envelope, payload).map(|payload| &*payload).map_err(|_| TooLong)
}

/// Parses a message and its sequence number from a payload.
///
/// # Errors
/// [`ParseError`] if the payload is of another version or malformed.
pub fn parse(payload: &[u8]) -> Result<(u32, Message<'_>), ParseError> {
    match payload.first() {
        Some(&VERSION) => {}
        Some(&version) => return Err(ParseError::Version(version)),
        None => return Err(ParseError::Malformed),
    }
    match postcard::take_from_bytes::<Envelope<'_>>(payload) {
        Ok((envelope, [])) => Ok((envelope.sequence, envelope.message)),
        _ => Err(ParseError::Malformed),
    }
}

/// Returns the part of a text that fits into a message.
pub(super) fn shorten(text: &str) -> &str {
    let mut end = text.len().min(MAX_TEXT);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    &text[..end]
}

#[cfg(test)]
mod tests {
    use super::super::frame::{Decoder, MAX_FRAME, encode};
    use super::*;
    use proptest::prelude::*;

    const LONG: &str = "0123456789012345678901234567890123456789012345678901234567890123";

    fn written(message: Message<'_>) -> Vec<u8> {
        write(0x0403_0201, message, &mut [0; MAX_PAYLOAD]).unwrap().to_vec()
    }

    #[test]
    fn a_tick_is_encoded_as_documented() {
        let tick = Tick { tick: 300, inputs: Samples { present: 0b10, bytes: &[9, 8, 7] } };
        let sequence = [0x81, 0x84, 0x8c, 0x20];
        let expected = [&[VERSION][..], &sequence, &[3], &[0xac, 0x02], &[2, 3, 9, 8, 7]].concat();
        assert_eq!(written(Message::Tick(tick)), expected);
        let without = Message::Tick(Tick { tick: 0, inputs: Samples::default() });
        assert_eq!(written(without), [&[VERSION][..], &sequence, &[3, 0, 0, 0]].concat());
        assert_eq!(written(Message::Stop), [&[VERSION][..], &sequence, &[5]].concat());
        let event = CommandEvent::Safe;
        let answer = Answer { echo: 1, tick: 2, event, outputs: Samples { present: 1, bytes: &[4; 8] } };
        let expected = [&[VERSION][..], &sequence, &[4, 1, 2, 5, 1, 8], &[4; 8]].concat();
        assert_eq!(written(Message::Answer(answer)), expected);
    }

    /// The longest of every message fits into a frame.
    #[test]
    fn a_written_message_is_parsed_back() {
        let most = u64::MAX;
        let samples = Samples { present: u32::MAX, bytes: &[255; MAX_CONTENT] };
        let names = &LONG.repeat(MAX_NAMES / MAX_TEXT);
        let hello = Hello {
            run: most,
            realtime: true,
            period_ns: most,
            last_tick: most,
            timeout_ticks: most,
            manual_rearm: true,
            role: LONG,
            reads: names,
            writes: names,
        };
        for message in [
            Message::Hello(hello),
            Message::Welcome(Welcome { run: most, next_tick: most, device: LONG }),
            Message::Refuse(Refuse { reason: Reason::NotGreeted, detail: LONG }),
            Message::Tick(Tick { tick: most, inputs: samples }),
            Message::Answer(Answer { echo: u32::MAX, tick: most, event: CommandEvent::Safe, outputs: samples }),
            Message::Stop,
        ] {
            let mut payload = [0; MAX_PAYLOAD];
            let payload = write(u32::MAX, message, &mut payload).unwrap();
            assert_eq!(parse(payload), Ok((u32::MAX, message)));
            let mut found = 0;
            Decoder::default().feed(encode(payload, &mut [0; MAX_FRAME]).unwrap(), |_| found += 1);
            assert_eq!(found, 1);
        }
    }

    #[test]
    fn another_version_and_malformed_payloads_are_distinct_errors() {
        let mut stop = written(Message::Stop);
        stop[0] = 9;
        assert_eq!(parse(&stop), Err(ParseError::Version(9)));
        assert_eq!(parse(&[]), Err(ParseError::Malformed));
        assert_eq!(parse(&[VERSION, 0, 77]), Err(ParseError::Malformed));
        let trailing = [written(Message::Stop), vec![0]].concat();
        assert_eq!(parse(&trailing), Err(ParseError::Malformed));
    }

    #[test]
    fn a_text_is_shortened_between_characters() {
        assert_eq!(shorten("short"), "short");
        let text = "é".repeat(MAX_TEXT);
        assert_eq!(shorten(&text[..]).len(), MAX_TEXT);
        assert_eq!(shorten(&format!("x{text}")).len(), MAX_TEXT - 1);
    }

    proptest! {
        #[test]
        fn no_payload_panics(payload in prop::collection::vec(any::<u8>(), 0..MAX_PAYLOAD)) {
            let _ = parse(&payload);
            let _ = parse(&[&[VERSION][..], &payload].concat());
        }
    }
}
