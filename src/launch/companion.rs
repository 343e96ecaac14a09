//! A process of a run besides the roles: started, ready, supervised, ended.
//!
//! Its owner gives the command, and decides how to react to its end. Must not end a run.

use super::children::{RoleProcess, program};
use super::error::LaunchError;
use super::incident::RoleFailure;
use super::janitor::Janitor;
use crate::system::tell;
use rustix::process::{Pid, Signal, kill_process};
use std::path::Path;
use std::process::Command;

/// A companion; without a process if the run needs none.
pub(super) struct Companion {
    name: &'static str,
    process: Option<RoleProcess>,
    ready: bool,
    /// True once its failure has been returned.
    failed: bool,
}

impl Companion {
    /// Starts this program under a name with these arguments, if there are any.
    pub fn start(name: &'static str, arguments: Option<impl FnOnce(&mut Command)>) -> Result<Self, LaunchError> {
        let mut companion = Self { name, process: None, ready: false, failed: false };
        if let Some(complete) = arguments {
            let mut command = program(name)?;
            complete(&mut command);
            companion.process = Some(RoleProcess::spawn(command, name.to_owned())?);
        }
        Ok(companion)
    }

    /// Returns the name and the process.
    pub fn process(&mut self) -> (&str, Option<&mut RoleProcess>) {
        (self.name, self.process.as_mut())
    }

    /// Returns true once the companion has written `file`, whose text is then printed, or if there is no process.
    ///
    /// # Errors
    /// [`LaunchError::Died`] if it has ended.
    pub fn ready(&mut self, file: &Path) -> Result<bool, LaunchError> {
        let Some(process) = self.process.as_mut().filter(|_| !self.ready) else { return Ok(true) };
        process.require_alive(self.name)?;
        if let Ok(text) = std::fs::read_to_string(file) {
            self.ready = true;
            if !text.is_empty() {
                tell(format_args!("{}: {text}", self.name));
            }
        }
        Ok(self.ready)
    }

    /// Returns, once, the failure of a process that has ended.
    pub fn failure(&mut self) -> Option<RoleFailure> {
        let process = self.process.as_mut().filter(|_| !self.failed)?;
        let status = process.ended()?;
        self.failed = true;
        Some(process.failure(status))
    }

    /// Returns and prints, once, the reason for which the run goes on without the companion. A `silent` one is killed.
    pub fn loss(&mut self, silent: bool, janitor: &mut Janitor) -> Option<String> {
        let cause = match self.failure() {
            Some(failure) => failure.cause,
            None if silent => {
                self.process.as_mut().map(RoleProcess::kill);
                "it sent no status any more".to_owned()
            }
            None => return None,
        };
        tell(format_args!("corotate: {} failed: {cause}; the run goes on without [companion-lost]", self.name));
        janitor.clear_dead();
        Some(cause)
    }

    /// Returns true if there is or was a process.
    pub fn is_started(&self) -> bool {
        self.process.is_some()
    }

    /// Asks the process to end.
    pub fn stop(&mut self) {
        let running = self.process.as_mut().and_then(|process| process.ended().is_none().then(|| process.pid()));
        if let Some(pid) = running.and_then(Pid::from_raw) {
            let _ = kill_process(pid, Signal::TERM);
        }
    }

    /// Returns true while the process runs.
    pub fn lingers(&mut self) -> bool {
        self.process.as_mut().is_some_and(|process| process.ended().is_none())
    }
}
