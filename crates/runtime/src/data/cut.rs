//! The parts of a log that are read: given by times, or found as free motion. Must not use a known body.

use super::form::{Cut, DataError, Options};
use super::log::Log;
use crate::identify::{Sample, free_stretches};
use std::path::Path;

/// The largest number of rows in which free motion is searched, because all are held in memory.
const ROWS: usize = 20_000_000;

/// Reads a file with the begin and the end of each part, s since the log's first row: a line for each, numbers between commas,
/// semicolons or spaces. Other cells and lines without two numbers at the top are left out.
///
/// # Errors
/// [`DataError`].
pub fn read_parts(path: &Path) -> Result<Vec<[f64; 2]>, DataError> {
    let text = std::fs::read_to_string(path).map_err(|source| DataError::Read { path: path.to_owned(), source })?;
    let mut parts = Vec::new();
    for (line, text) in (1..).zip(text.lines()).filter(|(_, text)| !text.trim().is_empty() && !text.starts_with('#')) {
        let mut cells = text.split([',', ';', '\t', ' ']).map(str::trim).filter(|cell| !cell.is_empty());
        match [cells.next(), cells.next()].map(|cell| cell.and_then(|cell| cell.parse::<f64>().ok())) {
            [Some(begin), Some(end)] if begin.is_finite() && end.is_finite() && begin < end => parts.push([begin, end]),
            [None, _] if parts.is_empty() => {}
            _ => {
                let reason =
                    "a part has a begin and a later end, s since the log's first row; correct the line".to_owned();
                return Err(DataError::Form { path: path.to_owned(), line, reason });
            }
        }
    }
    if parts.is_empty() { Err(DataError::Empty { path: path.to_owned() }) } else { Ok(parts) }
}

/// Returns options with the times of the free motion, if that is to be found.
pub fn resolved(path: &Path, options: &Options) -> Result<Options, DataError> {
    let cut = if options.cut == Cut::Free { Cut::Between(find_free(path, options)?) } else { options.cut.clone() };
    Ok(Options { cut, ..options.clone() })
}

/// Finds the stretches of free motion in a log, and returns their times.
fn find_free(path: &Path, options: &Options) -> Result<Vec<[f64; 2]>, DataError> {
    if !path.is_file() {
        let reason = "the log is read twice to find the free motion, so it must be a file; name one".to_owned();
        return Err(DataError::Option { name: "find free", reason });
    }
    let whole = Options { needed: [true; 3], cut: Cut::Whole, ..options.clone() };
    let (mut segments, mut rows): (Vec<Vec<Sample>>, usize) = (Vec::new(), 0);
    for entry in Log::open(path, &whole)? {
        let entry = entry?;
        if entry.begins {
            segments.push(Vec::new());
        }
        rows += 1;
        if rows > ROWS {
            let reason = format!("the log has more than {ROWS} rows; read a part of it with --from and --to");
            return Err(DataError::Option { name: "find free", reason });
        }
        let sample = Sample { time_s: entry.time_s, rate_rad_s: entry.rate_rad_s.into() };
        segments.last_mut().expect("the first row begins one").push(sample);
    }
    let found = free_stretches(&segments);
    if found.is_empty() { Err(DataError::NotFree { path: path.to_owned() }) } else { Ok(found) }
}
