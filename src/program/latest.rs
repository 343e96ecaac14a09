//! `runs/latest`: a link to the newest run in `runs/`, and what commands take where no run is named.
//!
//! Must not follow a link of another user.

use crate::files::Directory;
use crate::launch::{LATEST, RECORDING, RUNS};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The directory of the newest run.
///
/// # Errors
/// Why there is none, and what to do.
pub fn directory() -> Result<PathBuf, String> {
    let link = Path::new(RUNS).join(LATEST);
    match Directory::open(&link) {
        // By its own name, which stays true when the link moves on.
        Ok(_) => Ok(fs::read_link(&link).map_or(link, |run| Path::new(RUNS).join(run))),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            Err("no run is named, and there is no runs/latest here; run a scenario, or name a run's directory"
                .to_owned())
        }
        Err(error) => Err(format!("{}: {error}; name a run's directory", link.display())),
    }
}

/// The directory of the run that is meant, or the file: as given, or the newest run's.
///
/// # Errors
/// As [`directory`].
pub fn run(given: Option<&Path>) -> Result<PathBuf, String> {
    given.map_or_else(directory, |given| Ok(given.to_owned()))
}

/// The recording that is meant: the file that is given, or that of the directory, or that of the newest run.
///
/// # Errors
/// As [`directory`]; and where the run was not recorded.
pub fn recording(given: Option<&Path>) -> Result<PathBuf, String> {
    let path = run(given)?;
    if !path.is_dir() {
        return Ok(path);
    }
    let file = path.join(RECORDING);
    if file.exists() {
        return Ok(file);
    }
    Err(format!("{} has no {RECORDING}; `corotate run SCENARIO --record` keeps the samples of a run", path.display()))
}
