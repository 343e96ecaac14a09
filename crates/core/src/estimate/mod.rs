//! The component of an angular velocity that a log lacks, from the other two, \[D\] section 3, along the log.
//!
//! | file | duty |
//! |---|---|
//! | `reconstruction` | the hidden component, sample by sample |
//! | `rate` | which decay rate is sensible for a log |
//! | `score` | the estimate beside a measured component, where there is one |
//!
//! Pure: no clock, no I/O, no allocation but for `score`, which needs `std`. Must not read the hidden component but to score.

mod rate;
mod reconstruction;
#[cfg(feature = "std")]
mod score;

pub use rate::{RateChoice, RateSurvey};
pub use reconstruction::{FilterKind, Reconstructed, Reconstruction, ReconstructionError, Setup};
#[cfg(feature = "std")]
pub use score::{Score, SegmentScore};
