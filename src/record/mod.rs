//! Recordings: writes every sample of a run to one file, and reads, replays, compares and exports such files.
//!
//! | file | duty |
//! |---|---|
//! | `writer` | writes the MCAP file: chunks of bounded age, full disks |
//! | `changes` | writes the changes of inputs as messages of the signal `input`, so that foreign readers of a recording see them |
//! | `taps` | takes every sample of a run off a bus, and counts it |
//! | `recorder` | writes a run to a file, and compares its counters with those of the roles |
//! | `process` | runs the recorder as a process beside a loop |
//! | `scan` | reads the records of a file up to its last whole chunk |
//! | `track` | a recorded signal: its samples as bytes, stamps and columns |
//! | `reader` | reads a recording: its metadata, its signals and their tracks |
//! | `script` | reconstructs the ticks that a role executed, and their inputs |
//! | `replay` | feeds recorded inputs to the live roles, and compares their outputs bit for bit |
//! | `diff` | compares two recordings |
//! | `error` | the errors of recordings |
//! | `export` | writes tables as CSV and, with the feature of that name, Parquet |
//!
//! Must not change a sample, nor delay a loop, except by its credit in lockstep.

mod changes;
mod diff;
mod error;
mod export;
mod process;
mod reader;
mod recorder;
mod replay;
mod scan;
mod script;
mod taps;
mod track;
mod writer;

pub use diff::{Comparison, SignalDiff, Tolerances, ValueDiff, diff};
pub use error::RecordError;
#[cfg(feature = "parquet")]
pub use export::export_parquet;
#[cfg(feature = "parquet")]
pub(crate) use export::{Cell, ColumnKind, RowGroups};
pub use export::{ExportError, export_csv};
pub use process::{RecorderOptions, run_recorder};
pub use reader::{EndInfo, Recording, RunInfo};
pub(crate) use recorder::{JOINING, RECORDER};
pub use recorder::{Recorder, RecordingReport, SignalReport};
pub use replay::{Comparer, Difference, Inlets, Outlets, RoleReplay, replay_in_process};
pub use script::{InputScript, Item, Limit, Script, Step};
#[cfg(feature = "foxglove")]
pub(crate) use taps::{Channel, MessageSink, Taps};
pub use track::{SignalInfo, Track};
