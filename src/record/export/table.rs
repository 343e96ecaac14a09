//! A table of a recording, in any format.

use crate::files::Created;
use crate::record::reader::{Recording, SignalInfo};
use crate::sample::{FieldKind, Layout};
use std::io;

/// A table in the making.
pub trait Table: Sized {
    /// The extension of its file.
    const EXTENSION: &'static str;

    /// Begins the table of a signal.
    fn begin(file: Created, recording: &Recording, signal: &SignalInfo) -> io::Result<Self>;

    /// Adds a row: the bits of every column.
    fn row(&mut self, bits: &[u64]) -> io::Result<()>;

    /// Writes what is left.
    fn end(self) -> io::Result<()>;
}

/// The columns that every table has beside the recorded ones, before them.
pub const OWN: [(&str, FieldKind); 2] = [("time_s", FieldKind::F64), ("received_ns", FieldKind::U64)];

/// The name and type of every column.
pub fn columns(layout: &Layout) -> Vec<(String, FieldKind)> {
    let own = OWN.iter().map(|(name, kind)| ((*name).to_owned(), *kind));
    let recorded = layout.columns.iter().flat_map(|column| column.elements().map(|name| (name, column.kind)));
    own.chain(recorded).collect()
}
