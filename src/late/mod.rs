//! Late ticks and their causes.
//!
//! | file | duty |
//! |---|---|
//! | `model` | late ticks with causes, as `late.json` has them |
//! | `delay` | the length and the parts of one delay |
//! | `counters` | causes from the counters of a role's thread: their kinds |
//! | `explain` | causes from the kernel's events: their names |
//! | `ring` | the last seconds of the kernel's trace, undecoded |
//! | `tracer` | the process that records the kernel's trace beside a run |
//! | `assemble` | the report of a run, with chains of roles and totals by cause |
//! | `words` | late ticks in words |
//! | `perfetto` | late ticks and samples as a Chrome trace |

mod assemble;
mod counters;
mod delay;
mod explain;
mod model;
mod perfetto;
mod ring;
mod tracer;
mod words;

pub use assemble::report;
pub use corotate_trace::{Cause, CauseKind};
pub(crate) use counters::causes as causes_by_counters;
pub(crate) use delay::Delay;
pub use model::{
    CauseTotal, Chain, LateKind, LateReport, LateTick, Pattern, SCHEMA, Slice, SliceKind, Source, TickOfRole,
    TracerCost,
};
pub use perfetto::{Perfetto, SampleMark};
pub use ring::{TraceRing, remove_dead_traces};
pub use tracer::{Findings, TRACER, findings, ready_path, run_tracer};
pub use words::late_table;
pub(crate) use words::{ASCII_US, cause_rows, header, listing, pattern, sentence, us};

#[cfg(test)]
pub(crate) mod fixture;
