//! Late ticks and their causes.
//!
//! | file | duty |
//! |---|---|
//! | `model` | late ticks with causes, as `late.json` has them |

mod model;

pub use corotate_trace::{Cause, CauseKind};
pub use model::{
    CauseTotal, LateKind, LateReport, LateTick, Pattern, SCHEMA, Slice, SliceKind, Source, TickOfRole, TracerCost,
};
