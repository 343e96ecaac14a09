//! `corotate plant|observer|controller`: one role, as the launcher starts it.

use super::run::not_caught;
use super::{Exit, fail, runs};
use crate::runtime::{RoleError, RoleSeat, run_role};
use crate::system::remedy;
use signal_hook::consts::{SIGINT, SIGTERM};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Options of every role.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The run: its domain, as `corotate run --external ROLE` prints it, or the directory that its results go to [default: the newest run of this user]
    #[arg(long, value_name = "DIR")]
    domain: Option<PathBuf>,
    /// Die with this process (the launcher gives its own id)
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
}

const EXAMPLES: &str = "\
Example:
  corotate run pair.toml --external ROLE
                                   prints the line to type, with the domain";

/// Options of `corotate plant`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct PlantArguments {
    /// The body's name
    #[arg(long, value_name = "NAME")]
    pub body: String,
    #[command(flatten)]
    pub seat: Arguments,
}

/// Serves a role to the end of the run.
pub fn role(name: &str, arguments: &Arguments) -> Exit {
    if let Some(Err(exit)) = arguments.parent.map(die_with) {
        return exit;
    }
    let terminated = match terminated_by_signals() {
        Ok(terminated) => terminated,
        Err(exit) => return exit,
    };
    let domain = match runs::domain(arguments.domain.as_deref()) {
        Ok(domain) => domain,
        Err(exit) => return exit,
    };
    let seat = RoleSeat { domain, role: name.to_owned() };
    match run_role(&seat, &terminated) {
        Ok(()) => Exit::Ok,
        Err(error) => {
            let usage = matches!(
                error,
                RoleError::Domain(_) | RoleError::Config(_) | RoleError::NoSuchRole { .. } | RoleError::Hosted { .. }
            );
            fail(if usage { Exit::Usage } else { Exit::Failure }, &error)
        }
    }
}

/// A flag that the signals which ask a process to end set.
pub fn terminated_by_signals() -> Result<Arc<AtomicBool>, Exit> {
    let terminated = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        signal_hook::flag::register(signal, terminated.clone())
            .map_err(|error| fail(Exit::Failure, &not_caught(error)))?;
    }
    Ok(terminated)
}

/// Asks the kernel to kill this process when its parent dies.
pub fn die_with(parent: i32) -> Result<(), Exit> {
    use rustix::process::{Signal, getppid, set_parent_process_death_signal};
    set_parent_process_death_signal(Some(Signal::KILL)).map_err(|error| {
        let error = std::io::Error::from(error);
        fail(Exit::Failure, &format!("cannot be bound to the launcher's life: {error}; {}", remedy(&error)))
    })?;
    // The parent may have died before the request.
    match getppid() {
        Some(pid) if pid.as_raw_nonzero().get() == parent => Ok(()),
        _ => Err(fail(Exit::Failure, &"the launcher is gone; start the run again")),
    }
}
