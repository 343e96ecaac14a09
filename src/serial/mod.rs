//! A device behind a byte stream: its protocol, and both ends of it as state machines.
//!
//! The device takes the seat of a driven body: it *is* the body with its sensors and actuators, or simulates it. Its host
//! (`corotate bridge`) asks it tick by tick. Pure: bytes and times come in, frames go out; no I/O, no clock, no allocation.
//! Firmware in Rust takes [`Device`] from here, `no_std`, with the feature `serial` alone; `examples/serial_device.rs` is a
//! whole device. Must not know any rig, nor what carries the bytes.
//!
//! # Protocol, version 1
//!
//! Bytes on the line, either way:
//!
//! | part | bytes | what |
//! |---|---|---|
//! | delimiter | 1 | 0x00. Ends whatever came before, so garbage costs no frame but the one it hit |
//! | block | 6 to 515 | COBS of payload and CRC: no byte of it is 0x00 |
//! | delimiter | 1 | 0x00. Empty blocks between delimiters mean nothing |
//!
//! Before COBS a block is the payload (at most 508 bytes) and its CRC, 4 bytes, the lowest first: CRC-32 as in zlib and
//! Ethernet (reflected, polynomial 0x04C11DB7, initial value and final xor 0xFFFFFFFF, check value 0xCBF43926). A block
//! that is no COBS, is too long, or has another CRC is dropped and counted; nothing of it is used.
//!
//! A payload is postcard: `varint` is an unsigned integer, 7 bits per byte, the lowest first, the top bit set in all bytes
//! but the last; `bool` is one byte, 0 or 1; `text` and `bytes` are a varint length and so many bytes (UTF-8; at most 64
//! for a text, 240 for the content of a sample); `option` is 0x00, or 0x01 and the value.
//!
//! | field | type | what |
//! |---|---|---|
//! | version | 1 byte | 1. The first byte of a payload in every version of the protocol |
//! | sequence | varint, 32 bits | counts the sender's frames from 0, repeated ones too, and wraps |
//! | kind | 1 byte | 0 to 5, and what follows by kind: |
//!
//! | kind | from | fields in order |
//! |---|---|---|
//! | 0 Hello | host | run `varint`, realtime `bool`, period in ns `varint`, last tick `varint`, command timeout in ticks `varint`, manual rearm `bool`, body `text`, type names of command, measurement, truth: 3 `text` |
//! | 1 Welcome | device | run `varint` (of the Hello), next tick it can answer `varint`, its name and version `text` |
//! | 2 Refuse | device | reason: 1 byte (0 version, 1 samples, 2 body, 3 not greeted), detail `text`. The same in all versions |
//! | 3 Tick | host | tick `varint`, command `option` of `bytes` |
//! | 4 Answer | device | sequence of the frame answered `varint`, tick `varint`, what became of the command: 1 byte (0 none was due, 1 applied, 2 refused for good, 3 held, 4 expired now, 5 safe), measurement `bytes`, truth `bytes` (empty: not known) |
//! | 5 Stop | host | none |
//!
//! The content of a sample is its fields after the stamp in the order of `src/sample`, 8 bytes each, the lowest byte first:
//! IEEE 754 doubles and unsigned integers. The type names in Hello carry the version of the layout.
//!
//! ## What a device does
//!
//! - On **Hello** it compares the type names with its own and answers Refuse (reason 1, detail: its own name) if one
//!   differs. If it knows the run it goes on where it was; if not, it begins at its initial state. Then Welcome.
//! - On a payload of **another version** it answers Refuse with reason 0, in its own version.
//! - On **Tick k** before any Hello it answers Refuse with reason 3. If k is the tick it executed last, it tells the same
//!   answer again and does nothing else. If k is older, it says nothing. If k is later, it holds its input for the ticks in
//!   between, applies the command, *measures*, answers, and only then moves on: the measurement is of the instant k and
//!   says in its fields what acts from k on.
//! - **Expiry is its duty.** A tick without a command, and a tick that it never heard, is one missing command. It holds its
//!   last input until `command timeout` of them came in a row, and then applies its safe command. If `realtime`, its own
//!   clock counts the ticks where none are heard, half a period after each was due; otherwise silence means nothing.
//!   The next command ends the safe one, or nothing does in this run if `manual rearm`.
//! - On **Stop** it goes to its safe command at once. The run may still be resumed by a Hello.
//!
//! ## What the host does
//!
//! It sends Hello every 100 ms until the device says Welcome; asks for each tick once its command is there or, in real time,
//! when the tick is due; repeats a request after a quarter of the period and two round trips at least, twice as late each
//! time; gives it up at the cutoff of the period (never in lockstep); greets anew after 8 requests without any answer, or
//! when the line was cut. Answers to what is no longer asked are counted and dropped.

mod device;
mod frame;
mod host;
mod message;
#[cfg(test)]
mod tests;

pub use device::Device;
pub use frame::{CRC, Decoder, FrameBook, MAX_FRAME, MAX_PAYLOAD, TooLong, encode};
pub use host::{Heard, Host, LineCounters, Terms};
pub use message::{
    Answer, Hello, MAX_CONTENT, MAX_TEXT, Message, ParseError, Reason, Refuse, Tick, VERSION, Welcome, parse, write,
};

/// Takes any bytes as if they had come over a line, and hands on what is found in them: the whole way from bytes to
/// messages, for a fuzzer or a recorder.
pub fn decode(bytes: &[u8], mut each: impl FnMut(Result<(u32, Message<'_>), ParseError>)) -> FrameBook {
    let mut decoder = Decoder::default();
    decoder.feed(bytes, |payload| each(parse(payload)));
    decoder.counters()
}
