//! `summary.json` as it is read back. What a key does not say is left out; another layout is refused.

use crate::config::RunId;
use crate::hosts::HostsSummary;
use crate::telemetry::{Grant, Percentiles, Ticks, WatchReport};
use serde::Deserialize;
use std::collections::BTreeMap;

/// The layout that is read.
pub const SCHEMA: &str = "corotate/summary/v1";

/// A run's summary, as far as a report shows it.
#[derive(Debug, Deserialize)]
pub struct Summary {
    pub run: Option<RunId>,
    pub version: String,
    pub revision: String,
    pub scenario: String,
    pub clock: String,
    pub tick_hz: f64,
    pub last_tick: u64,
    pub started_utc: String,
    pub host: Host,
    pub signal: usize,
    pub accepted: Option<bool>,
    pub verdict: String,
    pub criteria: Vec<Criterion>,
    pub score: Score,
    pub incidents: Vec<Incident>,
    #[serde(default)]
    pub notes: Vec<String>,
    #[serde(default)]
    pub limits: Vec<Figure>,
    pub watchdog: Option<WatchReport>,
    pub certificates: Vec<Certificate>,
    pub books: Accounting,
    pub state: State,
    pub latencies: Vec<Stage>,
    pub hosts: Option<HostsSummary>,
    pub recording: Option<Recorded>,
    pub privileges: Vec<RoleGrant>,
}

#[derive(Debug, Default, Deserialize)]
pub struct Host {
    pub name: String,
    pub kernel: String,
    pub cores: usize,
    pub cpu: String,
}

#[derive(Debug, Deserialize)]
pub struct Criterion {
    pub name: String,
    pub limit: f64,
    pub value: Option<f64>,
    pub holds: Option<bool>,
    pub role: Option<String>,
    pub reason: Option<String>,
    #[serde(default)]
    pub default: bool,
}

/// Numbers that were not finite are none: JSON has no infinity.
#[derive(Debug, Deserialize)]
pub struct Score {
    pub scored_ticks: u64,
    pub unscored_ticks: u64,
    pub faulted_ticks: u64,
    pub metrics: Vec<Metric>,
    pub certificate: Option<CertificateScore>,
}

#[derive(Debug, Deserialize)]
pub struct Metric {
    pub name: String,
    pub last: Option<f64>,
    pub settled_max: Option<f64>,
    pub peak: Option<f64>,
    pub settled_at_s: Option<f64>,
}

#[derive(Debug, Deserialize)]
pub struct CertificateScore {
    pub held: u64,
    pub broken: u64,
    pub unjudged: u64,
}

#[derive(Debug, Deserialize)]
pub struct Incident {
    pub role: String,
    pub tick: u64,
    pub cause: String,
    pub last_words: String,
    pub action: String,
    pub outage_s: Option<f64>,
    pub recovery_s: Option<f64>,
}

#[derive(Debug, Deserialize)]
pub struct Figure {
    pub name: String,
    pub value: Option<f64>,
}

#[derive(Debug, Deserialize)]
pub struct Certificate {
    pub body: String,
    pub continuous_rate_per_s: Option<f64>,
    pub loop_rate_per_s: Option<f64>,
    pub reason: Option<String>,
    pub floors: Vec<Figure>,
    pub reaches: Vec<Reach>,
    pub conditions: Vec<Condition>,
    pub warnings: Vec<String>,
}

#[derive(Debug, Deserialize)]
pub struct Reach {
    pub metric: String,
    pub limit: f64,
    pub after_s: Option<f64>,
}

#[derive(Debug, Deserialize)]
pub struct Condition {
    pub name: String,
    pub value: Option<f64>,
    pub required: Option<f64>,
    pub holds: bool,
}

#[derive(Debug, Deserialize)]
pub struct Accounting {
    pub balanced: bool,
    pub problems: Vec<String>,
    pub unbooked: Vec<String>,
    pub roles: BTreeMap<String, Ticks>,
    pub links: Vec<Link>,
    pub missed_ticks: u64,
    pub rejected_samples: u64,
    #[serde(default)]
    pub rejected_by: BTreeMap<String, u64>,
    pub injected_faults: u64,
}

#[derive(Debug, Deserialize)]
pub struct Link {
    pub service: String,
    pub reader: String,
    pub published: Option<u64>,
    pub received: u64,
    pub gaps: u64,
    pub unread: Option<u64>,
    pub void: (Option<u64>, u64),
    pub stale: u64,
    pub rejected: u64,
    #[serde(default)]
    pub rejected_by: BTreeMap<String, u64>,
}

#[derive(Debug, Deserialize)]
pub struct State {
    pub hash: String,
    pub elapsed_ticks: u64,
    pub first_disturbed_tick: Option<u64>,
}

#[derive(Debug, Deserialize)]
pub struct Stage {
    pub role: String,
    pub stage: String,
    #[serde(flatten)]
    pub figures: Percentiles,
}

#[derive(Debug, Deserialize)]
pub struct Recorded {
    pub complete: bool,
    pub problem: Option<String>,
    pub messages: u64,
    pub bytes: u64,
}

#[derive(Debug, Deserialize)]
pub struct RoleGrant {
    pub role: String,
    #[serde(flatten)]
    pub grant: Grant,
}

impl Summary {
    /// Reads a summary; otherwise says why it is none.
    pub fn parse(text: &str) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Head {
            schema: String,
        }
        let head: Head = serde_json::from_str(text).map_err(|error| error.to_string())?;
        if head.schema != SCHEMA {
            return Err(format!("it is laid out as {}, and this version reads {SCHEMA}", head.schema));
        }
        serde_json::from_str(text).map_err(|error| error.to_string())
    }
}
