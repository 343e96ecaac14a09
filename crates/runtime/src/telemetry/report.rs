//! The final report of a role: counters, hash, histograms, privileges.

use super::hash::Checkpoints;
use super::late::LateRecord;
use super::latency::{Latency, Tallies};
use crate::serial::LineCounters;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The final report of a role.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RoleReport {
    /// The role's name.
    pub role: String,
    /// Its ticks.
    pub ticks: Ticks,
    /// The counters of the signals it wrote.
    pub written: Vec<LinkWritten>,
    /// The counters of the signals it read.
    pub read: Vec<LinkRead>,
    /// The results of its watchdog, if it watches anything.
    #[serde(default)]
    pub watchdog: Option<WatchReport>,
    /// Its latencies, by stage.
    #[serde(default)]
    pub stages: Vec<StageReport>,
    /// The privileges it asked for.
    #[serde(default)]
    pub grants: Vec<Grant>,
    /// The counters of the serial line, if a device executes the role.
    pub line: Option<LineCounters>,
    /// The times in which that device was absent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub outages: Vec<Outage>,
    /// The relation of the run's clock to that device, if the device sets the pace.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pace: Option<PaceReport>,
    /// The number of changes of inputs that it applied after their tick, because it received them too late.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub late_inputs: u64,
    /// The records of its late ticks, in real time; at most as many as a ledger keeps.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub late_ticks: Vec<LateRecord>,
}

fn is_zero(count: &u64) -> bool {
    *count == 0
}

/// A time in which a device did not answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Outage {
    /// The first tick that was not answered in time.
    pub tick: u64,
    /// The next tick that was answered; absent if the device was still away at the end.
    pub back_at_tick: Option<u64>,
    /// The time without an answer, s.
    pub seconds: f64,
    /// The stable code of the cause.
    #[serde(default)]
    pub code: String,
    /// The cause in words.
    pub cause: String,
}

/// The relation of a run's clock to the device that sets its pace.
///
/// The phase error of a window of a quarter second, or 16 periods if that is longer, is the delay of its least delayed
/// frame against the grid.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PaceReport {
    /// The state at the end: `acquiring`, `locked`, `holdover` or `lost`.
    pub state: String,
    /// The time from the device's first frame until the grid was locked, s; absent if it never was.
    pub locked_after_s: Option<f64>,
    /// The longest time from the first frame after a silence until the grid was locked again, s.
    pub relocked_after_s_max: Option<f64>,
    /// The median phase error since the first lock, µs.
    pub phase_error_p50_us: Option<f64>,
    /// Its 99th percentile, µs.
    pub phase_error_p99_us: Option<f64>,
    /// Its maximum, µs.
    pub phase_error_max_us: Option<f64>,
    /// The device's clock against this host's, ppm: positive if it is faster.
    pub drift_ppm: f64,
    /// Cycles that the device executed without the request that was sent, or due, for them. Lost requests do not count.
    pub slips: u64,
    /// Received frames.
    pub frames: u64,
    /// The number of silences in which the grid ran on by itself, and their sum, s.
    pub holdovers: u64,
    /// See `holdovers`.
    pub holdover_s: f64,
    /// The number of silences beyond the holdover.
    pub lost: u64,
    /// The number of corrections of the clock after the first tick.
    pub corrections: u64,
    /// The largest error that one of them began to remove, µs.
    pub largest_correction_us: f64,
    /// The steepest rate at which the clock was corrected, ppm.
    pub steepest_ppm: f64,
    /// The course, every second: time since the first frame, s; correction since the first tick, µs; phase error, µs.
    pub track: Vec<[f64; 3]>,
}

/// The results of a watchdog.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WatchReport {
    /// One entry per watched quantity.
    pub watched: Vec<WatchedReport>,
    /// The tick at which the safe command was latched, if it was.
    pub latched_at_tick: Option<u64>,
}

/// The results for one watched quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WatchedReport {
    /// `energy`, `momentum` (relative drifts), `innovation`, `lyapunov`.
    pub quantity: String,
    /// Its bound.
    pub max: f64,
    /// The number of judged values.
    pub judged: u64,
    /// The number of values beyond the bound.
    pub breaches: u64,
    /// The tick of the first breach.
    pub first_tick: Option<u64>,
    /// The largest value; null if it is infinite or NaN.
    pub largest: Option<f64>,
}

/// The counters of a role's ticks: `elapsed` = `executed` + `missed`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Ticks {
    /// Ticks that were due before the role ended.
    pub elapsed: u64,
    /// Ticks that it executed, with or without all inputs.
    pub executed: u64,
    /// Ticks that it did not execute.
    pub missed: u64,
    /// Ticks at which a due input was absent: a plant's command, a controller's measurement.
    #[serde(default)]
    pub starved: u64,
    /// Executed ticks with all inputs that were late: a body's lateness, or the age of an estimate or command, was above
    /// `realtime.late_us`. `None` if an external role does not count them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub late: Option<u64>,
    /// Ticks at which a plant applied its safe command.
    #[serde(default)]
    pub safe: u64,
    /// Scripted stalls.
    #[serde(default)]
    pub stalled: u64,
    /// Missed ticks that a scripted fault took.
    #[serde(default)]
    pub scripted: u64,
    /// Restarts that lost the predecessor's state.
    #[serde(default)]
    pub anew: u64,
    /// The first tick whose result may differ from an undisturbed run's.
    pub first_disturbed: Option<u64>,
    /// Of these, ticks within `realtime.start_grace_ticks`, which are not judged.
    #[serde(default, skip_serializing_if = "Excused::is_none")]
    pub excused: Excused,
}

