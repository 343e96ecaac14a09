//! The errors of a seat and their numbers.

use std::io;
use std::path::PathBuf;

/// A call failed.
#[derive(Debug, thiserror::Error)]
pub enum SeatError {
    #[error("a pointer is null; give the address of an object")]
    Null,
    #[error("a text is not UTF-8; encode it so")]
    Text,
    #[error("there is no open seat with this number; open one with corotate_seat_open")]
    Closed,
    #[error("another thread uses this seat; call it from one thread at a time")]
    Busy,
    #[error("no tick is under way; call corotate_seat_wait first")]
    NoTick,
    #[error("the run has ended; close the seat")]
    Ended,
    #[error("cannot read the seat {}: {source}; name the file that the waiting run prints, or its directory", path.display())]
    NoSeat { path: PathBuf, source: io::Error },
    #[error("{} is not a seat of this version: {reason}; start both programs from one release", path.display())]
    BadSeat { path: PathBuf, reason: String },
    #[error("{} is the seat of {found}, not of {role}; name that role, or its own seat", path.display())]
    OtherRole { path: PathBuf, role: String, found: String },
    #[error("the seat is not that of a run: `run --external ROLE` writes one; name its file")]
    NoRun,
    #[error("cannot start the run's program {program}: {source}")]
    Start { program: String, source: io::Error },
    #[error("the role reads no signal {name}, or writes none of that name; it has {known}")]
    NoSignal { name: String, known: String },
    #[error("{name} is the name of several signals; name one of {known}")]
    Ambiguous { name: String, known: String },
    #[error("a sample of {name} has {expected} bytes, not {given}; print its struct with `corotate seat … --header`")]
    Size { name: String, expected: usize, given: usize },
    #[error("the role uses no input {key}; it has {known}")]
    NoValue { key: String, known: String },
    #[error("the input {key} has {expected} numbers, not {given}")]
    Count { key: String, expected: usize, given: usize },
    #[error("{0}")]
    Run(String),
    #[error("the program that serves the seat ended without a reason; its error output says more")]
    Gone,
    #[error("a defect of libcorotate: {0}; report this line")]
    Panic(String),
}

impl SeatError {
    /// Returns the number that a C function returns.
    pub fn number(&self) -> i32 {
        match self {
            Self::Null | Self::Text => -1,
            Self::Closed => -2,
            Self::Busy => -3,
            Self::NoTick | Self::Ended => -4,
            Self::NoSeat { .. } | Self::BadSeat { .. } | Self::OtherRole { .. } | Self::NoRun => -5,
            Self::Start { .. } => -6,
            Self::NoSignal { .. } | Self::Ambiguous { .. } | Self::NoValue { .. } => -7,
            Self::Size { .. } | Self::Count { .. } => -8,
            Self::Run(_) | Self::Gone => -9,
            Self::Panic(_) => -10,
        }
    }
}
