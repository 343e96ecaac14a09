//! Causes of a delay, each with the time that it explains.

use serde::{Deserialize, Serialize};
use std::fmt;

/// The kind of a cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, strum::IntoStaticStr, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum CauseKind {
    /// Another task ran on the core.
    Task,
    /// The handler of an interrupt ran.
    Interrupt,
    /// A softirq ran.
    Softirq,
    /// The thread did not get on although no other task had its core. Named `hypervisor` if not even an interrupt came from the core in
    /// that time: the hypervisor, or firmware, had taken it.
    CoreTaken,
    /// The timer of a sleeping thread expired late. Named `idle core` if the core was idle.
    LateTimer,
    /// The thread was woken, and an idle core took long to run it.
    IdleCore,
    /// The limit of a cgroup on processor time stopped the thread.
    Throttled,
    /// Page faults of the thread.
    PageFault,
    /// The role's own computation.
    Step,
    /// A signal or a debugger had stopped the thread.
    Stopped,
    /// A scripted fault stalled the role.
    Fault,
    /// An input came late; the causes of that belong to its sender.
    Input,
    /// Nothing that was observed explains it.
    Unknown,
}

/// A cause of a delay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cause {
    /// The kind.
    pub kind: CauseKind,
    /// The name of the task, interrupt, softirq or sending role; otherwise empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub name: String,
    /// The thread identifier of a task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tid: Option<i32>,
    /// The kernel's priority of a task: below 0 SCHED_DEADLINE, 0 to 98 real time (99 − rt_priority), from 100 on others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub priority: Option<i32>,
    /// The part of the delay that it explains, µs. All parts together are never longer than the delay.
    pub us: f64,
}

impl Cause {
    /// Creates a cause without task, which explains `ns` nanoseconds.
    pub fn new(kind: CauseKind, name: impl Into<String>, ns: u64) -> Self {
        Self { kind, name: name.into(), tid: None, priority: None, us: ns as f64 / 1e3 }
    }

    /// Returns true if both are the same cause, whatever they explain. Threads of one name count as one cause.
    pub fn same(&self, cause: &Self) -> bool {
        (self.kind, &self.name) == (cause.kind, &cause.name)
    }
}

/// Writes the cause without its time, such as `task "hog" (thread 4711, SCHED_FIFO 95)`.
impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = &self.name;
        match self.kind {
            CauseKind::Task if name.is_empty() => write!(f, "another task on the core"),
            CauseKind::Task => {
                write!(f, "task \"{name}\"")?;
                let tid = self.tid.map(|tid| format!("thread {tid}"));
                let words: Vec<String> = tid.into_iter().chain(self.priority.map(policy)).collect();
                if words.is_empty() { Ok(()) } else { write!(f, " ({})", words.join(", ")) }
            }
            CauseKind::Interrupt if name.is_empty() => write!(f, "interrupts"),
            CauseKind::Interrupt => write!(f, "interrupt {name}"),
            CauseKind::Softirq if name.is_empty() => write!(f, "softirqs"),
            CauseKind::Softirq => write!(f, "softirq {name}"),
            CauseKind::CoreTaken if name.is_empty() => write!(f, "core taken by an interrupt or the hypervisor"),
            CauseKind::CoreTaken => write!(f, "core taken by the {name}"),
            CauseKind::LateTimer if name.is_empty() => write!(f, "timer late"),
            CauseKind::LateTimer => write!(f, "timer late on an {name}"),
            CauseKind::IdleCore => write!(f, "idle core woke late"),
            CauseKind::Throttled => write!(f, "processor quota of a cgroup"),
            CauseKind::PageFault => write!(f, "page faults"),
            CauseKind::Step => write!(f, "its own step"),
            CauseKind::Stopped => write!(f, "stopped by a signal or debugger"),
            CauseKind::Fault => write!(f, "stall by a scripted fault"),
            CauseKind::Input if name.is_empty() => write!(f, "late input"),
            CauseKind::Input => write!(f, "late input from {name}"),
            CauseKind::Unknown => write!(f, "unknown"),
        }
    }
}

/// Returns the scheduling class and priority in words, from the kernel's priority.
fn policy(priority: i32) -> String {
    match priority {
        ..0 => "SCHED_DEADLINE".to_owned(),
        0..=98 => format!("real-time priority {}", 99 - priority),
        99 => "real time".to_owned(),
        _ => format!("nice {}", priority - 120),
    }
}
