//! A device behind a byte stream: the protocol, and both of its ends as state machines.
//!
//! The device runs one role: a driven body, the observer, the controller, or observer and controller together. Its
//! host (`corotate bridge`) requests every tick. Pure: bytes and times come in, frames go out; no I/O, no clock, no
//! allocation. Firmware in Rust uses [`Device`], `no_std`, with the feature `serial` alone.
//! `examples/serial_device.rs` is a complete device, and `firmware/` one without an operating system. This module
//! must not depend on a rig, nor on the medium.
//!
//! `docs/serial-protocol.md` describes the protocol, version 2, byte by byte. Its examples are checked against this
//! module.

mod device;
#[cfg(test)]
mod documented;
mod frame;
mod host;
mod message;
mod role;
#[cfg(test)]
mod tests;

pub use device::Device;
pub use frame::{CRC, Decoder, FrameCounters, MAX_FRAME, MAX_PAYLOAD, TooLong, encode};
pub use host::{Cycle, DeviceEvent, HostSession, LineCounters, Terms};
pub use message::{
    Answer, Hello, MAX_CONTENT, MAX_NAMES, MAX_SAMPLES, MAX_TEXT, Message, ParseError, Reason, Refuse, Samples, Tick,
    VERSION, Welcome, parse, write,
};
pub use role::{
    DeviceController, DeviceFlightComputer, DeviceObserver, DevicePlant, DeviceRole, Inputs, Layout, Outputs,
};

/// Decodes any bytes as if they had come over a line and passes every result to `each`: all of the receiving path,
/// for a fuzzer or a recorder.
pub fn decode(bytes: &[u8], mut each: impl FnMut(Result<(u32, Message<'_>), ParseError>)) -> FrameCounters {
    let mut decoder = Decoder::default();
    decoder.feed(bytes, |payload| each(parse(payload)));
    decoder.counters()
}
