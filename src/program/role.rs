//! `corotate plant|observer|controller`: runs one role; the launcher starts roles by it.

use super::output::{CommandResult, Exit, fail};
use super::runs::join;
use crate::runtime::watch_continued;
use crate::seat::{RoleAddress, RoleError, run_role};
use signal_hook::consts::SIGCONT;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Options of every role.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The run's domain or results directory; `run --external ROLE` prints the domain [default: your newest run]
    #[arg(long, value_name = "DIR")]
    domain: Option<PathBuf>,
    /// Die with this process (set by the launcher)
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
}

const EXAMPLES: &str = "\
Example:
  corotate run pair.toml --external ROLE
                                   prints the command to type, with the domain";

/// Options of `corotate plant`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct PlantArguments {
    /// The body's name
    #[arg(long, value_name = "NAME")]
    pub body: String,
    #[command(flatten)]
    pub role: Arguments,
}

/// Options of `corotate observer`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct ObserverArguments {
    /// The observed body, if it is not the first one
    #[arg(long, value_name = "NAME")]
    pub body: Option<String>,
    #[command(flatten)]
    pub role: Arguments,
}

/// Runs the observer of a body, by default of the first one, to the end of the run.
pub fn observer(arguments: &ObserverArguments) -> CommandResult {
    let name = arguments.body.as_ref().map_or_else(|| "observer".to_owned(), |body| format!("observer-{body}"));
    role(&name, &arguments.role)
}

/// Runs a role to the end of the run.
pub fn role(name: &str, arguments: &Arguments) -> CommandResult {
    let (domain, terminated) = join(arguments.parent, arguments.domain.as_deref())?;
    let continued = Arc::new(AtomicBool::new(false));
    // Without the flag, a stop by a signal is not named as the cause of a late tick.
    if signal_hook::flag::register(SIGCONT, continued.clone()).is_ok() {
        watch_continued(continued);
    }
    let address = RoleAddress { domain, role: name.to_owned() };
    run_role(&address, &terminated).map(|()| Exit::Ok).map_err(|error| match error {
        RoleError::Domain(_) | RoleError::Config(_) | RoleError::NoSuchRole { .. } | RoleError::Hosted { .. } => {
            fail(Exit::Usage, error)
        }
        _ => fail(Exit::Failure, error),
    })
}
