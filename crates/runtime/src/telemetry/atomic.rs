//! The atomics of the handover, which a model checker replaces.

pub use std::sync::atomic::{AtomicU64, Ordering, fence};
