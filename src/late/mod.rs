//! Late ticks and their causes.
//!
//! | file | duty |
//! |---|---|
//! | `model` | late ticks with causes, as `late.json` has them |
//! | `delay` | the length and the parts of one delay |
//! | `counters` | causes from the counters of a role's thread: their kinds |
//! | `explain` | causes from the kernel's events: their names |
//! | `findings` | the findings of the tracing process, and their file |
//! | `ring` | the last seconds of the kernel's trace, undecoded |
//! | `last` | the last late tick of a running loop |
//! | `tracer` | the process that records the kernel's trace beside a run |
//! | `assemble` | the report of a run, with chains of roles and totals by cause |
//! | `steal` | time that the hypervisor took from the cores |
//! | `words` | late ticks in words |
//! | `perfetto` | late ticks and samples as a Chrome trace |

mod assemble;
mod counters;
mod delay;
mod explain;
mod findings;
mod last;
mod model;
mod perfetto;
mod ring;
mod steal;
mod tracer;
mod words;

pub use assemble::report;
pub use corotate_trace::{Cause, CauseKind};
pub(crate) use counters::causes as causes_by_counters;
pub(crate) use delay::Delay;
pub use findings::{Findings, TRACER, await_findings, findings, ready_path, trace_refusal, wants_trace};
pub use last::{LastLate, LateFollower, LateStatus};
pub use model::{
    CauseTotal, Chain, LateKind, LateReport, LateTick, Pattern, SCHEMA, Slice, SliceKind, Source, TickOfRole,
    TracerCost,
};
pub use perfetto::{Perfetto, SampleMark};
pub use ring::{TraceRing, remove_dead_traces};
pub use steal::Steal;
pub use tracer::run_tracer;
pub use words::late_table;
pub(crate) use words::{ASCII_US, cause_rows, folded, header, listing, pattern, sentence, us};

#[cfg(test)]
pub(crate) mod fixture;
