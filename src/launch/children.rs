//! The processes of a run: started from this program, their output read, reaped.
//!
//! The kernel ends a role with its launcher (parent-death signal). Must not leave a zombie.

use super::error::LaunchError;
use super::incident::RoleFailure;
use super::standstill::is_zombie;
use crate::bus::domain::Domain;
use crate::panics::Panic;
use crate::runtime::RoleId;
use crate::scenario::Scenario;
use crate::seat::panic_path;
use crate::system::{tell, this_program};
use rustix::process::{Pid, PidfdFlags, Signal, kill_process, pidfd_open};
use rustix::thread::{CpuSet, sched_setaffinity};
use std::collections::VecDeque;
use std::io::{self, BufRead, BufReader, Read};
use std::os::fd::OwnedFd;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

/// Time that a role may take to end after the stop.
pub(super) const END_LIMIT: Duration = Duration::from_secs(5);
/// Interval between two checks if a killed process has ended.
const KILL_LOOK: Duration = Duration::from_micros(200);
/// Exit code of this program after a failure.
const FAILURE: i32 = 1;
/// Length of the part of a role's error output that is kept.
const LAST_LINES: usize = 8;

/// A role's process.
pub(super) struct RoleProcess {
    child: Child,
    status: Option<ExitStatus>,
    /// Readable once the process has ended; `None` on a kernel without such descriptors.
    handle: Option<OwnedFd>,
    last_words: Arc<Mutex<VecDeque<String>>>,
    /// The file for its panic.
    panic: Option<PathBuf>,
    listener: Option<JoinHandle<()>>,
}

/// This program, for starting it in a role.
pub fn program(role: &str) -> Result<Command, LaunchError> {
    this_program().map_err(|source| LaunchError::Spawn { role: role.to_owned(), source })
}

impl RoleProcess {
    /// Starts a role of a scenario in a domain.
    pub fn start(scenario: &Scenario, role: RoleId, domain: &Domain) -> Result<Self, LaunchError> {
        let name = role.name(scenario).to_owned();
        let mut command = program(&name)?;
        command.arg(role.kind()).arg("--domain").arg(domain.root());
        if let RoleId::Plant(index) | RoleId::Observer(index @ 1..) = role {
            command.arg("--body").arg(&*scenario.bodies[index].name);
        }
        let panic = panic_path(domain.root(), &name);
        let mut process = Self::spawn(command, name)?;
        process.panic = Some(panic);
        Ok(process)
    }

    /// Starts a process that ends with this one, and whose output is printed under a name.
    pub fn spawn(mut command: Command, name: String) -> Result<Self, LaunchError> {
        command.arg("--parent").arg(std::process::id().to_string());
        // A group of its own: Ctrl-C reaches the launcher alone, and the launcher ends the roles in order.
        command.process_group(0).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        let failed = |source| LaunchError::Spawn { role: name.clone(), source };
        let mut child = command.spawn().map_err(failed)?;
        let stderr = child.stderr.take();
        let handle = Pid::from_raw(child.id() as i32).and_then(|pid| pidfd_open(pid, PidfdFlags::empty()).ok());
        let last_words = Arc::new(Mutex::new(VecDeque::new()));
        // Ended again if its output cannot be read.
        let mut process = Self { child, status: None, handle, last_words, panic: None, listener: None };
        let listen = |stderr| listen(name.clone(), stderr, process.last_words.clone());
        process.listener = stderr.map(listen).transpose().map_err(failed)?;
        Ok(process)
    }

    /// Returns the process identifier.
    pub fn pid(&self) -> i32 {
        self.child.id() as i32
    }

    /// Continues the process after a stop by a signal.
    pub fn resume(&mut self) {
        if let (None, Some(pid)) = (self.ended(), Pid::from_raw(self.pid())) {
            let _ = kill_process(pid, Signal::CONT);
        }
    }

