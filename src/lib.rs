//! corotate: bodies move together although not everything about them can be measured.
//!
//! This file is the map of the crate and holds no logic. Arrows between modules point down only:
//!
//! | module | duty | builds without `runtime` |
//! |---|---|---|
//! | `vector` | reductions of vectors of a few components | yes, `no_std` |
//! | [`model`] | bodies and their motion | yes, `no_std` |
//! | [`observe`] | invariant relations and the filter that serves them all | yes, `no_std` |
//! | [`identify`] | the inertia of a body from a log of its angular velocity | yes, `no_std` |
//! | [`estimate`] | the component that a log of angular velocity lacks, from the other two | yes, `no_std` |
//! | [`control`] | control laws and their certificates | yes, `no_std` |
//! | [`fault`] | scripted faults: what goes wrong with a sample or a role, and when | yes, `no_std` |
//! | [`sample`](mod@sample) | the fixed-size samples that travel between roles | yes, `no_std` |
//! | [`state`] | what a state machine remembers, as words: written, read back, counted | yes, `no_std` |
//! | [`role`] | plant, observer and controller as state machines without clock and I/O | yes, `no_std` |
//! | [`rate`] | the observers and the law of angular velocities, as roles | yes, `no_std` |
//! | `serial` | a device behind a byte stream: the protocol and both of its ends | yes, `no_std`, with `serial` |
//! | `rig` | which plant, observer and law belong together | no |
//! | `config` | scenario files: text with its checks, and the settings of a run | no |
//! | `data` | logs that others wrote, read row by row | no |
//! | `analysis` | what may be claimed of the loop that runs: its rate, its floor | no |
//! | `bus` | links between roles: shared memory (iceoryx2) or in-memory | no |
//! | `clock` | the time grid and how to wait on it | no |
//! | `files` | files beside other users: what is this user's alone, and where what is written goes | no |
//! | `shared` | words of memory that processes share | no |
//! | `telemetry` | histograms and counters, exported after the loop | no |
//! | `runtime` | drives one role on a bus with a clock | no |
//! | `score` | scores a run from the truth and the estimates | no |
//! | `direct` | a run in one thread without links | no |
//! | `scenario` | a scenario with its rig: the generic code below behind a table of functions; the registry of rigs | no |
//! | `seat` | a role as a process: of this program, a function, a device, a foreign program | no |
//! | `record` | writes every sample of a run to a file; reads, replays, compares and exports it | no |
//! | `hosts` | a run over several computers: relay, clocks, who may join; with the feature of that name | no |
//! | `launch` | starts, supervises and ends a run; scores it | no |
//! | `campaign` | one scenario run many times, varied; the table of its cases | no |
//! | `report` | a run as one page that is looked at | no |
//! | `bench` | what all of it costs beside its floors | no |
//! | `doctor` | whether this machine is fit for real time | no |
//! | `watch` | a screen on a running loop | no |
//! | `program` | the command line, for every program that names its rigs | no |
//! | `foxglove` | a running loop on a Foxglove WebSocket, with the feature of that name | no |
//!
//! The sources that the documentation cites: \[D\] I. S. Dmytryshyn, *Synchronisation of angular velocities of identical
//! rigid bodies*; \[SZ\] V. F. Shcherbak, N. V. Zhogoleva, *Identification of the moments of inertia of a rigid body*;
//! \[S\] S. A. Shatkov, *State observers in the restricted two-body problem*.

#![cfg_attr(not(feature = "runtime"), no_std)]

// What the exported macros name: their code stands in other crates, and in this one.
extern crate self as corotate;
#[doc(hidden)]
pub use bytemuck;
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
pub mod state;
mod vector;

#[cfg(feature = "serial")]
pub mod serial;

#[cfg(feature = "runtime")]
pub mod analysis;
#[cfg(feature = "runtime")]
pub mod bench;
#[cfg(feature = "runtime")]
pub mod bus;
#[cfg(feature = "runtime")]
pub mod campaign;
#[cfg(feature = "runtime")]
pub mod clock;
#[cfg(feature = "runtime")]
pub mod config;
#[cfg(feature = "runtime")]
pub mod data;
#[cfg(feature = "runtime")]
mod direct;
#[cfg(feature = "runtime")]
pub mod doctor;
#[cfg(feature = "runtime")]
pub mod files;
#[cfg(feature = "foxglove")]
pub mod foxglove;
#[cfg(feature = "runtime")]
pub mod hosts;
#[cfg(feature = "runtime")]
pub mod launch;
#[cfg(feature = "runtime")]
mod panics;
#[cfg(feature = "runtime")]
mod program;
#[cfg(feature = "runtime")]
pub mod record;
#[cfg(feature = "runtime")]
pub mod report;
#[cfg(feature = "runtime")]
pub mod rig;
#[cfg(feature = "runtime")]
pub mod runtime;
#[cfg(feature = "runtime")]
pub mod scenario;
#[cfg(feature = "runtime")]
pub mod score;
#[cfg(feature = "runtime")]
pub mod seat;
#[cfg(feature = "runtime")]
pub mod shared;
#[cfg(feature = "runtime")]
pub mod system;
#[cfg(feature = "runtime")]
pub mod telemetry;
#[cfg(feature = "runtime")]
pub mod watch;

#[cfg(feature = "runtime")]
pub use program::Program;
