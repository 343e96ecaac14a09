//! The table of a log's rows with their estimates.

use crate::data::Estimated;
use crate::files;
#[cfg(feature = "parquet")]
use crate::record::{Cell, ColumnKind, RowGroups};
use crate::sample::FieldKind;
use std::io;
use std::path::Path;

/// Number of rows per group of a Parquet table.
#[cfg(feature = "parquet")]
const ROWS_PER_GROUP: usize = 1 << 17;

/// Columns of tables, after the segment's name.
const COLUMNS: [(&str, FieldKind); 7] = [
    ("row", FieldKind::U64),
    ("time_s", FieldKind::F64),
    ("estimate_rad_s", FieldKind::F64),
    ("deviation_rad_s", FieldKind::F64),
    ("measured_rad_s", FieldKind::F64),
    ("error_rad_s", FieldKind::F64),
    ("observed", FieldKind::U64),
];

/// A writer of rows with estimates.
pub enum Table {
    Csv(Box<csv::Writer<files::Created>>),
    #[cfg(feature = "parquet")]
    Parquet(Box<RowGroups<files::Created>>),
}

impl Table {
    pub fn begin(path: &Path) -> io::Result<Self> {
        if is_parquet(path) {
            return Self::begin_parquet(path);
        }
        let mut out = csv::Writer::from_writer(files::create(path)?);
        out.write_record(["segment"].into_iter().chain(COLUMNS.map(|(name, _)| name)))?;
        Ok(Self::Csv(Box::new(out)))
    }

    #[cfg(feature = "parquet")]
    fn begin_parquet(path: &Path) -> io::Result<Self> {
        let columns = COLUMNS.map(|(name, kind)| (name.to_owned(), kind.into()));
        let columns = [("segment".to_owned(), ColumnKind::Word)].into_iter().chain(columns).collect();
        let about = vec![("version", env!("CARGO_PKG_VERSION").to_owned())];
        RowGroups::begin(files::create(path)?, "estimate", columns, false, about, ROWS_PER_GROUP)
            .map(|groups| Self::Parquet(Box::new(groups)))
    }

    /// Fails: built without Parquet.
    #[cfg(not(feature = "parquet"))]
    fn begin_parquet(_path: &Path) -> io::Result<Self> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub fn row(&mut self, row: &Estimated, segment: &str, axis: usize) -> io::Result<()> {
        let measured = row.principal_rad_s[axis - 1];
        let numbers = [
            row.entry.time_s,
            row.estimate.rate_rad_s,
            row.estimate.deviation_rad_s.unwrap_or(f64::NAN),
            measured,
            row.estimate.rate_rad_s - measured,
        ];
        let observed = u64::from(row.estimate.observed);
        match self {
            Self::Csv(out) => {
                let text = |value: f64| if value.is_finite() { format!("{value:?}") } else { String::new() };
                let cells = [segment.to_owned(), row.entry.row.to_string()].into_iter().chain(numbers.map(text));
                Ok(out.write_record(cells.chain([observed.to_string()]))?)
            }
            #[cfg(feature = "parquet")]
            Self::Parquet(groups) => {
                let [time, estimate, deviation, measured, error] = numbers.map(f64::to_bits);
                let bits = [row.entry.row, time, estimate, deviation, measured, error, observed].map(Cell::Bits);
                groups.row([Cell::Word(segment.to_owned())].into_iter().chain(bits).map(Some))
            }
        }
    }

    pub fn end(self) -> io::Result<()> {
        match self {
            Self::Csv(mut out) => out.flush(),
            #[cfg(feature = "parquet")]
            Self::Parquet(groups) => groups.end(),
        }
    }
}

/// Returns true if the table's name ends in .parquet.
pub fn is_parquet(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("parquet"))
}
