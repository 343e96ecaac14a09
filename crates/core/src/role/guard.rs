//! The reader's check of a sample before it is used: finite numbers, range, rate of change.
//!
//! A guard must not repair anything: it accepts or rejects a whole sample. It must not reject correct samples for
//! ever. The permitted change grows with the time since the last accepted sample, and a body that moves beyond its
//! range according to its equations of motion is accepted after [`SUSPECT_SAMPLES`] samples.

use crate::sample::Stamp;
use crate::state::{Persist, Words, persist_fields};

/// A check of the samples of one signal, in the order of their ticks.
pub trait Guard<S: ?Sized> {
    /// Returns true if the sample is accepted. Later samples are compared with the last accepted one.
    fn accepts(&mut self, sample: &S) -> bool;

    /// Returns the reason why the sample just checked was rejected. Called for rejected samples only.
    fn refusal(&self, _sample: &S) -> Refusal {
        Refusal::Other
    }
}

/// The reason why a sample is rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// A number is infinite or NaN.
    NotFinite,
    /// A value lies beyond its bound.
    OutOfRange,
    /// A value changed faster than the body can.
    TooFast,
    /// A value stayed bit-identical for too long.
    Stuck,
    /// A component that the reader needs is missing.
    Incomplete,
    /// The stamp's tick or generation is impossible.
    Stamp,
    /// The guard gives no reason.
    Other,
}

impl Refusal {
    /// All reasons, in the order of their counters.
    pub const ALL: [Self; 7] =
        [Self::NotFinite, Self::OutOfRange, Self::TooFast, Self::Stuck, Self::Incomplete, Self::Stamp, Self::Other];

    /// Returns the key in `summary.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::NotFinite => "not_finite",
            Self::OutOfRange => "out_of_range",
            Self::TooFast => "too_fast",
            Self::Stuck => "stuck",
            Self::Incomplete => "incomplete",
            Self::Stamp => "stamp",
            Self::Other => "other",
        }
    }

    /// Returns the reason why values fail a bound on their magnitude.
    pub fn of_values(values: &[f64]) -> Self {
        if values.iter().all(|value| value.is_finite()) { Self::OutOfRange } else { Self::NotFinite }
    }
}

/// A guard that accepts every sample, for readers that observe and do not act.
#[derive(Debug, Clone, Copy, Default)]
pub struct AcceptAll;

persist_fields!(AcceptAll,);

impl<S: ?Sized> Guard<S> for AcceptAll {
    #[inline]
    fn accepts(&mut self, _sample: &S) -> bool {
        true
    }
}

/// Physical limits of N components, in the units of the components and in ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds<const N: usize> {
    /// The largest magnitude.
    pub magnitude: [f64; N],
    /// The largest change per tick; +∞ where it is unbounded.
    pub slew_per_tick: [f64; N],
    /// The additional change permitted over any time: the noise of two samples.
    pub allowance: [f64; N],
    /// The number of consecutive bit-identical repetitions after which a component counts as stuck.
    pub repeats: u64,
}

/// The longest gap between accepted samples, in ticks, after which a sample need not also continue the one just
/// before it.
const SHORT_GAP_TICKS: u64 = 2;

/// A check of components against their bounds and against the last accepted ones.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlausibilityCheck<const N: usize> {
    bounds: Bounds<N>,
    /// The last accepted value per component, and its tick.
    accepted: [f64; N],
    accepted_tick: [Option<u64>; N],
    /// The previous sample, accepted or not, and the number of repetitions of each component.
    before: [f64; N],
    before_tick: u64,
    repeated: [u64; N],
    /// True if the previous sample was accepted.
    before_accepted: bool,
    /// Bit i is set if component i of the previous sample was accepted. Its `accepted_tick` is then `before_tick` and
    /// is not stored: see [`store_current_ticks`](Self::store_current_ticks).
    current: u64,
    /// The reason why the last rejected sample was rejected.
    refusal: Refusal,
}

impl<const N: usize> PlausibilityCheck<N> {
    /// The bits of all components.
    const ALL: u64 = (1 << N) - 1;

    /// Creates a check without history: it checks only the magnitude of each component's first value.
    pub fn new(bounds: Bounds<N>) -> Self {
        Self {
            bounds,
            accepted: [0.0; N],
            accepted_tick: [None; N],
            before: [f64::NAN; N],
            before_tick: 0,
            repeated: [0; N],
            before_accepted: true,
            current: 0,
            refusal: Refusal::Other,
        }
    }

