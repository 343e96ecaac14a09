//! A recording as columns for everyone else: one CSV file per signal.
//!
//! Numbers are written so that the very bits are read back from them. Parquet is left out: its library weighs more than all
//! of this program's, and every tool that reads Parquet reads CSV.

use super::RecordError;
use super::reader::{Recording, Track};
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Writes one file per signal, `<body>.<signal>.csv`, into a directory, which is made: the time in the run, s; when the
/// sample was received, ns; then every element of every field, the stamp's first. All samples are in it, voids too, as they
/// came. Returns the files.
///
/// # Errors
/// [`RecordError`].
pub fn export_csv(recording: &Recording, directory: &Path) -> Result<Vec<PathBuf>, RecordError> {
    let failed = |path: &Path, source| RecordError::Write { path: path.to_owned(), source };
    std::fs::create_dir_all(directory).map_err(|source| failed(directory, source))?;
    let mut files = Vec::new();
    for signal in recording.signals() {
        // One signal at a time: a recording may be larger than memory.
        for track in recording.tracks(|other| other.service == signal.service)? {
            let path = directory.join(format!("{}.{}.csv", file_name(&signal.body), file_name(&signal.signal)));
            write(&path, &track, recording.info().period_ns).map_err(|source| failed(&path, source))?;
            files.push(path);
        }
    }
    Ok(files)
}

/// A name from a file is not to lead anywhere else.
fn file_name(name: &str) -> String {
    name.chars().map(|letter| if letter.is_ascii_alphanumeric() || letter == '-' { letter } else { '_' }).collect()
}

fn write(path: &Path, track: &Track, period_ns: u64) -> io::Result<()> {
    let mut out = BufWriter::new(File::create(path)?);
    let columns = &track.info.layout.columns;
    let names: Vec<String> = columns.iter().flat_map(|column| column.elements()).collect();
    writeln!(out, "time_s,received_ns,{}", names.join(","))?;
    for index in 0..track.len() {
        let time_s = track.stamp(index).tick as f64 * (period_ns as f64 / 1e9);
        write!(out, "{time_s},{}", track.received_ns[index])?;
        for (column, layout) in columns.iter().enumerate() {
            for element in 0..layout.count {
                write!(out, ",{}", track.text(index, column, element))?;
            }
        }
        writeln!(out)?;
    }
    out.flush()
}
