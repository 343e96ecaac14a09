//! The score of a run.

use super::response::StepResponse;
use crate::config::Accept;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The score of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Ticks at which every sample was present.
    pub scored_ticks: u64,
    /// Ticks at which some sample was missing.
    pub unscored_ticks: u64,
    /// Ticks at which some body was lost. The metrics are infinite then, which JSON writes as null.
    pub faulted_ticks: u64,
    /// One entry per metric of the rig.
    pub metrics: Vec<MetricScore>,
    /// The result of the live certificate, if the rig has one.
    pub certificate: Option<CertificateScore>,
    /// Samples received per scored signal, by service.
    #[serde(skip)]
    pub received: Vec<(String, u64)>,
    /// Per signal and status bit, the number of ticks with this bit set; zero counts are left out.
    pub statuses: BTreeMap<String, BTreeMap<String, u64>>,
    /// The responses to steps of set points and disturbances.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub responses: Vec<StepResponse>,
    /// Recovery time per incident number, s: from the incident's tick until every metric with a limit stays within it, to the end or
    /// to the next incident.
    #[serde(skip)]
    pub recoveries_s: BTreeMap<u64, f64>,
}

/// The number of steps for which the bound on V̇ held for the true errors: V(k+1) ≤ V(k) + h·bound(k). A step is one tick of
/// one driven body; the three counts add up to all steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct CertificateScore {
    /// Steps for which the bound held, or V was at the rounding floor.
    pub held: u64,
    /// Steps for which the bound did not hold.
    pub broken: u64,
    /// Steps without a verdict: before the first command acts, around missed ticks, and while the motion was unobservable.
    pub unjudged: u64,
}

/// The score of one metric.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MetricScore {
    /// The metric's name; the unit is the last part.
    pub name: String,
    /// The value at the last scored tick; NaN if no tick was scored.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub last: f64,
    /// The largest value from `accept.settled_by_s` on; `None` if no tick was scored from there on.
    pub settled_max: Option<f64>,
    /// The largest value from `accept.peak_from_s` on, settled or not; `None` if no tick was scored from there on.
    pub peak: Option<f64>,
    /// The tick of the peak.
    pub peak_tick: Option<u64>,
    /// The time from which the value stayed within its limit, s; `None` without a limit, or if it did not stay there.
    pub settled_at_s: Option<f64>,
    /// The integral of the squared value over the run, (unit)² s; unscored ticks add nothing.
    #[serde(deserialize_with = "crate::telemetry::number_or_nan")]
    pub ise: f64,
    /// Ticks without a value from `accept.settled_by_s` on.
    #[serde(skip)]
    pub settled_blank: u64,
    /// Ticks without a value from `accept.peak_from_s` on.
    #[serde(skip)]
    pub peak_blank: u64,
    /// The largest accepted value; infinite without a limit.
    #[serde(skip)]
    pub(super) limit: f64,
    #[serde(skip)]
    pub(super) last_above: Option<u64>,
}

impl MetricScore {
    #[inline]
    pub(super) fn take(&mut self, tick: u64, value: f64, accept: &Accept, time_s: f64) {
        if value.is_nan() {
            self.settled_blank += u64::from(time_s >= accept.settled_by_s);
            self.peak_blank += u64::from(time_s >= accept.peak_from_s);
            return;
        }
        self.last = value;
        if time_s >= accept.settled_by_s {
            // No value here is NaN, for which `f64::max` would pay.
            self.settled_max = Some(self.settled_max.map_or(value, |worst| if value > worst { value } else { worst }));
        }
        if time_s >= accept.peak_from_s && self.peak.is_none_or(|peak| value > peak) {
            (self.peak, self.peak_tick) = (Some(value), Some(tick));
        }
        if value > self.limit {
            self.last_above = Some(tick);
        }
    }
}
