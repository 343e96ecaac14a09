//! Why a node cannot go on, and why there is no device, or none any more.

use super::line::LineError;
use crate::bus::BusError;
use crate::serial::{MAX_CONTENT, MAX_NAMES, MAX_SAMPLES, VERSION};
use std::path::PathBuf;

/// Why there is no device, or none any more.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum DeviceError {
    /// Its line could not be opened.
    #[error(transparent)]
    #[strum(transparent)]
    Line(#[from] LineError),
    /// It takes too long to say what must be said.
    #[error(
        "at {baud} baud one tick takes {line_us} us on the line, and the run has {tick_us} us for it; give --baud {least} \
         or more, or run with a lower tick_hz"
    )]
    #[strum(serialize = "line-too-slow")]
    TooSlow {
        /// The speed, bit/s.
        baud: u32,
        /// One request and its answer, µs.
        line_us: u64,
        /// The period up to its cutoff, µs.
        tick_us: u64,
        /// The least speed that would do, bit/s.
        least: u64,
    },
    /// The run asks for what a device does not do.
    #[error(
        "a device applies a command at the tick after it, and the run has actuation_delay_ticks = {ticks}; give 1, or let \
         a simulated plant take part"
    )]
    #[strum(serialize = "device-delay")]
    Delayed {
        /// The run's delay, ticks.
        ticks: u64,
    },
    /// It does not answer.
    #[error("the device on {} has not answered for {waited_s:.1} s: {hint}", path.display())]
    #[strum(serialize = "device-silent")]
    Silent {
        /// The line.
        path: PathBuf,
        /// How long it was waited for, s.
        waited_s: f64,
        /// What to look at.
        hint: String,
    },
    /// It speaks another protocol version.
    #[error(
        "the device on {} speaks protocol version {theirs} and this program version {VERSION}; update the older of the two",
        path.display()
    )]
    #[strum(serialize = "device-version")]
    Version {
        /// The line.
        path: PathBuf,
        /// The device's version.
        theirs: u8,
    },
    /// Another device answers in its place.
    #[error(
        "on {} the device `{found}` answers in the place of `{expected}`; connect that one again, or give \
         --allow-other-device",
        path.display()
    )]
    #[strum(serialize = "other-device")]
    Other {
        /// The line.
        path: PathBuf,
        /// The name of the device that the run began with.
        expected: String,
        /// The name of the other one.
        found: String,
    },
    /// What it would have to say is too much for a message.
    #[error(
        "`{role}` reads {read} and writes {written} bytes in {samples} samples per tick, and a message holds {MAX_CONTENT} \
         bytes in {MAX_SAMPLES} samples, whose names take {MAX_NAMES} bytes; no device can have this seat: drive fewer bodies"
    )]
    #[strum(serialize = "seat-too-large")]
    TooLong {
        /// The role.
        role: String,
        /// Bytes of the samples that it reads.
        read: usize,
        /// The same of those that it writes.
        written: usize,
        /// The number of samples in the longer message.
        samples: usize,
    },
    /// It refuses to take part.
    #[error("the device on {} refuses to be `{role}`: {reason}", path.display())]
    #[strum(serialize = "device-refused")]
    Refused {
        /// The line.
        path: PathBuf,
        /// The role.
        role: String,
        /// Its reason, and what to do.
        reason: String,
    },
}

/// Why a node cannot go on.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum NodeError {
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// The device at the end of a serial line is gone for good.
    #[error(transparent)]
    #[strum(transparent)]
    Device(#[from] DeviceError),
    /// The function that computes a role failed.
    #[error("{reason}")]
    #[strum(serialize = "computed-role-failed")]
    Computed {
        /// As it says.
        reason: String,
    },
}
