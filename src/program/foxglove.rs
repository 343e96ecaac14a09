//! `corotate foxglove`: serves a running loop on a Foxglove WebSocket. `corotate run --foxglove` starts it too.

use super::output::{CommandResult, Exit, Failure, fail};
use std::net::SocketAddr;
use std::path::PathBuf;

/// The default address: this machine only, Foxglove's port.
pub const ADDRESS: &str = "127.0.0.1:8765";

/// Options of `corotate foxglove`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The run's results directory or domain [default: your newest run]
    #[arg(value_name = "DIR")]
    domain: Option<PathBuf>,
    /// Listen on IP:PORT; with port 0 on a free port, which is printed
    #[arg(long, value_name = "ADDR", default_value = ADDRESS, value_parser = address)]
    address: SocketAddr,
    /// Write the address to this file (set by the launcher)
    #[arg(long, value_name = "FILE", hide = true)]
    tell: Option<PathBuf>,
    /// Die with this process (set by the launcher)
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
}

const EXAMPLES: &str = "\
Examples:
  corotate run rigid-pair --foxglove
                                   from the first tick; in Foxglove open
                                   \"Foxglove WebSocket\", ws://localhost:8765
  corotate run & corotate foxglove your newest run, from now on; end with Ctrl-C
  corotate foxglove --address 0.0.0.0:9000
                                   for other machines too; no authentication";

/// Parses the address to listen on.
pub fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| format!("not IP:PORT, such as {ADDRESS}; give the scenario before this option"))
}

/// Returns the reason for refusal if the program was built without Foxglove.
pub fn refusal() -> Option<&'static str> {
    let remedy = "this program was built without Foxglove; build it with `cargo build --release --features foxglove`";
    (!cfg!(feature = "foxglove")).then_some(remedy)
}

/// Serves a run to its end.
pub fn foxglove(arguments: &Arguments) -> CommandResult {
    refusal().map_or_else(|| serve(arguments), |reason| Err(fail(Exit::Usage, Failure::new("built-without", reason))))
}

#[cfg(not(feature = "foxglove"))]
fn serve(_: &Arguments) -> CommandResult {
    Err(Exit::Usage)
}

#[cfg(feature = "foxglove")]
fn serve(Arguments { domain, address, tell, parent }: &Arguments) -> CommandResult {
    use crate::foxglove::{FoxgloveError, FoxgloveOptions, run_foxglove};
    let (domain, terminated) = super::runs::join(*parent, domain.as_deref())?;
    let options = FoxgloveOptions { domain: Some(domain), address: *address, url_file: tell.clone() };
    run_foxglove(&options, &terminated).map(|()| Exit::Ok).map_err(|error| match error {
        FoxgloveError::Run(_) => fail(Exit::Usage, error),
        _ => fail(Exit::Failure, error),
    })
}
