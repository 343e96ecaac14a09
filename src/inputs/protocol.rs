//! The requests to a launcher and its answers, each one line of JSON.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use toml::Value;

/// The longest line, bytes.
pub(super) const LINE_MAX: u64 = 64 << 10;

/// A request to a launcher.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "request", rename_all = "kebab-case")]
pub enum Request {
    /// Asks for the values of all inputs.
    Get,
    /// Changes inputs, all at the same tick.
    Set {
        /// The changes.
        changes: Vec<WantedChange>,
        /// The tick from which they act; by default the earliest possible one.
        #[serde(default)]
        at_tick: Option<u64>,
    },
}

/// A wanted change of one input.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WantedChange {
    /// The scenario key.
    pub key: String,
    /// The new value, as the scenario writes it.
    pub value: Value,
    /// The time over which the value changes linearly, s; 0 for a step.
    #[serde(default)]
    pub ramp_s: f64,
}

/// The answer of a launcher.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "answer", rename_all = "kebab-case")]
pub enum Answer {
    /// The values of all inputs by key, at a tick.
    Values {
        /// The tick.
        tick: u64,
        /// The values.
        values: BTreeMap<String, Value>,
    },
    /// The changes act from this tick on.
    Accepted {
        /// The tick.
        tick: u64,
        /// Its time from the first tick, s.
        time_s: f64,
        /// In real time, the time from the receipt of the request to the tick, ms.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        delay_ms: Option<f64>,
    },
    /// Nothing changes.
    Refused {
        /// The stable code of the reason.
        code: String,
        /// The reason, with a remedy.
        reason: String,
    },
}

impl Answer {
    pub(super) fn refused(code: &str, reason: impl Into<String>) -> Self {
        Self::Refused { code: code.to_owned(), reason: reason.into() }
    }
}
