//! Reads logs of angular velocity from other programs, row by row in SI units, split into segments of one motion each.
//!
//! | file | duty |
//! |---|---|
//! | `log` | a log, row by row, and the beginning of its segments |
//! | `cut` | the parts of a log that are read |
//! | `form` | options of a log, rows of a file format, errors |
//! | `columns`, `names` | the column and the unit of each quantity, and what a name tells of them |
//! | `table` | the separator, the header and the first row of a text |
//! | `csv` | rows of a text |
//! | `mcap` | rows of an MCAP file |
//! | `parquet` | rows of a Parquet file, with the feature of that name |
//! | `packed` | gzip, zip, zstd, and files of other programs |
//! | `stamp`, `unit` | time stamps without rounding, and units |
//! | `plausible` | units that were assumed |
//! | `identification` | a body's inertia from logs |
//! | `estimation` | a log's hidden component |
//!
//! A log may be larger than memory: each row is read on demand. Must not interpolate, repair or invent a value; omitted rows
//! are counted, and assumptions are reported.

mod columns;
mod csv;
mod cut;
mod estimation;
mod form;
mod identification;
mod log;
mod mcap;
mod names;
mod packed;
#[cfg(feature = "parquet")]
mod parquet;
mod plausible;
mod stamp;
mod table;
mod unit;

pub use cut::read_parts;
pub use estimation::{EstimateError, Estimated, Estimation, FilterOrder, Request, estimate_log};
pub use form::{Cut, DataError, Meaning, Options};
pub use identification::{Identified, LogAccount, Ways, identify_logs};
pub use log::{Counts, Entry, Log};
pub use plausible::check_scale;
pub use unit::{RateUnit, TimeUnit};

#[cfg(test)]
mod tests;
