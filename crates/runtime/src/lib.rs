//! The control loop of corotate: scenarios, links over shared memory, clocks, nodes, scores.
//!
//! This file is the map of the crate and holds no logic. The crate `corotate` is the program and its facade: it re-exports every
//! module of this crate and of `corotate-core`, on which this crate builds. A module depends only on modules further down:
//!
//! | module | duty |
//! |---|---|
//! | `seat` | the process of a role: of this program, a function, a device, an external program |
//! | `scenario` | a scenario with its rig, behind a table of functions; the registry of rigs |
//! | `direct` | a run in one thread without links |
//! | `analysis` | the claims about the running loop: its rate and its error floor |
//! | `score` | scores a run from the truth and the estimates |
//! | `runtime` | drives a role on a bus with a clock |
//! | `rig` | a plant, an observer and a law that belong together |
//! | `failure` | errors with their codes |
//! | `data` | logs of other programs, read row by row |
//! | `config` | scenario files: text with its checks, and the settings of a run |
//! | `telemetry` | histograms and counters, exported after the loop |
//! | `bus` | links between roles: shared memory (iceoryx2) or in-memory |
//! | `clock` | the time grid, and waiting for it |
//! | `changes` | the changes of inputs that a run has received while it runs |
//! | `shared` | words of memory shared between processes |
//! | `panics` | the message and place of a panic, and the crate it is in |
//! | `files` | files on a machine with other users: private directories, safe creation |
//! | `system` | operating-system errors with their remedies |

// The exported macros use paths of the facade.
#[cfg(test)]
extern crate corotate_core as corotate;
use corotate_core::{
    control, estimate, fault, identify, input, model, observe, rate, role, sample, serial, state, vector,
};

pub mod analysis;
pub mod bus;
pub mod changes;
pub mod clock;
pub mod config;
pub mod data;
#[doc(hidden)]
pub mod direct;
#[doc(hidden)]
pub mod failure;
pub mod files;
#[doc(hidden)]
pub mod panics;
pub mod rig;
pub mod runtime;
pub mod scenario;
pub mod score;
pub mod seat;
pub mod shared;
pub mod system;
pub mod telemetry;
