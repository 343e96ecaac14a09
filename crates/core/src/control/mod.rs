//! Control laws with their certificates. Pure: no clock, no I/O, no allocation, no logging.

mod adaptation;
mod certificate;
mod fleet;
mod in_flight;
mod orbit_certificate;
mod orbit_hold;
mod synchronizer;
mod watchdog;

pub use adaptation::InertiaAdaptation;
pub use certificate::{Certificate, Condition};
pub use fleet::FleetLaw;
pub use in_flight::{ACTUATION_DELAY_MAX, InFlightCommands};
pub use orbit_certificate::OrbitCertificate;
pub use orbit_hold::{OrbitGains, OrbitHold};
pub use synchronizer::{Synchronizer, limited};
pub use watchdog::{Breaches, WATCHED_MAX, WatchBounds, Watchdog};
