//! Causes of late ticks.

mod cause;

pub use cause::{Cause, CauseKind};
