//! Late ticks and their causes.
//!
//! | file | duty |
//! |---|---|
//! | `model` | late ticks with causes, as `late.json` has them |
//! | `words` | late ticks in words |
//! | `perfetto` | late ticks and samples as a Chrome trace |

mod model;
mod perfetto;
mod words;

pub use corotate_trace::{Cause, CauseKind};
pub use model::{
    CauseTotal, Chain, LateKind, LateReport, LateTick, Pattern, SCHEMA, Slice, SliceKind, Source, TickOfRole,
    TracerCost,
};
pub use perfetto::{Perfetto, SampleMark};
pub use words::late_table;
pub(crate) use words::{ASCII_US, cause_rows, header, listing, pattern, sentence, us};

#[cfg(test)]
pub(crate) mod fixture;
