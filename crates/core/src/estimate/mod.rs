//! The component that is missing in a log of angular velocity, from the other two, \[D\] section 3.
//!
//! | file | duty |
//! |---|---|
//! | `reconstruction` | the hidden component, sample by sample |
//! | `rate` | the choice of a decay rate for a log |
//! | `scale` | the unit of two measured rates |
//! | `score` | the comparison of the estimate with a measured component |
//! | `wheel` | a body with a wheel as one without |
//!
//! Pure: no clock, no I/O, no allocation except in `score`, which needs `std`. The hidden component must be read for
//! scoring only.

mod rate;
mod reconstruction;
#[cfg(feature = "std")]
mod scale;
#[cfg(feature = "std")]
mod score;
mod wheel;

pub use rate::{RateChoice, RateSurvey};
pub use reconstruction::{FilterKind, Reconstructed, Reconstruction, ReconstructionError, Setup};
#[cfg(feature = "std")]
pub use scale::ScaleSurvey;
#[cfg(feature = "std")]
pub use score::{Score, SegmentScore};
pub use wheel::Wheel;
