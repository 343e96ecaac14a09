//! A trace instance of the kernel of its own: created, configured, read and removed in tracefs.
//!
//! Must not change another trace or mount anything. Reading never waits.

use crate::page::{FormatError, Formats, PAGE_FAULT, Page};
use rustix::fs::{Access, OFlags};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

/// The usual places of tracefs.
const ROOTS: [&str; 2] = ["/sys/kernel/tracing", "/sys/kernel/debug/tracing"];
/// The size of the ring of each core, KiB: room for some 60 000 switches.
const RING_KB: usize = 4096;
/// Options of an instance that make every event longer. A new instance inherits them.
const COSTLY_OPTIONS: [&str; 2] = ["stacktrace", "userstacktrace"];

/// An error of recording a kernel trace.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum TraceError {
    /// The machine has no tracefs.
    #[error(
        "no kernel trace: tracefs is not mounted; as root, run `mount -t tracefs nodev {root}`; the kernel needs CONFIG_FTRACE",
        root = ROOTS[0]
    )]
    #[strum(serialize = "no-tracefs")]
    NotMounted,
    /// This user must not use the tracefs.
    #[error(
        "no kernel trace: cannot open {}: {source}; run as root, or let root give this user access: `chown -R {user} {root}`",
        path.display(),
        user = rustix::process::geteuid().as_raw(),
        root = ROOTS[0]
    )]
    #[strum(serialize = "tracefs-not-permitted")]
    NotPermitted {
        /// The file or directory.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A setting of the trace is refused, or a file of it cannot be opened.
    #[error("cannot set up the kernel trace: {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write-tracefs")]
    Write {
        /// The file or directory.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A format of the kernel is unreadable.
    #[error(transparent)]
    #[strum(serialize = "trace-format")]
    Format(#[from] FormatError),
}

impl TraceError {
    /// Returns the error of changing `path`.
    fn changing(path: &Path, source: io::Error) -> Self {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::PermissionDenied => Self::NotPermitted { path, source },
            _ => Self::Write { path, source },
        }
    }
}

fn remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::AlreadyExists => "if no process uses it, remove it with `rmdir`",
        io::ErrorKind::OutOfMemory => "free some memory",
        _ => "run without a trace, and report it with `uname -r`",
    }
}

/// The directory of an instance. Dropping it stops the trace and removes the instance.
#[derive(Debug)]
struct Directory(PathBuf);

impl Directory {
    fn create(path: PathBuf) -> Result<Self, TraceError> {
        fs::create_dir(&path).map_err(|error| TraceError::changing(&path, error))?;
        Ok(Self(path))
    }

    /// Writes a setting to a file of the instance. Returns false if the kernel has no such file.
    fn write_optional(&self, file: &str, text: &str) -> Result<bool, TraceError> {
        let path = self.0.join(file);
        match OpenOptions::new()
            .write(true)
            .truncate(true)
            .open(&path)
            .and_then(|mut file| file.write_all(text.as_bytes()))
        {
            Ok(()) => Ok(true),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(TraceError::changing(&path, error)),
        }
    }

    fn write(&self, file: &str, text: &str) -> Result<(), TraceError> {
        if self.write_optional(file, text)? {
            return Ok(());
        }
        Err(TraceError::Write { path: self.0.join(file), source: io::ErrorKind::NotFound.into() })
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        // A process that still reads the instance keeps it from being removed: it must at least cost nothing.
        let _ = self.write("tracing_on", "0");
        let _ = fs::remove_dir(&self.0);
    }
}

/// A trace of some cores, separate from all other traces of the machine. Ends when it is dropped.
#[derive(Debug)]
pub struct Instance {
    /// The cores and the open files of their pages. Closed before the directory is removed.
    readers: Vec<(usize, File)>,
    buffer: Vec<u8>,
    formats: Formats,
    directory: Directory,
}

