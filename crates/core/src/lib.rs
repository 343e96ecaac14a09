//! The mathematics and the roles of corotate: no operating system, no allocator, no clock.
//!
//! Programs use the crate `corotate`, which re-exports every module of this one. Firmware depends on this crate
//! alone.
//!
//! | module | duty |
//! |---|---|
//! | [`vector`] | reductions of vectors of a few components |
//! | [`state`] | the state of a state machine as words: stored, restored, counted |
//! | [`sample`](mod@sample) | the fixed-size samples that roles exchange |
//! | [`model`] | bodies and their motion |
//! | [`fault`] | scripted faults: the affected sample or role, the kind and the tick |
//! | [`input`] | quantities that change while a loop runs: a gain, a reference, a disturbance |
//! | [`observe`] | invariant relations and their filters |
//! | [`control`] | control laws and their certificates |
//! | [`role`] | plant, observer and controller as state machines without clock and I/O |
//! | [`rate`] | the observers and the law of angular velocities, as roles |
//! | [`identify`] | the inertia of a body from a log of its angular velocity |
//! | [`estimate`] | the component that is missing in a log of angular velocity, from the other two |
//! | `serial` | a device behind a byte stream: the protocol and both of its ends; with the feature `serial` |
//!
//! Sources cited in the documentation: \[D\] I. S. Dmytryshyn, *Synchronisation of angular velocities of identical
//! rigid bodies*; \[SZ\] V. F. Shcherbak, N. V. Zhogoleva, *Identification of the moments of inertia of a rigid
//! body*; \[S\] S. A. Shatkov, *State observers in the restricted two-body problem*.

#![cfg_attr(not(feature = "std"), no_std)]

// The exported macros name the facade: they expand in other crates and in this one.
extern crate self as corotate;
#[doc(hidden)]
pub use bytemuck;
/// The path of this file. A panic in a source next to it is a defect of this crate.
#[doc(hidden)]
pub const FILE: &str = file!();
pub use nalgebra;

pub mod control;
pub mod estimate;
pub mod fault;
pub mod identify;
pub mod input;
pub mod model;
pub mod observe;
pub mod rate;
pub mod role;
pub mod sample;
#[cfg(feature = "serial")]
pub mod serial;
pub mod state;
pub mod vector;
