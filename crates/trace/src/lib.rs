//! Causes of late ticks: kernel traces of the cores of a control loop, decoded, and what kept a thread waiting in them.
//!
//! Knows no role, no tick and no clock but the trace's. Must not change anything of the machine but its own trace instance.

mod blame;
mod cause;
mod event;
mod page;
mod pattern;
mod timeline;
mod tracefs;

pub use blame::{Duty, Facts, Phase, Window};
pub use cause::{Cause, CauseKind};
pub use event::{Event, EventKind, Task, TaskState};
pub use page::{FormatError, Formats, Page};
pub use pattern::{Period, periods};
pub use timeline::{CoreTimeline, Occupant, Span, ThreadState, ThreadTimeline};
pub use tracefs::{Instance, TraceError, remove_instances, require_tracefs};