    /// Returns true if the components selected by the bits of `valid` are possible, and records them then.
    ///
    /// Samples of a restarted sender are compared with those before the restart: they describe the same body.
    #[inline]
    pub fn accepts(&mut self, stamp: &Stamp, values: &[f64; N], valid: u64) -> bool {
        self.accepts_within(stamp, values, valid, |bounds, i, _, ticks| bounds.slew_per_tick[i] * ticks)
    }

    /// Like [`accepts`](Self::accepts), for a body whose possible change depends on its state. `change` computes that
    /// of a component from the bounds, its index, all components and the number of ticks.
    #[inline]
    pub fn accepts_within(
        &mut self,
        stamp: &Stamp,
        values: &[f64; N],
        valid: u64,
        change: impl Fn(&Bounds<N>, usize, &[f64; N], f64) -> f64,
    ) -> bool {
        // Fast path: the same components were accepted one tick ago. `accepts_any` would give the same result.
        let valid = valid & Self::ALL;
        let next = self.before_accepted && valid == self.current && self.before_tick.checked_add(1) == Some(stamp.tick);
        let near = |i: usize| {
            let bound = self.bounds.allowance[i] + change(&self.bounds, i, &self.accepted, 1.0);
            valid >> i & 1 == 0 || self.in_range(i, values[i]) && (values[i] - self.accepted[i]).abs() <= bound
        };
        // Not `(0..N).all(near)`, which compiles to a call per component: see `vector`.
        let mut all_near = next && self.bounds.repeats == u64::MAX;
        for i in 0..N {
            all_near = all_near && near(i);
        }
        if all_near {
            for (i, &value) in values.iter().enumerate() {
                if valid >> i & 1 == 1 {
                    self.accepted[i] = value;
                }
            }
            (self.before, self.before_tick) = (*values, stamp.tick);
            return true;
        }
        self.accepts_any(stamp, values, valid, change)
    }

    /// Like [`accepts_within`](Self::accepts_within) for a sample in which the components selected by the bits of `held` repeat an
    /// earlier value. These must be possible too, but count neither as repetitions nor as the start of the next change.
    #[cold]
    pub fn accepts_held(
        &mut self,
        stamp: &Stamp,
        values: &[f64; N],
        (valid, held): (u64, u64),
        change: impl Fn(&Bounds<N>, usize, &[f64; N], f64) -> f64,
    ) -> bool {
        self.store_current_ticks();
        for i in (0..N).filter(|i| (valid & held) >> i & 1 == 1) {
            if !self.in_range(i, values[i]) {
                self.refusal = Refusal::of_values(&[values[i]]);
                return false;
            }
            if !self.can_reach(i, values[i], stamp.tick, &change) {
                self.refusal = Refusal::TooFast;
                return false;
            }
        }
        self.accepts_any(stamp, values, valid & !held, change)
    }

    /// The general path, not inlined so that the fast path saves no registers for it.
    #[inline(never)]
    fn accepts_any(
        &mut self,
        stamp: &Stamp,
        values: &[f64; N],
        valid: u64,
        change: impl Fn(&Bounds<N>, usize, &[f64; N], f64) -> f64,
    ) -> bool {
        self.store_current_ticks();
        let counts = self.bounds.repeats != u64::MAX;
        let mut refusal = None;
        for (i, &value) in values.iter().enumerate() {
            if counts && valid >> i & 1 == 1 {
                self.repeated[i] = if value == self.before[i] { self.repeated[i] + 1 } else { 0 };
            }
            if valid >> i & 1 == 0 || refusal.is_some() {
                continue;
            }
            refusal = match () {
                () if !self.in_range(i, value) => Some(Refusal::of_values(&[value])),
                () if self.repeated[i] > self.bounds.repeats => Some(Refusal::Stuck),
                () if !self.can_reach(i, value, stamp.tick, &change) => Some(Refusal::TooFast),
                () => None,
            };
        }
        let accepted = refusal.is_none();
        self.refusal = refusal.unwrap_or(self.refusal);
        if accepted {
            self.record_accepted(stamp, values, valid);
        }
        (self.before, self.before_tick, self.before_accepted) = (*values, stamp.tick, accepted);
        self.set_current();
        accepted
    }

