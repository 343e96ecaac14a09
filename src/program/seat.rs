//! `corotate seat`: prints what a foreign program needs to be a role.

use super::output::{CommandResult, Exit, fail, say};
use super::runs;
use super::scenario::{Change, load};
use super::seat_header::header;
use crate::config::{ClockKind, NotExternal};
use crate::runtime::RoleId;
use crate::seat::{RoleError, describe_seat, join_run};
use crate::system::tell;
use std::path::PathBuf;

/// Options of `corotate seat`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// A shipped scenario's name, a file (x.toml, ./x), or - for stdin
    #[arg(value_name = "SCENARIO")]
    file: PathBuf,
    /// The role: a body's name, observer or controller
    role: String,
    /// Clock of the ticks
    #[arg(long, value_name = "CLOCK", value_parser = ["realtime", "lockstep"])]
    clock: Option<String>,
    /// Override any key of the scenario
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// The waiting run's domain or results directory, or latest; SCENARIO must be the domain's scenario.toml
    #[arg(long, value_name = "DIR")]
    domain: Option<PathBuf>,
    /// Print the samples as a C header for libcorotate instead
    #[arg(long, conflicts_with = "domain")]
    header: bool,
}

const EXAMPLES: &str = "\
Example:
  corotate seat pair.toml follower
                                   services, samples and fields of the role
  corotate seat pair.toml controller --header > controller.h
                                   the structs for a program in C or C++";

/// Prints the seat as JSON.
pub fn seat(arguments: &Arguments) -> CommandResult {
    let clock = arguments.clock.iter().map(|clock| Change::Option("--clock", "clock", clock));
    let changes = arguments.set.iter().map(|argument| Change::Set(argument)).chain(clock);
    let scenario = load(Some(&arguments.file), changes).map_err(|error| fail(Exit::Usage, error))?;
    if scenario.clock == ClockKind::InProcess {
        return Err(fail(Exit::Usage, NotExternal::OneProcess));
    }
    let role = RoleId::named(&scenario, &arguments.role).ok_or_else(|| {
        let (role, known) = (arguments.role.clone(), scenario.roles().join(", "));
        fail(Exit::Usage, RoleError::NoSuchRole { role, known })
    })?;
    scenario.check_external(&arguments.role).map_err(|error| fail(Exit::Usage, error))?;
    if arguments.header {
        return say(&header(&scenario, role));
    }
    let root = arguments.domain.as_deref().map(|given| runs::domain(Some(given))).transpose()?;
    let domain = root.map(|root| join_run(&scenario, &root)).transpose();
    let domain = domain.map_err(|error| fail(Exit::Usage, error))?;
    if domain.is_none() {
        let name = &arguments.role;
        tell(format_args!(
            "corotate: without a domain, which exists only during a run; `run --external {name}` writes it with one, or add --domain"
        ));
    }
    say(&describe_seat(&scenario, role, domain.as_ref()).to_json())
}
