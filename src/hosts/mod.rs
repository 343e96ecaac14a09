//! A run over several hosts: what crosses from one to another, on which time, and who may take part.
//!
//! On every host one process, the relay, has the place of all roles that run elsewhere: it writes their signals into the shared memory
//! here, and sends those that are read there. The roles know nothing of it. Only [`net`](self) knows zenoh. Must not judge a sample, nor
//! decide how a run goes on.

#[cfg(feature = "hosts")]
mod carry;
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
mod seat;
#[cfg(feature = "hosts")]
mod stream;
#[cfg(feature = "hosts")]
mod timing;
#[cfg(feature = "hosts")]
mod wire;

#[cfg(feature = "hosts")]
pub use join::{JoinError, Part, Request};
#[cfg(feature = "hosts")]
pub use net::{Inquiry, NetError, ask_to_join};
#[cfg(feature = "hosts")]
pub use offset::{Estimate, Exchange, OffsetEstimator};
#[cfg(feature = "hosts")]
pub use probe::{Probe, probe};
#[cfg(feature = "hosts")]
pub use relay::{RelayError, RelaySeat, run_relay};
pub use report::{ClockReport, HostReport, HostsSummary, LinkEnd, Silence};
pub(crate) use report::{far_end_path, ready_path, relay_report_path};
pub use seat::{Address, AddressError, Carrier, Endpoint, HostSeat, Keys, RELAY};
#[cfg(feature = "hosts")]
pub use timing::ClockRefused;