    /// Records a sample that was accepted by another check.
    #[inline]
    pub fn record_accepted(&mut self, stamp: &Stamp, values: &[f64; N], valid: u64) {
        self.store_current_ticks();
        for i in (0..N).filter(|i| valid >> i & 1 == 1) {
            (self.accepted[i], self.accepted_tick[i]) = (values[i], Some(stamp.tick));
        }
        self.before_accepted = true;
        self.set_current();
    }

    /// Stores the ticks that `current` implies.
    fn store_current_ticks(&mut self) {
        for i in (0..N).filter(|i| self.current >> i & 1 == 1) {
            self.accepted_tick[i] = Some(self.before_tick);
        }
    }

    fn set_current(&mut self) {
        let current = |i: &usize| self.accepted_tick[*i] == Some(self.before_tick);
        self.current = (0..N).filter(current).fold(0, |current, i| current | 1 << i);
    }

    /// Returns the reason why the last rejected sample was rejected.
    pub fn refusal(&self) -> Refusal {
        self.refusal
    }

    /// Returns the bounds.
    pub fn bounds(&self) -> &Bounds<N> {
        &self.bounds
    }

    /// Returns true if all components lie in their range. NaN lies in no range.
    #[inline]
    pub fn contains(&self, values: &[f64; N]) -> bool {
        (0..N).all(|i| self.in_range(i, values[i]))
    }

    /// Returns true if a component lies in its range. NaN lies in no range.
    #[inline]
    fn in_range(&self, i: usize, value: f64) -> bool {
        value.abs() <= self.bounds.magnitude[i]
    }

    /// Returns true if a component can have reached a value since it was last accepted. The reachable range grows
    /// with time until it would admit noise, so after a rejected sample the value must also continue the previous
    /// one.
    #[inline]
    fn can_reach(
        &self,
        i: usize,
        value: f64,
        tick: u64,
        change: &impl Fn(&Bounds<N>, usize, &[f64; N], f64) -> f64,
    ) -> bool {
        let within = |from: &[f64; N], since: u64| {
            let ticks = tick.saturating_sub(since).max(1) as f64;
            (value - from[i]).abs() <= self.bounds.allowance[i] + change(&self.bounds, i, from, ticks)
        };
        self.accepted_tick[i].is_none_or(|since| {
            let smooth = self.before_accepted || tick.saturating_sub(since) <= SHORT_GAP_TICKS;
            within(&self.accepted, since) && (smooth || within(&self.before, self.before_tick))
        })
    }
}

impl<const N: usize> Persist for PlausibilityCheck<N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.store_current_ticks();
        self.accepted.persist(words);
        self.accepted_tick.persist(words);
        self.before.persist(words);
        self.before_tick.persist(words);
        self.repeated.persist(words);
        self.before_accepted.persist(words);
        self.set_current();
    }
}

/// The number of consecutive samples of a body beyond its range that are rejected even if they are correct.
pub const SUSPECT_SAMPLES: u64 = 8;
/// The permitted mismatch, as a part of the body's path: its inertia is not known exactly.
const MISMATCH: f64 = 0.25;

/// A check that distinguishes a body beyond its range from a faulty sensor: the body moves according to its equations
/// and the applied input.
///
/// The motion is predicted from one sample over [`SUSPECT_SAMPLES`] samples, then from the last of them. Small
/// differences do not add up, and an error that is hidden by noise at first does not stay hidden. After a deviation
/// the check restarts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionCheck<const N: usize> {
    /// The predicted state at `next_tick`.
    next: [f64; N],
    next_tick: u64,
    /// The length of the path since the sample at which the prediction started.
    path: f64,
    /// The number of consistent samples; 0 while the check is inactive.
    samples: u64,
}

impl<const N: usize> Default for MotionCheck<N> {
    fn default() -> Self {
        Self { next: [0.0; N], next_tick: 0, path: 0.0, samples: 0 }
    }
}

impl<const N: usize> MotionCheck<N> {
    /// Returns true while a motion is being checked.
    #[inline]
    pub fn active(&self) -> bool {
        self.samples > 0
    }

    /// Ends the check.
    #[inline]
    pub fn stop(&mut self) {
        self.samples = 0;
    }