impl Instance {
    /// Creates the trace instance `name` and starts recording the cores, and page faults of the threads.
    ///
    /// # Errors
    /// [`TraceError`]: tracefs is missing, not permitted, or refuses a setting. No instance remains.
    pub fn create(name: &str, cores: &[usize], tids: &[i32]) -> Result<Self, TraceError> {
        Self::create_in(&find_root(&ROOTS.map(Path::new))?, name, cores, tids)
    }

    fn create_in(root: &Path, name: &str, cores: &[usize], tids: &[i32]) -> Result<Self, TraceError> {
        let directory = Directory::create(root.join("instances").join(name))?;
        let formats = Formats::read(&directory.0)?;
        configure(&directory, cores)?;
        let readers = cores.iter().map(|&core| Ok((core, open_pages(&directory.0, core)?)));
        let readers = readers.collect::<Result<_, TraceError>>()?;
        let mut instance = Self { readers, buffer: vec![0; formats.page_size()], formats, directory };
        for event in instance.formats.events().filter(|&event| event != PAGE_FAULT) {
            instance.directory.write(&format!("events/{event}/enable"), "1")?;
        }
        instance.set_page_fault_threads(tids)?;
        instance.directory.write("tracing_on", "1")?;
        Ok(instance)
    }

    /// Records the page faults of these threads only. Has no effect where the kernel lacks the event.
    ///
    /// # Errors
    /// [`TraceError::Write`] if the kernel refuses the filter.
    pub fn set_page_fault_threads(&mut self, tids: &[i32]) -> Result<(), TraceError> {
        if !self.formats.events().any(|event| event == PAGE_FAULT) {
            return Ok(());
        }
        if !tids.is_empty() {
            let terms: Vec<String> = tids.iter().map(|tid| format!("common_pid == {tid}")).collect();
            self.directory.write(&format!("events/{PAGE_FAULT}/filter"), &terms.join(" || "))?;
        }
        let enable = if tids.is_empty() { "0" } else { "1" };
        self.directory.write(&format!("events/{PAGE_FAULT}/enable"), enable)
    }

    /// Returns the formats with which to decode the pages.
    pub fn formats(&self) -> &Formats {
        &self.formats
    }

    /// Reads the pages that the kernel holds for a core, without waiting. A core that is not recorded has no pages.
    pub fn read(&mut self, core: usize, pages: &mut impl FnMut(Page)) {
        let Some((_, file)) = self.readers.iter_mut().find(|(recorded, _)| *recorded == core) else { return };
        // A busy core could fill pages as fast as they are read: reads at most one ring.
        for _ in 0..=RING_KB * 1024 / self.buffer.len().max(1) {
            match file.read(&mut self.buffer) {
                // An empty ring is an error, `EAGAIN`. A page is retried with the next call after other errors.
                Ok(0) | Err(_) => return,
                Ok(length) => {
                    if let Some(page) = Page::new(&self.buffer[..length], &self.formats) {
                        pages(page);
                    }
                }
            }
        }
    }
}

/// Checks that this user can create trace instances.
///
/// # Errors
/// [`TraceError::NotMounted`], [`TraceError::NotPermitted`].
pub fn require_tracefs() -> Result<(), TraceError> {
    let path = find_root(&ROOTS.map(Path::new))?.join("instances");
    rustix::fs::access(&path, Access::WRITE_OK).map_err(|error| TraceError::NotPermitted { path, source: error.into() })
}

/// Sets the clock, cores, ring and options of an instance that does not record yet.
fn configure(directory: &Directory, cores: &[usize]) -> Result<(), TraceError> {
    directory.write("tracing_on", "0")?;
    directory.write("trace_clock", "mono")?;
    directory.write("tracing_cpumask", &core_mask(cores))?;
    directory.write("options/overwrite", "1")?;
    // `record-cmd` and `record-tgid` stay as they are: the kernel changes them for all instances at once.
    for option in COSTLY_OPTIONS {
        directory.write_optional(&format!("options/{option}"), "0")?;
    }
    // Only of these cores: the ring of every core would cost 4 MiB each, and work on cores that do not concern this trace.
    for core in cores {
        directory.write(&format!("per_cpu/cpu{core}/buffer_size_kb"), &RING_KB.to_string())?;
    }
    Ok(())
}

