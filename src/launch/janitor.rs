//! The janitor: a process that removes the files of dead processes from a run's domain, and the domain if the launcher is
//! killed.
//!
//! The transport's clean-up may take long, and never ends while the creator of a file is stopped. So the launcher does not
//! wait: it requests a clean-up by a byte, polls for the answer, and replaces a janitor that does not answer in time. Must not
//! touch files of live processes.

use super::error::LaunchError;
use crate::bus::domain::{self, Domain};
use crate::bus::iox;
use crate::clock::monotonic_ns;
use crate::late::remove_dead_traces;
use crate::system::{name_thread, tell, this_program};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use std::fs::{self, Metadata};
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Stdio};
use std::time::{Duration, SystemTime};

/// The request for a clean-up, and its answer.
const CLEAR: u8 = b'c';
/// Time without an answer after which a janitor is replaced, ns. A clean-up takes some 5 ms per dead process.
const ANSWER_NS: u64 = 2_000_000_000;
/// Time from the end of a clean-up to the next of a silent process, ns. Without it, a clean-up would follow the other.
const PAUSE_NS: u64 = 250_000_000;
/// The number of janitors that are tried in a row for one request.
const ATTEMPTS: u32 = 3;
/// The interval between two checks for unfinished files and new processes.
const LOOK: Duration = Duration::from_millis(50);
/// Coarsest resolution of a directory's time of change: a directory that changed just before a look is read again.
const GRAIN: Duration = Duration::from_millis(100);

/// The launcher's handle on the janitor.
pub(super) struct Janitor {
    root: PathBuf,
    limit: Duration,
    process: Process,
    /// Number of requests without an answer, and time of the oldest, ns.
    pending: u64,
    since_ns: u64,
    /// Number of janitors that were tried for them.
    attempts: u32,
}

struct Process {
    child: Child,
    /// Held open: the kernel closes it when the launcher dies, and the janitor sees the end of its input.
    line: ChildStdin,
    answers: ChildStdout,
}

impl Janitor {
    /// Starts the janitor of a domain. A file that its creator does not finish for `limit` counts as abandoned.
    pub fn start(domain: &Domain, limit: Duration) -> Result<Self, LaunchError> {
        let root = domain.root().to_owned();
        let process =
            Process::start(&root, limit).map_err(|source| LaunchError::Spawn { role: "janitor".to_owned(), source })?;
        Ok(Self { root, limit, process, pending: 0, since_ns: 0, attempts: 0 })
    }

    /// Returns the domain's directory.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Requests the removal of the files of dead processes.
    pub fn clear_dead(&mut self) {
        if self.pending == 0 {
            (self.since_ns, self.attempts) = (monotonic_ns(), 1);
        }
        // If the janitor died, or is stopped and its pipe full, the check for its answer finds that.
        let _ = self.process.line.write_all(&[CLEAR]);
        self.pending += 1;
    }

    /// Requests a clean-up from time to time while it is called repeatedly, so that a silent process that has died is noticed.
    pub fn clear_silent(&mut self) {
        if !self.is_busy() && monotonic_ns().saturating_sub(self.since_ns) > PAUSE_NS {
            self.clear_dead();
        }
    }

    /// Returns true while a request is unanswered. To be called repeatedly: it reads the answers.
    pub fn is_busy(&mut self) -> bool {
        if self.pending == 0 {
            return false;
        }
        let mut answers = [0; 64];
        match self.process.answers.read(&mut answers) {
            Ok(0) => self.replace("died"),
            Ok(count) => {
                self.pending = self.pending.saturating_sub(count as u64);
                self.since_ns = monotonic_ns();
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                if monotonic_ns().saturating_sub(self.since_ns) > ANSWER_NS {
                    self.replace("hung");
                }
            }
            Err(_) => {}
        }
        self.pending > 0
    }

    /// Returns the descriptor on which to wait for an answer, if one is due.
    pub fn answers(&self) -> Option<BorrowedFd<'_>> {
        (self.pending > 0).then(|| self.process.answers.as_fd())
    }

    /// Replaces the janitor, and repeats the request.
    fn replace(&mut self, how: &str) {
        let started = (self.attempts < ATTEMPTS).then(|| Process::start(&self.root, self.limit));
        match started {
            Some(Ok(process)) => {
                self.process.kill();
                self.process = process;
                let attempts = self.attempts + 1;
                self.pending = 0;
                self.clear_dead();
                self.attempts = attempts;
            }
            Some(Err(_)) | None => {
                tell(format_args!("corotate: the janitor {how}; files of a dead process may prevent its restart"));
                self.pending = 0;
            }
        }
    }
}

