//! Reads logs of angular velocity from other programs, row by row in SI units, split into segments of one motion each.
//!
//! | file | duty |
//! |---|---|
//! | `log` | a log, row by row, and the beginning of its segments |
//! | `form` | options of a log, rows of a file format, errors |
//! | `columns` | the column and the unit of each quantity |
//! | `csv` | rows of a CSV file |
//! | `mcap` | rows of an MCAP file |
//! | `parquet` | rows of a Parquet file, with the feature of that name |
//! | `stamp`, `unit` | time stamps without rounding, and units |
//! | `identification` | a body's inertia from logs |
//! | `estimation` | a log's hidden component |
//!
//! A log may be larger than memory: each row is read on demand. Must not interpolate, repair or invent a value; omitted rows
//! are counted, and assumptions are reported.

mod columns;
mod csv;
mod estimation;
mod form;
mod identification;
mod log;
mod mcap;
#[cfg(feature = "parquet")]
mod parquet;
mod stamp;
mod unit;

pub use estimation::{EstimateError, Estimated, Estimation, FilterOrder, Request, estimate_log};
pub use form::{DataError, Meaning, Options};
pub use identification::{Identified, LogAccount, Ways, identify_logs};
pub use log::{Counts, Entry, Log};
pub use unit::{RateUnit, TimeUnit};

#[cfg(test)]
mod tests;
