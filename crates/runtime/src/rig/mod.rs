//! Rigs: a plant, an observer and a control law that belong together, with their parameters.
//!
//! Start with [`SimpleRig`]; implement [`Rig`] for fleets, own guards or certificates. This module does not know how roles are
//! driven or how their samples travel.

mod contract;
mod delay;
mod filter;
mod fleet;
mod orbit;
mod pictures;
mod rigid_body;
mod sensors;
mod simple;
mod words;

pub use crate::config::BodyInfo;
pub use contract::{
    CertificateReport, Command, ConditionReport, Context, Estimate, Figure, FleetCommand, FleetMeasurement, FleetTruth,
    Measurement, Monitor, Rig, RigLoopBody, Start, Truth, Watched, controller, further_observer, loop_body, observer,
    plant, sensed_body,
};
pub use delay::{DelayLine, Due};
pub use fleet::{Fleet, NoFleet};
pub use orbit::{OrbitLaw, OrbitObserver, OrbitPlant, OrbitRig};
pub use pictures::named;
pub use pictures::{Graph, Inputs, Lyapunov, Picture, Plane, Point, graphs};
pub use rigid_body::{RateLaw, RigidBodyRig};
pub use sensors::{SensedBody, Sensors};
pub use simple::{Bounded, Difference, SimpleRig};
pub use words::{WordGuard, WordView};

/// Evaluates an expression with the concrete rig behind an `AnyRig`, for tests and benchmarks of this crate's rigs.
///
/// # Panics
/// If the rig is not one of this crate's.
#[macro_export]
macro_rules! with_shipped_rig {
    ($any:expr, $rig:ident => $body:expr) => {
        if let Some($rig) = $any.downcast_ref::<$crate::rig::RigidBodyRig>() {
            $body
        } else {
            let $rig = $any.downcast_ref::<$crate::rig::OrbitRig>().expect("a rig of this crate");
            $body
        }
    };
}
