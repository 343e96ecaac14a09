//! The `[accept]` table: the criteria that make a run a test.
//!
//! Must not judge; `launch` compares the results of a run with it.

use super::checks::Checks;
use super::error::nearest;
use super::raw::{Accept as Raw, RawTicks};
use super::reader::keys_of;
use serde::Deserialize;
use std::collections::BTreeMap;

/// Acceptance criteria. A run without criteria is not judged.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Accept {
    /// The time from which the limits apply, s.
    pub settled_by_s: f64,
    /// Largest allowed value per metric of the rig, after settling.
    pub metric_max: BTreeMap<String, f64>,
    /// The time from which the peaks count, s.
    pub peak_from_s: f64,
    /// Bound per metric of the rig that holds at every tick from `peak_from_s` on, even after faults.
    pub metric_peak: BTreeMap<String, f64>,
    /// The most ticks that roles may miss. A single number limits the missed and starved ticks of all roles together.
    pub missed_ticks_max: Option<TickLimit>,
    /// The most ticks at which a due input may be absent.
    pub starved_ticks_max: Option<TickLimit>,
    /// The most ticks at which a driven body may apply its safe command.
    pub safe_ticks_max: Option<TickLimit>,
    /// The most ticks that may be missed, lack an input, or be late. Not judged by default.
    pub late_ticks_max: Option<TickLimit>,
    /// The most ticks without a score. With more, the metrics are not judged.
    pub unscored_ticks_max: Option<TickAmount>,
    /// Limits of latencies by their keys, µs.
    pub latency_max_us: Vec<(&'static str, f64)>,
    /// Limits of the pace of a device by their keys.
    pub pace_max: Vec<(&'static str, f64)>,
    /// Limits of the responses to steps of inputs by their keys.
    pub response_max: Vec<(&'static str, f64)>,
}

/// A limit on ticks.
#[derive(Debug, Clone, PartialEq)]
pub enum TickLimit {
    /// For every role.
    All(TickAmount),
    /// By role; roles that are not named have no limit.
    ByRole(BTreeMap<String, TickAmount>),
}

/// An amount of ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TickAmount {
    /// A number of ticks.
    Count(u64),
    /// A fraction of the ticks, 0 to 1.
    Share(f64),
}

impl TickAmount {
    /// Returns this amount of `ticks`, in whole ticks.
    pub fn count(self, ticks: u64) -> u64 {
        match self {
            Self::Count(count) => count,
            // A billionth more: 1 % of 300 ticks is 3, despite rounding.
            Self::Share(share) => (share * ticks as f64 * (1.0 + 1e-9)) as u64,
        }
    }
}

impl Accept {
    /// Returns true if no criterion is given; then nothing is judged, not even by a default.
    pub fn is_empty(&self) -> bool {
        let ticks = [&self.missed_ticks_max, &self.starved_ticks_max, &self.safe_ticks_max, &self.late_ticks_max];
        self.metric_max.is_empty()
            && self.metric_peak.is_empty()
            && ticks.into_iter().all(Option::is_none)
            && self.unscored_ticks_max.is_none()
            && self.latency_max_us.is_empty()
            && self.pace_max.is_empty()
            && self.response_max.is_empty()
    }

    /// Returns the limits of metrics by their keys.
    pub(crate) fn metric_limits(&self) -> BTreeMap<String, f64> {
        let max = self.metric_max.iter().map(|(metric, limit)| (format!("{metric}_max"), *limit));
        let peak = self.metric_peak.iter().map(|(metric, limit)| (format!("{metric}_peak"), *limit));
        max.chain(peak).collect()
    }
}

/// The criteria of metrics, with keys of the rig. Values have any type, so that an unknown key is refused as unknown.
#[derive(Deserialize)]
pub(crate) struct Metrics {
    #[serde(default)]
    pub accept: toml::Table,
}

/// Returns true if a key is common to all rigs, so that no metric can have it.
pub(crate) fn is_common(key: &str) -> bool {
    keys_of::<Raw>().contains(&key)
}

/// The limit of the computation alone.
const STEP: &str = "step_latency_p99_us_max";

/// The scenario of the criteria. Without a rig, `metrics` are unknown, and keys that may be metrics are not checked.
pub(crate) struct Setting<'a> {
    pub duration_s: f64,
    pub realtime: bool,
    pub metrics: Option<&'a [&'a str]>,
    pub roles: Option<&'a [&'a str]>,
    /// The roles that can apply a safe command.
    pub driven: &'a [&'a str],
}

