//! The parts of a log that are read: given by times, or found as free motion. Must not use a known body.

use super::form::{Cut, DataError, Options};
use super::log::Log;
use crate::identify::{Sample, free_stretches};
use nalgebra::Vector3;
use std::path::Path;

/// The largest number of rows in which free motion is searched, because all are held in memory.
const ROWS: usize = 20_000_000;

/// Reads a file with the begin and the end of each part, s since the log's first row: a line for each, cells between commas,
/// semicolons, tabs or spaces. A header tells the columns of begin and end, else they are the first two.
///
/// # Errors
/// [`DataError`].
pub fn read_parts(path: &Path) -> Result<Vec<[f64; 2]>, DataError> {
    let text = std::fs::read_to_string(path).map_err(|source| DataError::Read { path: path.to_owned(), source })?;
    let (mut parts, mut columns, mut header) = (Vec::new(), [0, 1], false);
    for (line, text) in (1..).zip(text.lines()).filter(|(_, text)| !text.trim().is_empty() && !text.starts_with('#')) {
        let cells: Vec<&str> = match text.contains([',', ';', '\t']) {
            true => text.split([',', ';', '\t']).map(str::trim).collect(),
            false => text.split_whitespace().collect(),
        };
        let refuse = |reason: &str| DataError::Form { path: path.to_owned(), line, reason: reason.to_owned() };
        if parts.is_empty() && !header && cells.iter().all(|cell| cell.parse::<f64>().is_err()) {
            let named = |starts: [&str; 3]| {
                cells.iter().position(|cell| starts.iter().any(|start| cell.to_lowercase().starts_with(start)))
            };
            columns = match (named(["begin", "start", "from"]), named(["end", "stop", "to"])) {
                (Some(begin), Some(end)) => [begin, end],
                _ if cells.len() == 2 => columns,
                _ => return Err(refuse("no columns are called begin and end; name them so")),
            };
            header = true;
            continue;
        }
        match columns.map(|column| cells.get(column).and_then(|cell| cell.parse::<f64>().ok())) {
            [Some(begin), Some(end)] if begin.is_finite() && end.is_finite() && begin < end => parts.push([begin, end]),
            _ => {
                return Err(refuse(
                    "a part has a begin and a later end, s since the log's first row; correct the line",
                ));
            }
        }
    }
    if parts.is_empty() { Err(DataError::Empty { path: path.to_owned() }) } else { Ok(parts) }
}

/// The columns of the accelerometer that shows free motion.
type Forces = Option<[String; 3]>;

/// Returns options with the times of the free motion, if that is to be found, and the columns that show it.
pub fn resolved(path: &Path, options: &Options) -> Result<(Options, Forces), DataError> {
    if options.cut != Cut::Free {
        return Ok((options.clone(), None));
    }
    let (parts, forces) = find_free(path, options)?;
    Ok((Options { cut: Cut::Between(parts), ..options.clone() }, forces))
}

/// Finds the stretches of free motion in a log, and returns their times.
fn find_free(path: &Path, options: &Options) -> Result<(Vec<[f64; 2]>, Forces), DataError> {
    if !path.is_file() {
        let reason = "the log is read twice to find the free motion, so it must be a file; name one".to_owned();
        return Err(DataError::Option { name: "find free", reason });
    }
    let whole = Options { may_lack: [false; 3], ..options.clone() };
    let (mut segments, mut forces): (Vec<Vec<Sample>>, Vec<Vector3<f64>>) = (Vec::new(), Vec::new());
    let mut log = Log::open_whole(path, &whole)?;
    while let Some(entry) = log.next().transpose()? {
        if entry.begins {
            segments.push(Vec::new());
        }
        forces.push(log.force().into());
        if forces.len() > ROWS {
            let reason = format!("the log has more than {ROWS} rows; read a part of it with --from and --to");
            return Err(DataError::Option { name: "find free", reason });
        }
        let sample = Sample { time_s: entry.time_s, rate_rad_s: entry.rate_rad_s.into() };
        segments.last_mut().expect("the first row begins one").push(sample);
    }
    let (found, shown) = free_stretches(&segments, &forces);
    let columns = log.meaning().forces.clone().filter(|_| shown);
    if found.is_empty() { Err(DataError::NotFree { path: path.to_owned() }) } else { Ok((found, columns)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_read_by_their_names_or_their_order() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("parts.csv");
        let parts = |text: &str| {
            std::fs::write(&path, text).unwrap();
            read_parts(&path)
        };
        for text in [
            "1,2\n3.5,4\n",
            "begin,end\n1,2\n# a comment\n3.5,4\n",
            "from to\n1 2\n3.5 4\n",
            "segment,start,end,keep,comment\n0,1,2,,a throw\n1,3.5,4,,\n",
            "name;Stop (s);Start (s)\na;2;1\nb;4;3.5\n",
        ] {
            assert_eq!(parts(text).unwrap(), [[1.0, 2.0], [3.5, 4.0]], "{text}");
        }
        for text in ["a,b,c\n1,2,3\n", "1,2\n3,2\n", "begin,end\nbegin,end\n1,2\n", "1,inf\n", "1\n"] {
            assert!(matches!(parts(text), Err(DataError::Form { .. })), "{text}");
        }
        assert!(matches!(parts("begin,end\n"), Err(DataError::Empty { .. })));
    }
}
