//! The part of a scenario that every rig shares, as typed: the serde mirror of the file with its defaults.
//!
//! Must not judge values; [`crate::scenario`] does.

use super::fault::RawFault;
use super::hosts::{Host, Network};
use crate::role::Rearm;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Raw {
    pub name: String,
    pub rig: String,
    #[serde(default)]
    pub clock: ClockKind,
    pub tick_hz: f64,
    pub duration_s: f64,
    #[serde(default = "default_seed")]
    pub seed: u64,
    #[serde(default = "next_tick")]
    pub actuation_delay_ticks: u64,
    #[serde(default)]
    pub record: bool,
    #[serde(default)]
    pub actuator: Actuator,
    #[serde(default)]
    pub realtime: Realtime,
    #[serde(default)]
    pub launch: Launch,
    #[serde(default)]
    pub supervision: Supervision,
    #[serde(default)]
    pub watchdog: Watchdog,
    #[serde(default)]
    pub accept: Accept,
    #[serde(default, skip_serializing_if = "Network::is_default")]
    pub network: Network,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub host: Vec<Host>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub fault: Vec<RawFault>,
}

fn default_seed() -> u64 {
    1
}

fn next_tick() -> u64 {
    1
}

/// What makes the ticks of a run follow one another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ClockKind {
    /// Absolute deadlines on the monotonic clock, one process per role.
    #[default]
    Realtime,
    /// Every role waits for its inputs, nobody looks at the time; one process per role.
    Lockstep,
    /// The same roles in one thread, over links in memory.
    InProcess,
}

impl ClockKind {
    /// The name that a scenario and the command line use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Realtime => "realtime",
            Self::Lockstep => "lockstep",
            Self::InProcess => "in-process",
        }
    }
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Actuator {
    pub command_timeout_ticks: u64,
    #[serde(with = "RearmName")]
    pub rearm: Rearm,
}

#[derive(Serialize, Deserialize)]
#[serde(remote = "Rearm", rename_all = "kebab-case")]
enum RearmName {
    Auto,
    Manual,
}

impl Default for Actuator {
    fn default() -> Self {
        Self { command_timeout_ticks: 20, rearm: Rearm::Auto }
    }
}

/// What a real-time run asks of the machine. Whatever is not granted is reported, and the run goes on without it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Realtime {
    /// SCHED_FIFO priority of all roles, 1 to 99; 0: do not ask.
    pub priority: i32,
    /// The cores of the roles.
    pub cores: Cores,
    /// Whether roles lock their memory.
    pub lock_memory: bool,
    /// Whether the launcher holds `/dev/cpu_dma_latency` at 0, which keeps idle cores from sleeping deeply.
    pub low_latency_idle: bool,
    /// How a role waits for a sample.
    pub wake: Wake,
    /// How long before a tick a role wakes to spin, µs; never more than a quarter of the period.
    pub wake_lead_us: f64,
    /// How long a role spins for a sample that is due before it sleeps, µs; never more than a quarter of the period.
    pub spin_us: f64,
    /// The part of the period after which the controller goes on without samples that are still missing, 0 to 1.
    pub cutoff: f64,
}

impl Default for Realtime {
    fn default() -> Self {
        Self {
            priority: 80,
            cores: Cores::Named(NamedCores::Auto),
            lock_memory: true,
            low_latency_idle: true,
            wake: Wake::Auto,
            wake_lead_us: 60.0,
            spin_us: 200.0,
            cutoff: 0.75,
        }
    }
}

/// How a role waits for a sample that another role sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Wake {
    /// Where SCHED_FIFO is granted: gives way to a sender on the same core, spins for one on another, then sleeps on the
    /// sender's notifier. Elsewhere as `event`: among equals, who spins holds up whom it waits for.
    Auto,
    /// Spins, whoever the sender is, then sleeps on its notifier.
    Spin,
    /// Sleeps on the sender's notifier at once.
    Event,
}

/// Where the roles run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "there is no such choice; give \"auto\", \"any\", or a list of core numbers such as [0, 1]"
)]
pub enum Cores {
    /// `"auto"` or `"any"`.
    Named(NamedCores),
    /// These: plants in turn; observer and controller on the next, or beside the leader and the first follower.
    List(Vec<usize>),
}

/// The named choices of [`Cores`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NamedCores {
    /// As a list of all cores that the process may use, where SCHED_FIFO is granted; otherwise as `any`.
    Auto,
    /// Leave it to the scheduler.
    Any,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Launch {
    pub startup_timeout_s: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub external_timeout_s: Option<f64>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub processes: Vec<Vec<String>>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub external: Vec<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub debug: Vec<String>,
}

impl Default for Launch {
    fn default() -> Self {
        let (processes, external, debug) = (Vec::new(), Vec::new(), Vec::new());
        Self { startup_timeout_s: 30.0, external_timeout_s: None, processes, external, debug }
    }
}

/// What follows where the controller's inputs or its commands are beyond a bound. The bounds are keys of the rig's.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Watchdog {
    pub from_s: f64,
    pub on_breach: OnBreach,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latch_after_ticks: Option<u64>,
}

/// What follows from a breach.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum OnBreach {
    /// It is counted.
    #[default]
    Count,
    /// The controller falls silent for good, and the safe command takes over.
    Safe,
}

/// What the launcher does about roles that die or hang while the ticks run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Supervision {
    /// What is done about a role that failed.
    pub on_failure: Policy,
    /// A role that says nothing for so long counts as hung and is killed, s. Roles speak every 20 ms.
    pub heartbeat_timeout_s: f64,
    /// How often one role is started anew in a run.
    pub restarts_max: u64,
    /// The least time between two starts of one role, s.
    pub restart_interval_s: f64,
}

/// The criteria that every rig has. Those of metrics are keys of the rig's.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Accept {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub settled_by_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peak_from_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub missed_ticks_max: Option<RawTicks>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub starved_ticks_max: Option<RawTicks>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub safe_ticks_max: Option<RawTicks>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unscored_ticks_max: Option<RawTicks>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step_latency_p99_us_max: Option<f64>,
}

/// A limit on ticks as typed.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "this is no limit on ticks; give a number, a share such as \"1 %\", or a table such as { controller = 5 }"
)]
pub(crate) enum RawTicks {
    Count(f64),
    Share(String),
    ByRole(BTreeMap<String, RawTicks>),
}

/// What is done about a role that failed, by role.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "there is no such choice; give \"restart\", \"stop\", or a table such as { observer = \"restart\", leader = \"stop\" }"
)]
pub enum Policy {
    /// The same for all.
    All(OnFailure),
    /// By role; those not named are started anew.
    ByRole(BTreeMap<String, OnFailure>),
}

/// What is done about a role that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnFailure {
    /// Start it anew.
    Restart,
    /// End the run in order; exit code 4.
    Stop,
}

impl Default for Supervision {
    fn default() -> Self {
        Self {
            on_failure: Policy::All(OnFailure::Restart),
            heartbeat_timeout_s: 2.0,
            restarts_max: 5,
            restart_interval_s: 0.1,
        }
    }
}

impl Supervision {
    /// What is done about a role that failed.
    pub fn reaction_to(&self, role: &str) -> OnFailure {
        match &self.on_failure {
            Policy::All(policy) => *policy,
            Policy::ByRole(roles) => roles.get(role).copied().unwrap_or(OnFailure::Restart),
        }
    }
}
