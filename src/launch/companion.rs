//! A process of a run that is no role: started, waited for until it is ready, watched, and let go.
//!
//! Its owner gives its command and decides what its end means. Must not end a run.

use super::LaunchError;
use super::children::{RoleProcess, program};
use super::incident::Failure;
use super::janitor::Janitor;
use crate::system::tell;
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
    /// Starts this program under a name if there are `arguments`, which complete its command.
    pub fn start(name: &'static str, arguments: Option<impl FnOnce(&mut Command)>) -> Result<Self, LaunchError> {
        let mut companion = Self { name, process: None, ready: false, failed: false };
        if let Some(complete) = arguments {
            let mut command = program(name)?;
            complete(&mut command);
            companion.process = Some(RoleProcess::spawn(command, name.to_owned())?);
        }
        Ok(companion)
    }

    /// The name and the process.
    pub fn process(&mut self) -> (&str, Option<&mut RoleProcess>) {
        (self.name, self.process.as_mut())
    }

    /// Returns true once the companion has written `file`, whose text is printed if there is any, or if there is no process.
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

    /// Returns how the process failed, once, if it has ended.
    pub fn failure(&mut self) -> Option<Failure> {
        let process = self.process.as_mut().filter(|_| !self.failed)?;
        let status = process.ended()?;
        self.failed = true;
        Some(process.failure(status))
    }

    /// Returns why the run goes on without the companion, once, and prints it. One that is `silent` is ended.
    pub fn loss(&mut self, silent: bool, janitor: &mut Janitor) -> Option<String> {
        let cause = match self.failure() {
            Some(failure) => failure.cause,
            None if silent => {
                self.process.as_mut().map(RoleProcess::kill);
                "it said nothing any more".to_owned()
            }
            None => return None,
        };
        tell(format_args!("corotate: {} failed: {cause}; the run goes on without [companion-lost]", self.name));
        janitor.clear_dead();
        Some(cause)
    }

    /// True while the process runs.
    pub fn lingers(&mut self) -> bool {
        self.process.as_mut().is_some_and(|process| process.ended().is_none())
    }
}
