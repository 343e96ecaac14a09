//! The `[watchdog]` table: the physical quantities that the controller watches, and the reaction to a breach.
//!
//! Must refuse a bound on a quantity that a rig does not provide: it would never be breached.

use super::checks::Checks;
use super::error::nearest;
use super::raw::{OnBreach, Watchdog};
use crate::control::WatchBounds;
use serde::Deserialize;
use std::collections::BTreeMap;

/// The bounds by key; the keys depend on the rig.
#[derive(Deserialize)]
pub(crate) struct Maxima {
    #[serde(default)]
    pub watchdog: BTreeMap<String, f64>,
}

/// Checks the bounds and resolves them to ticks.
pub(crate) fn resolve(
    raw: &Watchdog,
    maxima: &BTreeMap<String, f64>,
    monitors: &[(&'static str, Option<&'static str>)],
    tick_s: f64,
    duration_s: f64,
    checks: &mut Checks<'_>,
) -> WatchBounds {
    let mut bounds = WatchBounds { from_tick: (raw.from_s / tick_s).round() as u64, ..WatchBounds::NONE };
    let keys: Vec<String> = monitors.iter().map(|(name, _)| format!("{name}_max")).collect();
    for (name, max) in maxima {
        let key = format!("watchdog.{name}");
        let Some(index) = keys.iter().position(|known| known == name) else {
            let known: Vec<&str> = keys.iter().map(String::as_str).collect();
            let remedy =
                if known.is_empty() { "this rig has no quantity to watch".to_owned() } else { nearest(name, &known) };
            checks.refuse(&key, "unknown-quantity", format!("unknown quantity; {remedy}"));
            continue;
        };
        checks.positive(&key, *max);
        if let Some(reason) = monitors[index].1 {
            checks.refuse(&key, "unused-key", format!("{reason}; remove it"));
        }
        bounds.max[index] = *max;
    }
    let from_s = raw.from_s;
    checks.require(from_s >= 0.0, "watchdog.from_s", "negative", || {
        format!("{from_s} s is before the run; give an instant from 0 on, before its end at {duration_s} s")
    });
    if from_s >= duration_s {
        checks
            .warn("watchdog.from_s", format!("the run ends at {duration_s} s, before {from_s} s: nothing is watched"));
    }
    let watches = bounds != WatchBounds { from_tick: bounds.from_tick, ..WatchBounds::NONE };
    let safe = raw.on_breach == OnBreach::Safe;
    checks.require(watches || !safe, "watchdog.on_breach", "no-effect", || {
        "has no effect without a bound; add one".to_owned()
    });
    checks.require(safe || raw.latch_after_ticks.is_none(), "watchdog.latch_after_ticks", "unused-key", || {
        "has no effect without on_breach = \"safe\"; set that, or remove this".to_owned()
    });
    checks.require(raw.latch_after_ticks != Some(0), "watchdog.latch_after_ticks", "out-of-range", || {
        "0 would latch without a breach; give 1 or more".to_owned()
    });
    bounds.latch_after_ticks = safe.then_some(raw.latch_after_ticks.unwrap_or(1));
    bounds
}
