//! The loop of corotate as processes: scenarios, links over shared memory, clocks, nodes, scores.
//!
//! This file is the map of the crate and holds no logic. The program and its facade are the crate `corotate`, which re-exports every
//! module of this one and of `corotate-core`, on which it stands. Arrows between modules point down only:
//!
//! | module | duty |
//! |---|---|
//! | `seat` | a role as a process: of this program, a function, a device, a foreign program |
//! | `scenario` | a scenario with its rig: the generic code below behind a table of functions; the registry of rigs |
//! | `direct` | a run in one thread without links |
//! | `analysis` | what may be claimed of the loop that runs: its rate, its floor |
//! | `score` | scores a run from the truth and the estimates |
//! | `runtime` | drives one role on a bus with a clock |
//! | `rig` | which plant, observer and law belong together |
//! | `failure` | errors with their codes |
//! | `data` | logs that others wrote, read row by row |
//! | `config` | scenario files: text with its checks, and the settings of a run |
//! | `telemetry` | histograms and counters, exported after the loop |
//! | `bus` | links between roles: shared memory (iceoryx2) or in-memory |
//! | `clock` | the time grid and how to wait on it |
//! | `shared` | words of memory that processes share |
//! | `panics` | the message and place of a panic, and whose code it is in |
//! | `files` | files beside other users: what is this user's alone, and where what is written goes |
//! | `system` | what the operating system says: errors with their remedies |

// The exported macros name the facade, which re-exports what they need.
#[cfg(test)]
extern crate corotate_core as corotate;
use corotate_core::{control, estimate, fault, identify, model, observe, rate, role, sample, serial, state, vector};

pub mod analysis;
pub mod bus;
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
