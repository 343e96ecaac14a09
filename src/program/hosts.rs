//! `corotate join`, its relay, and the options for connections between hosts.

use super::output::{CommandResult, Exit, Failure, fail};
use super::signals::die_with;
use crate::hosts::{Address, Endpoint, Keys};
use std::path::PathBuf;

/// Options for the authentication of hosts.
#[derive(clap::Args, Default, Clone)]
pub struct KeyArguments {
    /// Certificate of the authority that signed those of all hosts
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    tls_ca: Option<PathBuf>,
    /// Certificate of this host
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    tls_cert: Option<PathBuf>,
    /// Private key of this host
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    tls_key: Option<PathBuf>,
    /// Accept hosts without TLS (insecure)
    #[arg(long, hide_short_help = true)]
    insecure: bool,
}

impl KeyArguments {
    /// Returns true if any of the options is given.
    pub fn any(&self) -> bool {
        self.insecure || [&self.tls_ca, &self.tls_cert, &self.tls_key].into_iter().any(Option::is_some)
    }

    /// Returns the endpoint at an address, with these keys.
    pub fn endpoint(&self, address: Address) -> Result<Endpoint, Failure> {
        let keys = match (&self.tls_ca, &self.tls_cert, &self.tls_key) {
            (Some(ca), Some(cert), Some(key)) => Some(Keys { ca: ca.clone(), cert: cert.clone(), key: key.clone() }),
            (None, None, None) => None,
            _ => {
                let text = "--tls-ca, --tls-cert and --tls-key belong together; give all three or none";
                return Err(Failure::new("missing-keys", text));
            }
        };
        let endpoint = Endpoint { address, keys, insecure: self.insecure };
        endpoint.check()?;
        Ok(endpoint)
    }

    /// Returns the command line by which another host joins.
    pub fn join_command(&self, address: &Address) -> String {
        let keys = if self.tls_ca.is_some() { " --tls-ca FILE --tls-cert FILE --tls-key FILE" } else { "" };
        let insecure = if self.insecure { " --insecure" } else { "" };
        format!("join {address}{keys}{insecure}")
    }
}

/// Options of `corotate join`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct JoinArguments {
    /// Address of the run: quic/HOST:PORT, or tcp/ or udp/ on loopback
    #[arg(value_name = "ADDR")]
    address: Address,
    /// This host's name in the scenario [default: a free one]
    #[arg(long, value_name = "NAME")]
    host: Option<String>,
    #[command(flatten)]
    keys: KeyArguments,
    /// Print nothing but errors
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
The launching host sends the scenario with its files, and writes the results.
All hosts must run the same version with the same rigs.

Examples:
  corotate run FILE --host bench --listen tcp/127.0.0.1:7447
                                   on the launching host; it waits
  corotate join tcp/127.0.0.1:7447
                                   on every other host; here the same machine
  corotate join quic/bench.example:7447 --tls-ca ca.pem --tls-cert flight.pem
           --tls-key flight.key    over a network";

/// Options of the relay.
#[derive(clap::Args)]
pub struct RelayArguments {
    #[arg(long)]
    domain: PathBuf,
    #[arg(long)]
    host: String,
    #[arg(long)]
    hub: String,
    #[arg(long)]
    address: Address,
    #[command(flatten)]
    keys: KeyArguments,
    #[arg(long)]
    parent: Option<i32>,
}

/// Returns the reason for refusal if the program was built without hosts.
pub fn refusal() -> Option<&'static str> {
    (!cfg!(feature = "hosts")).then_some("this program was built without hosts; build it with `--features hosts`")
}

fn unusable(failure: Failure) -> Exit {
    fail(Exit::Usage, failure)
}

/// Joins a run to its end.
pub fn join(arguments: &JoinArguments) -> CommandResult {
    with_hosts::join(arguments, arguments.keys.endpoint(arguments.address.clone()).map_err(unusable)?)
}

/// Measures the link to a waiting host.
pub fn probe(address: &Address, keys: &KeyArguments, seconds: f64, json: bool) -> CommandResult {
    with_hosts::probe(&keys.endpoint(address.clone()).map_err(unusable)?, seconds, json)
}

/// Runs the relay of a host to the end of the run.
pub fn relay(arguments: &RelayArguments) -> CommandResult {
    arguments.parent.map_or(Ok(()), die_with)?;
    with_hosts::relay(arguments, arguments.keys.endpoint(arguments.address.clone()).map_err(unusable)?)
}

#[cfg(not(feature = "hosts"))]
mod with_hosts {
    use super::*;

    pub fn join(_arguments: &JoinArguments, _endpoint: Endpoint) -> CommandResult {
        Err(unusable(Failure::new("built-without", refusal().unwrap_or_default())))
    }

