//! A run over several hosts: the signals that cross, the common time, and the admission of hosts.
//!
//! On every host one process, the relay, stands in for all roles that run elsewhere: it writes their signals into the shared memory of
//! its host, and sends those that they read. Roles need no change. Only `net` uses zenoh. Must not judge a sample, nor decide how a run
//! goes on.

#[cfg(feature = "hosts")]
mod changes;
#[cfg(feature = "hosts")]
mod clock;
mod endpoint;
#[cfg(feature = "hosts")]
mod forward;
#[cfg(feature = "hosts")]
mod join;
#[cfg(feature = "hosts")]
mod net;
#[cfg(feature = "hosts")]
mod offset;
#[cfg(feature = "hosts")]
mod plan;
#[cfg(feature = "hosts")]
mod probe;
#[cfg(feature = "hosts")]
mod relay;
mod report;
#[cfg(feature = "hosts")]
mod stream;
#[cfg(feature = "hosts")]
mod wire;

#[cfg(feature = "hosts")]
pub use clock::ClockError;
pub use endpoint::{Address, AddressError, Carrier, Endpoint, HostEndpoint, Keys, RELAY};
#[cfg(feature = "hosts")]
pub use join::{Admission, JoinError, JoinRequest};
#[cfg(feature = "hosts")]
pub use net::{HubSession, NetError, ask_to_join};
#[cfg(feature = "hosts")]
pub use offset::{Estimate, Exchange, OffsetEstimator};
#[cfg(feature = "hosts")]
pub use probe::{Probe, probe};
#[cfg(feature = "hosts")]
pub use relay::{RelayError, RelayOptions, run_relay};
pub use report::{ClockStatistics, HostStatistics, LinkStatistics, NetworkStatistics, Silence};
pub(crate) use report::{far_end_path, ready_path, relay_report_path};
