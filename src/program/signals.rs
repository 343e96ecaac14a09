//! Termination by signals, and by the death of the parent.

use super::output::{Exit, Failure, fail};
use crate::system::remedy;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize};

fn not_caught(error: io::Error) -> Failure {
    Failure::new("no-signals", format!("cannot catch signals: {error}; {}", remedy(&error)))
}

/// Catches SIGINT, SIGTERM and SIGHUP. Returns the number of the last one; 0 before the first.
pub fn catch_signals() -> Result<Arc<AtomicUsize>, Failure> {
    let signal = Arc::new(AtomicUsize::new(0));
    for number in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register_usize(number, signal.clone(), number as usize).map_err(not_caught)?;
    }
    Ok(signal)
}

/// Catches SIGINT and SIGTERM. Returns a flag that they set.
pub fn terminated_by_signals() -> Result<Arc<AtomicBool>, Exit> {
    let terminated = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        signal_hook::flag::register(signal, terminated.clone())
            .map_err(|error| fail(Exit::Failure, not_caught(error)))?;
    }
    Ok(terminated)
}

/// Asks the kernel to kill this process when its parent dies.
pub fn die_with(parent: i32) -> Result<(), Exit> {
    use rustix::process::{Signal, getppid, set_parent_process_death_signal};
    set_parent_process_death_signal(Some(Signal::KILL)).map_err(|error| {
        let error = io::Error::from(error);
        let text = format!("cannot request death with the launcher: {error}; {}", remedy(&error));
        fail(Exit::Failure, Failure::new("not-bound", text))
    })?;
    // The parent may have died before the request.
    match getppid() {
        Some(pid) if pid.as_raw_nonzero().get() == parent => Ok(()),
        _ => Err(fail(Exit::Failure, Failure::new("launcher-gone", "the launcher is gone; start the run again"))),
    }
}
