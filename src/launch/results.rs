//! A run's directory: it holds the files of one run, and is locked while that run writes them.
//!
//! The files of an earlier run are removed as a whole, and only where the caller asks for it. Must not touch a file that is not
//! certainly one of ours.

use crate::config::RunId;
use crate::files;
use crate::system::{random_bits, utc};
use rustix::fs::OFlags;
use serde::Deserialize;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// The names of a run's files.
pub(crate) use crate::seat::SUMMARY;
pub(crate) const SCENARIO: &str = "scenario.toml";
pub(crate) const LATE: &str = "late.json";
pub(crate) const HASHES: &str = "hashes.txt";
pub(crate) const RECORDING: &str = "run.mcap";
pub(crate) const REPORT: &str = "report.html";
pub(crate) const LATENCY: &str = "latency";
pub(crate) const LATENCY_LOG: &str = "latency.hlog";
/// The lock of a run that is under way, with its identifier and process.
const LOCK: &str = "run.lock";
/// The beginning of the lock's text.
const LOCK_HEAD: &str = "corotate ";
/// The longest part of the lock's text that is quoted, bytes.
const LOCK_TEXT: u64 = 128;
/// The number of attempts at a lock that another process has removed meanwhile.
const ATTEMPTS: u32 = 100;
/// The files that a campaign's directory has from its first case on.
const CAMPAIGN_FILES: [&str; 2] = ["campaign.toml", "journal"];
/// The beginning of the generator's name in a report's page.
pub(crate) const GENERATOR: &str = "<meta name=\"generator\" content=\"corotate";
/// The beginning of a recording: the magic bytes, the header's kind and length, and its texts with their lengths.
const RECORDING_MAGIC: &[u8] = b"\x89MCAP0\r\n\x01";
const RECORDING_HEAD: u64 = 64;
const RECORDING_PROFILE: &[u8] = b"\x04\0\0\0ros2";
const RECORDING_LIBRARY: &[u8] = b"corotate ";

/// True if a file's content is an older run's.
type IsOurs = fn(&[u8]) -> bool;

/// The reason for which a directory cannot take a run's results.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum ResultsError {
    /// A file that a run would write exists, and is not from an older run.
    #[error(
        "{} exists and is not from an older run of this program; name another directory with --out, or remove it",
        path.display()
    )]
    #[strum(serialize = "foreign-file")]
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// Another run writes to the directory.
    #[error("another run writes its results to {}{holder}; wait for its end, or name another directory with --out", path.display())]
    #[strum(serialize = "directory-busy")]
    Busy {
        /// The directory.
        path: PathBuf,
        /// The run and its process, as far as they are known.
        holder: String,
    },
    /// The directory holds the results of an earlier run.
    #[error("{} holds files of an earlier run: {}; name another directory with --out, or give --overwrite to remove them", path.display(), names(files))]
    #[strum(serialize = "earlier-run")]
    Finished {
        /// The directory.
        path: PathBuf,
        /// The files.
        files: Vec<PathBuf>,
    },
    /// The directory belongs to a campaign.
    #[error("{} holds the results of a campaign; name another directory with --out", path.display())]
    #[strum(serialize = "campaign-directory")]
    Campaign {
        /// The directory.
        path: PathBuf,
    },
    /// The directory cannot be created, read or cleared.
    #[error("{}: {source}; name another directory with --out", path.display())]
    #[strum(serialize = "cannot-use-directory")]
    Directory {
        /// The directory, or the file in it.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

/// The default directory of runs.
pub const RUNS: &str = "runs";
/// The link in it to the newest run.
pub const LATEST: &str = "latest";
/// The largest number of runs of one scenario that begin in one second.
const DIRECTORIES: u32 = 10_000;

/// Returns the directory for the results of a run that began at `started`: the given one, or a new one under `runs/`.
///
/// # Errors
/// The system error, with the path.
pub fn make_directory(given: Option<&Path>, name: &str, started: SystemTime) -> io::Result<PathBuf> {
    let named = |path: &Path, error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", path.display()));
    if let Some(path) = given {
        return files::create_directories(path).map(|()| path.to_owned()).map_err(|error| named(path, error));
    }
    let runs = Path::new(RUNS);
    files::create_directories(runs).map_err(|error| named(runs, error))?;
    // To the second, without what separates the parts.
    let began = utc(started)[.."1970-01-01T00:00:00".len()].replace(['-', ':'], "");
    let stem = format!("{began}Z-{name}");
    for attempt in 1..=DIRECTORIES {
        let path = runs.join(if attempt == 1 { stem.clone() } else { format!("{stem}-{attempt}") });
        match files::create_directory(&path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            other => return other.map(|()| path.clone()).map_err(|error| named(&path, error)),
        }
    }
    Err(io::Error::new(io::ErrorKind::AlreadyExists, format!("{stem} and {DIRECTORIES} more exist already")))
}

/// Points the link `runs/latest` at a run's directory, in one step, if it lies in `runs/`.
///
/// # Errors
/// The system error; also if the name belongs to something other than a link.
pub fn make_latest(directory: &Path) -> io::Result<()> {
    let runs = match fs::canonicalize(RUNS) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        runs => runs?,
    };
    let directory = fs::canonicalize(directory)?;
    match directory.file_name() {
        Some(name) if directory.parent() == Some(&runs) && name != LATEST => {
            files::link(Path::new(RUNS), LATEST, Path::new(name))
        }
        _ => Ok(()),
    }
}