    /// Returns the exit status of the process once it has ended.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        if self.status.is_none() {
            self.status = self.child.try_wait().ok().flatten();
        }
        self.status
    }

    /// Returns a descriptor that becomes readable at the end of a process that still runs.
    pub fn handle(&self) -> Option<&OwnedFd> {
        self.handle.as_ref().filter(|_| self.status.is_none())
    }

    /// Returns the panic that ended it, if one did.
    pub fn panic(&self) -> Option<RoleFailure> {
        self.panic.as_deref().and_then(Panic::take).map(RoleFailure::from_panic)
    }

    /// Returns the failure of a role that ended early.
    pub fn failure(&mut self, status: ExitStatus) -> RoleFailure {
        // A panic is caught by our own `main`, or ends the process by SIGABRT.
        let panicked = status.code() == Some(FAILURE) || status.signal() == Some(libc::SIGABRT);
        if let Some(failure) = self.panic().filter(|_| panicked) {
            return failure;
        }
        let (code, cause) = match (status.code(), status.signal()) {
            (Some(code), _) => ("exited", format!("it exited with code {code}")),
            (None, Some(signal)) => ("killed", format!("it was killed by {}", signal_name(signal))),
            (None, None) => ("ended", "it ended".to_owned()),
        };
        RoleFailure::new(code, cause, self.last_words())
    }

    /// Returns an error if the process has ended before the ticks run.
    pub fn require_alive(&mut self, name: &str) -> Result<(), LaunchError> {
        let Some(status) = self.ended() else { return Ok(()) };
        let RoleFailure { cause, last_words, .. } = self.failure(status);
        Err(LaunchError::Died { role: name.to_owned(), cause, last_words })
    }

    /// Returns the end of the error output of an ended process.
    pub fn last_words(&mut self) -> String {
        self.stop_listening();
        let words = self.last_words.lock().map(|lines| lines.iter().cloned().collect::<Vec<_>>()).unwrap_or_default();
        words.join(" | ")
    }

    /// Ends the process at once and reaps it. A killed thread exits only after it has been scheduled: a process whose core
    /// is busy at a higher priority is therefore allowed on every core.
    pub fn kill(&mut self) {
        if self.ended().is_none() {
            let mut any = CpuSet::new();
            (0..CpuSet::MAX_CPU).for_each(|core| any.set(core));
            let _ = sched_setaffinity(Pid::from_raw(self.child.id() as i32), &any);
            let _ = self.child.kill();
            while self.ended().is_none() {
                // A debugger that holds it may keep its exit status for ever.
                if is_zombie(self.pid()) {
                    self.status = self.ended().or(Some(ExitStatus::from_raw(libc::SIGKILL)));
                } else {
                    std::thread::sleep(KILL_LOOK);
                }
            }
        }
    }

    fn stop_listening(&mut self) {
        if let Some(listener) = self.listener.take() {
            let _ = listener.join();
        }
    }
}

impl Drop for RoleProcess {
    fn drop(&mut self) {
        self.kill();
        self.stop_listening();
    }
}

fn signal_name(signal: i32) -> String {
    match signal {
        libc::SIGKILL => "SIGKILL".to_owned(),
        libc::SIGSEGV => "SIGSEGV".to_owned(),
        libc::SIGBUS => "SIGBUS (is /dev/shm full?)".to_owned(),
        libc::SIGABRT => "SIGABRT".to_owned(),
        libc::SIGTERM => "SIGTERM".to_owned(),
        _ => format!("signal {signal}"),
    }
}

/// Prints a role's error output with its name in front, and keeps the end of it.
fn listen(
    name: String,
    stderr: impl Read + Send + 'static,
    last: Arc<Mutex<VecDeque<String>>>,
) -> io::Result<JoinHandle<()>> {
    std::thread::Builder::new().spawn(move || {
        for line in BufReader::new(stderr).lines().map_while(Result::ok) {
            tell(format_args!("[{name}] {line}"));
            if let Ok(mut last) = last.lock() {
                last.push_back(line);
                while last.len() > LAST_LINES {
                    last.pop_front();
                }
            }
        }
    })
}
