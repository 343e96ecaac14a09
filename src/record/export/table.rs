//! A table of a recording, in any format.

use crate::files::Created;
use crate::record::reader::Recording;
use crate::record::track::SignalInfo;
use crate::sample::{FieldKind, Layout};
use std::io;

/// A writer of one table.
pub trait Table: Sized {
    /// The file name extension.
    const EXTENSION: &'static str;

    /// Begins the table of a signal.
    fn begin(file: Created, recording: &Recording, signal: &SignalInfo) -> io::Result<Self>;

    /// Adds a row from the bits of every column.
    fn row(&mut self, bits: &[u64]) -> io::Result<()>;

    /// Writes the remaining rows and the end of the file.
    fn end(self) -> io::Result<()>;
}

/// The first columns of every table; the recorded ones follow.
pub const COMMON: [(&str, FieldKind); 2] = [("time_s", FieldKind::F64), ("received_ns", FieldKind::U64)];

/// Returns the name and type of every column.
pub fn columns(layout: &Layout) -> Vec<(String, FieldKind)> {
    let common = COMMON.iter().map(|(name, kind)| ((*name).to_owned(), *kind));
    let recorded = layout.columns.iter().flat_map(|column| column.elements().map(|name| (name, column.kind)));
    common.chain(recorded).collect()
}