/// Returns an identifier for a new run.
///
/// # Errors
/// The error of the system's source of random numbers.
pub fn new_run() -> io::Result<RunId> {
    Ok(RunId::from_bits(random_bits()?.to_ne_bytes()))
}

/// A directory for the results of one run, locked against other runs until this is dropped.
#[derive(Debug)]
#[must_use]
pub struct Claim {
    path: PathBuf,
    _lock: File,
    /// The files of an earlier run that were removed.
    pub removed: Vec<PathBuf>,
}

impl Drop for Claim {
    fn drop(&mut self) {
        // Removed while it is still locked: the next process creates a lock of its own.
        let _ = fs::remove_file(self.path.join(LOCK));
    }
}

/// Locks a directory for the results of a run, and creates it if it does not exist. Files of an earlier run are removed if
/// `overwrite` is true; otherwise the directory is refused.
///
/// # Errors
/// [`ResultsError`]. Nothing has been removed then, unless the system refused to remove one of several files.
pub fn claim(directory: &Path, run: RunId, overwrite: bool) -> Result<Claim, ResultsError> {
    files::create_directories(directory).map_err(failed(directory))?;
    if CAMPAIGN_FILES.iter().all(|name| directory.join(name).is_file()) {
        return Err(ResultsError::Campaign { path: directory.to_owned() });
    }
    let mut claim = Claim { path: directory.to_owned(), _lock: lock(directory, run)?, removed: Vec::new() };
    let older = older(directory)?;
    let (empty, written): (Vec<_>, Vec<_>) = older.into_iter().partition(|path| is_empty(path));
    if !overwrite && !written.is_empty() {
        return Err(ResultsError::Finished { path: directory.to_owned(), files: written });
    }
    empty.iter().chain(&written).try_for_each(|path| fs::remove_file(path).map_err(failed(path)))?;
    claim.removed = written;
    // It stays if it is not empty.
    match fs::remove_dir(directory.join(LATENCY)) {
        Err(error) if !matches!(error.kind(), ErrorKind::NotFound | ErrorKind::DirectoryNotEmpty) => {
            Err(failed(&directory.join(LATENCY))(error))
        }
        _ => Ok(claim),
    }
}

/// Creates the lock file of a directory, or takes over that of a killed run, and writes the run's identifier into it.
fn lock(directory: &Path, run: RunId) -> Result<File, ResultsError> {
    let path = directory.join(LOCK);
    let failed = |source| ResultsError::Directory { path: path.clone(), source };
    for _ in 0..ATTEMPTS {
        let mut options = OpenOptions::new();
        let opened = files::open_with(&path, options.read(true).write(true).create(true), OFlags::NOFOLLOW);
        let mut file = opened.map_err(failed)?;
        let mut text = String::new();
        // A file that is not valid text is not ours.
        let read = (&file).take(LOCK_TEXT).read_to_string(&mut text);
        if read.is_err() || !(text.is_empty() || text.starts_with(LOCK_HEAD)) {
            return Err(ResultsError::Foreign { path });
        }
        files::require_own(&file).map_err(failed)?;
        match files::lock(&file, &path) {
            Ok(true) => {}
            Ok(false) => continue,
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                let holder = text.strip_prefix(LOCK_HEAD).map_or(String::new(), |held| format!(" ({})", held.trim()));
                return Err(ResultsError::Busy { path: directory.to_owned(), holder });
            }
            Err(error) => return Err(failed(error)),
        }
        let text = format!("{LOCK_HEAD}{}, process {}\n", run.comment(), std::process::id());
        let written = file.set_len(0).and_then(|()| io::Seek::rewind(&mut file));
        return written.and_then(|()| file.write_all(text.as_bytes())).map(|()| file).map_err(failed);
    }
    Err(failed(ErrorKind::WouldBlock.into()))
}

