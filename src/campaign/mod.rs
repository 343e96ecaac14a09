//! Campaigns: one scenario run many times, each time a little different, and the table that comes of it.
//!
//! A case is a pure function of the campaign's text and the case's number: the same for ever, on every machine, under every
//! clock. Must not print, nor know how a command line looks.

mod journal;
mod table;

pub use journal::JournalError;
pub use table::{Axis, AxisKind, End, Find, Margin, MarginPoint, Metric, Parameter, Row, Statistic, Table};
