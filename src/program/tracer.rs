//! `corotate tracer`: records the kernel's trace beside a run; the launcher starts it.

use super::output::{CommandResult, Exit, fail};
use super::runs::join;
use crate::late::run_tracer;
use std::path::PathBuf;

/// Options of the tracing process.
#[derive(clap::Args)]
pub struct Arguments {
    /// The run's domain
    #[arg(long)]
    domain: PathBuf,
    /// Die with this process (set by the launcher)
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
}

/// Traces a run to its end.
pub fn tracer(arguments: &Arguments) -> CommandResult {
    let (domain, terminated) = join(arguments.parent, Some(&arguments.domain))?;
    run_tracer(&domain, &terminated).map(|()| Exit::Ok).map_err(|error| fail(Exit::Failure, error))
}
