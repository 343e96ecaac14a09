//! Addresses of hosts, and the keys that they require. Must not open anything.

use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;
use std::str::FromStr;

/// Name of a run's relay, in places where roles have theirs.
pub const RELAY: &str = "relay";

/// The protocol that carries messages between hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Carrier {
    /// TCP, unencrypted.
    Tcp,
    /// UDP, unencrypted: lost datagrams are not repeated.
    Udp,
    /// QUIC (TLS 1.3 over UDP); both sides show a certificate. There is no TLS over TCP, because zenoh reads and writes such a
    /// connection from two threads without a lock (its issue 2557), and crashes.
    Quic,
}

/// The address of a listening host: `tcp/HOST:PORT`, `udp/HOST:PORT` or `quic/HOST:PORT`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// The protocol.
    pub carrier: Carrier,
    host: String,
    port: u16,
}

/// Reasons to refuse an address, or its combination with keys.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum AddressError {
    /// The address is malformed.
    #[error("`{0}` is not an address; write quic/HOST:PORT, tcp/HOST:PORT or udp/HOST:PORT")]
    #[strum(serialize = "not-an-address")]
    Form(String),
    /// Any host could join.
    #[error(
        "{0} accepts any host that can reach it; use quic/HOST:PORT with --tls-ca, --tls-cert and --tls-key, or add --insecure on a \
         trusted network"
    )]
    #[strum(serialize = "open-address")]
    Open(Address),
    /// Keys are missing.
    #[error("{0} needs --tls-ca, --tls-cert and --tls-key; docs/hosts.md shows how to make keys")]
    #[strum(serialize = "missing-keys")]
    Keys(Address),
    /// The protocol does not use keys.
    #[error("{0} does not use keys; use quic/HOST:PORT, or leave out --tls-ca, --tls-cert and --tls-key")]
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
            // In zenoh, the text after a `?` or `#` in an address configures the session.
            let plain = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'_' | b':' | b'[' | b']');
            let whole = !host.is_empty() && host.bytes().all(plain);
            whole.then_some(Self { carrier, host: host.to_owned(), port: port.parse().ok()? })
        };
        parse().ok_or_else(|| AddressError::Form(text.to_owned()))
    }
}

impl Address {
    /// Returns true if only this machine can reach the address.
    fn is_loopback(&self) -> bool {
        let bare = self.host.trim_matches(['[', ']']);
        bare == "localhost" || bare.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
    }
}

/// The files with which a host proves its identity and checks that of others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    /// Certificate of the authority that has signed the certificates of all hosts.
    pub ca: PathBuf,
    /// Certificate of this host.
    pub cert: PathBuf,
    /// Private key of this host.
    pub key: PathBuf,
}

/// An address with its keys.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Endpoint {
    /// The address.
    pub address: Address,
    /// The keys, for QUIC.
    pub keys: Option<Keys>,
    /// True if any host that can reach the address may join.
    pub insecure: bool,
}

impl Endpoint {
    /// Checks that the address has keys, is a loopback address, or is insecure by request.
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

    /// Returns the command-line options that give another process of this program the same endpoint.
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

/// A host of a run, with the address of the launching host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostEndpoint {
    /// Name of the host in the scenario.
    pub host: String,
    /// Address and keys of the launching host.
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
    fn an_address_prints_as_written_and_a_malformed_one_is_refused() {
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
    fn an_address_beyond_loopback_needs_keys_or_insecure() {
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
