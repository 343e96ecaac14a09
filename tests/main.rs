//! All tests but those beside the code: one program, which is compiled and linked once.
//! `cargo test --release --test all hil::` runs those of `hil.rs`.
//! Tests run beside each other, so none may change what belongs to the whole process.

mod common;

mod actuation_delay;
mod allocations;
mod bench;
mod campaign;
mod campaign_page;
mod claims;
mod command_line;
mod computed;
mod conformance;
mod contest;
#[path = "../benches/contest/main.rs"]
#[allow(dead_code, reason = "its command line is not used")]
mod contestants;
mod damage;
mod debugging;
mod directories;
mod doctor;
mod documents;
mod environment;
mod faults;
mod fleet;
#[cfg(feature = "foxglove")]
mod foxglove;
mod gyro_loss;
mod hil;
#[cfg(feature = "hosts")]
mod hosts;
mod identification;
mod injection;
mod joiners;
mod junit;
#[cfg(feature = "hooks")]
mod kill_campaign;
#[cfg(feature = "hooks")]
mod kill_matrix;
mod mathematics;
mod neighbours;
mod noise;
mod one_process;
mod orbit;
mod own_data;
mod own_rig;
#[cfg(feature = "parquet")]
mod parquet;
mod processes;
mod record;
mod reference_loop;
mod report;
mod serial;
mod strangers;
mod timing;
mod verdicts;
mod watch;
