//! Runs the real program as a user would, in a directory and a runtime directory of its own, under a watchdog.

#![allow(dead_code, reason = "every test file uses its own part of this")]

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Nothing here takes so long, however loaded the machine is; what does, hangs.
pub const WATCHDOG: Duration = Duration::from_secs(300);

/// Limits nothing but metrics: for a run in real time that is not about missed ticks.
pub const ANY_TICKS: &str =
    "missed_ticks_max={}, starved_ticks_max={}, safe_ticks_max={}, unscored_ticks_max=\"100 %\"";

/// Such a run of a scenario that has criteria.
pub const WITHOUT_TICK_LIMITS: [&str; 4] = [
    "--set=accept.missed_ticks_max={}",
    "--set=accept.starved_ticks_max={}",
    "--set=accept.safe_ticks_max={}",
    "--set=accept.unscored_ticks_max=\"100 %\"",
];

/// A place to run in, with nothing of any other run in it.
pub struct Bench {
    directory: tempfile::TempDir,
    runtime: tempfile::TempDir,
    /// The program that it runs.
    program: PathBuf,
    /// The user to run as, if not this one.
    user: Option<u32>,
}

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
    pub fn summary(&self, scenario: &str, arguments: &[&str]) -> serde_json::Value {
        let file = self.path(&format!("{scenario}.toml"));
        std::fs::copy(shipped(scenario), &file).unwrap();
        let done = self.run(&[&["run", file.to_str().unwrap(), "--json"], arguments].concat());
        assert_eq!(done.code, Some(0), "{done:?}");
        serde_json::from_str(&done.stdout).unwrap()
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

    pub fn ended(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
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

/// Says that something is not tested here, past the harness, which keeps what a test prints: `tests/run` collects it.
pub fn skipped(what: &str, why: &str) {
    std::io::stderr().write_all(format!("SKIPPED: {what} because {why}\n").as_bytes()).unwrap();
}

/// A scenario that ships with the program.
pub fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(format!("{name}.toml"))
}

/// The interpreter that has the readers' requirements; made by the script that says what is missing if it fails.
pub fn python() -> PathBuf {
    let made = Command::new(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/readers/venv")).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    PathBuf::from(String::from_utf8(made.stdout).unwrap().trim())
}

/// A writer of chunks of the kind that the program writes.
fn rewriter(to: &Path) -> mcap::Writer<std::io::BufWriter<std::fs::File>> {
    let options = mcap::WriteOptions::new().compression(Some(mcap::Compression::Lz4));
    options.create(std::io::BufWriter::new(std::fs::File::create(to).unwrap())).unwrap()
}

/// Writes a recording again, as anybody could, with something changed: schemas, and the samples of one topic by tick; what is
/// made empty is left out.
pub fn rewrite(from: &Path, to: &Path, schema: impl Fn(String) -> String, change: impl Fn(&str, u32, &mut Vec<u8>)) {
    let bytes = std::fs::read(from).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut writer = rewriter(to);
    for index in &summary.metadata_indexes {
        writer.write_metadata(&mcap::read::metadata(&bytes, index).unwrap()).unwrap();
    }
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let mut message = message.unwrap();
        let mut channel = (*message.channel).clone();
        let mut of = (**channel.schema.as_ref().unwrap()).clone();
        of.data = Cow::Owned(schema(String::from_utf8(of.data.to_vec()).unwrap()).into_bytes());
        channel.schema = Some(of.into());
        let mut data = message.data.to_vec();
        change(&channel.topic, message.sequence, &mut data);
        message.channel = channel.into();
        if !data.is_empty() {
            message.data = Cow::Owned(data);
            writer.write(&message).unwrap();
        }
    }
    writer.finish().unwrap();
}

/// Writes a recording again, as anybody could, with its metadata changed and their checksums made right again.
pub fn rewrite_metadata(from: &Path, to: &Path, change: impl Fn(&str, &mut BTreeMap<String, String>)) {
    let bytes = std::fs::read(from).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut writer = rewriter(to);
    for index in &summary.metadata_indexes {
        let mut metadata = mcap::read::metadata(&bytes, index).unwrap();
        metadata.metadata.remove("checksum");
        change(&metadata.name, &mut metadata.metadata);
        let mut hasher = xxhash_rust::xxh3::Xxh3::new();
        let texts = metadata.metadata.iter().flat_map(|(key, value)| [key, value]);
        for text in [&metadata.name].into_iter().chain(texts) {
            hasher.update(&(text.len() as u64).to_le_bytes());
            hasher.update(text.as_bytes());
        }
        metadata.metadata.insert("checksum".to_owned(), format!("{:016x}", hasher.digest()));
        writer.write_metadata(&metadata).unwrap();
    }
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        writer.write(&message.unwrap()).unwrap();
    }
    writer.finish().unwrap();
}

/// The rows of a reference file in `tests/data`, its header left out.
pub fn reference(name: &str) -> Vec<Vec<f64>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name);
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().skip(1).map(|line| line.split(',').map(|word| word.parse().unwrap()).collect()).collect()
}
