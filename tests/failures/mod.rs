//! Failures of samples, processes, system calls, the machine, other users and the input: runs recover or are refused.

mod bad_input;
mod environment;
mod faults;
mod injection;
mod joiners;
#[cfg(feature = "hooks")]
mod kill_campaign;
#[cfg(feature = "hooks")]
mod kill_matrix;
mod neighbours;
mod strangers;