impl Process {
    fn start(root: &Path, limit: Duration) -> io::Result<Self> {
        let mut command = this_program()?;
        command.arg("janitor").arg("--domain").arg(root).arg("--limit-s").arg(limit.as_secs_f64().to_string());
        let mut child =
            command.process_group(0).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
        let pipes = child.stdin.take().zip(child.stdout.take());
        let (line, answers) = pipes.ok_or_else(|| io::Error::other("it has no pipes"))?;
        for end in [line.as_fd(), answers.as_fd()] {
            fcntl_setfl(end, fcntl_getfl(end)? | OFlags::NONBLOCK)?;
        }
        Ok(Self { child, line, answers })
    }

    fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Kills the janitor once the domain is removed: it may be stopped, and the launcher does not wait for it.
impl Drop for Janitor {
    fn drop(&mut self) {
        self.process.kill();
    }
}

fn timespec(duration: Duration) -> Timespec {
    Timespec { tv_sec: duration.as_secs() as i64, tv_nsec: duration.subsec_nanos() as _ }
}

/// Runs the janitor in a domain: removes unfinished files, and the files of dead processes when `line` requests it or a process
/// joins. The end of `line` means that the launcher is dead: then it removes this domain and every other one whose launcher is dead.
///
/// # Errors
/// The system's error if a thread cannot start.
pub fn janitor(
    domain: &Domain,
    limit: Duration,
    mut line: impl Read + AsFd,
    mut answers: impl Write,
) -> io::Result<()> {
    name_thread("janitor");
    let swept = domain.clone();
    // Beside the clean-up, which waits for unfinished files itself. The thread ends with the process.
    std::thread::Builder::new().spawn(move || sweep(&swept, limit))?;
    let mut nodes = Watched::new(domain.root().join("nodes"));
    loop {
        // Files that cannot be removed now are removed when the next process joins.
        let clear = || drop(iox::clear_dead(domain));
        if nodes.changed() {
            clear();
        }
        let mut input = [PollFd::new(&line, PollFlags::IN)];
        if !poll(&mut input, Some(&timespec(LOOK))).is_ok_and(|ready| ready > 0) {
            continue;
        }
        let mut requests = [0; 64];
        let requests = match line.read(&mut requests) {
            Ok(0) | Err(_) => break,
            Ok(count) => &requests[..count],
        };
        clear();
        // No process is left to which a failure could be reported.
        let _ = answers.write_all(requests).and_then(|()| answers.flush());
    }
    // Roles whose launcher was killed end now: files that they still hold, or were about to create, are removed in a later round.
    let mut gone = Vec::new();
    for pause_ms in [0, 50, 500] {
        std::thread::sleep(Duration::from_millis(pause_ms));
        gone.iter().for_each(Domain::remove_if_over);
        gone.extend(domain::remove_dead_domains().unwrap_or_default());
        remove_dead_traces();
    }
    Ok(())
}

/// Removes unfinished files of a domain, in an endless loop.
fn sweep(domain: &Domain, limit: Duration) {
    let mut files = Watched::new(domain::SHARED_MEMORY.into());
    let mut services = Watched::new(domain.root().join("services"));
    let mut unfinished = false;
    loop {
        // Not short-circuited: each look stores its result.
        if files.changed() | services.changed() | unfinished {
            unfinished = domain.remove_unfinished(limit);
        }
        std::thread::sleep(LOOK);
    }
}

/// A directory whose files change.
struct Watched {
    path: PathBuf,
    /// The time of its latest known change.
    seen: Option<SystemTime>,
}

impl Watched {
    fn new(path: PathBuf) -> Self {
        Self { path, seen: None }
    }

    /// Returns true if its files may have changed since the last check.
    fn changed(&mut self) -> bool {
        let now = SystemTime::now();
        let Ok(changed) = fs::metadata(&self.path).as_ref().map(Metadata::modified) else { return false };
        // Without a time of change, the directory is read every time.
        let changed = changed.ok().filter(|changed| now.duration_since(*changed).is_ok_and(|age| age > GRAIN));
        changed.is_none() || std::mem::replace(&mut self.seen, changed) != changed
    }
}