fn open_pages(directory: &Path, core: usize) -> Result<File, TraceError> {
    let path = directory.join(format!("per_cpu/cpu{core}/trace_pipe_raw"));
    let flags = OFlags::NONBLOCK.bits().cast_signed();
    OpenOptions::new().read(true).custom_flags(flags).open(&path).map_err(|error| TraceError::changing(&path, error))
}

/// Returns the set of cores as the kernel reads it: hexadecimal, 32 cores per word, the highest word first.
fn core_mask(cores: &[usize]) -> String {
    let words = cores.iter().max().map_or(1, |last| last / 32 + 1);
    let word = |index: usize| {
        cores.iter().filter(|&core| core / 32 == index).fold(0_u32, |bits, core| bits | 1 << (core % 32))
    };
    (0..words).rev().map(|index| format!("{:08x}", word(index))).collect::<Vec<_>>().join(",")
}

/// Returns the first root that holds a tracefs.
fn find_root(roots: &[&Path]) -> Result<PathBuf, TraceError> {
    let mut refused = None;
    for root in roots {
        let path = root.join("instances");
        match fs::metadata(&path) {
            Ok(_) => return Ok(root.to_path_buf()),
            Err(source) if source.kind() == io::ErrorKind::PermissionDenied => {
                refused.get_or_insert(TraceError::NotPermitted { path, source });
            }
            Err(_) => {}
        }
    }
    Err(refused.unwrap_or(TraceError::NotMounted))
}

/// Removes the trace instances that a crashed process has left: those whose names start with `prefix` and for which `keep`
/// returns false. Returns their names. An instance that a process still reads stays, as does everything without permission.
pub fn remove_instances(prefix: &str, keep: impl Fn(&str) -> bool) -> Vec<String> {
    match find_root(&ROOTS.map(Path::new)) {
        Ok(root) => remove_instances_in(&root, prefix, keep),
        Err(_) => Vec::new(),
    }
}

