//! Angular velocities: the observers and the law of the rig `rigid-body` as roles, the same for the rig and for
//! firmware.
//!
//! These roles select the measured and the supplied components; the mathematics is in `model`, `observe` and
//! `control`. They must not depend on a scenario.

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