    pub fn relay(_arguments: &RelayArguments, _endpoint: Endpoint) -> CommandResult {
        Err(unusable(Failure::new("built-without", refusal().unwrap_or_default())))
    }

    pub fn probe(_endpoint: &Endpoint, _seconds: f64, _json: bool) -> CommandResult {
        Err(unusable(Failure::new("built-without", refusal().unwrap_or_default())))
    }
}

#[cfg(feature = "hosts")]
mod with_hosts {
    use super::*;
    use crate::hosts::{
        Admission, HostEndpoint, JoinError, JoinRequest, NetError, RelayError, RelayOptions, ask_to_join, run_relay,
    };
    use crate::launch::{FarOutcome, Launch, new_domain};
    use crate::program::output::exit_of;
    use crate::program::output::say;
    use crate::program::signals::catch_signals;
    use crate::program::signals::terminated_by_signals;
    use crate::scenario::Scenario;
    use crate::system::{random_bits, tell};

    pub fn relay(arguments: &RelayArguments, endpoint: Endpoint) -> CommandResult {
        let terminated = terminated_by_signals()?;
        let host = HostEndpoint { host: arguments.host.clone(), endpoint };
        let options = RelayOptions { domain: arguments.domain.clone(), host, hub: arguments.hub.clone() };
        run_relay(&options, &terminated).map(|()| Exit::Ok).map_err(|error| match error {
            RelayError::NoHost(..) | RelayError::Clock(_) => fail(Exit::Usage, error),
            _ => fail(Exit::Failure, error),
        })
    }

    pub fn probe(endpoint: &Endpoint, seconds: f64, json: bool) -> CommandResult {
        let probe = crate::hosts::probe(endpoint, seconds).map_err(|error| fail(Exit::Failure, error))?;
        let object = || serde_json::to_string(&probe).expect("figures are JSON") + "\n";
        say(&if json { object() } else { probe.to_string() })
    }

    pub fn join(arguments: &JoinArguments, endpoint: Endpoint) -> CommandResult {
        let signal = catch_signals().map_err(|error| fail(Exit::Failure, error))?;
        let part = ask(arguments, &endpoint)?;
        let print_unless_quiet = |text: &str| {
            if !arguments.quiet {
                tell(text);
            }
        };
        print_unless_quiet(&format!("joined the run of host {} as host {}", part.hub, part.host));
        // Read twice: the scenario determines the size of the domain, and its files belong in the domain.
        let temporary = tempfile::tempdir()
            .map_err(|error| fail(Exit::Failure, Failure::new("cannot-create", format!("cannot join: {error}"))))?;
        let sized = part.scenario(temporary.path()).map_err(refused)?;
        let owned = new_domain(&sized).map_err(|error| fail(exit_of(&error), error))?;
        drop(temporary);
        let scenario: Scenario = part.scenario(owned.domain().root()).map_err(refused)?;
        let seat = HostEndpoint { host: part.host.clone(), endpoint };
        let mut silent = |_: &crate::launch::Progress<'_>| {};
        let mut launch = Launch::new(&signal, &mut silent);
        let outcome = crate::launch::join(&scenario, owned, &seat, &part.hub, &mut launch);
        let FarOutcome { failed, ticks: (executed, missed), .. } =
            outcome.map_err(|error| fail(exit_of(&error), error))?;
        print_unless_quiet(&format!("host {}: its roles executed {executed} ticks and missed {missed}", part.host));
        let signal = signal.load(std::sync::atomic::Ordering::Relaxed);
        Ok(match failed {
            Some(_) if signal != 0 => Exit::Signal(signal),
            Some(reason) => fail(Exit::ProcessLost, Failure::new("run-failed", reason)),
            None => Exit::Ok,
        })
    }

    /// Asks the launching host for a part in the run.
    fn ask(arguments: &JoinArguments, endpoint: &Endpoint) -> Result<Admission, Exit> {
        let token =
            random_bits().map_err(|error| fail(Exit::Failure, Failure::new("no-random-numbers", error)))? as u64;
        let request = JoinRequest::new(arguments.host.as_deref(), token).encode();
        let answer = ask_to_join(endpoint, &request);
        let answer = answer.map_err(|error| {
            let usage = matches!(error, NetError::Key { .. });
            fail(if usage { Exit::Usage } else { Exit::Failure }, error)
        })?;
        Admission::decode(&answer).map_err(refused)
    }

    fn refused(error: JoinError) -> Exit {
        let exit = if matches!(error, JoinError::Write { .. }) { Exit::Failure } else { Exit::Usage };
        fail(exit, Failure::prefixed("cannot join", error))
    }
}
