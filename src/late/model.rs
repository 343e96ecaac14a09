//! Late ticks of a run and their causes, as `late.json` has them.
//!
//! Must not name a cause that was not observed.

use crate::config::RunId;
use corotate_trace::{Cause, CauseKind};
use serde::{Deserialize, Serialize};

/// Layout version of `late.json`.
pub const SCHEMA: &str = "corotate/late/v1";

/// The source of the causes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, strum::IntoStaticStr)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Source {
    /// Counters of the roles' threads: they tell the kind of a cause.
    Counters,
    /// The kernel's trace: it also tells the name.
    Kernel,
}

/// The late ticks of a run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LateReport {
    /// The layout version.
    pub schema: String,
    /// The run.
    pub run: Option<RunId>,
    /// The scenario's name.
    pub scenario: String,
    /// The period, µs.
    pub period_us: f64,
    /// The limit beyond which an executed tick is late, µs.
    pub late_us: f64,
    /// The source of the causes.
    pub source: Source,
    /// The reason why there is no better source, with the remedy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// The number of late, missed and starved ticks that the roles counted.
    pub counted: u64,
    /// The examined ones, in the order of time. Fewer than counted if there were more than the roles keep.
    pub ticks: Vec<LateTick>,
    /// Totals by cause, the largest sum first.
    pub causes: Vec<CauseTotal>,
    /// Periods with which late ticks repeat.
    pub patterns: Vec<Pattern>,
    /// The costs of the tracing process, if one ran.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracer: Option<TracerCost>,
}

/// The kind of a late tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, strum::IntoStaticStr)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum LateKind {
    /// Executed with all inputs, beyond the limit.
    Late,
    /// Not executed.
    Missed,
    /// Executed without a due input.
    Starved,
}

/// A late tick, or several missed ones in a row, of one role.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LateTick {
    /// The role.
    pub role: String,
    /// The tick; the first one of several.
    pub tick: u64,
    /// The number of ticks.
    pub ticks: u64,
    /// The kind.
    pub kind: LateKind,
    /// The due time of the tick, s after the first tick.
    pub time_s: f64,
    /// The delay from the due time to the sample, or of a missed tick to the next look at the clock, µs.
    pub late_us: f64,
    /// The causes, the largest part first.
    pub causes: Vec<Cause>,
    /// The tick of another role that made this one late, if its late tick was examined too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub caused_by: Option<TickOfRole>,
    /// The cores around the tick, for the worst ticks of a run with the kernel's trace.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub slices: Vec<Slice>,
}

/// A tick of a role.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TickOfRole {
    /// The role.
    pub role: String,
    /// The tick.
    pub tick: u64,
}

/// The kind of a slice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SliceKind {
    /// A role of the run.
    Role,
    /// Another task.
    Task,
    /// The handler of an interrupt.
    Interrupt,
    /// A softirq.
    Softirq,
    /// The idle task.
    Idle,
}

/// What ran on a core for some time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Slice {
    /// The core.
    pub core: usize,
    /// The kind.
    pub kind: SliceKind,
    /// The name of the role, task, interrupt or softirq.
    pub name: String,
    /// Begin, relative to the due time of the tick, µs.
    pub from_us: f64,
    /// End, relative to the due time of the tick, µs.
    pub to_us: f64,
}

/// All late ticks with the same main cause.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CauseTotal {
    /// The cause in words.
    pub cause: String,
    /// The kind.
    pub kind: CauseKind,
    /// The name of the task, interrupt, softirq or role.
    pub name: String,
    /// The number of late ticks to which it contributed.
    pub ticks: u64,
    /// Its largest part in one of them, µs.
    pub worst_us: f64,
    /// The sum of its parts, µs.
    pub sum_us: f64,
}

/// Late ticks that repeat with a period.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pattern {
    /// The period, ms.
    pub period_ms: f64,
    /// The number of late ticks at the same phase.
    pub ticks: u64,
    /// The number of late ticks that were compared.
    pub of: u64,
    /// A frequent reason for this period, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
}

/// The costs of the tracing process.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TracerCost {
    /// Its processor time, s.
    pub cpu_s: f64,
    /// The number of decoded events.
    pub events: u64,
    /// The number of times at which the kernel's ring was full, so that events are missing.
    pub overruns: u64,
}

impl LateReport {
    /// Returns the examined ticks, the longest delay first.
    pub fn worst_first(&self) -> Vec<&LateTick> {
        let mut ticks: Vec<&LateTick> = self.ticks.iter().collect();
        ticks.sort_by(|a, b| b.late_us.total_cmp(&a.late_us));
        ticks
    }

    /// Returns the late tick of a role that covers `tick`, if it was examined.
    pub fn find(&self, role: &str, tick: u64) -> Option<&LateTick> {
        self.ticks.iter().find(|late| late.role == role && (late.tick..late.tick + late.ticks).contains(&tick))
    }
}

impl LateTick {
    /// Returns the part of the delay that no cause explains, µs.
    pub fn unexplained_us(&self) -> f64 {
        (self.late_us - self.causes.iter().map(|cause| cause.us).sum::<f64>()).max(0.0)
    }
}