fn remove_instances_in(root: &Path, prefix: &str, keep: impl Fn(&str) -> bool) -> Vec<String> {
    let directory = root.join("instances");
    let names = fs::read_dir(&directory).into_iter().flatten().flatten();
    let names = names.filter_map(|entry| entry.file_name().into_string().ok());
    let left = names.filter(|name| name.starts_with(prefix) && !keep(name));
    left.filter(|name| fs::remove_dir(directory.join(name)).is_ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::EventKind;
    use rustix::time::{ClockId, clock_gettime};
    use std::time::Duration;

    /// Returns an instance's directory with the files that this module writes.
    fn imitation(root: &Path, cores: &[usize]) -> Directory {
        let directory = root.join("instances/x");
        let formats = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests-data/6.18");
        let events: Vec<_> = Formats::read(&formats).unwrap().events().collect();
        let settings = ["tracing_on", "trace_clock", "tracing_cpumask", "options/overwrite", "options/stacktrace"];
        let rings = cores.iter().map(|core| format!("per_cpu/cpu{core}/buffer_size_kb"));
        let enables = events.iter().map(|event| format!("events/{event}/enable"));
        let filter = format!("events/{PAGE_FAULT}/filter");
        for file in settings.map(String::from).into_iter().chain(rings).chain(enables).chain([filter]) {
            let path = directory.join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "as before").unwrap();
        }
        Directory(directory)
    }

    #[test]
    fn a_core_mask_is_hexadecimal_words() {
        assert_eq!(core_mask(&[]), "00000000");
        assert_eq!(core_mask(&[0, 2, 31]), "80000005");
        assert_eq!(core_mask(&[33, 1, 64]), "00000001,00000002,00000002");
    }

    #[test]
    fn an_instance_is_configured_for_its_cores() {
        let root = tempfile::tempdir().unwrap();
        let directory = imitation(root.path(), &[1, 3]);
        configure(&directory, &[1, 3]).unwrap();
        let written = |file: &str| fs::read_to_string(directory.0.join(file)).unwrap();
        let files = ["tracing_on", "trace_clock", "tracing_cpumask", "options/overwrite", "options/stacktrace"];
        assert_eq!(files.map(written), ["0", "mono", "0000000a", "1", "0"]);
        assert_eq!(["1", "3"].map(|core| written(&format!("per_cpu/cpu{core}/buffer_size_kb"))), ["4096", "4096"]);
        let error = configure(&directory, &[2]).unwrap_err();
        assert_eq!(<&str>::from(&error), "cannot-write-tracefs");
        assert!(error.to_string().contains("per_cpu/cpu2/buffer_size_kb"));
    }

    #[test]
    fn page_faults_are_filtered_by_thread() {
        let root = tempfile::tempdir().unwrap();
        let directory = imitation(root.path(), &[]);
        let formats = Formats::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests-data/6.18")).unwrap();
        let mut instance = Instance { readers: Vec::new(), buffer: Vec::new(), formats, directory };
        let written = |instance: &Instance| {
            let path = instance.directory.0.join("events").join(PAGE_FAULT);
            ["filter", "enable"].map(|file| fs::read_to_string(path.join(file)).unwrap())
        };
        instance.set_page_fault_threads(&[]).unwrap();
        assert_eq!(written(&instance)[1], "0");
        instance.set_page_fault_threads(&[12, 7]).unwrap();
        assert_eq!(written(&instance), ["common_pid == 12 || common_pid == 7", "1"]);
        instance.read(0, &mut |_| panic!("core 0 is not recorded"));
        instance.formats = Formats::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests-data/5.4")).unwrap();
        instance.set_page_fault_threads(&[1]).unwrap();
        assert_eq!(written(&instance), ["common_pid == 12 || common_pid == 7", "1"]);
    }

    #[test]
    fn a_failed_instance_is_removed() {
        let root = tempfile::tempdir().unwrap();
        let create = |name| Instance::create_in(root.path(), name, &[0], &[]).unwrap_err();
        assert_eq!(<&str>::from(&create("x")), "cannot-write-tracefs");
        fs::create_dir_all(root.path().join("instances/taken")).unwrap();
        // The imitation has no formats.
        assert_eq!(<&str>::from(&create("x")), "trace-format");
        assert!(!root.path().join("instances/x").exists());
        // An instance of another process is left alone.
        assert_eq!(<&str>::from(&create("taken")), "cannot-write-tracefs");
        assert!(root.path().join("instances/taken").exists());
    }

    #[test]
    fn the_first_mounted_root_is_used() {
        let root = tempfile::tempdir().unwrap();
        let [first, second] = ["a", "b"].map(|name| root.path().join(name));
        let find = || find_root(&[&first, &second]);
        assert_eq!(<&str>::from(&find().unwrap_err()), "no-tracefs");
        // The directory without the mount.
        fs::create_dir(&first).unwrap();
        fs::create_dir_all(second.join("instances")).unwrap();
        assert_eq!(find().unwrap(), second);
        fs::create_dir(first.join("instances")).unwrap();
        assert_eq!(find().unwrap(), first);
        let refused = TraceError::changing(&first, io::ErrorKind::PermissionDenied.into());
        assert_eq!(<&str>::from(&refused), "tracefs-not-permitted");
    }

    #[test]
    fn instances_of_crashed_processes_are_removed() {
        let root = tempfile::tempdir().unwrap();
        assert!(remove_instances_in(root.path(), "corotate-", |_| false).is_empty());
        for name in ["corotate-1", "corotate-2", "other", "corotate-3/open"] {
            fs::create_dir_all(root.path().join("instances").join(name)).unwrap();
        }
        assert_eq!(remove_instances_in(root.path(), "corotate-", |name| name == "corotate-2"), ["corotate-1"]);
        let left = |name: &str| root.path().join("instances").join(name).exists();
        assert!(["corotate-2", "other", "corotate-3"].into_iter().all(left));
    }

    fn skip(error: &TraceError) {
        // Bypasses the test harness, which captures printed output.
        let _ = io::stderr().write_all(format!("SKIPPED: the kernel's traces because: {error}\n").as_bytes());
    }

    fn now_ns() -> u64 {
        let now = clock_gettime(ClockId::Monotonic);
        u64::try_from(now.tv_sec * 1_000_000_000 + now.tv_nsec).unwrap()
    }

    /// Reads all cores and returns the time and the kind of each event.
    fn read_all(instance: &mut Instance, cores: &[usize]) -> Vec<(u64, EventKind)> {
        let mut events = Vec::new();
        for &core in cores {
            let mut pages = Vec::new();
            instance.read(core, &mut |page| pages.push(page));
            pages.iter().for_each(|page| instance.formats().decode(page, core, &mut events));
        }
        events.into_iter().map(|event| (event.ns, event.kind)).collect()
    }

    #[test]
    fn the_kernel_records_switches_and_page_faults_of_a_thread() {
        let cores: Vec<usize> = (0..std::thread::available_parallelism().unwrap().get()).collect();
        let name = format!("corotate-test-{}", std::process::id());
        let mut instance = match Instance::create(&name, &cores, &[]) {
            Ok(instance) => instance,
            Err(error @ (TraceError::NotMounted | TraceError::NotPermitted { .. })) => return skip(&error),
            Err(error) => panic!("{error}"),
        };
        let path = instance.directory.0.clone();
        let start = now_ns();
        let tid = rustix::thread::gettid().as_raw_nonzero().get();
        instance.set_page_fault_threads(&[tid]).unwrap();
        for _ in 0..100 {
            std::thread::sleep(Duration::from_micros(200));
        }
        // So large that the allocator takes new pages from the kernel.
        std::hint::black_box(vec![1_u8; 8 << 20]);
        let end = now_ns();
        let events = read_all(&mut instance, &cores);
        let within = |ns: u64| (start..=end).contains(&ns);
        // Switches to the thread are not counted: on some virtual machines the kernel omits all that the idle task does.
        let leaves = |kind: &EventKind| matches!(kind, EventKind::Switch { from, .. } if from.tid == tid);
        let switches = events.iter().filter(|(ns, kind)| within(*ns) && leaves(kind)).count();
        assert!(switches >= 100, "{switches}");
        let faults: Vec<_> = events.iter().filter(|(_, kind)| matches!(kind, EventKind::PageFault { .. })).collect();
        if instance.formats().events().any(|event| event == PAGE_FAULT) {
            assert!(faults.len() > 10, "{}", faults.len());
        }
        assert!(faults.iter().all(|(_, kind)| *kind == EventKind::PageFault { tid }));
        // An instance in use stays and goes on; its name is taken.
        assert!(remove_instances(&name, |_| false).is_empty());
        std::thread::sleep(Duration::from_millis(1));
        assert!(!read_all(&mut instance, &cores).is_empty());
        assert_eq!(<&str>::from(&Instance::create(&name, &cores, &[]).unwrap_err()), "cannot-write-tracefs");
        assert!(path.exists());
        drop(instance);
        assert!(!path.exists());
    }

    #[test]
    fn the_kernel_removes_the_instance_of_a_crashed_process() {
        let name = format!("corotate-left-{}", std::process::id());
        let create = |root: PathBuf| Directory::create(root.join("instances").join(&name));
        match find_root(&ROOTS.map(Path::new)).and_then(create) {
            Ok(directory) => {
                assert_eq!(remove_instances(&name, |_| false), [name]);
                assert!(!directory.0.exists());
            }
            Err(error) => skip(&error),
        }
    }
}
