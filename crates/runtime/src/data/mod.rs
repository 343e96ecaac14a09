//! Logs of angular velocity that others wrote: read row by row in SI units, cut into segments of one motion each.
//!
//! | file | duty |
//! |---|---|
//! | `log` | a log, row by row, and where its segments begin |
//! | `form` | what is told of a log, what a form of file gives, why it cannot be read |
//! | `columns` | which column is what, and in which unit |
//! | `csv` | rows of a CSV file |
//! | `mcap` | rows of an MCAP file |
//! | `parquet` | rows of a Parquet file, with the feature of that name |
//! | `stamp`, `unit` | time stamps without rounding, and units |
//! | `identification` | a body's inertia from logs |
//! | `estimation` | a log's hidden component |
//!
//! A log may be larger than memory: a row is read when it is asked for. Must not interpolate, repair or invent a value; what
//! is left out is counted, and what is assumed is told.

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
