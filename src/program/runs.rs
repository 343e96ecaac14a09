//! Finds the finished or running run that the command line names, by the same rules for every command.
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

/// Returns the results of a run, a directory or a recording: of the newest run in `runs/` without a name or for `latest`. The
/// domain of a running run selects its directory.
///
/// # Errors
/// The reason why there are no results, with a remedy.
pub fn results(given: Option<&Path>) -> Result<PathBuf, Failure> {
    match given.filter(|given| *given != Path::new(LATEST)) {
        None => newest(),
        Some(given) => Ok(Domain::join(given).ok().and_then(|domain| results_of(&domain)).unwrap_or(given.to_owned())),
    }
}

/// Returns the results directory of a run, which its domain names.
fn results_of(domain: &Domain) -> Option<PathBuf> {
    let path = files::read(&results_path(domain.root())).ok()?;
    Some(PathBuf::from(OsString::from_vec(path)))
}

/// Returns the directory of the newest run.
fn newest() -> Result<PathBuf, Failure> {
    let link = Path::new(RUNS).join(LATEST);
    match Directory::open(&link) {
        // By its own name, because the link moves.
        Ok(_) => Ok(fs::read_link(&link).map_or(link, |run| Path::new(RUNS).join(run))),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let text = "there is no runs/latest here; run a scenario, or name a run's directory";
            Err(Failure::new("no-latest-run", text))
        }
        Err(error) => Err(Failure::new("cannot-read", format!("{}: {error}; name a run's directory", link.display()))),
    }
}

/// Returns the recording of a run: the named file, or the one in the run's directory.
///
/// # Errors
/// Like [`results`]. If the run was not recorded, the error names the newest run that was.
pub fn recording(given: Option<&Path>) -> Result<PathBuf, Failure> {
    let path = results(given)?;
    if !path.is_dir() {
        return Ok(path);
    }
    let file = path.join(RECORDING);
    if file.exists() {
        return Ok(file);
    }
    let remedy = match newest_recording(&path) {
        Some(file) => format!("the newest recorded run is {}", file.parent().unwrap_or(&file).display()),
        None => format!("record a run with `{} run SCENARIO --record`", name()),
    };
    Err(Failure::new("no-recording", format!("{} has no {RECORDING}; {remedy}", path.display())))
}

/// Returns the newest recording in `runs/`, except that of the given directory or file.
pub fn newest_recording(except: &Path) -> Option<PathBuf> {
    let except = fs::canonicalize(except).ok()?;
    let entries = fs::read_dir(RUNS).ok()?.flatten().filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    let recorded = entries.filter_map(|entry| {
        let file = entry.path().join(RECORDING);
        let modified = fs::metadata(&file).ok().filter(fs::Metadata::is_file)?.modified().ok()?;
        let (whole, directory) = (fs::canonicalize(&file).ok()?, fs::canonicalize(entry.path()).ok()?);
        (whole != except && directory != except).then_some((modified, file))
    });
    recorded.max().map(|(_, file)| file)
}

/// Returns the domain of a running run, given by its domain, results directory or recording: of the user's newest run without
/// a name or for `latest`.
///
/// # Errors
/// The exit code, once the reason is printed.
pub fn domain(given: Option<&Path>) -> Result<PathBuf, Exit> {
    let given = given.filter(|given| *given != Path::new(LATEST));
    find_run(given).map_err(|error| fail(Exit::Usage, error))
}

/// Prepares this process to join a run: it dies with its parent, if given, and signals set a flag. Returns the run's domain
/// and the flag.
///
/// # Errors
/// The exit code, once the reason is printed.
pub fn join(parent: Option<i32>, given: Option<&Path>) -> Result<(PathBuf, Arc<AtomicBool>), Exit> {
    parent.map_or(Ok(()), die_with)?;
    let terminated = terminated_by_signals()?;
    Ok((domain(given)?, terminated))
}
