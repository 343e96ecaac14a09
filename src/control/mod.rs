//! Control laws and the conditions under which they are proven. Pure: no clock, no I/O, no allocation, no logging.

mod certificate;
mod synchronizer;

pub use certificate::{Certificate, Condition};
pub use synchronizer::Synchronizer;
