//! Plant, observer and controller as plain state machines: samples in, samples out.
//!
//! They have no clock, no I/O, no allocation and no logging: their time is the tick in a sample's stamp. The same
//! state machines run in one thread, in lockstep and in real time, and therefore give the same bits in all three.

mod actuated;
mod controller;
mod cycle;
mod guard;
mod observer;
mod plant;
mod relation;

pub use actuated::{Actuated, Dynamics};
pub use controller::{Controller, Law, LawInputs, REFERENCE_MAX};
pub use cycle::{LoopBody, LoopControl, LoopObserver, command_index, cycle, respond};
pub use guard::{AcceptAll, Bounds, Guard, MotionCheck, PlausibilityCheck, Refusal, SUSPECT_SAMPLES};
pub use observer::{Estimator, Observer};
pub use plant::{Actuation, Body, CommandEvent, Plant, Rearm, SingleBody};
pub use relation::{InvariantRelation, RelationObserver};
