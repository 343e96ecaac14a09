//! A watchdog on physics: bounds on quantities that are constant or small in a sound loop.
//!
//! The watchdog only counts and reports; the commanding role decides what follows. It checks the inputs of the law,
//! not the truth: an estimate that violates physics is as bad as a body that does.

use crate::state::persist_fields;

/// The number of values whose median is the reference, so that a single bad sample does not affect it.
const REFERENCE_SAMPLES: usize = 5;

/// The largest number of quantities of one watchdog.
pub const WATCHED_MAX: usize = 8;

/// The bounds of a watchdog.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WatchBounds {
    /// The first tick that is checked; the references are taken from here on.
    pub from_tick: u64,
    /// The largest value of each quantity, relative for drifts; +∞ disables the check.
    pub max: [f64; WATCHED_MAX],
    /// The number of consecutive ticks with a breach after which the safe command is latched; never if absent.
    pub latch_after_ticks: Option<u64>,
}

impl WatchBounds {
    /// No bounds.
    pub const NONE: Self = Self { from_tick: 0, max: [f64::INFINITY; WATCHED_MAX], latch_after_ticks: None };
}

/// The breaches of one watched quantity.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Breaches {
    /// The number of checked values.
    pub judged: u64,
    /// The number of breaches.
    pub count: u64,
    /// The first tick with a breach.
    pub first_tick: Option<u64>,
    /// The largest checked value.
    pub largest: f64,
}

/// A watchdog with its counters.
#[derive(Debug, Clone)]
pub struct Watchdog {
    bounds: WatchBounds,
    /// True if any quantity is watched.
    active: bool,
    references: [Reference; WATCHED_MAX],
    breaches: [Breaches; WATCHED_MAX],
    /// The last tick with a breach, and the number of consecutive ones.
    streak: (u64, u64),
    latched_at: Option<u64>,
}

impl Watchdog {
    /// Creates a watchdog with zero counters.
    pub fn new(bounds: WatchBounds) -> Self {
        Self {
            active: bounds.max.iter().any(|max| *max < f64::INFINITY),
            bounds,
            references: [Reference::default(); WATCHED_MAX],
            breaches: [Breaches::default(); WATCHED_MAX],
            streak: (0, 0),
            latched_at: None,
        }
    }

    /// Returns true if any quantity is watched.
    #[inline]
    pub fn active(&self) -> bool {
        self.active
    }

    /// Returns true if this quantity is watched at a tick.
    #[inline]
    pub fn watches(&self, quantity: usize, tick: u64) -> bool {
        tick >= self.bounds.from_tick && self.bounds.max[quantity] < f64::INFINITY
    }

    /// Checks a quantity that must stay constant, in any unit.
    #[inline]
    pub fn check_constant(&mut self, quantity: usize, tick: u64, value: f64) {
        if self.watches(quantity, tick)
            && let Some(drift) = self.references[quantity].drift(value)
        {
            self.check(quantity, tick, drift);
        }
    }

    /// Checks a quantity that must stay small.
    #[inline]
    pub fn check_magnitude(&mut self, quantity: usize, tick: u64, value: f64) {
        if self.watches(quantity, tick) {
            self.check(quantity, tick, value.abs());
        }
    }

    fn check(&mut self, quantity: usize, tick: u64, value: f64) {
        let (max, breaches) = (self.bounds.max[quantity], &mut self.breaches[quantity]);
        breaches.judged += 1;
        // NaN is a breach of every bound.
        let value = if value.is_nan() { f64::INFINITY } else { value };
        breaches.largest = breaches.largest.max(value);
        if value > max {
            breaches.count += 1;
            breaches.first_tick.get_or_insert(tick);
            self.broken(tick);
        }
    }

    fn broken(&mut self, tick: u64) {
        self.streak = match self.streak {
            (last, count) if count > 0 && last == tick => (tick, count),
            (last, count) if count > 0 && last + 1 == tick => (tick, count + 1),
            _ => (tick, 1),
        };
        if self.bounds.latch_after_ticks.is_some_and(|after| self.streak.1 >= after) {
            self.latched_at.get_or_insert(tick);
        }
    }

