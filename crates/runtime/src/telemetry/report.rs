//! What a role says of its run when it ends: the counters, the hash, the histograms, the privileges.

use super::{Checkpoints, Latency, Tallies};
use crate::serial::LineCounters;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A role's account of itself.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RoleReport {
    /// The role's name.
    pub role: String,
    /// Its ticks.
    pub ticks: Ticks,
    /// What it wrote, by signal.
    pub written: Vec<LinkWritten>,
    /// What it read, by signal.
    pub read: Vec<LinkRead>,
    /// What its watchdog saw, if it has one that watches anything.
    #[serde(default)]
    pub watchdog: Option<WatchReport>,
    /// Its latencies, by stage.
    #[serde(default)]
    pub stages: Vec<StageReport>,
    /// What it asked of the machine, and what it got.
    #[serde(default)]
    pub grants: Vec<Grant>,
    /// The counters of its device's serial line, if a device has the seat.
    pub line: Option<LineCounters>,
    /// When that device was absent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub outages: Vec<Outage>,
}

/// A time in which a device did not answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Outage {
    /// The first tick that it did not answer in time.
    pub tick: u64,
    /// The tick that it answered next; none if it was absent at the end.
    pub back_at_tick: Option<u64>,
    /// The time without an answer, s.
    pub seconds: f64,
    /// The stable name of the cause.
    #[serde(default)]
    pub code: String,
    /// The cause in words.
    pub cause: String,
}

/// What a watchdog saw.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WatchReport {
    /// One entry per quantity that is watched.
    pub watched: Vec<WatchedReport>,
    /// The tick at which the safe command was latched, if it was.
    pub latched_at_tick: Option<u64>,
}

/// How one watched quantity fared.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WatchedReport {
    /// `energy`, `momentum` (relative drifts), `innovation`, `lyapunov`.
    pub quantity: String,
    /// Its bound.
    pub max: f64,
    /// How often it was judged.
    pub judged: u64,
    /// How often it was beyond its bound.
    pub breaches: u64,
    /// The first tick at which it was.
    pub first_tick: Option<u64>,
    /// The largest value; null where that is infinite or no number.
    pub largest: Option<f64>,
}

/// The counters of a role's ticks: `elapsed` = `executed` + `missed`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Ticks {
    /// Ticks that the role should have executed until it ended.
    pub elapsed: u64,
    /// Ticks that it executed, on whatever inputs.
    pub executed: u64,
    /// Ticks that it did not execute.
    pub missed: u64,
    /// Ticks at which an input that was due was absent: a plant's command, a controller's measurement.
    #[serde(default)]
    pub starved: u64,
    /// Ticks at which a plant applied its safe command.
    #[serde(default)]
    pub safe: u64,
    /// Scripted stalls.
    #[serde(default)]
    pub stalled: u64,
    /// Of the missed ticks, those that a scripted fault took.
    #[serde(default)]
    pub scripted: u64,
    /// Lives that began without the state of the one before.
    #[serde(default)]
    pub anew: u64,
    /// The first tick whose result differs from an undisturbed run's, if any does.
    pub first_disturbed: Option<u64>,
}

/// The counters of a signal's writing end: `published` + `void` + `skipped` = `last_tick` + 1.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LinkWritten {
    /// The service.
    pub service: String,
    /// Samples sent.
    pub published: u64,
    /// Ticks without a sample.
    pub skipped: u64,
    /// Ticks without a sample for which a void was sent: in lockstep and in one thread.
    #[serde(default)]
    pub void: u64,
    /// Samples sent beyond the one of each tick: second, late and broken ones, by scripted faults.
    #[serde(default)]
    pub extra: u64,
    /// Samples that a scripted fault touched.
    #[serde(default)]
    pub injected: u64,
    /// The tick of the last sample.
    pub last_tick: Option<u64>,
    /// The hash of what was sent; a program that is not ours need not keep one.
    #[serde(default)]
    pub hash: Option<Checkpoints>,
}

/// The counters of a signal's reading end: `received` + `void` + `gaps` = `last_tick` + 1.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkRead {
    /// The service.
    pub service: String,
    /// Samples received.
    pub received: u64,
    /// Ticks between them without one: skipped by the writer, or overtaken by a newer sample.
    pub gaps: u64,
    /// Samples that were not newer than the one before.
    pub stale: u64,
    /// Voids received in the place of samples.
    #[serde(default)]
    pub void: u64,
    /// Samples that were received and not believed; they count as received where they were of the tick that was due.
    #[serde(default)]
    pub rejected: u64,
    /// Samples rejected by reason, by the names of [`Refusal`](crate::role::Refusal); only reasons that occurred.
    #[serde(default)]
    pub rejected_by: BTreeMap<String, u64>,
    /// The tick of the last sample.
    pub last_tick: Option<u64>,
}

impl LinkWritten {
    /// Returns the number of ticks that are counted.
    pub fn covered(&self) -> u64 {
        self.last_tick.map_or(0, |tick| tick + 1)
    }

    /// Returns true if the counters add up.
    pub fn balances(&self) -> bool {
        self.published + self.void + self.skipped == self.covered()
    }
}

impl LinkRead {
    /// Returns the number of ticks that are counted.
    pub fn covered(&self) -> u64 {
        self.last_tick.map_or(0, |tick| tick + 1)
    }

    /// Returns true if the counters add up. A link that is `lossless` has no gaps.
    pub fn balances(&self, lossless: bool) -> bool {
        self.received + self.void + self.gaps == self.covered() && (!lossless || self.gaps == 0)
    }

    /// Returns true if the counters add up with those of the writing end, which sent `in_flight` samples more than it counted.
    ///
    /// Only what was sent beyond one sample per tick can be stale; a broken stamp may also look like another tick's.
    pub fn agrees(&self, written: &LinkWritten, in_flight: u64) -> bool {
        let (covered, sent) = (self.covered(), written.covered() + in_flight);
        let published = written.published + in_flight;
        let ticks = self.received + self.void + self.gaps + sent.saturating_sub(covered);
        covered <= sent && self.stale <= written.extra && published + written.void + written.skipped == ticks
    }
}

/// One stage's latencies.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct StageReport {
    /// `lateness`, `hop`, `step`, `age`, `baseline`, `serial`.
    pub stage: String,
    /// HdrHistogram V2 encoding, ns.
    pub histogram: Vec<u8>,
    /// Counts beside the histogram.
    #[serde(flatten)]
    pub tallies: Tallies,
}

impl StageReport {
    /// Packs the stages that have values.
    pub fn all(stages: &[(&str, &Latency)]) -> Vec<Self> {
        stages
            .iter()
            .filter(|(_, latency)| !latency.is_empty())
            .map(|(stage, latency)| Self::new(stage, latency))
            .collect()
    }

    /// Packs one stage.
    pub fn new(stage: &str, latency: &Latency) -> Self {
        let (histogram, tallies) = latency.encode();
        Self { stage: stage.to_owned(), histogram, tallies }
    }

    /// The latencies; empty if the bytes are damaged.
    pub fn latency(&self) -> Latency {
        Latency::decode(&self.histogram, self.tallies).unwrap_or_default()
    }
}

/// A privilege: asked for, granted or not.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Grant {
    /// What.
    pub privilege: String,
    /// The value asked for.
    pub asked: String,
    /// Whether the machine granted it.
    pub granted: bool,
    /// If not, the machine's reason and what to do.
    pub reason: String,
}
