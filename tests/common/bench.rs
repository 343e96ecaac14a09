//! A directory and a runtime directory for the programs of one test, and what they leave there.

use super::process::{Done, Running, WATCHDOG, await_some, processes_marked};
use super::{shipped, summary_in};
use corotate::seat::seat_path;
use serde_json::Value;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// A place to run in, with nothing of any other run in it.
pub struct Bench {
    directory: tempfile::TempDir,
    runtime: tempfile::TempDir,
    /// The program that it runs.
    program: PathBuf,
    /// The user to run as, if not this one.
    user: Option<u32>,
}

impl Bench {
    pub fn new() -> Self {
        Self::of(Path::new(env!("CARGO_BIN_EXE_corotate")))
    }

    /// A bench of another program that is corotate with other rigs.
    pub fn of(program: &Path) -> Self {
        // Socket names limit the length of the runtime directory's path.
        let runtime = tempfile::Builder::new().prefix("ct").rand_bytes(6).tempdir_in("/tmp").unwrap();
        Self { directory: tempfile::tempdir().unwrap(), runtime, program: program.to_owned(), user: None }
    }

    /// A bench whose programs run as `nobody` where this process is root.
    pub fn unprivileged() -> Self {
        let mut bench = Self::new();
        if rustix::process::getuid().is_root() {
            const NOBODY: u32 = 65534;
            for directory in [&bench.directory, &bench.runtime] {
                std::os::unix::fs::chown(directory.path(), Some(NOBODY), Some(NOBODY)).unwrap();
            }
            // The build's own directory may be closed to others.
            std::fs::copy(&bench.program, bench.path("corotate")).unwrap();
            bench.program = bench.path("corotate");
            bench.user = Some(NOBODY);
        }
        bench
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Where the domains of its programs lie, in a directory of the program's name.
    pub fn runtime(&self) -> PathBuf {
        self.runtime.path().to_owned()
    }

    pub fn command(&self) -> Command {
        self.command_of(&self.program)
    }

    /// A command in this bench by another program than ours.
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

    /// Runs a shipped scenario and returns its summary; it must end well.
    pub fn summary(&self, scenario: &str, arguments: &[&str]) -> Value {
        let file = self.path(&format!("{scenario}.toml"));
        std::fs::copy(shipped(scenario), &file).unwrap();
        self.run(&[&["run", file.to_str().unwrap(), "--json"], arguments].concat()).succeeded().json()
    }

    /// The `summary.json` of a directory of results.
    pub fn summary_in(&self, directory: &str) -> Value {
        summary_in(&self.path(directory))
    }

    /// Starts a run that lasts until it is stopped, and waits until its ticks run.
    pub fn start_endless(&self, arguments: &[&str]) -> Running {
        let endless = ["run", "rigid-pair", "--duration", "100000", "--out", "out", "--set", "accept={}"];
        let running = self.start(&[&endless[..], arguments].concat());
        for role in ["leader", "follower", "observer", "controller"] {
            self.await_ticks(role);
        }
        running
    }

    /// The seat that a run of this bench leaves for a role, once it does.
    pub fn await_seat(&self, role: &str) -> PathBuf {
        await_some(|| self.domains().iter().map(|domain| seat_path(domain, role)).find(|seat| seat.is_file()))
    }

    /// The domains that exist in this bench's runtime directory.
    pub fn domains(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.runtime.path().join("corotate")).into_iter().flatten();
        entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_dir()).collect()
    }

    /// Asserts that no process, file or shared memory of any run in this bench is left; waits for the dying.
    pub fn assert_clean(&self, domains: &[PathBuf]) {
        let end = Instant::now() + WATCHDOG;
        while !self.left(domains).is_empty() {
            assert!(Instant::now() < end, "left behind: {:?}", self.left(domains));
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// The processes, files and shared memory of runs in this bench and of these domains.
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

    /// The entry in the environment by which every process of this bench is known.
    pub fn mark(&self) -> String {
        format!("XDG_RUNTIME_DIR={}", self.runtime.path().display())
    }

    /// Every process of the program that runs in this bench, zombies apart.
    pub fn processes(&self) -> Vec<u32> {
        processes_marked(&self.mark())
    }

    /// The process of a role, once it runs.
    pub fn await_role(&self, role: &str) -> u32 {
        await_some(|| self.role(role))
    }

    /// The process of a role, once it has executed ticks.
    pub fn await_ticks(&self, role: &str) -> u32 {
        let process = self.await_role(role);
        self.await_commits(role, 1);
        process
    }

    /// Waits until a role has committed its state so often.
    pub fn await_commits(&self, role: &str, commits: u64) {
        await_some(|| (self.commits(role) >= commits).then_some(()));
    }

    /// How often a role has committed its state: the second word of its ledger, in each tick once.
    pub fn commits(&self, role: &str) -> u64 {
        let ledger = format!("shared/{role}.books");
        let word = |domain: PathBuf| {
            let bytes = std::fs::read(domain.join(&ledger)).ok()?;
            Some(u64::from_ne_bytes(bytes.get(8..16)?.try_into().ok()?))
        };
        self.domains().into_iter().filter_map(word).max().unwrap_or(0)
    }

    /// The process of a role, if it runs.
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

/// Whoever cleans up after a test that failed needs the directory until that is done.
impl Drop for Bench {
    fn drop(&mut self) {
        let end = Instant::now() + Duration::from_secs(10);
        while std::thread::panicking() && !self.processes().is_empty() && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}
