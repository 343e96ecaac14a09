//! The `[watchdog]` table: which physical quantities the controller watches, and what follows from a breach.
//!
//! Must refuse a bound on what a rig does not tell: it would never be broken.

use super::raw::{OnBreach, Watchdog};
use super::scenario::{Checks, finite_positive};
use crate::control::{WatchBounds, Watched};
use crate::rig::AnyRig;

/// Checks the bounds and resolves them to ticks.
pub(super) fn resolve(
    raw: &Watchdog,
    rig: &AnyRig,
    tick_s: f64,
    duration_s: f64,
    checks: &mut Checks<'_>,
) -> WatchBounds {
    let mut bounds = WatchBounds { from_tick: (raw.from_s / tick_s).round() as u64, ..WatchBounds::NONE };
    for (watched, (key, max)) in Watched::ALL.into_iter().zip(raw.bounds()) {
        let Some(max) = max else { continue };
        finite_positive(checks, key, max);
        if let Some(reason) = rig.unwatched(watched) {
            checks.refuse(key, format!("{reason}; remove it"));
        }
        bounds.max[watched as usize] = max;
    }
    checks.require(raw.from_s >= 0.0 && raw.from_s < duration_s, "watchdog.from_s", || {
        format!("{} s is not within the run of {duration_s} s; give an instant from 0 on, before its end", raw.from_s)
    });
    let watches = bounds != WatchBounds { from_tick: bounds.from_tick, ..WatchBounds::NONE };
    let safe = raw.on_breach == OnBreach::Safe;
    checks.require(watches || !safe, "watchdog.on_breach", || {
        "has nothing to follow from: no bound is given; add one, such as lyapunov_rad2_s2_max".to_owned()
    });
    checks.require(safe || raw.latch_after_ticks.is_none(), "watchdog.latch_after_ticks", || {
        "is for on_breach = \"safe\"; set that, or remove it".to_owned()
    });
    checks.require(raw.latch_after_ticks != Some(0), "watchdog.latch_after_ticks", || {
        "0 would latch without a breach; give 1 or more".to_owned()
    });
    bounds.latch_after_ticks = safe.then_some(raw.latch_after_ticks.unwrap_or(1));
    bounds
}