    /// Returns the tick at which the safe command was latched, if it was. It stays latched for the rest of the run.
    #[inline]
    pub fn latched_at(&self) -> Option<u64> {
        self.latched_at
    }

    /// Returns the breaches of each quantity.
    pub fn breaches(&self) -> &[Breaches; WATCHED_MAX] {
        &self.breaches
    }

    /// Returns the bounds.
    pub fn bounds(&self) -> &WatchBounds {
        &self.bounds
    }
}

/// The initial value of a constant quantity.
#[derive(Debug, Clone, Copy, Default)]
struct Reference {
    first: [f64; REFERENCE_SAMPLES],
    count: u64,
}

impl Reference {
    /// Returns the relative difference from the reference; `None` while the reference is being taken.
    fn drift(&mut self, value: f64) -> Option<f64> {
        let taken = self.count as usize;
        if taken < REFERENCE_SAMPLES {
            self.first[taken] = value;
            self.count += 1;
            self.first[..=taken].sort_unstable_by(f64::total_cmp);
            return None;
        }
        let reference = self.first[REFERENCE_SAMPLES / 2];
        Some(((value - reference) / reference).abs())
    }
}

persist_fields!(Watchdog, breaches, latched_at, streak, references);
persist_fields!(Breaches, judged, count, first_tick, largest);
persist_fields!(Reference, first, count);

#[cfg(test)]
mod tests {
    use super::*;

    fn watchdog(latch_after_ticks: Option<u64>) -> Watchdog {
        let mut max = [f64::INFINITY; WATCHED_MAX];
        max[..3].copy_from_slice(&[0.01, 0.01, 0.5]);
        Watchdog::new(WatchBounds { from_tick: 10, max, latch_after_ticks })
    }

    #[test]
    fn the_reference_is_the_median_of_the_first_values_from_its_tick_on() {
        let mut watchdog = watchdog(None);
        let invariants = |watchdog: &mut Watchdog, tick, values: [f64; 2]| {
            values.iter().enumerate().for_each(|(quantity, value)| watchdog.check_constant(quantity, tick, *value));
        };
        (0..10).for_each(|tick| invariants(&mut watchdog, tick, [99.0, 99.0]));
        [2.0, 1e300, 2.0, 2.0, f64::NAN]
            .iter()
            .zip(10..)
            .for_each(|(value, tick)| invariants(&mut watchdog, tick, [*value, 4.0]));
        assert_eq!(watchdog.breaches()[0], Breaches::default(), "no check while the reference is taken");
        invariants(&mut watchdog, 15, [2.01, 4.1]);
        let [energy, momentum, ..] = *watchdog.breaches();
        assert_eq!((energy.judged, energy.count), (1, 0));
        assert_eq!((momentum.count, momentum.first_tick), (1, Some(15)));
        assert!((momentum.largest - 0.025).abs() < 1e-12);
    }

    #[test]
    fn nan_is_a_breach_and_an_unwatched_quantity_is_not_checked() {
        let mut watchdog = watchdog(None);
        for (tick, value) in [(9, 9.0), (10, 0.5), (11, -0.6), (12, f64::NAN), (13, f64::INFINITY)] {
            watchdog.check_magnitude(2, tick, value);
            watchdog.check_magnitude(3, tick, value);
        }
        let [_, _, innovation, lyapunov, ..] = *watchdog.breaches();
        assert_eq!((innovation.judged, innovation.count, innovation.first_tick), (4, 3, Some(11)));
        assert_eq!(innovation.largest, f64::INFINITY);
        assert_eq!(lyapunov, Breaches::default());
        assert_eq!(watchdog.latched_at(), None, "without a latch it only counts");
    }

    #[test]
    fn consecutive_breaches_latch_for_good() {
        let mut watchdog = watchdog(Some(3));
        for tick in [10, 11, 13, 14, 14, 14] {
            watchdog.check_magnitude(2, tick, 1.0);
        }
        assert_eq!(watchdog.latched_at(), None, "two consecutive ticks, whatever the number of breaches per tick");
        watchdog.check_magnitude(2, 15, 1.0);
        watchdog.check_magnitude(2, 16, 0.0);
        assert_eq!(watchdog.latched_at(), Some(15));
    }
}
