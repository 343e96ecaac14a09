//! Which run a command means: one that is over or one that is under way, by one rule for every command.
//!
//! Must not follow a link of another user.

use super::output::{Exit, Failure, fail};
use super::shipped::name;
use super::signals::{die_with, terminated_by_signals};
use crate::bus::domain::Domain;
use crate::files::{self, Directory};
use crate::launch::{LATEST, RECORDING, RUNS};
use crate::seat::{find_run, results_path};
use std::ffi::OsString;
use std::fs;
use std::io::ErrorKind;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// The results of a run: its directory, or a recording. Without a name, and by the name `latest`, those of the newest run in `runs/`;
/// the domain of a run that is under way stands for its directory.
///
/// # Errors
/// Why there are none, and what to do.
pub fn results(given: Option<&Path>) -> Result<PathBuf, Failure> {
    match given.filter(|given| *given != Path::new(LATEST)) {
        None => newest(),
        Some(given) => Ok(Domain::join(given).ok().and_then(|domain| results_of(&domain)).unwrap_or(given.to_owned())),
    }
}

/// The directory that the results of a run go to, as its domain tells.
fn results_of(domain: &Domain) -> Option<PathBuf> {
    let path = files::read(&results_path(domain.root())).ok()?;
    Some(PathBuf::from(OsString::from_vec(path)))
}

/// The directory of the newest run.
fn newest() -> Result<PathBuf, Failure> {
    let link = Path::new(RUNS).join(LATEST);
    match Directory::open(&link) {
        // By its own name, which stays true when the link moves on.
        Ok(_) => Ok(fs::read_link(&link).map_or(link, |run| Path::new(RUNS).join(run))),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let text = "no run is named, and there is no runs/latest here; run a scenario, or name a run's directory";
            Err(Failure::new("no-latest-run", text))
        }
        Err(error) => Err(Failure::new("cannot-read", format!("{}: {error}; name a run's directory", link.display()))),
    }
}

/// The recording of a run: the file that is named, or that of the run's directory.
///
/// # Errors
/// As [`results`]; and where the run was not recorded, which one was.
pub fn recording(given: Option<&Path>) -> Result<PathBuf, Failure> {
    let path = results(given)?;
    if !path.is_dir() {
        return Ok(path);
    }
    let file = path.join(RECORDING);
    if file.exists() {
        return Ok(file);
    }
    let other = match newest_recording(&path) {
        Some(other) => format!("the newest run with one is {}", other.parent().unwrap_or(&other).display()),
        None => format!("`{} run SCENARIO --record` keeps the samples of a run", name()),
    };
    Err(Failure::new("no-recording", format!("{} has no {RECORDING}; {other}", path.display())))
}

/// The newest recording in `runs/` of another run than the one in this directory, or this file.
pub fn newest_recording(than: &Path) -> Option<PathBuf> {
    let than = fs::canonicalize(than).ok()?;
    let entries = fs::read_dir(RUNS).ok()?.flatten().filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    let recorded = entries.filter_map(|entry| {
        let file = entry.path().join(RECORDING);
        let modified = fs::metadata(&file).ok().filter(fs::Metadata::is_file)?.modified().ok()?;
        let (whole, directory) = (fs::canonicalize(&file).ok()?, fs::canonicalize(entry.path()).ok()?);
        (whole != than && directory != than).then_some((modified, file))
    });
    recorded.max().map(|(_, file)| file)
}

/// The domain of a run that is under way: the newest of this user without a name, and by the name `latest`; else the one of that
/// domain, or whose results go to that directory, or that recording.
///
/// # Errors
/// The exit code, once the reason is told.
pub fn domain(given: Option<&Path>) -> Result<PathBuf, Exit> {
    let given = given.filter(|given| *given != Path::new(LATEST));
    find_run(given).map_err(|error| fail(Exit::Usage, error))
}

/// Prepares a process to join a run: it dies with its parent, if one is given, and signals set a flag. Returns the run's domain and
/// the flag.
///
/// # Errors
/// The exit code, once the reason is printed.
pub fn join(parent: Option<i32>, given: Option<&Path>) -> Result<(PathBuf, Arc<AtomicBool>), Exit> {
    parent.map_or(Ok(()), die_with)?;
    let terminated = terminated_by_signals()?;
    Ok((domain(given)?, terminated))
}
