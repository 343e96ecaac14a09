//! Runs whole loops under every clock, in one process or several, with devices and on several hosts, and checks how they end.

mod actuation_delay;
mod allocations;
mod claims;
mod computed;
mod conformance;
mod debugging;
mod fleet;
mod hil;
#[cfg(feature = "hosts")]
mod hosts;
mod one_process;
mod own_rig;
mod processes;
mod serial;
mod timing;
mod verdicts;