    /// Returns true once the motion has been consistent for long enough. `allowance` is the noise of two samples;
    /// `flow` computes the state one tick later. Call it with every sample while the check is [active](Self::active).
    pub fn is_consistent(
        &mut self,
        tick: u64,
        values: &[f64; N],
        allowance: &[f64; N],
        flow: impl FnOnce(&[f64; N]) -> [f64; N],
    ) -> bool {
        let near = |i: usize| (values[i] - self.next[i]).abs() <= allowance[i] + MISMATCH * self.path;
        let follows = self.active() && tick == self.next_tick && (0..N).all(near);
        self.samples = if follows { self.samples + 1 } else { 1 };
        let restart = self.samples % SUSPECT_SAMPLES == 1;
        let from = if restart { *values } else { self.next };
        self.next = flow(&from);
        self.next_tick = tick + 1;
        let moved = from.iter().zip(&self.next).map(|(from, next)| (next - from) * (next - from)).sum::<f64>();
        self.path = if restart { 0.0 } else { self.path } + libm::sqrt(moved);
        self.samples > SUSPECT_SAMPLES
    }
}

impl<const N: usize> MotionCheck<N> {
    /// Moves the prediction over a tick whose values are not new. Returns true if the motion has been consistent for long enough
    /// before. Call it only while the check is [active](Self::active).
    pub fn coast(&mut self, tick: u64, flow: impl FnOnce(&[f64; N]) -> [f64; N]) -> bool {
        if tick != self.next_tick {
            self.stop();
            return false;
        }
        let next = flow(&self.next);
        let moved = self.next.iter().zip(&next).map(|(from, next)| (next - from) * (next - from)).sum::<f64>();
        self.path += libm::sqrt(moved);
        (self.next, self.next_tick) = (next, tick + 1);
        self.samples > SUSPECT_SAMPLES
    }
}