/// Counted ticks that are not judged, because they are among the first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Excused {
    /// Missed ticks.
    pub missed: u64,
    /// Of these, ticks that a scripted fault took.
    pub scripted: u64,
    /// Ticks at which a due input was absent.
    pub starved: u64,
    /// Late ticks.
    pub late: u64,
    /// Ticks at which a plant applied its safe command.
    pub safe: u64,
}

impl Excused {
    fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

impl Ticks {
    /// Returns the number of ticks that were missed after the start without a scripted fault.
    pub fn overruns(&self) -> u64 {
        let excused = self.excused.missed.saturating_sub(self.excused.scripted);
        self.missed.saturating_sub(self.scripted).saturating_sub(excused)
    }
}

/// The counters of a signal's writing end: `published` + `void` + `skipped` = `last_tick` + 1.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LinkWritten {
    /// The service name.
    pub service: String,
    /// Samples sent.
    pub published: u64,
    /// Ticks without a sample.
    pub skipped: u64,
    /// Ticks for which a no-sample marker was sent, in lockstep and in one thread.
    #[serde(default)]
    pub void: u64,
    /// Samples beyond the one of each tick: duplicated, late and corrupted ones, by scripted faults.
    #[serde(default)]
    pub extra: u64,
    /// Samples that a scripted fault changed.
    #[serde(default)]
    pub injected: u64,
    /// The tick of the last sample.
    pub last_tick: Option<u64>,
    /// The hash of what was sent; optional for external programs.
    #[serde(default)]
    pub hash: Option<Checkpoints>,
}

/// The counters of a signal's reading end: `received` + `void` + `gaps` = `last_tick` + 1.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkRead {
    /// The service name.
    pub service: String,
    /// Samples received.
    pub received: u64,
    /// Ticks without a sample: skipped by the writer, or overtaken by a newer sample.
    pub gaps: u64,
    /// Samples that were not newer than the one before.
    pub stale: u64,
    /// No-sample markers received.
    #[serde(default)]
    pub void: u64,
    /// Rejected samples. They also count as received if they belong to the due tick.
    #[serde(default)]
    pub rejected: u64,
    /// Rejected samples by reason, named as in [`Refusal`](crate::role::Refusal). Reasons that did not occur are absent.
    #[serde(default)]
    pub rejected_by: BTreeMap<String, u64>,
    /// The tick of the last sample.
    pub last_tick: Option<u64>,
}

impl LinkWritten {
    /// Returns the number of counted ticks.
    pub fn covered(&self) -> u64 {
        self.last_tick.map_or(0, |tick| tick + 1)
    }

    /// Returns true if the counters add up.
    pub fn balances(&self) -> bool {
        self.published + self.void + self.skipped == self.covered()
    }
}

impl LinkRead {
    /// Returns the number of counted ticks.
    pub fn covered(&self) -> u64 {
        self.last_tick.map_or(0, |tick| tick + 1)
    }

    /// Returns true if the counters add up. A `lossless` link has no gaps.
    pub fn balances(&self, lossless: bool) -> bool {
        self.received + self.void + self.gaps == self.covered() && (!lossless || self.gaps == 0)
    }

    /// Returns true if the counters agree with those of the writing end, which sent `in_flight` samples after its last count.
    ///
    /// Only samples beyond one per tick can be stale; one with a corrupted stamp may also look like another tick's.
    pub fn agrees(&self, written: &LinkWritten, in_flight: u64) -> bool {
        let (covered, sent) = (self.covered(), written.covered() + in_flight);
        let published = written.published + in_flight;
        let ticks = self.received + self.void + self.gaps + sent.saturating_sub(covered);
        covered <= sent && self.stale <= written.extra && published + written.void + written.skipped == ticks
    }
}

/// The latencies of one stage.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct StageReport {
    /// `lateness`, `hop`, `step`, `age`, `baseline`, `serial`.
    pub stage: String,
    /// The histogram in HdrHistogram V2 encoding, ns.
    pub histogram: Vec<u8>,
    /// Counts beside the histogram.
    #[serde(flatten)]
    pub tallies: Tallies,
}

impl StageReport {
    /// Encodes the stages that have values.
    pub fn all(stages: &[(&str, &Latency)]) -> Vec<Self> {
        stages
            .iter()
            .filter(|(_, latency)| !latency.is_empty())
            .map(|(stage, latency)| Self::new(stage, latency))
            .collect()
    }

    /// Encodes one stage.
    pub fn new(stage: &str, latency: &Latency) -> Self {
        let (histogram, tallies) = latency.encode();
        Self { stage: stage.to_owned(), histogram, tallies }
    }

    /// Decodes the latencies; empty if the bytes are damaged.
    pub fn latency(&self) -> Latency {
        Latency::decode(&self.histogram, self.tallies).unwrap_or_default()
    }
}

/// A privilege that was asked for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Grant {
    /// The name of the privilege.
    pub privilege: String,
    /// The value asked for.
    pub asked: String,
    /// True if the machine granted it.
    pub granted: bool,
    /// The machine's reason if it was refused, and what to do.
    pub reason: String,
}
