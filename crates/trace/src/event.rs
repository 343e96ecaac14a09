//! Events of a kernel trace, as the causes of late ticks need them.

use serde::{Deserialize, Serialize};

/// A task as an event names it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Task {
    /// The thread identifier; 0 is the idle task of each core.
    pub tid: i32,
    /// The name (`comm`), at most 15 bytes.
    pub name: String,
    /// The kernel's priority: below 0 SCHED_DEADLINE, 0 to 98 real time (99 − rt_priority), 100 to 139 others.
    pub priority: i32,
}

/// The state in which a task left its core.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskState {
    /// It can run, and waits for a core.
    Runnable,
    /// It sleeps, and a signal wakes it.
    Sleeping,
    /// It sleeps and no signal wakes it: input or output, a page.
    Uninterruptible,
    /// A signal or a debugger has stopped it.
    Stopped,
    /// It has ended, or is in a state without a name here.
    Gone,
}

/// An event on a core.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    /// The time, ns, on the monotonic clock.
    pub ns: u64,
    /// The core.
    pub core: usize,
    /// The event.
    pub kind: EventKind,
}

/// The kind of an event.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EventKind {
    /// `sched_switch`: a core changes from one task to another.
    Switch {
        /// The task that leaves the core.
        from: Task,
        /// The state in which it leaves.
        state: TaskState,
        /// The task that runs from now on.
        to: Task,
    },
    /// `sched_waking`: a task is woken. `by` is the thread identifier of the task that runs on the core of the event.
    Waking {
        /// The thread that wakes it, or during whose time an interrupt does.
        by: i32,
        /// The woken task.
        task: Task,
        /// The core on which it will run.
        target: usize,
    },
    /// `irq_handler_entry`: the handler of a device's interrupt begins.
    IrqEntry {
        /// The number of the interrupt.
        irq: i32,
        /// The name of the handler.
        name: String,
    },
    /// `irq_handler_exit`.
    IrqExit,
    /// `softirq_entry`.
    SoftirqEntry {
        /// The number: 0 HI, 1 TIMER, 2 NET_TX, 3 NET_RX, 4 BLOCK, 5 IRQ_POLL, 6 TASKLET, 7 SCHED, 8 HRTIMER, 9 RCU.
        vector: u32,
    },
    /// `softirq_exit`.
    SoftirqExit,
    /// The entry of an interrupt of the processor itself: `local_timer`, `reschedule`, `call_function`, …
    VectorEntry {
        /// The name of the event without `_entry`.
        name: &'static str,
    },
    /// The exit of such an interrupt.
    VectorExit,
    /// `page_fault_user`: the running task `tid` takes a page fault.
    PageFault {
        /// The thread.
        tid: i32,
    },
    /// The ring was full: events before this instant are missing.
    Lost,
}
