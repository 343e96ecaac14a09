//! The process that shows a run on a Foxglove WebSocket, seen from the launcher.
//!
//! No role waits for it; the ticks do, once, until it listens. Must not let its end be the run's.

use super::LaunchError;
use super::children::{RoleProcess, program};
use super::janitor::Janitor;
use crate::bus::domain::Domain;
use crate::system::tell;
use std::net::SocketAddr;
use std::path::PathBuf;

/// The process's name.
pub(super) const FOXGLOVE: &str = "foxglove";

/// A run's process of this kind, if it has one.
pub(super) struct FoxgloveWatch {
    process: Option<RoleProcess>,
    /// Where it tells that it listens, and at which address.
    tells: PathBuf,
    listens: bool,
}

impl FoxgloveWatch {
    /// Starts the process, if there is an `address` for it.
    pub fn start(address: Option<SocketAddr>, domain: &Domain) -> Result<Self, LaunchError> {
        let tells = domain.root().join("foxglove.address");
        let start = |address: SocketAddr| {
            let mut command = program(FOXGLOVE)?;
            command
                .arg(FOXGLOVE)
                .arg(domain.root())
                .arg("--address")
                .arg(address.to_string())
                .arg("--tell")
                .arg(&tells);
            RoleProcess::spawn(command, FOXGLOVE.to_owned())
        };
        Ok(Self { process: address.map(start).transpose()?, tells, listens: false })
    }

    /// Whether the ticks may run; how it failed if it listens nowhere. The address is told to the user.
    pub fn ready(&mut self) -> Result<bool, LaunchError> {
        let Some(process) = self.process.as_mut().filter(|_| !self.listens) else { return Ok(true) };
        process.require_alive(FOXGLOVE)?;
        if let Ok(address) = std::fs::read_to_string(&self.tells) {
            tell(format_args!("foxglove: {address}"));
            self.listens = true;
        }
        Ok(self.listens)
    }

    /// Looks whether it has ended: then the run goes on without.
    pub fn supervise(&mut self, janitor: &mut Janitor) {
        let Some(process) = &mut self.process else { return };
        if let Some(status) = process.ended() {
            let cause = process.failure(status).cause;
            tell(format_args!("corotate: foxglove failed: {cause}; the run goes on without"));
            self.process = None;
            janitor.clear_dead();
        }
    }

    /// Whether it has not ended yet.
    pub fn lingers(&mut self) -> bool {
        self.process.as_mut().is_some_and(|process| process.ended().is_none())
    }
}
