//! The part of a scenario that every rig shares, as typed: the serde mirror of the file with its defaults.
//!
//! Must not judge values; [`crate::scenario`] does.

use super::fault::RawFault;
use super::hosts::{Host, Network};
use super::input::RawInput;
use super::reference::RawReferences;
use super::sensor::Sensor;
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
    #[serde(default = "one_step", skip_serializing_if = "is_one")]
    pub substeps: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub observed: Option<Vec<String>>,
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
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub input: Vec<RawInput>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sensor: Vec<Sensor>,
    #[serde(default, skip_serializing_if = "RawReferences::is_empty")]
    pub reference: RawReferences,
}

fn default_seed() -> u64 {
    1
}

fn next_tick() -> u64 {
    1
}

fn one_step() -> u64 {
    1
}

fn is_one(number: &u64) -> bool {
    *number == 1
}

/// The clock that drives the ticks of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ClockKind {
    /// Absolute deadlines on the monotonic clock, one process per role.
    #[default]
    Realtime,
    /// Every role waits for its inputs, without regard to time; one process per role.
    Lockstep,
    /// The same roles in one thread, over links in memory.
    InProcess,
}

impl ClockKind {
    /// Returns the name used in scenarios and on the command line.
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
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub safe: bool,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub disconnected: bool,
}

#[derive(Serialize, Deserialize)]
#[serde(remote = "Rearm", rename_all = "kebab-case")]
enum RearmName {
    Auto,
    Manual,
}

impl Default for Actuator {
    fn default() -> Self {
        Self { command_timeout_ticks: 20, rearm: Rearm::Auto, safe: false, disconnected: false }
    }
}

/// The requests of a real-time run to the machine. A refused request is reported, and the run continues without it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Realtime {
    /// SCHED_FIFO priority of all roles, 1 to 99; 0: no request.
    pub priority: i32,
    /// The cores of the roles.
    pub cores: Cores,
    /// True if roles lock their memory.
    pub lock_memory: bool,
    /// True if the launcher holds `/dev/cpu_dma_latency` at 0, which keeps idle cores out of deep sleep states.
    pub low_latency_idle: bool,
    /// The way in which a role waits for a sample.
    pub wake: Wake,
    /// The time before a tick at which a role wakes to spin, µs; at most a quarter of the period.
    pub wake_lead_us: f64,
    /// The time for which a role spins for a due sample before it sleeps, µs; at most a quarter of the period.
    pub spin_us: f64,
    /// The fraction of the period after which the controller continues without missing samples, 0 to 1.
    pub cutoff: f64,
    /// The lateness of a body, or the age of an estimate or a command, beyond which a tick counts as late, µs. Default: a tenth of
    /// the period, at least 50 µs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub late_us: Option<f64>,
    /// The source of the causes of late ticks.
    pub trace: Trace,
    /// The reaction to a role that misses a tick without a scripted fault.
    #[serde(skip_serializing_if = "Overrun::is_skip")]
    pub overrun: Overrun,
    /// The number of first ticks in which nothing is judged: neither missed, starved, late and safe ticks nor latencies.
    #[serde(skip_serializing_if = "is_zero")]
    pub start_grace_ticks: u64,
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}

/// The reaction to a role that misses a tick without a scripted fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Overrun {
    /// Counts the tick, and goes on with the next one that is due.
    #[default]
    Skip,
    /// Ends the run in order.
    Stop,
    /// Applies the safe command of every driven body.
    Safe,
}

impl Overrun {
    fn is_skip(&self) -> bool {
        *self == Self::Skip
    }
}

/// The source of the causes of late ticks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Trace {
    /// As `kernel` where tracefs can be written, otherwise as `counters`.
    Auto,
    /// No causes are looked for.
    Off,
    /// Counters of the roles' threads, which need no privilege: they tell the kind of a cause.
    Counters,
    /// The kernel's trace (tracefs): it tells the name of the task or interrupt. Where it cannot be written, the run goes on with the
    /// counters.
    Kernel,
}

impl Realtime {
    /// Returns the limit beyond which a tick counts as late, ns.
    pub fn late_ns(&self, period_ns: u64) -> u64 {
        self.late_us.map_or((period_ns / 10).max(50_000), |us| (us * 1e3) as u64)
    }
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
            late_us: None,
            trace: Trace::Auto,
            overrun: Overrun::Skip,
            start_grace_ticks: 0,
        }
    }
}