/// Checks the criteria.
pub(crate) fn resolve(raw: &Raw, metrics: &toml::Table, setting: &Setting<'_>, checks: &mut Checks<'_>) -> Accept {
    let mut accept = Accept {
        settled_by_s: instant("settled_by_s", raw.settled_by_s, setting, checks),
        peak_from_s: instant("peak_from_s", raw.peak_from_s, setting, checks),
        missed_ticks_max: limit("missed_ticks_max", raw.missed_ticks_max.as_ref(), setting.roles, checks),
        starved_ticks_max: limit("starved_ticks_max", raw.starved_ticks_max.as_ref(), setting.roles, checks),
        safe_ticks_max: limit(
            "safe_ticks_max",
            raw.safe_ticks_max.as_ref(),
            setting.roles.and(Some(setting.driven)),
            checks,
        ),
        late_ticks_max: limit("late_ticks_max", raw.late_ticks_max.as_ref(), setting.roles, checks),
        latency_max_us: raw.latencies().collect(),
        pace_max: raw.paces().collect(),
        response_max: raw.responses().collect(),
        ..Accept::default()
    };
    for (key, limit) in accept.latency_max_us.iter().chain(&accept.pace_max).chain(&accept.response_max) {
        not_negative(&format!("accept.{key}"), *limit, checks);
    }
    if let [(STEP, _)] = accept.latency_max_us[..]
        && setting.realtime
        && accept.late_ticks_max.is_none()
    {
        checks.warn(
            &format!("accept.{STEP}"),
            "only the step is judged: a late sample or command passes; add age_p99_us_max or lateness_p99_us_max"
                .to_owned(),
        );
    }
    match limit("unscored_ticks_max", raw.unscored_ticks_max.as_ref(), None, checks) {
        Some(TickLimit::All(amount)) => accept.unscored_ticks_max = Some(amount),
        Some(TickLimit::ByRole(_)) => checks.refuse(
            "accept.unscored_ticks_max",
            "one-limit",
            "ticks are scored for all roles together; give a number, or a share such as \"1 %\"",
        ),
        None => {}
    }
    for (key, value) in metrics {
        let path = format!("accept.{key}");
        let Some(metrics) = setting.metrics else { continue };
        let number = value.as_float().or_else(|| value.as_integer().map(|count| count as f64));
        match (limit_of(&mut accept, key, metrics), number) {
            (None, _) => {
                checks.refuse(&path, "unknown-criterion", format!("unknown criterion; {}", known(key, metrics)))
            }
            (Some(_), None) => checks.refuse(&path, "wrong-type", format!("got {value}; give a number")),
            (Some((limits, metric)), Some(number)) => {
                not_negative(&path, number, checks);
                limits.insert(metric.to_owned(), number);
            }
        }
    }
    let peaks = !accept.metric_peak.is_empty();
    checks.require(
        peaks || setting.metrics.is_none() || raw.peak_from_s.is_none(),
        "accept.peak_from_s",
        "unused-key",
        || "has no effect without a criterion that ends in _peak; add one, or remove this".to_owned(),
    );
    accept
}

fn not_negative(path: &str, value: f64, checks: &mut Checks<'_>) {
    checks.require(value >= 0.0, path, "negative", || format!("{value} is below zero; give 0 or more"));
}

fn instant(key: &str, value: Option<f64>, setting: &Setting<'_>, checks: &mut Checks<'_>) -> f64 {
    let Some(value) = value else { return 0.0 };
    let path = format!("accept.{key}");
    not_negative(&path, value, checks);
    let duration_s = setting.duration_s;
    if value > duration_s {
        checks.warn(
            &path,
            format!(
                "the run ends at {duration_s} s, before {value} s: criteria that apply from then on are not judged"
            ),
        );
    }
    value
}

/// Checks a limit on ticks, and its roles if they are known.
fn limit(key: &str, raw: Option<&RawTicks>, roles: Option<&[&str]>, checks: &mut Checks<'_>) -> Option<TickLimit> {
    let path = format!("accept.{key}");
    match raw? {
        RawTicks::ByRole(by_role) => {
            let mut limits = BTreeMap::new();
            for (role, raw) in by_role {
                let path = format!("{path}.{role}");
                let amount = amount(&path, raw, checks);
                if let Some(roles) = roles {
                    checks.require(roles.contains(&role.as_str()), &path, "unknown-role", || {
                        format!("there is no such role; {}", nearest(role, roles))
                    });
                }
                limits.extend(amount.map(|amount| (role.clone(), amount)));
            }
            Some(TickLimit::ByRole(limits))
        }
        raw => amount(&path, raw, checks).map(TickLimit::All),
    }
}

fn amount(path: &str, raw: &RawTicks, checks: &mut Checks<'_>) -> Option<TickAmount> {
    match raw {
        RawTicks::Count(count) => {
            not_negative(path, *count, checks);
            checks.require(count.fract() == 0.0, path, "not-whole", || {
                format!("{count} is not a number of ticks; give a whole number, or a share such as \"1 %\"")
            });
            Some(TickAmount::Count(*count as u64))
        }
        RawTicks::Share(text) => {
            let percent = text.strip_suffix('%').and_then(|number| number.trim().parse::<f64>().ok());
            let percent = percent.filter(|percent| (0.0..=100.0).contains(percent));
            checks.require(percent.is_some(), path, "out-of-range", || {
                format!("`{text}` is not a share of ticks; give one from \"0 %\" to \"100 %\", or a number of ticks")
            });
            percent.map(|percent| TickAmount::Share(percent / 100.0))
        }
        RawTicks::ByRole(_) => {
            checks.refuse(path, "one-limit", "a role has one limit; give a number, or a share such as \"1 %\"");
            None
        }
    }
}

/// Returns the limits to which a key belongs, and its metric; `None` if it limits no metric.
fn limit_of<'a>(
    accept: &'a mut Accept,
    key: &'a str,
    metrics: &[&str],
) -> Option<(&'a mut BTreeMap<String, f64>, &'a str)> {
    let metric_with = |suffix: &str| key.strip_suffix(suffix).filter(|metric| metrics.contains(metric));
    match (metric_with("_max"), metric_with("_peak")) {
        (Some(metric), _) => Some((&mut accept.metric_max, metric)),
        (None, metric) => Some((&mut accept.metric_peak, metric?)),
    }
}

fn known(key: &str, metrics: &[&str]) -> String {
    let keys_with = |suffix: &'static str| metrics.iter().map(move |metric| format!("{metric}{suffix}"));
    let common = keys_of::<Raw>().iter().map(|key| (*key).to_owned());
    let known: Vec<String> = keys_with("_max").chain(keys_with("_peak")).chain(common).collect();
    nearest(key, &known.iter().map(String::as_str).collect::<Vec<_>>())
}
