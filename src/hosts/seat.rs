//! Where a host is reached, and what it takes to be let in. Must not open anything.

use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;
use std::str::FromStr;

/// The name of a run's relay where a role would have its own.
pub const RELAY: &str = "relay";

/// What carries the messages between hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Carrier {
    /// TCP, in the clear.
    Tcp,
    /// UDP, in the clear: what is lost is not sent again.
    Udp,
    /// QUIC, which is TLS 1.3 over UDP; both sides show who they are. The engine's TLS over TCP reads and writes one connection from two
    /// threads without a lock (its issue 2557), and dies of it.
    Quic,
}

/// Where a host listens: `tcp/HOST:PORT`, `udp/HOST:PORT` or `quic/HOST:PORT`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// What carries the messages.
    pub carrier: Carrier,
    host: String,
    port: u16,
}

/// Why an address, or the way to use it, is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum AddressError {
    /// It has not the form.
    #[error("`{0}` is no address; write quic/HOST:PORT, tcp/HOST:PORT or udp/HOST:PORT")]
    #[strum(serialize = "not-an-address")]
    Form(String),
    /// Anybody could join.
    #[error(
        "{0} is open to everybody who reaches it; take quic/HOST:PORT with --tls-ca, --tls-cert and --tls-key, or say --insecure if \
         only friends do"
    )]
    #[strum(serialize = "open-address")]
    Open(Address),
    /// Keys are missing.
    #[error("{0} needs --tls-ca, --tls-cert and --tls-key, all three; docs/hosts.md tells how to make them")]
    #[strum(serialize = "missing-keys")]
    Keys(Address),
    /// Keys are of no use.
    #[error("{0} uses no keys; take quic/HOST:PORT, or leave --tls-ca, --tls-cert and --tls-key out")]
    #[strum(serialize = "unused-keys")]
    NoKeys(Address),
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let carrier = match self.carrier {
            Carrier::Tcp => "tcp",
            Carrier::Udp => "udp",
            Carrier::Quic => "quic",
        };
        write!(f, "{carrier}/{}:{}", self.host, self.port)
    }
}

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        let parse = || {
            let (carrier, place) = text.split_once('/')?;
            let carrier = match carrier {
                "tcp" => Carrier::Tcp,
                "udp" => Carrier::Udp,
                "quic" => Carrier::Quic,
                _ => return None,
            };
            let (host, port) = place.rsplit_once(':')?;
            // What follows a `?` or `#` in an address of the engine's would configure it.
            let plain = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'_' | b':' | b'[' | b']');
            let whole = !host.is_empty() && host.bytes().all(plain);
            whole.then_some(Self { carrier, host: host.to_owned(), port: port.parse().ok()? })
        };
        parse().ok_or_else(|| AddressError::Form(text.to_owned()))
    }
}

impl Address {
    /// Whether only this machine reaches it.
    fn is_loopback(&self) -> bool {
        let bare = self.host.trim_matches(['[', ']']);
        bare == "localhost" || bare.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
    }
}

/// The files by which a host shows who it is, and knows who others are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    /// The certificate of the authority that has signed those of all hosts.
    pub ca: PathBuf,
    /// This host's certificate.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

/// An address with all that it takes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Endpoint {
    /// Where.
    pub address: Address,
    /// The keys, with QUIC.
    pub keys: Option<Keys>,
    /// Whether it may be open to everybody who reaches it.
    pub insecure: bool,
}

impl Endpoint {
    /// Refuses what would be open without having been said to be.
    ///
    /// # Errors
    /// [`AddressError`].
    pub fn check(&self) -> Result<(), AddressError> {
        let address = self.address.clone();
        match (self.address.carrier, &self.keys) {
            (Carrier::Quic, None) => Err(AddressError::Keys(address)),
            (Carrier::Quic, Some(_)) => Ok(()),
            (_, Some(_)) => Err(AddressError::NoKeys(address)),
            (_, None) if self.insecure || self.address.is_loopback() => Ok(()),
            (_, None) => Err(AddressError::Open(address)),
        }
    }

    /// The options that give another process of this program the same.
    pub fn options(&self) -> Vec<std::ffi::OsString> {
        let mut options = vec!["--address".into(), self.address.to_string().into()];
        if let Some(Keys { ca, cert, key }) = &self.keys {
            let files = [("--tls-ca", ca), ("--tls-cert", cert), ("--tls-key", key)];
            options.extend(files.into_iter().flat_map(|(option, file)| [option.into(), file.clone().into()]));
        }
        options.extend(self.insecure.then(|| "--insecure".into()));
        options
    }
}

/// The part of one host in a run that another may have launched.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostSeat {
    /// The host's name in the scenario.
    pub host: String,
    /// Where the host that launches listens.
    pub endpoint: Endpoint,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn endpoint(address: &str, keys: bool, insecure: bool) -> Endpoint {
        let file = |name: &str| PathBuf::from(name);
        let keys = keys.then(|| Keys { ca: file("ca"), cert: file("cert"), key: file("key") });
        Endpoint { address: address.parse().unwrap(), keys, insecure }
    }

    #[test]
    fn an_address_is_what_it_says() {
        for text in ["tcp/127.0.0.1:7447", "quic/bench.example:1", "udp/[::1]:65535"] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        for text in [
            "",
            "127.0.0.1:7447",
            "tls/a:1",
            "tcp/a",
            "tcp/:1",
            "tcp/a:70000",
            "tcp/a:1?rel=0",
            "tcp/a;x:1",
            "tcp/a/b:1",
        ] {
            assert!(matches!(text.parse::<Address>(), Err(AddressError::Form(_))), "{text}");
        }
    }

    #[test]
    fn nothing_is_open_that_was_not_said_to_be() {
        for loopback in ["tcp/127.0.0.1:1", "udp/[::1]:1", "tcp/localhost:1"] {
            assert_eq!(endpoint(loopback, false, false).check(), Ok(()));
        }
        let open = endpoint("tcp/192.0.2.1:1", false, false);
        assert!(matches!(open.check(), Err(AddressError::Open(_))));
        assert_eq!(endpoint("tcp/0.0.0.0:1", false, true).check(), Ok(()));
        assert!(matches!(endpoint("tcp/0.0.0.0:1", false, false).check(), Err(AddressError::Open(_))));
        assert_eq!(endpoint("quic/192.0.2.1:1", true, false).check(), Ok(()));
        assert!(matches!(endpoint("quic/127.0.0.1:1", false, true).check(), Err(AddressError::Keys(_))));
        assert!(matches!(endpoint("tcp/127.0.0.1:1", true, false).check(), Err(AddressError::NoKeys(_))));
    }
}