/// The way in which a role waits for a sample from another role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Wake {
    /// With SCHED_FIFO: yields to a sender on the same core, spins for one on another core, then sleeps on the sender's notifier.
    /// Without it, as `event`: at equal priority, spinning delays the sender.
    Auto,
    /// Spins for every sender, then sleeps on its notifier.
    Spin,
    /// Sleeps on the sender's notifier at once.
    Event,
}

/// The cores on which the roles run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "unknown choice; give \"auto\", \"any\", or a list of core numbers such as [0, 1]")]
pub enum Cores {
    /// `"auto"` or `"any"`.
    Named(NamedCores),
    /// These cores: plants in turn; observer and controller on the next ones, or beside the leader and the first follower.
    List(Vec<usize>),
}

/// The named choices of [`Cores`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NamedCores {
    /// With SCHED_FIFO, as a list of all cores that the process may use; otherwise as `any`.
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

/// The reaction to inputs or commands of the controller that exceed a bound. The bounds are keys of the rig.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Watchdog {
    pub from_s: f64,
    pub on_breach: OnBreach,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latch_after_ticks: Option<u64>,
}

/// The reaction to a breach.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum OnBreach {
    /// Counts the breach.
    #[default]
    Count,
    /// Silences the controller for the rest of the run, so that the safe command takes over.
    Safe,
}

/// The launcher's reaction to roles that die or hang while the ticks run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Supervision {
    /// The reaction to a failed role.
    pub on_failure: Policy,
    /// The time without a heartbeat after which a role counts as hung and is killed, s. Roles send one every 20 ms.
    pub heartbeat_timeout_s: f64,
    /// The most restarts of one role in a run.
    pub restarts_max: u64,
    /// The least time between two starts of one role, s.
    pub restart_interval_s: f64,
}

/// The criteria common to all rigs. The criteria of metrics are keys of the rig.
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
    pub late_ticks_max: Option<RawTicks>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unscored_ticks_max: Option<RawTicks>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step_latency_p99_us_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub age_p99_us_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub age_p999_us_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub age_max_us: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lateness_p99_us_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lateness_max_us: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub phase_error_p99_us_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub slips_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rise_time_s_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub overshoot_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub settling_time_s_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steady_state_error_max: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub command_peak_max: Option<f64>,
}

impl Accept {
    /// Returns the keys and limits of latencies.
    pub fn latencies(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let limits = [
            ("step_latency_p99_us_max", self.step_latency_p99_us_max),
            ("age_p99_us_max", self.age_p99_us_max),
            ("age_p999_us_max", self.age_p999_us_max),
            ("age_max_us", self.age_max_us),
            ("lateness_p99_us_max", self.lateness_p99_us_max),
            ("lateness_max_us", self.lateness_max_us),
        ];
        limits.into_iter().filter_map(|(key, limit)| Some((key, limit?)))
    }
}

impl Accept {
    /// Returns the keys and limits of the pace of a device.
    pub fn paces(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let limits = [("phase_error_p99_us_max", self.phase_error_p99_us_max), ("slips_max", self.slips_max)];
        limits.into_iter().filter_map(|(key, limit)| Some((key, limit?)))
    }

    /// Returns the keys and limits of responses to steps of inputs.
    pub fn responses(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let limits = [
            ("rise_time_s_max", self.rise_time_s_max),
            ("overshoot_max", self.overshoot_max),
            ("settling_time_s_max", self.settling_time_s_max),
            ("steady_state_error_max", self.steady_state_error_max),
            ("command_peak_max", self.command_peak_max),
        ];
        limits.into_iter().filter_map(|(key, limit)| Some((key, limit?)))
    }
}

/// A limit on ticks as typed.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "the limit has the wrong type; give a number, a share such as \"1 %\", or a table such as { controller = 5 }"
)]
pub(crate) enum RawTicks {
    Count(f64),
    Share(String),
    ByRole(BTreeMap<String, RawTicks>),
}

/// The reaction to a failed role, by role.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "unknown choice; give \"restart\", \"stop\", or a table such as { observer = \"restart\", leader = \"stop\" }"
)]
pub enum Policy {
    /// The same for all.
    All(OnFailure),
    /// By role; roles that are not named are restarted.
    ByRole(BTreeMap<String, OnFailure>),
}

/// The reaction to a failed role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnFailure {
    /// Restart it.
    Restart,
    /// End the run in an orderly way; exit code 4.
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
    /// Returns the reaction to the failure of a role.
    pub fn reaction_to(&self, role: &str) -> OnFailure {
        match &self.on_failure {
            Policy::All(policy) => *policy,
            Policy::ByRole(roles) => roles.get(role).copied().unwrap_or(OnFailure::Restart),
        }
    }
}
