//! Programs that run and have ended, signals to them, and waiting under a watchdog.

use super::bench::Bench;
use serde_json::Value;
use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Nothing here takes so long, however loaded the machine is; what does, hangs.
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

/// A test that fails leaves no run behind: the roles die with their launcher, and the janitor cleans up.
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
            // Another test's child held the copied program open for writing when it was forked; it execs soon.
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

    /// The process of a role, once it runs, unless the program ends before.
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
    /// Asserts that the program ended well.
    #[track_caller]
    pub fn succeeded(self) -> Self {
        assert_eq!(self.code, Some(0), "{self:?}");
        self
    }

    /// The codes of the errors that it printed, in their order. All of them are in the manual.
    #[track_caller]
    pub fn codes(&self) -> Vec<&str> {
        let codes: Vec<&str> = self.stderr.lines().filter_map(code_of).collect();
        let known = super::documented_codes();
        assert!(codes.iter().all(|code| known.iter().any(|known| known == code)), "not in the manual: {codes:?}");
        codes
    }

    /// Returns true if it printed an error of this code.
    #[track_caller]
    pub fn says(&self, code: &str) -> bool {
        self.codes().contains(&code)
    }

    /// What it printed, as JSON.
    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }
}

/// The code that ends an error's line, in brackets.
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

/// Every process with this entry in its environment, zombies apart.
pub fn processes_marked(mark: &str) -> Vec<u32> {
    let pids = std::fs::read_dir("/proc").unwrap().filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    pids.filter(|pid: &u32| {
        let environment = std::fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
        String::from_utf8_lossy(&environment).split('\0').any(|entry| entry == mark)
    })
    .collect()
}

/// What a process's status says of it, the like of `State` and `SigCgt`; empty if it has ended.
pub fn status_of(pid: u32, field: &str) -> String {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let told = status.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':'));
    told.unwrap_or_default().trim().to_owned()
}

/// Whether a process has a handler for a signal.
pub fn catches(pid: u32, signal: i32) -> bool {
    u64::from_str_radix(&status_of(pid, "SigCgt"), 16).is_ok_and(|caught| caught >> (signal - 1) & 1 == 1)
}

pub fn send_signal(pid: u32, signal: i32) {
    let pid = rustix::process::Pid::from_raw(pid as i32).unwrap();
    let signal = rustix::process::Signal::from_named_raw(signal).unwrap();
    let _ = rustix::process::kill_process(pid, signal);
}

/// Polls until there is something, under the watchdog.
pub fn await_some<T>(mut look: impl FnMut() -> Option<T>) -> T {
    let end = Instant::now() + WATCHDOG;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < end, "it never came");
        std::thread::sleep(Duration::from_millis(2));
    }
}
