//! The `[[fault]]` tables as typed.

use serde::{Deserialize, Serialize};

/// The Gilbert-Elliott channel as typed.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawChannel {
    pub good_to_bad: f64,
    pub bad_to_good: f64,
    #[serde(default)]
    pub when_good: f64,
    #[serde(default = "always")]
    pub when_bad: f64,
}

/// A weakly-hard constraint as typed.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawWeaklyHard {
    pub misses: u64,
    pub window: u64,
    pub pattern: PatternName,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum PatternName {
    Random,
    Burst,
    Even,
}

/// The names of a delay's jitter distributions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum DistributionName {
    Uniform,
    Geometric,
    Normal,
}

/// The longest delay, ticks; this many samples are kept.
pub(crate) const MAX_DELAY_TICKS: u64 = 1000;

/// The names of the kinds of faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Kind {
    Drop,
    Duplicate,
    Delay,
    Freeze,
    NotANumber,
    Infinite,
    OutOfRange,
    BitFlip,
    LostAxis,
    NoiseBurst,
    Stall,
    Miss,
    Kill,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawFault {
    pub kind: Kind,
    pub role: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub body: Option<String>,
    pub from_tick: u64,
    #[serde(default = "single_tick")]
    pub ticks: u64,
    #[serde(default = "always")]
    pub probability: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub every: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gilbert_elliott: Option<RawChannel>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weakly_hard: Option<RawWeaklyHard>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub component: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bit: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deviation: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub delay_ticks: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jitter_ticks: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distribution: Option<DistributionName>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spread_ticks: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stall_ms: Option<f64>,
}

fn single_tick() -> u64 {
    1
}

fn always() -> f64 {
    1.0
}
