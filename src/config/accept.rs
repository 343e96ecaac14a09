//! The `[accept]` table: what makes a run a test.
//!
//! Must not judge; what a run came to is held against it by `launch`.

use super::nearest;
use super::scenario::Checks;
use std::collections::BTreeMap;

/// Acceptance criteria. Without any, nothing is judged.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Accept {
    /// From this time on the limits apply, s.
    pub settled_by_s: f64,
    /// Largest allowed value per metric of the rig, after settling.
    pub metric_max: BTreeMap<String, f64>,
    /// From this time on the peaks count, s.
    pub peak_from_s: f64,
    /// Declared bound per metric of the rig: it may never be larger from `peak_from_s` on, whatever happens.
    pub metric_peak: BTreeMap<String, f64>,
    /// Most ticks that all roles together may miss.
    pub missed_ticks_max: Option<u64>,
    /// Limit of the 99th percentile of the estimate and of the control step, µs.
    pub step_latency_p99_us_max: Option<f64>,
}

/// Checks the criteria. Without a rig, `metrics` are not known and nothing is said of criteria that may be theirs.
pub(super) fn resolve(
    raw: &BTreeMap<String, f64>,
    duration_s: f64,
    metrics: Option<&[&str]>,
    checks: &mut Checks<'_>,
) -> Accept {
    let mut accept = Accept::default();
    for (key, &value) in raw {
        let path = format!("accept.{key}");
        checks
            .require(value >= 0.0, &path, || format!("{value} is below zero, which no result can be; give 0 or more"));
        match key.as_str() {
            "settled_by_s" => {
                accept.settled_by_s = value;
                check_instant(&path, value, duration_s, checks);
            }
            "peak_from_s" => {
                accept.peak_from_s = value;
                check_instant(&path, value, duration_s, checks);
            }
            "missed_ticks_max" => {
                accept.missed_ticks_max = Some(value as u64);
                checks.require(value.fract() == 0.0, &path, || {
                    format!("{value} is no count of ticks; give a whole number")
                });
            }
            "step_latency_p99_us_max" => accept.step_latency_p99_us_max = Some(value),
            _ => {
                let Some(metrics) = metrics else { continue };
                if !take_metric(&mut accept, key, value, metrics) {
                    checks.refuse(&path, format!("unknown criterion; {}", known(key, metrics)));
                }
            }
        }
    }
    let peaks = !accept.metric_peak.is_empty();
    checks.require(peaks || metrics.is_none() || !raw.contains_key("peak_from_s"), "accept.peak_from_s", || {
        "is from when on peaks count, and no criterion is a peak; add one that ends in _peak, or remove it".to_owned()
    });
    accept
}

/// Takes a limit of a metric; false if it is none.
fn take_metric(accept: &mut Accept, key: &str, value: f64, metrics: &[&str]) -> bool {
    let of = |suffix: &str| key.strip_suffix(suffix).filter(|metric| metrics.contains(metric));
    let (limits, metric) = match (of("_max"), of("_peak")) {
        (Some(metric), _) => (&mut accept.metric_max, metric),
        (None, Some(metric)) => (&mut accept.metric_peak, metric),
        (None, None) => return false,
    };
    limits.insert(metric.to_owned(), value);
    true
}

fn check_instant(path: &str, value: f64, duration_s: f64, checks: &mut Checks<'_>) {
    checks.require(value < duration_s, path, || {
        format!(
            "{value} s is not before the end of the run at {duration_s} s, so nothing would be judged; lower it or raise \
             duration_s, or judge nothing with --set accept={{}}"
        )
    });
}

fn known(key: &str, metrics: &[&str]) -> String {
    let of = |suffix: &'static str| metrics.iter().map(move |metric| format!("{metric}{suffix}"));
    let others = ["settled_by_s", "peak_from_s", "missed_ticks_max", "step_latency_p99_us_max"].map(str::to_owned);
    let known: Vec<String> = of("_max").chain(of("_peak")).chain(others).collect();
    nearest(key, &known.iter().map(String::as_str).collect::<Vec<_>>())
}
