//! `corotate foxglove`: a running loop on a Foxglove WebSocket, as `corotate run --foxglove` starts it or by hand.

use super::output::{Ended, Exit, Failure, fail};
use std::net::SocketAddr;
use std::path::PathBuf;

/// Where it listens unless told otherwise: on this machine only, at Foxglove's own port.
pub const ADDRESS: &str = "127.0.0.1:8765";

/// Options of `corotate foxglove`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The run: the directory that its results go to, or its domain [default: the newest run of this user]
    #[arg(value_name = "DIR")]
    domain: Option<PathBuf>,
    /// Where to listen, as IP:PORT; at port 0 the system chooses one, and it is printed
    #[arg(long, value_name = "ADDR", default_value = ADDRESS, value_parser = address)]
    address: SocketAddr,
    /// Where to tell the address (the launcher gives a file)
    #[arg(long, value_name = "FILE", hide = true)]
    tell: Option<PathBuf>,
    /// Die with this process (the launcher gives its own id)
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
}

const EXAMPLES: &str = "\
Examples:
  corotate run rigid-pair --foxglove
                                   from the first tick on; in Foxglove open
                                   \"Foxglove WebSocket\", ws://localhost:8765
  corotate run & corotate foxglove the newest run of this user, from now on;
                                   Ctrl-C ends it in order
  corotate foxglove --address 0.0.0.0:9000
                                   for other machines too: whoever reaches
                                   that port sees everything";

/// Where to listen, as it is typed.
pub fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| format!("it is not IP:PORT, as {ADDRESS}; the scenario's file goes before this option"))
}

/// What there is to say to whoever asks a program for it that was built without.
pub fn refusal() -> Option<&'static str> {
    let remedy = "this program was built without Foxglove; build it with `cargo build --release --features foxglove`";
    (!cfg!(feature = "foxglove")).then_some(remedy)
}

/// Shows a run to its end.
pub fn foxglove(arguments: &Arguments) -> Ended {
    refusal().map_or_else(|| serve(arguments), |reason| Err(fail(Exit::Usage, Failure::new("built-without", reason))))
}

#[cfg(not(feature = "foxglove"))]
fn serve(_: &Arguments) -> Ended {
    Err(Exit::Usage)
}

#[cfg(feature = "foxglove")]
fn serve(Arguments { domain, address, tell, parent }: &Arguments) -> Ended {
    use crate::foxglove::{FoxgloveError, FoxgloveOptions, run_foxglove};
    let (domain, terminated) = super::runs::join(*parent, domain.as_deref())?;
    let options = FoxgloveOptions { domain: Some(domain), address: *address, url_file: tell.clone() };
    run_foxglove(&options, &terminated).map(|()| Exit::Ok).map_err(|error| match error {
        FoxgloveError::Run(_) => fail(Exit::Usage, error),
        _ => fail(Exit::Failure, error),
    })
}
