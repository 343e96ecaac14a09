//! Recognises by `/proc` a process that a signal or a debugger has stopped.
//!
//! Must not decide what follows from it.

use std::fmt;
use std::fs;
use std::path::PathBuf;

/// A process that a signal or a debugger keeps from running.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Standstill {
    /// True if a thread is stopped. A debugger that has let all of them go on may still be why the process is silent.
    pub stopped: bool,
    /// The debugger that is attached, if one is: its process and name.
    pub debugger: Option<(i32, String)>,
}

impl fmt::Display for Standstill {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.stopped { "stopped by " } else { "traced by " })?;
        match &self.debugger {
            None => f.write_str("a signal"),
            Some((pid, name)) => write!(f, "a debugger (pid {pid}, {name})"),
        }
    }
}

/// One thread of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Thread {
    state: char,
    tracer: i32,
}

impl Thread {
    fn dead(self) -> bool {
        matches!(self.state, 'Z' | 'X')
    }
}

/// Looks for a stop or a debugger: `None` for a process that runs freely, has ended, or cannot be looked at.
pub(super) fn standstill(pid: i32) -> Option<Standstill> {
    let threads = threads(pid);
    if threads.iter().all(|thread| thread.dead()) {
        return None;
    }
    let stopped = threads.iter().any(|thread| matches!(thread.state, 'T' | 't'));
    let tracer = threads.iter().map(|thread| thread.tracer).find(|tracer| *tracer != 0);
    let debugger = tracer.map(|tracer| {
        let name = fs::read_to_string(format!("/proc/{tracer}/comm")).unwrap_or_default();
        (tracer, name.trim().to_owned())
    });
    (stopped || debugger.is_some()).then_some(Standstill { stopped, debugger })
}

/// Returns true if a process has ended and is not reaped yet: a debugger that traced it may keep it so for ever.
pub(super) fn is_zombie(pid: i32) -> bool {
    let threads = threads(pid);
    !threads.is_empty() && threads.iter().all(|thread| thread.dead())
}

/// Returns the remedy where this user's debuggers cannot attach to a process that is not their child.
pub(super) fn attach_remedy() -> Option<&'static str> {
    let scope = fs::read_to_string("/proc/sys/kernel/yama/ptrace_scope").unwrap_or_default();
    remedy_of(scope.trim(), rustix::process::geteuid().is_root())
}

fn remedy_of(ptrace_scope: &str, root: bool) -> Option<&'static str> {
    match (ptrace_scope, root) {
        ("2", false) => Some("only root may attach here (kernel.yama.ptrace_scope = 2): put sudo in front"),
        ("3", _) => Some("attaching is disabled until the next boot (kernel.yama.ptrace_scope = 3)"),
        _ => None,
    }
}

/// All threads of a process; none if it is gone or hidden.
fn threads(pid: i32) -> Vec<Thread> {
    let read = |path: PathBuf| {
        let state = state_of(&fs::read_to_string(path.join("stat")).ok()?)?;
        let tracer = fs::read_to_string(path.join("status")).ok().and_then(|status| tracer_in(&status));
        Some(Thread { state, tracer: tracer.unwrap_or(0) })
    };
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    tasks.filter_map(|task| read(task.path())).collect()
}

/// The state in the text of `stat`: the field after the name, which is in parentheses and may have any characters.
fn state_of(stat: &str) -> Option<char> {
    stat.rsplit_once(')')?.1.trim_start().chars().next()
}

/// The process of the tracer in the text of `status`; 0 without a tracer, `None` if the text has no such line.
fn tracer_in(status: &str) -> Option<i32> {
    status.lines().find_map(|line| line.strip_prefix("TracerPid:"))?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::{Command, Stdio};

    #[test]
    fn a_state_is_what_follows_the_name_whatever_that_is() {
        for (stat, state) in [
            ("4711 (corotate) S 1 4711 4711 0 -1 4194560 1", Some('S')),
            ("4711 (a b) T 1 4711 4711 0 -1", Some('T')),
            ("4711 (a) R (b)) t 1 4711 4711 0 -1", Some('t')),
            ("4711 () Z) S 1 2", Some('S')),
            ("4711 (x\ny) T 1 2", Some('T')),
            ("4711 (cut", None),
            ("4711 (cut)", None),
            ("", None),
        ] {
            assert_eq!(state_of(stat), state, "{stat:?}");
        }
    }

    #[test]
    fn the_tracer_is_in_the_status() {
        let status = "Name:\tTracerPid: 9\nState:\tt (tracing stop)\nTgid:\t4711\nPid:\t4711\nPPid:\t1\nTracerPid:\t4720\nUid:\t0\n";
        assert_eq!(tracer_in(status), Some(4720));
        assert_eq!(tracer_in(&status.replace("4720", "0")), Some(0));
        assert_eq!(tracer_in("Name:\tx\n"), None);
    }

    #[test]
    fn what_forbids_to_attach_has_a_remedy() {
        let remedies =
            [("0", false), ("1", false), ("2", true), ("", false)].map(|(scope, root)| remedy_of(scope, root));
        assert_eq!(remedies, [None; 4], "in scope 1 a debugged role permits any tracer");
        assert!(remedy_of("2", false).is_some() && remedy_of("3", true).is_some());
    }

    #[test]
    fn a_stopped_process_is_seen_until_it_goes_on() {
        let mut child = Command::new("sleep").arg("600").stdin(Stdio::null()).spawn().unwrap();
        let pid = child.id() as i32;
        let send = |signal| {
            let pid = rustix::process::Pid::from_raw(pid).unwrap();
            rustix::process::kill_process(pid, signal).unwrap();
        };
        let awaited = |wanted: Option<Standstill>| {
            while standstill(pid) != wanted {
                std::thread::yield_now();
            }
        };
        awaited(None);
        send(rustix::process::Signal::STOP);
        awaited(Some(Standstill { stopped: true, debugger: None }));
        assert!(!is_zombie(pid));
        send(rustix::process::Signal::CONT);
        awaited(None);
        child.kill().unwrap();
        while !is_zombie(pid) {
            std::thread::yield_now();
        }
        assert_eq!(standstill(pid), None, "a zombie is not stopped");
        child.wait().unwrap();
        assert!(!is_zombie(pid) && standstill(pid).is_none());
    }
}
