//! Campaigns: one scenario run many times, each time a little different, and the resulting table.
//!
//! A case is a pure function of the campaign's text and the case's number: the same in every version, on every machine, under every
//! clock. Must not print, nor know how a command line looks.

mod apply;
mod axis;
mod case;
mod draw;
mod error;
mod file;
mod journal;
mod margin;
#[cfg(feature = "parquet")]
mod parquet;
mod results;
mod sweep;
mod table;
#[cfg(test)]
mod tests;

pub use error::SweepError;
pub(crate) use file::is_campaign;
pub use file::{Campaign, Case, Shipped};
pub use journal::{Entry, JournalError};
pub(crate) use results::CAMPAIGN;
pub use results::{Counts, worst};
pub use sweep::{Collection, NoShard, Shard, Sweep, Swept, merge};
pub use table::{Axis, AxisKind, End, Find, Margin, MarginPoint, Metric, Parameter, Row, Statistic, Table};

/// Version and revision: the results of one campaign come from one build.
pub const BUILD: &str = concat!(env!("CARGO_PKG_VERSION"), " ", env!("COROTATE_BUILT_REVISION"));

/// The campaigns that ship with the program: name and text.
pub const SHIPPED: [(&str, &str); 4] = [
    ("timing-map", include_str!("../../config/campaigns/timing-map.toml")),
    ("inertia-error", include_str!("../../config/campaigns/inertia-error.toml")),
    ("noise-filter", include_str!("../../config/campaigns/noise-filter.toml")),
    ("start", include_str!("../../config/campaigns/start.toml")),
];
