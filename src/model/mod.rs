//! Bodies and their motion. Pure: no clock, no I/O, no allocation, no logging.

mod integrate;
mod orbit;
mod rigid_body;

pub use integrate::{flow, rk4_step};
pub use orbit::{CentralField, CentralFieldError, OrbitFault, OrbitState};
pub use rigid_body::{Inertia, InertiaError, RigidBody, euler};
