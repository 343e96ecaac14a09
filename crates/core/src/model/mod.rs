//! Bodies, their motion, and the noise of their sensors. Pure: no clock, no I/O, no allocation, no logging.

mod fleet;
mod integrate;
mod noise;
mod orbit;
mod rigid_body;

pub use fleet::flow_all;
pub use integrate::{flow, rk4_step};
pub use noise::{Noise, quantize, uniform};
pub use orbit::{CentralField, CentralFieldError, OrbitFault, OrbitState};
pub use rigid_body::{Inertia, InertiaError, RigidBody, closure, euler};