impl<const N: usize> Persist for MotionCheck<N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.next.persist(words);
        self.next_tick.persist(words);
        self.path.persist(words);
        self.samples.persist(words);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn guard() -> PlausibilityCheck<3> {
        let slew_per_tick = [0.01, 0.01, f64::INFINITY];
        PlausibilityCheck::new(Bounds { magnitude: [2.0; 3], slew_per_tick, allowance: [0.001; 3], repeats: u64::MAX })
    }

    fn accepts(guard: &mut PlausibilityCheck<3>, tick: u64, values: [f64; 3], valid: u64) -> bool {
        guard.accepts(&Stamp { tick, generation: 1, ..Stamp::default() }, &values, valid)
    }

    /// With a finite `repeats` the fast path is disabled.
    #[test]
    fn the_fast_path_gives_the_result_of_the_general_one() {
        let mut random = rand_pcg::Pcg64::new(7, 7);
        let mut draw = move |below: u64| {
            use rand_pcg::rand_core::Rng;
            random.next_u64() % below
        };
        let guard = |repeats| {
            PlausibilityCheck::new(Bounds {
                magnitude: [2.0; 3],
                slew_per_tick: [0.01, 0.02, f64::INFINITY],
                allowance: [1e-3; 3],
                repeats,
            })
        };
        let (mut short, mut long) = (guard(u64::MAX), guard(u64::MAX - 1));
        let (mut tick, mut values, mut accepted_samples) = (0, [0.0; 3], 0);
        for _ in 0..100_000 {
            tick += if draw(50) == 0 { draw(5) } else { 1 };
            for value in &mut values {
                *value += (draw(200) as f64 - 99.5) * 1e-4;
            }
            let mut shown = values;
            match draw(60) {
                0 => shown[draw(3) as usize] = f64::NAN,
                1 => shown[draw(3) as usize] += 1.0,
                2 => values = [0.0; 3],
                _ => {}
            }
            let valid = if draw(20) == 0 { draw(8) } else { 7 };
            let accepted = accepts(&mut short, tick, shown, valid);
            assert_eq!(accepted, accepts(&mut long, tick, shown, valid), "tick {tick}, {shown:?}");
            accepted_samples += u64::from(accepted);
            long.repeated = [0; 3];
            short.store_current_ticks();
            // Compared as text, because NaN is unequal to itself.
            assert_eq!(format!("{:?}", PlausibilityCheck { bounds: long.bounds, ..short }), format!("{long:?}"));
        }
        assert!((10_000..95_000).contains(&accepted_samples), "{accepted_samples}");
    }

    #[test]
    fn samples_that_are_not_finite_or_out_of_range_are_rejected() {
        for wrong in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 2.1, -2.1, f64::MAX] {
            for component in 0..3 {
                let mut values = [0.5; 3];
                values[component] = wrong;
                assert!(!accepts(&mut guard(), 0, values, 7), "{wrong}");
                assert!(
                    accepts(&mut guard(), 0, values, 7 & !(1 << component)),
                    "components that are not valid are not checked"
                );
            }
        }
        assert!(accepts(&mut guard(), 0, [2.0, -2.0, 0.0], 7));
    }

    #[test]
    fn a_jump_is_rejected_until_enough_time_has_passed() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7));
        assert!(accepts(&mut guard, 1, [0.0109, 0.0, 1.9], 7), "slew and allowance");
        let jump = [0.5, 0.0, 0.0];
        let first = (2..100).find(|tick| accepts(&mut guard, *tick, jump, 7));
        assert_eq!(first, Some(50), "(0.5 - 0.0109 - 0.001) / 0.01 = 48.8 ticks after tick 1");
        assert!(accepts(&mut guard, 51, jump, 7), "then at once");
    }

    #[test]
    fn every_exponent_or_sign_flip_is_detected_and_the_next_good_sample_accepted() {
        let (value, mut refused) = (0.6, 0);
        for bit in 0..64 {
            let mut guard = guard();
            assert!(accepts(&mut guard, 0, [value; 3], 7));
            let wrong = f64::from_bits(f64::to_bits(value) ^ 1 << bit);
            let accepted = accepts(&mut guard, 1, [wrong, value, value], 7);
            assert_eq!(accepted, (wrong - value).abs() <= 0.011, "bit {bit}: {wrong}");
            refused += u32::from(!accepted);
            assert!(accepts(&mut guard, 2, [value; 3], 7), "bit {bit}");
        }
        assert!(refused >= 12, "eleven exponent bits and the sign: {refused}");
    }

    #[test]
    fn samples_of_a_restarted_sender_continue_those_before() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 5, [0.0; 3], 7));
        let stamp = |tick| Stamp { tick, generation: 2, ..Stamp::default() };
        assert!(!guard.accepts(&stamp(6), &[1.0; 3], 7) && guard.accepts(&stamp(7), &[0.02; 3], 7));
    }

    #[test]
    fn a_restored_guard_has_the_same_state() {
        let (mut guard, samples) = (self::guard(), [(0, 0.0), (1, 0.3), (2, 0.3), (3, 0.301)]);
        for (tick, value) in samples {
            accepts(&mut guard, tick, [value; 3], 7);
        }
        let mut kept = Vec::new();
        guard.persist(&mut Kept(&mut kept));
        let mut restored = self::guard();
        restored.persist(&mut crate::state::StoredWords(&kept));
        // The reason is not persistent: it is read only right after a rejection.
        restored.refusal = guard.refusal;
        assert_eq!(guard, restored);
    }

    struct Kept<'a>(&'a mut Vec<u64>);

    impl Words for Kept<'_> {
        fn word(&mut self, value: &mut u64) {
            self.0.push(*value);
        }
    }

    #[test]
    fn noise_is_rejected_however_long_it_lasts() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7));
        let wild = |tick: u64| if tick.is_multiple_of(2) { 0.2 } else { -0.2 };
        let accepted = (1..500).filter(|tick| accepts(&mut guard, *tick, [wild(*tick), 0.0, 0.0], 7)).count();
        assert_eq!(accepted, 0, "within reach, but no body moves like this");
        let good = (500..510).find(|tick| accepts(&mut guard, *tick, [0.1, 0.0, 0.0], 7));
        assert_eq!(good, Some(501), "the second sample continues the first");
    }

    #[test]
    fn after_a_short_gap_or_lost_samples_one_good_sample_is_accepted() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7) && !accepts(&mut guard, 1, [1.0; 3], 7));
        assert!(accepts(&mut guard, 2, [0.0; 3], 7));
        assert!(accepts(&mut guard, 100, [0.5, 0.0, 0.0], 7), "no rejected sample in between");
    }

    #[test]
    fn a_stuck_component_is_accepted_for_a_limited_time() {
        let mut guard = PlausibilityCheck::new(Bounds { repeats: 3, ..guard().bounds });
        let accepted = (0..10).filter(|tick| accepts(&mut guard, *tick, [0.5; 3], 7)).count();
        assert_eq!(accepted, 4, "the first, and three repetitions");
        assert!(!accepts(&mut guard, 10, [0.501, 0.501, 0.5], 7), "one component is still stuck");
        assert!(accepts(&mut guard, 11, [0.502, 0.502, 0.501], 7), "it moves again");
    }

    fn accepts_held(guard: &mut PlausibilityCheck<3>, tick: u64, values: [f64; 3], held: u64) -> bool {
        let stamp = Stamp { tick, generation: 1, ..Stamp::default() };
        guard.accepts_held(&stamp, &values, (7, held), |bounds, i, _, ticks| bounds.slew_per_tick[i] * ticks)
    }

    /// The next new value may differ by what the body can do in the whole time.
    #[test]
    fn a_held_component_does_not_shorten_the_time_since_its_last_value() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7));
        for tick in 1..10 {
            assert!(accepts_held(&mut guard, tick, [0.0, 0.01 * tick as f64, 0.0], 0b001), "tick {tick}");
        }
        assert!(!accepts(&mut guard.clone(), 10, [0.12, 0.1, 0.0], 7), "too fast for ten ticks");
        assert!(!accepts(&mut guard.clone(), 10, [0.1, 0.05, 0.0], 7), "too fast for one tick");
        assert!(accepts(&mut guard, 10, [0.1, 0.1, 0.0], 7));
    }

    #[test]
    fn an_impossible_held_value_is_rejected_with_its_reason() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7));
        for (value, reason) in [(f64::NAN, Refusal::NotFinite), (2.1, Refusal::OutOfRange), (0.5, Refusal::TooFast)] {
            assert!(!accepts_held(&mut guard, 1, [value, 0.0, 0.0], 0b001), "{value}");
            assert_eq!(guard.refusal(), reason, "{value}");
        }
        assert!(!accepts_held(&mut guard, 1, [0.0, 0.5, 0.0], 0b001), "new components are checked too");
    }

    #[test]
    fn held_values_are_not_stuck_ones() {
        let mut guard = PlausibilityCheck::new(Bounds { repeats: 3, ..guard().bounds });
        let held =
            |guard: &mut _, ticks: std::ops::Range<u64>| ticks.filter(|k| accepts_held(guard, *k, [0.5; 3], 7)).count();
        assert!(accepts(&mut guard, 0, [0.5; 3], 7));
        assert_eq!(held(&mut guard, 1..30), 29);
        let repeated = (1..6).filter(|n| accepts(&mut guard, 30 * n, [0.5; 3], 7)).count();
        assert_eq!(repeated, 3, "new values that repeat are");
    }

    /// A driven body beyond its range, whose sensor is slow: the prediction goes on in between.
    #[test]
    fn a_motion_is_followed_through_ticks_without_a_new_value() {
        let flow = |from: &[f64; 1]| [from[0] + 0.1];
        let mut check = MotionCheck::<1>::default();
        let confirmed = (0..60).find(|tick| {
            let value = [0.1 * *tick as f64];
            if tick % 4 == 0 { check.is_consistent(*tick, &value, &[1e-9], flow) } else { check.coast(*tick, flow) }
        });
        assert_eq!(confirmed, Some(4 * SUSPECT_SAMPLES), "as many new values as without held ones");
        assert!(!check.coast(90, flow) && !check.active(), "a gap ends the check");
    }

    #[test]
    fn a_rejected_sample_has_its_reason() {
        let mut guard = PlausibilityCheck::new(Bounds { repeats: 2, ..guard().bounds });
        assert!(accepts(&mut guard, 0, [0.5; 3], 7));
        for (tick, value, reason) in [
            (1, f64::NAN, Refusal::NotFinite),
            (2, f64::INFINITY, Refusal::NotFinite),
            (3, -3.0, Refusal::OutOfRange),
            (4, 1.5, Refusal::TooFast),
        ] {
            let values = [value, 0.5 + tick as f64 * 1e-4, 0.5 + tick as f64 * 1e-4];
            assert!(!accepts(&mut guard, tick, values, 7), "{value}");
            assert_eq!(guard.refusal(), reason, "{value}");
        }
        let stuck = (5..12).map(|tick| accepts(&mut guard, tick, [0.5; 3], 7)).last();
        assert_eq!((stuck, guard.refusal()), (Some(false), Refusal::Stuck));
    }
}
