//! The messages: what they say and how they lie in a payload. The table in the module's documentation is this file's.
//!
//! A sample travels as the bytes after its stamp, so that no message knows any rig. Must not know how messages are sent.

use super::frame::{MAX_PAYLOAD, TooLong};
use crate::role::CommandEvent;
use serde::{Deserialize, Serialize};

/// The version of this protocol: the first byte of every payload, in all versions.
pub const VERSION: u8 = 2;
/// The most bytes of samples in a [`Tick`] or an [`Answer`]: 120 fields.
pub const MAX_CONTENT: usize = 960;
/// The most samples in either.
pub const MAX_SAMPLES: usize = 32;
/// The longest name or reason in a message, bytes.
pub const MAX_TEXT: usize = 64;
/// The longest list of layouts in a message, bytes.
pub const MAX_NAMES: usize = 448;

/// What is said on the line.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Message<'a> {
    /// Host: who is there, and how the run will be.
    #[serde(borrow)]
    Hello(Hello<'a>),
    /// Device: it takes part.
    Welcome(Welcome<'a>),
    /// Device: it does not, or not yet.
    Refuse(Refuse<'a>),
    /// Host: a tick is due.
    Tick(Tick<'a>),
    /// Device: what it makes of that tick.
    Answer(Answer<'a>),
    /// Host: go to the safe command now.
    Stop,
}

/// The host's greeting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello<'a> {
    /// Which run. A device that knows it goes on where it was; another one begins at its initial state.
    pub run: u64,
    /// Whether ticks follow the clock; if not, they come as fast as they are answered, and silence means nothing.
    pub realtime: bool,
    /// The period h, ns.
    pub period_ns: u64,
    /// The last tick of the run; the first is 0.
    pub last_tick: u64,
    /// After so many ticks in a row without a command a body goes to its safe command. At least 1.
    pub timeout_ticks: u64,
    /// Whether the safe command is for good (until another run), or ends with the next command.
    pub manual_rearm: bool,
    /// The seat that the device takes: a body's name, `observer`, `controller`, or `observer controller` for both.
    pub role: &'a str,
    /// The names of the layouts of the samples in [`Tick::inputs`], in order, with a blank between two: versioned type names with
    /// hashes, or without them to a device that knows none.
    pub reads: &'a str,
    /// Those of [`Answer::outputs`].
    pub writes: &'a str,
}

/// A device that takes part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome<'a> {
    /// [`Hello::run`], told back.
    pub run: u64,
    /// The first tick that the device would still answer; 0 if it has just begun.
    pub next_tick: u64,
    /// What the device calls itself: kind and version, for people.
    pub device: &'a str,
}

/// Why a device does not take part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reason {
    /// The payload's first byte is another version than the device's.
    Version,
    /// The samples are of other types.
    Samples,
    /// The device has another role, or is not fit for it.
    Role,
    /// It was not greeted since it began: greet it.
    NotGreeted,
}

/// A device that does not take part. This message is the same in all versions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refuse<'a> {
    /// The kind of reason.
    pub reason: Reason,
    /// What a person should know.
    pub detail: &'a str,
}

/// Some of the samples that were agreed upon, each as the bytes after its stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Samples<'a> {
    /// Bit i: sample i is there.
    pub present: u32,
    /// Those that are there, one after another.
    pub bytes: &'a [u8],
}

/// A tick that is due.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tick<'a> {
    /// The tick k.
    pub tick: u64,
    /// What is known in time and believed: for a body the command computed from measurement k − 1, which acts from k on; for
    /// the others the samples of tick k.
    #[serde(borrow)]
    pub inputs: Samples<'a>,
}

/// The answer to a tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Answer<'a> {
    /// The sequence number of the frame that is answered.
    pub echo: u32,
    /// Its tick.
    pub tick: u64,
    /// What became of a body's command; of all others that none was due.
    pub event: CommandEvent,
    /// What the device says of this tick: of a body the state at k under the command that now acts.
    #[serde(borrow)]
    pub outputs: Samples<'a>,
}

#[derive(Serialize, Deserialize)]
struct Envelope<'a> {
    version: u8,
    /// Counts the sender's frames, from 0, repeated ones too.
    sequence: u32,
    #[serde(borrow)]
    message: Message<'a>,
}

/// Why a payload is no message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ParseError {
    /// It is of this version of the protocol.
    Version(u8),
    /// It is of this version, and nonsense.
    Malformed,
}

/// Writes a message into a payload and returns it.
///
/// # Errors
/// [`TooLong`], only if names in it are.
pub fn write<'a>(sequence: u32, message: Message<'_>, payload: &'a mut [u8; MAX_PAYLOAD]) -> Result<&'a [u8], TooLong> {
    let envelope = Envelope { version: VERSION, sequence, message };
    postcard::to_slice(&envelope, payload).map(|payload| &*payload).map_err(|_| TooLong)
}

/// Reads a message and its sequence number from a payload.
///
/// # Errors
/// [`ParseError`].
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

/// As much of a text as a message takes.
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
    fn a_tick_lies_in_its_payload_as_documented() {
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
    fn what_is_written_is_read_back() {
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
    fn another_version_is_told_from_nonsense() {
        let mut stop = written(Message::Stop);
        stop[0] = 9;
        assert_eq!(parse(&stop), Err(ParseError::Version(9)));
        assert_eq!(parse(&[]), Err(ParseError::Malformed));
        assert_eq!(parse(&[VERSION, 0, 77]), Err(ParseError::Malformed));
        let trailing = [written(Message::Stop), vec![0]].concat();
        assert_eq!(parse(&trailing), Err(ParseError::Malformed));
    }

    #[test]
    fn a_text_is_cut_between_characters() {
        assert_eq!(shorten("short"), "short");
        let text = "é".repeat(MAX_TEXT);
        assert_eq!(shorten(&text[..]).len(), MAX_TEXT);
        assert_eq!(shorten(&format!("x{text}")).len(), MAX_TEXT - 1);
    }

    proptest! {
        #[test]
        fn no_payload_makes_it_fail(payload in prop::collection::vec(any::<u8>(), 0..MAX_PAYLOAD)) {
            let _ = parse(&payload);
            let _ = parse(&[&[VERSION][..], &payload].concat());
        }
    }
}
