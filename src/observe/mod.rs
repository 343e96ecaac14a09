//! Observers by the method of invariant relations: one filter, and one relation per unknown.
//!
//! Pure: no clock, no I/O, no allocation, no logging. Must not see the truth, nor remember more than the filter's state.

mod filter;
mod hidden_rate;
mod orbit_velocity;

pub use filter::{Increment, InvariantFilter};
pub use hidden_rate::{Conic, HiddenRate, HiddenRateError, Observation, RateSample};
pub use orbit_velocity::{OrbitSample, OrbitVelocity, to_inertial, to_polar};