fn is_empty(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|file| file.len() == 0)
}

/// Returns the names of files, for a message.
fn names(files: &[PathBuf]) -> String {
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let (mut latency, names): (Vec<_>, Vec<_>) =
        files.iter().partition(|path| path.parent().is_some_and(|parent| parent.ends_with(LATENCY)));
    latency.truncate(1);
    let latency = latency.iter().map(|_| format!("{LATENCY}/"));
    names.into_iter().map(name).chain(latency).collect::<Vec<_>>().join(", ")
}

impl Claim {
    /// Returns the names of the removed files, for a message; `None` if none was removed.
    pub fn removed_names(&self) -> Option<String> {
        (!self.removed.is_empty()).then(|| names(&self.removed))
    }
}

fn failed(path: &Path) -> impl FnOnce(io::Error) -> ResultsError {
    let path = path.to_owned();
    |source| ResultsError::Directory { path, source }
}

/// Returns the files of an older run that have the names of a run's files.
fn older(directory: &Path) -> Result<Vec<PathBuf>, ResultsError> {
    let kinds: [(&str, IsOurs); 6] = [
        (SUMMARY, is_summary),
        (LATE, is_late_report),
        (SCENARIO, names_run),
        (HASHES, names_run),
        (RECORDING, is_recording),
        (REPORT, is_report),
    ];
    let mut older = Vec::new();
    for (name, is_ours) in kinds {
        let limit = if name == RECORDING { RECORDING_HEAD } else { u64::MAX };
        older.extend(known(directory.join(name), limit, is_ours)?);
    }
    let latency = directory.join(LATENCY);
    let entries = match fs::read_dir(&latency) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(older),
        Err(error) if error.kind() == ErrorKind::NotADirectory => return Err(ResultsError::Foreign { path: latency }),
        entries => entries.map_err(failed(&latency))?,
    };
    for entry in entries {
        let path = entry.map_err(failed(&latency))?.path();
        let ours = path.extension().is_some_and(|kind| kind == "hgrm") || path.ends_with(LATENCY_LOG);
        if ours {
            older.extend(known(path, u64::MAX, names_run)?);
        }
    }
    Ok(older)
}

/// Returns the file if it exists and is ours.
fn known(path: PathBuf, limit: u64, is_ours: IsOurs) -> Result<Option<PathBuf>, ResultsError> {
    let about = match fs::symlink_metadata(&path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        about => about.map_err(failed(&path))?,
    };
    if !about.is_file() {
        return Err(ResultsError::Foreign { path });
    }
    let mut head = Vec::new();
    files::open(&path).and_then(|file| file.take(limit).read_to_end(&mut head)).map_err(failed(&path))?;
    // An empty file was begun and never written.
    if head.is_empty() || is_ours(&head) { Ok(Some(path)) } else { Err(ResultsError::Foreign { path }) }
}

fn names_run(bytes: &[u8]) -> bool {
    std::str::from_utf8(bytes).is_ok_and(|text| RunId::in_comments_of(text).is_some())
}

fn is_summary(bytes: &[u8]) -> bool {
    is_json_of(bytes, "corotate/summary/")
}

fn is_late_report(bytes: &[u8]) -> bool {
    is_json_of(bytes, "corotate/late/")
}

/// Returns true if the file is a run's JSON object whose schema begins with `schema`.
fn is_json_of(bytes: &[u8], schema: &str) -> bool {
    #[derive(Deserialize)]
    struct Head {
        schema: String,
        #[serde(rename = "run")]
        _run: RunId,
    }
    serde_json::from_slice::<Head>(bytes).is_ok_and(|head| head.schema.starts_with(schema))
}

fn is_recording(bytes: &[u8]) -> bool {
    let texts = bytes.strip_prefix(RECORDING_MAGIC).and_then(|rest| rest.get(size_of::<u64>()..));
    let library = texts.and_then(|texts| texts.strip_prefix(RECORDING_PROFILE)?.get(size_of::<u32>()..));
    library.is_some_and(|library| library.starts_with(RECORDING_LIBRARY))
}

