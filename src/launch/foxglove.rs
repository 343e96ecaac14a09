//! The process that shows a run on a Foxglove WebSocket, seen from the launcher.
//!
//! No role waits for it; the ticks do, once, until it listens. Its end is not the run's.

use super::companion::Companion;
use super::error::LaunchError;
use crate::bus::domain::Domain;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::Command;

/// The process's name.
const FOXGLOVE: &str = "foxglove";

/// The file in which the process writes the address at which it listens.
pub(super) fn address_path(domain: &Domain) -> PathBuf {
    domain.root().join("foxglove.address")
}

/// Starts the process, if there is an `address` for it.
pub(super) fn start(address: Option<SocketAddr>, domain: &Domain) -> Result<Companion, LaunchError> {
    let arguments = address.map(|address| {
        move |command: &mut Command| {
            command.arg(FOXGLOVE).arg(domain.root()).args(["--address", &address.to_string()]);
            command.arg("--tell").arg(address_path(domain));
        }
    });
    Companion::start(FOXGLOVE, arguments)
}
