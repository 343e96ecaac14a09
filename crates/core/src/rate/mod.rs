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
/// The numbers of the inputs that bodies, observers and laws of this rig take.
pub mod port {
    /// The three gains of the law, 1/s.
    pub const GAIN: usize = 0;
    /// The rate relative to the leader, rad/s.
    pub const OFFSET: usize = 1;
    /// The decay rate of the observer's error, 1/s.
    pub const DECAY: usize = 2;
    /// The disturbance of a body, rad/s².
    pub const DISTURBANCE: usize = 3;
    /// The number of ports.
    pub const COUNT: usize = 4;
}

pub use hidden::HiddenObserver;
pub use identifier::Identifier;
pub use law::{RateLaw, RateLawDesign};
pub use learner::{Learner, LearnerDesign};
pub use observer::{KalmanObserver, RateObserver};
