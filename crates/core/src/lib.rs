//! The mathematics and the roles of corotate: no operating system, no allocator, no clock.
//!
//! The program and its facade are the crate `corotate`, which re-exports every module of this one; firmware depends on this crate alone.
//!
//! | module | duty |
//! |---|---|
//! | [`vector`] | reductions of vectors of a few components |
//! | [`state`] | the state of a state machine as words: written, read back, counted |
//! | [`sample`](mod@sample) | the fixed-size samples that travel between roles |
//! | [`model`] | bodies and their motion |
//! | [`fault`] | scripted faults: which sample or role fails, in which manner and when |
//! | [`observe`] | invariant relations and the filter that serves them all |
//! | [`control`] | control laws and their certificates |
//! | [`role`] | plant, observer and controller as state machines without clock and I/O |
//! | [`rate`] | the observers and the law of angular velocities, as roles |
//! | [`identify`] | the inertia of a body from a log of its angular velocity |
//! | [`estimate`] | the component that a log of angular velocity lacks, from the other two |
//! | `serial` | a device behind a byte stream: the protocol and both of its ends; with the feature `serial` |
//!
//! The sources that the documentation cites: \[D\] I. S. Dmytryshyn, *Synchronisation of angular velocities of identical
//! rigid bodies*; \[SZ\] V. F. Shcherbak, N. V. Zhogoleva, *Identification of the moments of inertia of a rigid body*;
//! \[S\] S. A. Shatkov, *State observers in the restricted two-body problem*.

#![cfg_attr(not(feature = "std"), no_std)]

// The exported macros name the facade: their code stands in other crates, and in this one.
extern crate self as corotate;
#[doc(hidden)]
pub use bytemuck;
/// This file: a panic beside it is a defect of this crate.
#[doc(hidden)]
pub const FILE: &str = file!();
pub use nalgebra;

pub mod control;
pub mod estimate;
pub mod fault;
pub mod identify;
pub mod model;
pub mod observe;
pub mod rate;
pub mod role;
pub mod sample;
#[cfg(feature = "serial")]
pub mod serial;
pub mod state;
pub mod vector;
