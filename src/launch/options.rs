//! What the caller of a run gives, and what it is told meanwhile.

use crate::hosts::HostEndpoint;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::AtomicUsize;

/// What a run needs besides its scenario.
pub struct Launch<'a> {
    /// Roles that somebody else starts, besides the scenario's own.
    pub external: Vec<String>,
    /// The file to record every sample to.
    pub record: Option<PathBuf>,
    /// The directory that its results will be written to, by its whole path: whoever looks for the run finds it by that.
    pub results: Option<PathBuf>,
    /// Where to show the run on a Foxglove WebSocket; not in one thread, and only by a program that was built with it.
    pub foxglove: Option<SocketAddr>,
    /// This host's part in a run over several, which others join; without it all roles run here.
    pub host: Option<HostEndpoint>,
    /// Refuse to run without every privilege that was asked for.
    pub require_realtime: bool,
    /// Whether the hash is kept of the ticks on the way too, by which two runs are compared; a run in one thread may do without.
    pub checkpoints: bool,
    /// The signal that asked the run to end; 0 while none has.
    pub signal: &'a AtomicUsize,
    /// Called now and then.
    pub progress: &'a mut dyn FnMut(&Progress<'_>),
}

impl<'a> Launch<'a> {
    /// What a run needs at the least, to be added to by whoever wants more. Roles are processes of this program: its `main` is
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

/// How far a run is.
#[derive(Debug, Clone, PartialEq)]
pub enum Progress<'a> {
    /// Waits for roles; these are started by somebody else, in this domain.
    Waiting {
        /// Roles that are not ready.
        roles: Vec<&'a str>,
        /// External roles among them.
        external: Vec<&'a str>,
        /// Other hosts among whose roles some of them are, once these can be joined with.
        hosts: Vec<&'a str>,
        /// The domain's directory; it holds a file with the seat of each external role.
        domain: PathBuf,
    },
    /// A role keeps the run waiting, or goes on: a line to print, now and then.
    External(&'a str),
    /// Ticks run.
    Running {
        /// The last tick scored.
        tick: u64,
        /// The last tick of the run.
        last_tick: u64,
        /// The latest value of the rig's first metric.
        metric: f64,
    },
}
