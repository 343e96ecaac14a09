//! `corotate plant|observer|controller`: one role, as the launcher starts it.

use super::output::{Ended, Exit, fail};
use super::runs::join;
use crate::seat::{RoleAddress, RoleError, run_role};
use std::path::PathBuf;

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
pub fn role(name: &str, arguments: &Arguments) -> Ended {
    let (domain, terminated) = join(arguments.parent, arguments.domain.as_deref())?;
    let seat = RoleAddress { domain, role: name.to_owned() };
    run_role(&seat, &terminated).map(|()| Exit::Ok).map_err(|error| match error {
        RoleError::Domain(_) | RoleError::Config(_) | RoleError::NoSuchRole { .. } | RoleError::Hosted { .. } => {
            fail(Exit::Usage, error)
        }
        _ => fail(Exit::Failure, error),
    })
}
