//! corotate: a feedback control loop as separate processes, measured, tested and replayed.
//!
//! This file is the map of the crate and holds no logic. The mathematics and the roles are the crate `corotate-core`, the loop is
//! `corotate-runtime`; their modules stand here under the same names. Arrows between modules point down only:
//!
//! | module | duty |
//! |---|---|
//! | `record` | writes every sample of a run to a file; reads, replays, compares and exports it |
//! | `hosts` | a run over several computers: relay, clocks, who may join; with the feature of that name |
//! | `inputs` | changes of inputs while a run lasts |
//! | `late` | late ticks and their causes |
//! | `launch` | starts, supervises and ends a run; scores it |
//! | `campaign` | one scenario run many times, varied; the table of its cases |
//! | `report` | a run as one page that is looked at |
//! | `bench` | what all of it costs beside its floors |
//! | `doctor` | whether this machine is fit for real time |
//! | `watch` | a screen on a running loop |
//! | `program` | the command line, for every program that names its rigs |
//! | `foxglove` | a running loop on a Foxglove WebSocket, with the feature of that name |
//!
//! The sources that the documentation cites: \[D\] I. S. Dmytryshyn, *Synchronisation of angular velocities of identical
//! rigid bodies*; \[SZ\] V. F. Shcherbak, N. V. Zhogoleva, *Identification of the moments of inertia of a rigid body*;
//! \[S\] S. A. Shatkov, *State observers in the restricted two-body problem*.

// The exported macros name it: their code stands in other crates, and in this one.
extern crate self as corotate;
#[doc(hidden)]
pub use bytemuck;
#[doc(inline)]
pub use corotate_core::{
    control, estimate, fault, identify, input, model, observe, persist_fields, rate, role, sample, serial, state,
};
#[doc(inline)]
pub use corotate_runtime::{
    analysis, bus, changes, clock, config, data, files, rig, runtime, scenario, score, seat, shared, system, telemetry,
    with_shipped_rig,
};
use corotate_runtime::{direct, failure, panics};
// Its functions give the same bits on every machine.
pub use libm;
pub use nalgebra;

/// A file at the root of these sources.
const FILE: &str = file!();

pub mod bench;
pub mod campaign;
pub mod doctor;
#[cfg(feature = "foxglove")]
pub mod foxglove;
pub mod hosts;
pub mod inputs;
pub mod late;
pub mod launch;
pub mod prelude;
mod program;
pub mod record;
pub mod report;
pub mod watch;

pub use program::Program;
