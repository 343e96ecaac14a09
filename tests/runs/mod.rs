//! Whole loops: under every clock, in one or several processes, with devices, on several hosts.

mod actuation_delay;
mod allocations;
mod c_programs;
mod claims;
mod computed;
mod conformance;
mod debugging;
mod fleet;
mod hil;
#[cfg(feature = "hosts")]
mod hosts;
mod inputs;
mod late;
mod observed;
mod one_plant;
mod one_process;
mod overrun;
mod own_rig;
mod pace;
mod processes;
mod rates;
mod serial;
mod served;
mod timing;
mod udp;
mod verdicts;
