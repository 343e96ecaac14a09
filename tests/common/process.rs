//! Running and ended programs, signals, and waiting under a watchdog.

use super::bench::Bench;
use serde_json::Value;
use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The limit on every wait. On the most loaded machine only a hang takes longer.
pub const WATCHDOG: Duration = Duration::from_secs(300);

/// A program that is running.
pub struct Running {
    child: Child,
    stdout: Option<JoinHandle<String>>,
    stderr: Option<JoinHandle<String>>,
}

/// A program that has ended.
#[derive(Debug)]
pub struct Done {
    pub code: Option<i32>,
    pub signal: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

/// Kills the launcher if the test fails: the roles die with it, and the janitor cleans up.
impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Running {
    pub fn new(command: &mut Command) -> Self {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = await_some(|| match command.spawn() {
            // A child forked by another test still holds the copied program open for writing, until its exec.
            Err(error) if error.kind() == std::io::ErrorKind::ExecutableFileBusy => None,
            spawned => Some(spawned.unwrap()),
        });
        let stdout = child.stdout.take().map(collect);
        let stderr = child.stderr.take().map(collect);
        Self { child, stdout, stderr }
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    pub fn signal(&self, signal: i32) {
        send_signal(self.pid(), signal);
    }

    /// Waits for the process of a role; `None` if the program ends first.
    pub fn await_role_or_end(&mut self, bench: &Bench, role: &str) -> Option<u32> {
        await_some(|| match bench.role(role) {
            Some(pid) => Some(Some(pid)),
            None => self.child.try_wait().unwrap().map(|_| None),
        })
    }

    pub fn has_ended(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    pub fn wait(mut self) -> Done {
        let end = Instant::now() + WATCHDOG;
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(Instant::now() < end, "the program hung");
            std::thread::sleep(Duration::from_millis(2));
        };
        let text = |reader: Option<JoinHandle<String>>| reader.unwrap().join().unwrap();
        Done {
            code: status.code(),
            signal: status.signal(),
            stdout: text(self.stdout.take()),
            stderr: text(self.stderr.take()),
        }
    }
}

impl Done {
    /// Asserts exit code 0.
    #[track_caller]
    pub fn succeeded(self) -> Self {
        assert_eq!(self.code, Some(0), "{self:?}");
        self
    }

    /// Returns the codes of the printed errors in order, and asserts that the manual lists each.
    #[track_caller]
    pub fn codes(&self) -> Vec<&str> {
        let codes: Vec<&str> = self.stderr.lines().filter_map(code_of).collect();
        let known = super::documented_codes();
        assert!(codes.iter().all(|code| known.iter().any(|known| known == code)), "not in the manual: {codes:?}");
        codes
    }

    /// Returns true if an error with this code was printed.
    #[track_caller]
    pub fn says(&self, code: &str) -> bool {
        self.codes().contains(&code)
    }

    /// Returns the number of roles of `replay --json` without a difference, and the number of those compared to the end.
    #[track_caller]
    pub fn roles_replayed(&self) -> (usize, usize) {
        let replay = self.json();
        let same = replay["roles"].as_array().unwrap().iter().filter(|role| role["same"] == true);
        (same.clone().count(), same.filter(|role| role["limit"].is_null()).count())
    }

    /// Parses stdout as JSON.
    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }
}

/// Returns the code in brackets at the end of an error's line.
pub fn code_of(line: &str) -> Option<&str> {
    let (_, code) = line.strip_suffix(']')?.rsplit_once(" [")?;
    let plain = code.bytes().all(|letter| letter.is_ascii_lowercase() || letter.is_ascii_digit() || letter == b'-');
    (plain && !code.is_empty()).then_some(code)
}

fn collect(mut pipe: impl Read + Send + 'static) -> JoinHandle<String> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        pipe.read_to_end(&mut bytes).unwrap();
        String::from_utf8_lossy(&bytes).into_owned()
    })
}

/// Returns every process with this entry in its environment, except zombies.
pub fn processes_marked(mark: &str) -> Vec<u32> {
    let pids = std::fs::read_dir("/proc").unwrap().filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    pids.filter(|pid: &u32| {
        let environment = std::fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
        String::from_utf8_lossy(&environment).split('\0').any(|entry| entry == mark)
    })
    .collect()
}

/// Returns a field of a process's status, such as `State` or `SigCgt`; empty if the process has ended.
pub fn status_of(pid: u32, field: &str) -> String {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let value = status.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':'));
    value.unwrap_or_default().trim().to_owned()
}

/// Returns true if a process has a handler for a signal.
pub fn catches(pid: u32, signal: i32) -> bool {
    u64::from_str_radix(&status_of(pid, "SigCgt"), 16).is_ok_and(|caught| caught >> (signal - 1) & 1 == 1)
}

pub fn send_signal(pid: u32, signal: i32) {
    let pid = rustix::process::Pid::from_raw(pid as i32).unwrap();
    let signal = rustix::process::Signal::from_named_raw(signal).unwrap();
    let _ = rustix::process::kill_process(pid, signal);
}

/// Polls until `look` returns a value, under the watchdog.
pub fn await_some<T>(mut look: impl FnMut() -> Option<T>) -> T {
    let end = Instant::now() + WATCHDOG;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < end, "waited in vain");
        std::thread::sleep(Duration::from_millis(2));
    }
}