fn is_report(bytes: &[u8]) -> bool {
    std::str::from_utf8(bytes).is_ok_and(|text| text.contains(GENERATOR))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_runs_have_one_identifier() {
        assert_ne!(new_run().unwrap(), new_run().unwrap());
    }

    /// A file of another program with the name of ours is kept, and so is everything beside it.
    #[test]
    fn a_foreign_file_refuses_the_directory_and_nothing_is_removed() {
        let names = ["summary.json", "late.json", "scenario.toml", "hashes.txt", "run.mcap", "report.html"];
        for name in names.into_iter().chain(["latency/a.step.hgrm"]) {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            let ours = directory.path().join(if name == "hashes.txt" { "scenario.toml" } else { "hashes.txt" });
            fs::write(&ours, format!("# {}", new_run().unwrap().comment())).unwrap();
            for content in [
                "name = \"mine\"\n",
                "{\"schema\":\"corotate/summary/v1\"}",
                "{\"schema\":\"corotate/late/v1\"}",
                "\u{89}MCAP0 of another program",
            ] {
                fs::write(&path, content).unwrap();
                let refused = claim(directory.path(), new_run().unwrap(), true).unwrap_err();
                assert!(matches!(&refused, ResultsError::Foreign { path: told } if *told == path), "{refused}");
                assert!(path.exists() && ours.exists());
            }
            fs::remove_file(&path).unwrap();
            fs::create_dir(&path).unwrap();
            let refused = claim(directory.path(), new_run().unwrap(), true);
            assert!(matches!(refused, Err(ResultsError::Foreign { .. })), "{name} as a directory");
        }
    }

    #[test]
    fn what_is_nobodys_name_stays() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        fs::create_dir(at("latency")).unwrap();
        let kept = ["notes.txt", "latency/notes.txt", "verdict.xml"].map(at);
        kept.iter().for_each(|path| fs::write(path, "mine").unwrap());
        let gone = ["late.json", "scenario.toml", "latency/latency.hlog"].map(at);
        gone.iter().for_each(|path| fs::write(path, format!("#[{}]", new_run().unwrap().comment())).unwrap());
        let late = serde_json::json!({ "schema": "corotate/late/v9", "run": new_run().unwrap() });
        fs::write(&gone[0], late.to_string()).unwrap();
        fs::write(at("run.mcap"), "").unwrap();
        let run = || new_run().unwrap();
        assert!(matches!(claim(directory.path(), run(), false), Err(ResultsError::Finished { .. })));
        assert!(gone.iter().all(|path| path.exists()));
        let claimed = claim(directory.path(), run(), true).unwrap();
        assert_eq!(claimed.removed, gone);
        assert!(matches!(claim(directory.path(), run(), true), Err(ResultsError::Busy { .. })));
        drop(claimed);
        assert!(!at("run.lock").exists());
        assert!(kept.iter().all(|path| path.exists()) && !gone.iter().any(|path| path.exists()));
        assert!(!at("run.mcap").exists(), "it was begun and never written");
    }
    #[test]
    fn a_lock_that_is_left_is_taken_over_and_a_foreign_one_is_not() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(LOCK);
        let claimed = || claim(directory.path(), new_run().unwrap(), false);
        fs::write(&path, format!("{LOCK_HEAD}run 0, process 1\n")).unwrap();
        drop(claimed().unwrap());
        fs::write(&path, "mine").unwrap();
        assert!(matches!(claimed(), Err(ResultsError::Foreign { .. })));
        assert_eq!(fs::read(&path).unwrap(), b"mine");
        fs::remove_file(&path).unwrap();
        // Opened as a file is, it would wait for a writer.
        rustix::fs::mkfifoat(rustix::fs::CWD, &path, rustix::fs::Mode::RWXU).unwrap();
        assert!(matches!(claimed(), Err(ResultsError::Directory { .. })));
    }

    #[test]
    fn of_many_at_once_one_gets_the_directory() {
        let directory = tempfile::tempdir().unwrap();
        let claims: Vec<_> = std::thread::scope(|scope| {
            let threads: Vec<_> =
                (0..16).map(|_| scope.spawn(|| claim(directory.path(), new_run().unwrap(), false))).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        assert_eq!(claims.iter().filter(|claim| claim.is_ok()).count(), 1);
        assert!(claims.iter().flat_map(|claim| claim.as_ref().err()).all(|e| matches!(e, ResultsError::Busy { .. })));
    }
}
