//! Control laws and the conditions under which they are proven. Pure: no clock, no I/O, no allocation, no logging.

mod adaptation;
mod certificate;
mod synchronizer;

pub use adaptation::InertiaAdaptation;
pub use certificate::{Certificate, Condition};
pub use synchronizer::Synchronizer;
