//! A device behind a byte stream: its protocol, and both ends of it as state machines.
//!
//! The device takes a role's seat: a driven body, the observer, the controller, or observer and controller together. Its host
//! (`corotate bridge`) asks it tick by tick. Pure: bytes and times come in, frames go out; no I/O, no clock, no allocation.
//! Firmware in Rust takes [`Device`] from here, `no_std`, with the feature `serial` alone; `examples/serial_device.rs` is a
//! whole device, and `firmware/` one without an operating system. Must not know any rig, nor what carries the bytes.
//!
//! The protocol, version 2, byte by byte: `docs/serial-protocol.md`. Its examples are checked against this module.

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
pub use host::{DeviceEvent, HostSession, LineCounters, Terms};
pub use message::{
    Answer, Hello, MAX_CONTENT, MAX_NAMES, MAX_SAMPLES, MAX_TEXT, Message, ParseError, Reason, Refuse, Samples, Tick,
    VERSION, Welcome, parse, write,
};
pub use role::{
    DeviceController, DeviceFlightComputer, DeviceObserver, DevicePlant, DeviceRole, Inputs, Layout, Outputs,
};

/// Takes any bytes as if they had come over a line, and hands on what is found in them: the whole way from bytes to
/// messages, for a fuzzer or a recorder.
pub fn decode(bytes: &[u8], mut each: impl FnMut(Result<(u32, Message<'_>), ParseError>)) -> FrameCounters {
    let mut decoder = Decoder::default();
    decoder.feed(bytes, |payload| each(parse(payload)));
    decoder.counters()
}
