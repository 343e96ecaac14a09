//! Measurements of a role's run: latency histograms, counters, and the hash of what it published.
//!
//! Everything is allocated before the loop starts and only counted in it; export and arithmetic follow. Must not log.

mod atomic;
mod counters;
mod export;
mod handover;
mod hash;
mod late;
mod latency;
mod ledger;
mod machine;
mod report;

pub use counters::{ReadCounters, TickCounters, WriteCounters};
pub use export::{write_hgrm, write_hlog};
pub(crate) use handover::{find, keep};
pub use hash::{Checkpoints, CommonCheckpoints, StateHash, chained, combine};
pub use late::{LateLog, LateRecord, LateTicks, Usage};
pub use latency::number_or_nan;
pub use latency::{Latency, MAX_LATENCY_NS, Percentiles, Tallies};
pub use latency::{quantile, sorted};
pub use ledger::{Ledger, LedgerError, Slots, Store};
pub use machine::MachineInfo;
pub use report::{
    Excused, Grant, LinkRead, LinkWritten, Outage, PaceReport, RoleReport, StageReport, Ticks, WatchReport,
    WatchedReport,
};
