//! Rigs: which plant, observer and control law belong together, with their parameters.
//!
//! Must not know how roles are driven, nor what carries their samples.

mod contract;
mod delay;
mod filter;
mod fleet;
mod orbit;
mod pictures;
mod rigid_body;
mod simple;
mod words;

pub use crate::config::BodyInfo;
pub use contract::{
    CertificateReport, Command, ConditionReport, Context, Estimate, Figure, FleetCommand, FleetMeasurement, FleetTruth,
    Measurement, Monitor, Rig, Start, Truth, Watched,
};
pub use delay::{DelayLine, Due};
pub use fleet::{Fleet, NoFleet};
pub use orbit::{OrbitLaw, OrbitObserver, OrbitPlant, OrbitRig};
pub use pictures::named;
pub use pictures::{Graph, Inputs, Lyapunov, Picture, Plane, Point, graphs};
pub use rigid_body::{RateLaw, RigidBodyRig};
pub(crate) use simple::field_named;
pub use simple::{Bounded, Difference, SimpleRig};
pub use words::{WordGuard, WordView};

/// Runs an expression with the rig at hand, whichever of those in this crate it is: for tests, and for the suite, which measures
/// them.
///
/// # Panics
/// With any other rig.
#[macro_export]
macro_rules! with_shipped_rig {
    ($any:expr, $rig:ident => $body:expr) => {
        if let Some($rig) = $any.downcast_ref::<$crate::rig::RigidBodyRig>() {
            $body
        } else {
            let $rig = $any.downcast_ref::<$crate::rig::OrbitRig>().expect("this is for the rigs of this crate");
            $body
        }
    };
}
