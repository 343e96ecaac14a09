//! Physics as a watchdog: what must stay constant or small in a sound loop, held against bounds.
//!
//! Must only count and say so; whoever commands decides what follows. Works on what the law itself works on, not on the
//! truth: an estimate that breaks the physics is as bad as a body that does.

use crate::state::persist_fields;

/// Values from which a reference is taken: their median, so that one bad sample spoils nothing.
const REFERENCE_SAMPLES: usize = 5;

/// The most quantities that one watchdog watches.
pub const WATCHED_MAX: usize = 8;

/// The bounds of a watchdog.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WatchBounds {
    /// Nothing is judged before this tick; the references are taken from here on.
    pub from_tick: u64,
    /// The largest value of each quantity, drifts relative; +inf where it is not watched.
    pub max: [f64; WATCHED_MAX],
    /// After so many ticks in a row with a breach the safe command is latched; never if absent.
    pub latch_after_ticks: Option<u64>,
}

impl WatchBounds {
    /// Nothing is watched.
    pub const NONE: Self = Self { from_tick: 0, max: [f64::INFINITY; WATCHED_MAX], latch_after_ticks: None };
}

/// How a quantity that is watched fared.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Breaches {
    /// How often it was judged.
    pub judged: u64,
    /// How often it was beyond its bound.
    pub count: u64,
    /// The first tick at which it was.
    pub first_tick: Option<u64>,
    /// The largest value that was judged.
    pub largest: f64,
}

/// A watchdog with its counts.
#[derive(Debug, Clone)]
pub struct Watchdog {
    bounds: WatchBounds,
    /// Whether anything is watched.
    active: bool,
    references: [Reference; WATCHED_MAX],
    breaches: [Breaches; WATCHED_MAX],
    /// The last tick with a breach, and how many there were in a row.
    streak: (u64, u64),
    latched_at: Option<u64>,
}

impl Watchdog {
    /// A watchdog that has seen nothing.
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

    /// Whether anything is watched.
    #[inline]
    pub fn active(&self) -> bool {
        self.active
    }

    /// Whether this quantity is watched at a tick.
    #[inline]
    pub fn watches(&self, quantity: usize, tick: u64) -> bool {
        tick >= self.bounds.from_tick && self.bounds.max[quantity] < f64::INFINITY
    }

    /// Looks at what must stay constant, in any unit.
    #[inline]
    pub fn constant(&mut self, quantity: usize, tick: u64, value: f64) {
        if self.watches(quantity, tick)
            && let Some(drift) = self.references[quantity].drift(value)
        {
            self.judge(quantity, tick, drift);
        }
    }

    /// Looks at what must stay small.
    #[inline]
    pub fn magnitude(&mut self, quantity: usize, tick: u64, value: f64) {
        if self.watches(quantity, tick) {
            self.judge(quantity, tick, value.abs());
        }
    }

    fn judge(&mut self, quantity: usize, tick: u64, value: f64) {
        let (max, breaches) = (self.bounds.max[quantity], &mut self.breaches[quantity]);
        breaches.judged += 1;
        // What is not a number is beyond every bound.
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

    /// The tick at which the safe command was latched, if it was. Nothing ends it in this run.
    #[inline]
    pub fn latched_at(&self) -> Option<u64> {
        self.latched_at
    }

    /// How each quantity fared.
    pub fn breaches(&self) -> &[Breaches; WATCHED_MAX] {
        &self.breaches
    }

    /// The bounds.
    pub fn bounds(&self) -> &WatchBounds {
        &self.bounds
    }
}

/// What a constant was when it was first looked at.
#[derive(Debug, Clone, Copy, Default)]
struct Reference {
    first: [f64; REFERENCE_SAMPLES],
    count: u64,
}

impl Reference {
    /// The relative difference from the reference; none while that is being taken.
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
            values.iter().enumerate().for_each(|(quantity, value)| watchdog.constant(quantity, tick, *value));
        };
        (0..10).for_each(|tick| invariants(&mut watchdog, tick, [99.0, 99.0]));
        [2.0, 1e300, 2.0, 2.0, f64::NAN]
            .iter()
            .zip(10..)
            .for_each(|(value, tick)| invariants(&mut watchdog, tick, [*value, 4.0]));
        assert_eq!(watchdog.breaches()[0], Breaches::default(), "nothing is judged while the reference is taken");
        invariants(&mut watchdog, 15, [2.01, 4.1]);
        let [energy, momentum, ..] = *watchdog.breaches();
        assert_eq!((energy.judged, energy.count), (1, 0));
        assert_eq!((momentum.count, momentum.first_tick), (1, Some(15)));
        assert!((momentum.largest - 0.025).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_number_is_a_breach_and_what_is_not_watched_is_none() {
        let mut watchdog = watchdog(None);
        for (tick, value) in [(9, 9.0), (10, 0.5), (11, -0.6), (12, f64::NAN), (13, f64::INFINITY)] {
            watchdog.magnitude(2, tick, value);
            watchdog.magnitude(3, tick, value);
        }
        let [_, _, innovation, lyapunov, ..] = *watchdog.breaches();
        assert_eq!((innovation.judged, innovation.count, innovation.first_tick), (4, 3, Some(11)));
        assert_eq!(innovation.largest, f64::INFINITY);
        assert_eq!(lyapunov, Breaches::default());
        assert_eq!(watchdog.latched_at(), None, "it only counts");
    }

    #[test]
    fn latches_after_breaches_in_a_row_and_for_good() {
        let mut watchdog = watchdog(Some(3));
        for tick in [10, 11, 13, 14, 14, 14] {
            watchdog.magnitude(2, tick, 1.0);
        }
        assert_eq!(watchdog.latched_at(), None, "twice in a row, however many breaches a tick has");
        watchdog.magnitude(2, 15, 1.0);
        watchdog.magnitude(2, 16, 0.0);
        assert_eq!(watchdog.latched_at(), Some(15));
    }
}
