//! Plant, observer and controller as plain state machines: samples in, samples out.
//!
//! No clock, no I/O, no allocation, no logging: time is the tick in a sample's stamp. The same machines run in one thread,
//! in lockstep and in real time; that is why all three give the same bits.

mod controller;
mod guard;
mod observer;
mod plant;
mod relation;

pub use controller::{Controller, Law};
pub use guard::{AcceptAll, Bounds, Guard, MotionCheck, PlausibilityCheck, Refusal, SUSPECT_SAMPLES};
pub use observer::{Estimator, Observer};
pub use plant::{Actuation, Body, CommandEvent, Plant, Rearm, SingleBody};
pub use relation::{InvariantRelation, RelationObserver};
