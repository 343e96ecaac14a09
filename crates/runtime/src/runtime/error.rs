//! Errors of nodes and devices.

use super::line::LineError;
use crate::bus::BusError;
use crate::serial::{MAX_CONTENT, MAX_NAMES, MAX_SAMPLES, VERSION};

/// A device failed or cannot take part.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum DeviceError {
    /// The line could not be opened.
    #[error(transparent)]
    #[strum(transparent)]
    Line(#[from] LineError),
    /// One tick takes longer on the line than the run allows.
    #[error(
        "at {baud} baud one tick takes {line_us} us on the line, and the run has {tick_us} us for it; give --baud {least} \
         or more, or run with a lower tick_hz"
    )]
    #[strum(serialize = "line-too-slow")]
    TooSlow {
        /// The speed, bit/s.
        baud: u32,
        /// Duration of one request and its answer, µs.
        line_us: u64,
        /// The period up to its cutoff, µs.
        tick_us: u64,
        /// The lowest sufficient speed, bit/s.
        least: u64,
    },
    /// The run uses an actuation delay that devices do not support.
    #[error(
        "a device applies a command at the tick after it, and the run has actuation_delay_ticks = {ticks}; give 1, or let \
         a simulated plant take part"
    )]
    #[strum(serialize = "device-delay")]
    Delayed {
        /// The run's delay, ticks.
        ticks: u64,
    },
    /// The device would take two roles that compute at different rates.
    #[error(
        "one device cannot be observer and controller at different rates: observer.every_ticks = {observer_ticks}, \
         controller.every_ticks = {controller_ticks}; make them equal, or give each role a device of its own"
    )]
    #[strum(serialize = "device-rates")]
    Rates {
        /// The controller's rate, ticks.
        controller_ticks: u64,
        /// The observer's rate, ticks.
        observer_ticks: u64,
    },
    /// The device does not answer.
    #[error("the device on {line} has not answered for {waited_s:.1} s: {hint}")]
    #[strum(serialize = "device-silent")]
    Silent {
        /// The line.
        line: String,
        /// Waiting time, s.
        waited_s: f64,
        /// A hint on what to check.
        hint: String,
    },
    /// The device uses another protocol version.
    #[error(
        "the device on {line} speaks protocol version {theirs} and this program version {VERSION}; update the older of the two"
    )]
    #[strum(serialize = "device-version")]
    Version {
        /// The line.
        line: String,
        /// The device's version.
        theirs: u8,
    },
    /// Another device answers instead of the expected one.
    #[error(
        "on {line} the device `{found}` answers in the place of `{expected}`; connect that one again, or give \
         --allow-other-device"
    )]
    #[strum(serialize = "other-device")]
    Other {
        /// The line.
        line: String,
        /// The name of the device at the start of the run.
        expected: String,
        /// The name of the device that answered.
        found: String,
    },
    /// The samples of the role do not fit into a message.
    #[error(
        "`{role}` reads {read} and writes {written} bytes in {samples} samples per tick, and a message holds {MAX_CONTENT} \
         bytes in {MAX_SAMPLES} samples, whose names take {MAX_NAMES} bytes; no device can take this role: drive fewer bodies"
    )]
    #[strum(serialize = "seat-too-large")]
    TooLong {
        /// The role.
        role: String,
        /// Bytes of the samples that the role reads.
        read: usize,
        /// Bytes of the samples that the role writes.
        written: usize,
        /// Number of samples in the longer message.
        samples: usize,
    },
    /// The run has no clock that a device may set.
    #[error(
        "no device can set the pace of this run: {reason}; run in real time with --external BODY, or leave out --pace device"
    )]
    #[strum(serialize = "no-pace-clock")]
    PaceUnavailable {
        /// The reason.
        reason: String,
    },
    /// Another device sets the pace.
    #[error("another device sets the pace of this run already; leave out --pace device")]
    #[strum(serialize = "pace-taken")]
    PaceTaken,
    /// The device is not a body.
    #[error("`{role}` cannot set the pace; only a driven body can, so leave out --pace device")]
    #[strum(serialize = "pace-role")]
    PaceRole {
        /// The role.
        role: String,
    },
    /// The device sends no frames by its own timer, or not at the run's rate.
    #[error(
        "the device on {line} keeps no pace of {tick_hz} Hz: {frames} frames came by its own timer in {waited_s:.1} s; give it a program \
         that sends a frame in each of its cycles, set tick_hz to its rate, or leave out --pace device"
    )]
    #[strum(serialize = "no-pace")]
    NoPace {
        /// The line.
        line: String,
        /// The run's rate, Hz.
        tick_hz: f64,
        /// Received frames.
        frames: u64,
        /// Waiting time, s.
        waited_s: f64,
    },
    /// The device that sets the pace is lost, and the run shall end then.
    #[error(
        "the device sets the pace, and was silent for {silent_s:.1} s; check its line, or give a longer --holdover"
    )]
    #[strum(serialize = "pace-lost")]
    PaceLost {
        /// The silence, s.
        silent_s: f64,
    },
    /// The device refuses the role.
    #[error("the device on {line} refuses to be `{role}`: {reason}")]
    #[strum(serialize = "device-refused")]
    Refused {
        /// The line.
        line: String,
        /// The role.
        role: String,
        /// The device's reason, with a remedy.
        reason: String,
    },
}

/// A node cannot continue.
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
    /// The function that computes the role failed.
    #[error("{reason}")]
    #[strum(serialize = "computed-role-failed")]
    Computed {
        /// The reason that the function returned.
        reason: String,
    },
}
