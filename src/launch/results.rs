//! A run's directory: it holds the files of one run.
//!
//! What an older run of ours left there goes as a whole before anything new is written. Must not touch a file that is not
//! certainly one of ours.

use crate::config::RunId;
use crate::files;
use crate::system::{random_bits, utc};
use serde::Deserialize;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// The files of a run.
pub(crate) const SUMMARY: &str = "summary.json";
pub(crate) const SCENARIO: &str = "scenario.toml";
pub(crate) const HASHES: &str = "hashes.txt";
pub(crate) const RECORDING: &str = "run.mcap";
pub(crate) const REPORT: &str = "report.html";
pub(crate) const LATENCY: &str = "latency";
pub(crate) const LATENCY_LOG: &str = "latency.hlog";
/// What a report's page begins its generator's name with.
pub(crate) const GENERATOR: &str = "<meta name=\"generator\" content=\"corotate";
/// How a recording begins: the magic bytes, the header's kind and length, and its texts with their lengths.
const RECORDING_MAGIC: &[u8] = b"\x89MCAP0\r\n\x01";
const RECORDING_HEAD: u64 = 64;
const RECORDING_PROFILE: &[u8] = b"\x04\0\0\0ros2";
const RECORDING_LIBRARY: &[u8] = b"corotate ";

/// Whether a file's content is an older run's.
type IsOurs = fn(&[u8]) -> bool;

/// Why a directory cannot take a run's results.
#[derive(Debug, thiserror::Error)]
pub enum ResultsError {
    /// A file that a run would write is there, and is none of an older run.
    #[error(
        "{} is there and is not known to be an older run's of this program; name another directory with --out, or remove it",
        path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// The directory cannot be made, looked at, or cleared.
    #[error("{}: {source}; name another directory with --out", path.display())]
    Directory {
        /// The directory, or the file in it.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

/// Where runs go that are not told where.
pub const RUNS: &str = "runs";
/// The link in it to the newest.
pub const LATEST: &str = "latest";
/// The most runs of one scenario that begin in one second.
const DIRECTORIES: u32 = 10_000;

/// The directory for the results of a run that began then: as given, or a new one under `runs/`.
///
/// # Errors
/// Those of the system, with the path.
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
    Err(io::Error::new(io::ErrorKind::AlreadyExists, format!("{stem} and {DIRECTORIES} more are there already")))
}

/// Makes a run's directory the newest of `runs/`, if that is where it lies: a link, made in one step.
///
/// # Errors
/// Those of the system, and where something else than a link has the name.
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

/// An identifier for a new run.
///
/// # Errors
/// Those of the system's source of random numbers.
pub fn new_run() -> io::Result<RunId> {
    Ok(RunId::from_bits(random_bits()?.to_ne_bytes()))
}

/// Makes a directory for a run's results. If it exists, the files of an older run of ours in it are removed.
///
/// # Errors
/// [`ResultsError`]; nothing has been removed if a file is [`Foreign`](ResultsError::Foreign).
pub fn claim(directory: &Path) -> Result<(), ResultsError> {
    files::create_directories(directory).map_err(failed(directory))?;
    let older = older(directory)?;
    older.iter().try_for_each(|path| fs::remove_file(path).map_err(failed(path)))?;
    // It stays if somebody else has put something there.
    match fs::remove_dir(directory.join(LATENCY)) {
        Err(error) if !matches!(error.kind(), ErrorKind::NotFound | ErrorKind::DirectoryNotEmpty) => {
            Err(failed(&directory.join(LATENCY))(error))
        }
        _ => Ok(()),
    }
}

fn failed(path: &Path) -> impl FnOnce(io::Error) -> ResultsError {
    let path = path.to_owned();
    |source| ResultsError::Directory { path, source }
}

/// The files in the place of a run's, all of which are an older run's.
fn older(directory: &Path) -> Result<Vec<PathBuf>, ResultsError> {
    let kinds: [(&str, IsOurs); 5] = [
        (SUMMARY, is_summary),
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

/// The file if it exists and is ours.
fn known(path: PathBuf, limit: u64, is_ours: IsOurs) -> Result<Option<PathBuf>, ResultsError> {
    let about = match fs::symlink_metadata(&path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        about => about.map_err(failed(&path))?,
    };
    if !about.is_file() {
        return Err(ResultsError::Foreign { path });
    }
    let mut head = Vec::new();
    File::open(&path).and_then(|file| file.take(limit).read_to_end(&mut head)).map_err(failed(&path))?;
    // What was begun and never written holds nothing of anybody's.
    if head.is_empty() || is_ours(&head) { Ok(Some(path)) } else { Err(ResultsError::Foreign { path }) }
}

fn names_run(bytes: &[u8]) -> bool {
    std::str::from_utf8(bytes).is_ok_and(|text| RunId::in_comments_of(text).is_some())
}

fn is_summary(bytes: &[u8]) -> bool {
    #[derive(Deserialize)]
    struct Head {
        schema: String,
        #[serde(rename = "run")]
        _run: RunId,
    }
    serde_json::from_slice::<Head>(bytes).is_ok_and(|head| head.schema.starts_with("corotate/summary/"))
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

    /// A file that is merely named like ours stays, and so does everything beside it.
    #[test]
    fn a_foreign_file_refuses_the_directory_and_nothing_is_removed() {
        let names = ["summary.json", "scenario.toml", "hashes.txt", "run.mcap", "report.html", "latency/a.step.hgrm"];
        for name in names {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            let ours = directory.path().join(if name == "hashes.txt" { "scenario.toml" } else { "hashes.txt" });
            fs::write(&ours, format!("# {}", new_run().unwrap().comment())).unwrap();
            for content in ["name = \"mine\"\n", "{\"schema\":\"corotate/summary/v1\"}", "\u{89}MCAP0 of somebody"] {
                fs::write(&path, content).unwrap();
                let refused = claim(directory.path()).unwrap_err();
                assert!(matches!(&refused, ResultsError::Foreign { path: told } if *told == path), "{refused}");
                assert!(path.exists() && ours.exists());
            }
            fs::remove_file(&path).unwrap();
            fs::create_dir(&path).unwrap();
            assert!(matches!(claim(directory.path()), Err(ResultsError::Foreign { .. })), "{name} as a directory");
        }
    }

    #[test]
    fn what_is_nobodys_name_stays() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        fs::create_dir(at("latency")).unwrap();
        let kept = ["notes.txt", "latency/notes.txt", "verdict.xml"].map(at);
        kept.iter().for_each(|path| fs::write(path, "mine").unwrap());
        let gone = ["scenario.toml", "latency/latency.hlog"].map(at);
        gone.iter().for_each(|path| fs::write(path, format!("#[{}]", new_run().unwrap().comment())).unwrap());
        fs::write(at("run.mcap"), "").unwrap();
        claim(directory.path()).unwrap();
        assert!(kept.iter().all(|path| path.exists()) && !gone.iter().any(|path| path.exists()));
        assert!(!at("run.mcap").exists(), "it was begun and never written");
    }
}
