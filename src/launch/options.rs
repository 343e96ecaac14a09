//! The options of a run, and its progress reports.

use crate::hosts::HostEndpoint;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::AtomicUsize;

/// The options of a run besides its scenario.
pub struct Launch<'a> {
    /// External roles, besides those of the scenario.
    pub external: Vec<String>,
    /// The file for the recording.
    pub record: Option<PathBuf>,
    /// The absolute path of the directory for its results, by which other programs find the run.
    pub results: Option<PathBuf>,
    /// The address of a Foxglove WebSocket server; not in one thread, and only with the feature `foxglove`.
    pub foxglove: Option<SocketAddr>,
    /// This host's endpoint in a run over several hosts; without it all roles run here.
    pub host: Option<HostEndpoint>,
    /// Refuse to run unless every requested privilege is granted.
    pub require_realtime: bool,
    /// True if the hash has checkpoints, by which two runs are compared; a run in one thread may go without.
    pub checkpoints: bool,
    /// The signal that asked the run to end; 0 while none has.
    pub signal: &'a AtomicUsize,
    /// Called with the progress at intervals.
    pub progress: &'a mut dyn FnMut(&Progress<'_>),
}

impl<'a> Launch<'a> {
    /// Creates the minimal options. Roles are processes of this program: its `main` must be
    /// [`Program::main`](crate::Program::main).
    pub fn new(signal: &'a AtomicUsize, progress: &'a mut dyn FnMut(&Progress<'_>)) -> Self {
        Self {
            external: Vec::new(),
            record: None,
            results: None,
            foxglove: None,
            host: None,
            require_realtime: false,
            checkpoints: true,
            signal,
            progress,
        }
    }
}

/// The progress of a run.
#[derive(Debug, Clone, PartialEq)]
pub enum Progress<'a> {
    /// The run waits for roles.
    Waiting {
        /// Roles that are not ready.
        roles: Vec<&'a str>,
        /// External roles among them.
        external: Vec<&'a str>,
        /// Other hosts that have such roles, once they can join.
        hosts: Vec<&'a str>,
        /// The domain's directory, with the seat description of each external role.
        domain: PathBuf,
    },
    /// A line about a role for which the run waits, or that goes on.
    External(&'a str),
    /// The ticks run.
    Running {
        /// The last scored tick.
        tick: u64,
        /// The last tick of the run.
        last_tick: u64,
        /// The latest value of the rig's first metric.
        metric: f64,
    },
}
