//! Scenario files: the text as typed, its checks, and the [`Settings`] that it resolves to. An invalid scenario starts nothing.
//!
//! Every error gives file, line and key, the reason and the remedy. Must not touch the machine beyond reading the file.

pub(crate) mod accept;
mod body;
mod checks;
pub(crate) mod common;
mod document;
mod edit;
mod error;
pub(crate) mod fault;
pub(crate) mod hosts;
pub(crate) mod input;
mod rates;
pub(crate) mod raw;
mod reader;
pub(crate) mod reference;
mod run_id;
pub(crate) mod sensor;
mod settings;
mod shape;
pub(crate) mod watchdog;

pub use accept::{Accept, TickAmount, TickLimit};
pub(crate) use body::observe;
pub use body::{BodyInfo, role_names};
pub use checks::Checks;
pub use document::{Document, read_text};
pub use error::{ConfigError, PathError, Place, Problem};
pub use fault::ScriptedFault;
pub use hosts::{ClockSource, Host, Hosts, LinkBudget, Network};
pub(crate) use input::DISCONNECTED;
pub use input::{ChangeLists, InputInfo, InputUse, InputUser, Inputs, ResponseField, Variability, set_point_of};
pub use rates::Rates;
pub use raw::{ClockKind, Cores, NamedCores, OnFailure, Overrun, Policy, Realtime, Supervision, Trace, Wake};
pub(crate) use reader::keys_of;
pub use run_id::{NoRunId, RunId};
pub use sensor::Sensor;
pub use settings::{NotExternal, Settings};
pub(crate) use shape::{Key, Shape};

pub use error::nearest;

/// Returns true if a text is the name of something shipped with the program, not a file's path.
pub fn is_name(text: &str) -> bool {
    !text.contains('/') && !text.ends_with(".toml")
}

/// The scenarios that ship with the program: name and text.
pub const SHIPPED: [(&str, &str); 13] = [
    ("rigid-pair", include_str!("../../config/rigid-pair.toml")),
    ("rigid-pair-hyperbolic", include_str!("../../config/rigid-pair-hyperbolic.toml")),
    ("rigid-trio", include_str!("../../config/rigid-trio.toml")),
    ("rigid-fleet", include_str!("../../config/rigid-fleet.toml")),
    ("noisy-pair", include_str!("../../config/noisy-pair.toml")),
    ("mismatched-follower", include_str!("../../config/mismatched-follower.toml")),
    ("inertia", include_str!("../../config/inertia.toml")),
    ("inertia-axisymmetric", include_str!("../../config/inertia-axisymmetric.toml")),
    ("gyro-loss", include_str!("../../config/gyro-loss.toml")),
    ("recorded-leader", include_str!("../../config/recorded-leader.toml")),
    ("faults", include_str!("../../config/faults.toml")),
    ("orbit-hold", include_str!("../../config/orbit-hold.toml")),
    ("orbit-rendezvous", include_str!("../../config/orbit-rendezvous.toml")),
];
