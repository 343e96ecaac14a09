//! Exports a recording as tables: one file per signal, one row per sample.
//!
//! Writes all tables in one pass, because a recording may be larger than memory. Must not leave an incomplete table under
//! its final name, nor change a bit.

mod csv;
#[cfg(feature = "parquet")]
mod parquet;
mod table;
#[cfg(feature = "parquet")]
pub(crate) use parquet::{Cell, ColumnKind, RowGroups};

use self::table::Table;
use super::error::RecordError;
use super::reader::Recording;
use super::track::SignalInfo;
use crate::files;
use crate::sample::Stamp;
use crate::system::remedy;
use std::fs::Permissions;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use tempfile::TempPath;

/// A failure to export a recording.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum ExportError {
    /// The recording cannot be read.
    #[error(transparent)]
    #[strum(transparent)]
    Recording(#[from] RecordError),
    /// A table, or the directory for it, cannot be written.
    #[error("cannot write {}: {source}; {}, or name another directory", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The table, or the directory.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A table has more columns than its format supports.
    #[error("{service} has {columns} columns, but Parquet readers handle at most {most}; export it with --csv")]
    #[strum(serialize = "too-many-columns")]
    Wide {
        /// The signal.
        service: String,
        /// Number of columns.
        columns: usize,
        /// Largest number of columns.
        most: usize,
    },
}

/// Writes every signal to `<body>.<signal>.csv` in a directory, which is created. Returns the files.
///
/// Columns: time in the run, s; time of receipt, ns; then every element of every field, beginning with the stamp. Rows:
/// all samples and no-sample markers in the order of receipt.
///
/// # Errors
/// [`ExportError`].
pub fn export_csv(recording: &Recording, directory: &Path) -> Result<Vec<PathBuf>, ExportError> {
    export::<csv::Csv>(recording, directory)
}

/// Writes the same tables as Parquet, `<body>.<signal>.parquet`.
///
/// # Errors
/// [`ExportError`].
#[cfg(feature = "parquet")]
pub fn export_parquet(recording: &Recording, directory: &Path) -> Result<Vec<PathBuf>, ExportError> {
    use self::parquet::{COLUMNS_MAX, Parquet};
    use self::table::COMMON;
    let width = |signal: &SignalInfo| COMMON.len() + signal.layout.size() / 8;
    match recording.signals().iter().find(|signal| width(signal) > COLUMNS_MAX) {
        Some(signal) => {
            let (service, columns) = (signal.service.clone(), width(signal));
            Err(ExportError::Wide { service, columns, most: COLUMNS_MAX })
        }
        None => export::<Parquet>(recording, directory),
    }
}

fn export<T: Table>(recording: &Recording, directory: &Path) -> Result<Vec<PathBuf>, ExportError> {
    let failed = |source| ExportError::Write { path: directory.to_owned(), source };
    files::create_directories(directory).map_err(failed)?;
    let place = files::Directory::open(directory).map_err(failed)?;
    let begin = |signal: &SignalInfo| TemporaryFile::<T>::begin(recording, signal, &place, directory);
    let mut tables = recording.signals().iter().map(begin).collect::<Result<Vec<_>, _>>()?;
    let (mut bits, mut written) = (Vec::new(), Ok(()));
    recording.visit(|signal, received_ns, sample| {
        // `visit` cannot be stopped early.
        if written.is_ok() {
            set_row(&mut bits, recording.info().period_ns, received_ns, sample);
            written = tables[signal].row(&bits);
        }
    })?;
    written?;
    tables.into_iter().map(|table| table.end(&place)).collect()
}

/// A table under a temporary name.
struct TemporaryFile<T> {
    path: PathBuf,
    file: TempPath,
    table: T,
}

impl<T: Table> TemporaryFile<T> {
    fn begin(
        recording: &Recording,
        signal: &SignalInfo,
        place: &files::Directory,
        directory: &Path,
    ) -> Result<Self, ExportError> {
        let name = format!("{}.{}.{}", file_name(&signal.body), file_name(&signal.signal), T::EXTENSION);
        let path = directory.join(&name);
        // The umask applies, as for any new file.
        let permissions = Permissions::from_mode(0o666);
        let created =
            tempfile::Builder::new().prefix(&name).suffix(".part").permissions(permissions).tempfile_in(place.path());
        let begun = created.and_then(|created| {
            let (file, path) = created.into_parts();
            Ok((path, T::begin(file.into(), recording, signal)?))
        });
        match begun {
            Ok((file, table)) => Ok(Self { path, file, table }),
            Err(source) => Err(ExportError::Write { path, source }),
        }
    }

    fn row(&mut self, bits: &[u64]) -> Result<(), ExportError> {
        self.table.row(bits).map_err(|source| ExportError::Write { path: self.path.clone(), source })
    }

    /// Completes the table and gives it its final name.
    fn end(self, place: &files::Directory) -> Result<PathBuf, ExportError> {
        let Self { path, file, table } = self;
        let named = place.path().join(path.file_name().unwrap_or_default());
        match table.end().and_then(|()| file.persist(named).map_err(io::Error::from)) {
            Ok(()) => Ok(path),
            Err(source) => Err(ExportError::Write { path, source }),
        }
    }
}

/// Replaces characters that could make a recorded name lead out of the directory.
fn file_name(name: &str) -> String {
    name.chars().map(|letter| if letter.is_ascii_alphanumeric() || letter == '-' { letter } else { '_' }).collect()
}

/// Sets `bits` to the row of a sample.
fn set_row(bits: &mut Vec<u64>, period_ns: u64, received_ns: u64, sample: &[u8]) {
    let stamp: Stamp = bytemuck::pod_read_unaligned(&sample[..size_of::<Stamp>()]);
    let time_s = stamp.tick as f64 * (period_ns as f64 / 1e9);
    bits.clear();
    bits.extend([time_s.to_bits(), received_ns]);
    bits.extend(sample.as_chunks().0.iter().map(|word| u64::from_le_bytes(*word)));
}
