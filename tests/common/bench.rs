//! A working directory and a runtime directory for the programs of one test, and inspection of what they leave there.

use super::process::{Done, Running, WATCHDOG, await_some, processes_marked};
use super::{shipped, summary_in};
use corotate::seat::seat_path;
use serde_json::Value;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// Private directories in which a test runs the program.
pub struct Bench {
    directory: tempfile::TempDir,
    runtime: tempfile::TempDir,
    /// The program under test.
    program: PathBuf,
    /// The user to run as, if not the current one.
    user: Option<u32>,
}

impl Bench {
    pub fn new() -> Self {
        Self::with_program(Path::new(env!("CARGO_BIN_EXE_corotate")))
    }

    /// Creates a bench for another program, which is corotate with other rigs.
    pub fn with_program(program: &Path) -> Self {
        // The length of socket names limits the runtime directory's path.
        let runtime = tempfile::Builder::new().prefix("ct").rand_bytes(6).tempdir_in("/tmp").unwrap();
        Self { directory: tempfile::tempdir().unwrap(), runtime, program: program.to_owned(), user: None }
    }

    /// Creates a bench whose programs run as `nobody` if the test runs as root.
    pub fn unprivileged() -> Self {
        let mut bench = Self::new();
        if rustix::process::getuid().is_root() {
            const NOBODY: u32 = 65534;
            for directory in [&bench.directory, &bench.runtime] {
                std::os::unix::fs::chown(directory.path(), Some(NOBODY), Some(NOBODY)).unwrap();
            }
            // Other users may not be able to read the build directory.
            std::fs::copy(&bench.program, bench.path("corotate")).unwrap();
            bench.program = bench.path("corotate");
            bench.user = Some(NOBODY);
        }
        bench
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Returns the runtime directory; the domains are below it, in a directory named after the program.
    pub fn runtime(&self) -> PathBuf {
        self.runtime.path().to_owned()
    }

    pub fn command(&self) -> Command {
        self.command_of(&self.program)
    }

    /// Returns a command of any program, run in this bench.
    pub fn command_of(&self, program: &Path) -> Command {
        let mut command = Command::new(program);
        if let Some(user) = self.user {
            command.uid(user).gid(user);
        }
        command.current_dir(self.directory.path()).env("XDG_RUNTIME_DIR", self.runtime.path());
        command
    }

    pub fn start(&self, arguments: &[&str]) -> Running {
        Running::new(self.command().args(arguments))
    }

    pub fn start_program(&self, program: &Path, arguments: &[&str]) -> Running {
        Running::new(self.command_of(program).args(arguments))
    }

    pub fn run(&self, arguments: &[&str]) -> Done {
        self.start(arguments).wait()
    }

    /// Runs a shipped scenario, which must succeed, and returns its summary.
    pub fn summary(&self, scenario: &str, arguments: &[&str]) -> Value {
        let file = self.path(&format!("{scenario}.toml"));
        std::fs::copy(shipped(scenario), &file).unwrap();
        self.run(&[&["run", file.to_str().unwrap(), "--json"], arguments].concat()).succeeded().json()
    }

    /// Returns the `summary.json` of a results directory.
    pub fn summary_in(&self, directory: &str) -> Value {
        summary_in(&self.path(directory))
    }

    /// Starts a run without end and waits until every role has executed a tick.
    pub fn start_endless(&self, arguments: &[&str]) -> Running {
        let endless = ["run", "rigid-pair", "--duration", "100000", "--out", "out", "--set", "accept={}"];
        let running = self.start(&[&endless[..], arguments].concat());
        for role in ["leader", "follower", "observer", "controller"] {
            self.await_ticks(role);
        }
        running
    }

    /// Waits for the seat file of an external role and returns its path.
    pub fn await_seat(&self, role: &str) -> PathBuf {
        await_some(|| self.joinable().map(|domain| seat_path(&domain, role)).find(|seat| seat.is_file()))
    }

    /// Waits for a domain that other processes can join.
    pub fn await_domain(&self) -> PathBuf {
        await_some(|| self.joinable().next())
    }

    fn joinable(&self) -> impl Iterator<Item = PathBuf> {
        self.domains().into_iter().filter(|domain| domain.join("scenario.toml").exists())
    }

    /// Returns the domains in this bench's runtime directory.
    pub fn domains(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.runtime.path().join("corotate")).into_iter().flatten();
        entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_dir()).collect()
    }

    /// Waits until no process, file or shared memory of any run in this bench is left.
    pub fn assert_clean(&self, domains: &[PathBuf]) {
        let end = Instant::now() + WATCHDOG;
        while !self.left(domains).is_empty() {
            assert!(Instant::now() < end, "left behind: {:?}", self.left(domains));
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Returns the processes, files and shared memory of runs in this bench and of these domains.
    pub fn left(&self, domains: &[PathBuf]) -> Vec<PathBuf> {
        let ids: Vec<String> =
            domains.iter().map(|path| path.file_name().unwrap().to_string_lossy().into_owned()).collect();
        let files = |directory: &Path| -> Vec<PathBuf> {
            std::fs::read_dir(directory).into_iter().flatten().map(|entry| entry.unwrap().path()).collect()
        };
        let mut left = files(&self.runtime.path().join("corotate"));
        let named = |path: &PathBuf| ids.iter().any(|id| path.to_string_lossy().contains(id));
        left.extend(files(Path::new("/dev/shm")).into_iter().filter(named));
        left.extend(self.processes().into_iter().map(|pid| PathBuf::from(format!("/proc/{pid}"))));
        left
    }

    /// Returns the environment entry that identifies every process of this bench.
    pub fn mark(&self) -> String {
        format!("XDG_RUNTIME_DIR={}", self.runtime.path().display())
    }

    /// Returns every process in this bench except zombies.
    pub fn processes(&self) -> Vec<u32> {
        processes_marked(&self.mark())
    }

    /// Waits for the process of a role and returns it.
    pub fn await_role(&self, role: &str) -> u32 {
        await_some(|| self.role(role))
    }

    /// Waits until a role has executed a tick and returns its process.
    pub fn await_ticks(&self, role: &str) -> u32 {
        let process = self.await_role(role);
        self.await_commits(role, 1);
        process
    }

    /// Waits until a role has committed its state the given number of times.
    pub fn await_commits(&self, role: &str, commits: u64) {
        await_some(|| (self.commits(role) >= commits).then_some(()));
    }

    /// Returns how many ticks a role has committed: the second word of its persistent state.
    pub fn commits(&self, role: &str) -> u64 {
        let state = format!("shared/{role}.books");
        let word = |domain: PathBuf| {
            let bytes = std::fs::read(domain.join(&state)).ok()?;
            Some(u64::from_ne_bytes(bytes.get(8..16)?.try_into().ok()?))
        };
        self.domains().into_iter().filter_map(word).max().unwrap_or(0)
    }

    /// Returns the process of a role if it is running.
    pub fn role(&self, role: &str) -> Option<u32> {
        let is_role = |pid: &u32| {
            let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            let words: Vec<String> = line.split(|byte| *byte == 0).map(|w| String::from_utf8_lossy(w).into()).collect();
            let body = words.iter().position(|word| word == "--body").map(|index| words[index + 1].as_str());
            words.len() > 2 && words[1] != "run" && (words[1] == role || body == Some(role))
        };
        self.processes().into_iter().find(is_role)
    }
}

/// After a failed test, keeps the directories until the processes that clean up have ended.
impl Drop for Bench {
    fn drop(&mut self) {
        let end = Instant::now() + Duration::from_secs(10);
        while std::thread::panicking() && !self.processes().is_empty() && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}
