//! Angular velocities: the observers and the law of the rig `rigid-body` as roles. What that rig runs is what firmware runs.
//!
//! Which components are measured, which one is supplied and from what is decided here; the mathematics is in `model`, `observe`
//! and `control`. Must not know a scenario.

mod hidden;
mod identifier;
mod law;
mod learner;
mod observer;

#[cfg(feature = "std")]
pub use hidden::ALL;
pub use hidden::HiddenObserver;
pub use identifier::Identifier;
pub use law::{RateLaw, RateLawDesign};
pub use learner::{Learner, LearnerDesign};
pub use observer::{KalmanObserver, RateObserver};
