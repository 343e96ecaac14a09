//! What the receiving end checks of a sample before anything is made of it: numbers, range, and how fast they change.
//!
//! Must not repair anything: a sample is believed whole or not at all. Must not refuse for ever what was right: the change
//! that is allowed grows with the time since the last sample that was believed, and a body that moves beyond its range as its
//! equations of motion say is believed after [`SUSPECT_SAMPLES`] samples.

use crate::sample::Stamp;
use crate::state::{Persist, Words, persist_fields};

/// Judges the samples of one signal, in the order of their ticks.
pub trait Guard<S: ?Sized> {
    /// Whether the sample is to be believed. One that is becomes what the next are compared with.
    fn accepts(&mut self, sample: &S) -> bool;

    /// Returns why the sample that was just judged is not accepted; called for such samples only.
    fn refusal(&self, _sample: &S) -> Refusal {
        Refusal::Other
    }
}

/// Why a sample is not accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// A number is infinite or none.
    NotFinite,
    /// A value lies beyond its bound.
    OutOfRange,
    /// A value changed faster than the body can.
    TooFast,
    /// A value stayed the same to the last bit for too long.
    Stuck,
    /// A component that the reader needs is absent.
    Incomplete,
    /// The stamp's tick or generation cannot be.
    Stamp,
    /// By a guard that gives no reason.
    Other,
}

impl Refusal {
    /// All of them, in the order of their counters.
    pub const ALL: [Self; 7] =
        [Self::NotFinite, Self::OutOfRange, Self::TooFast, Self::Stuck, Self::Incomplete, Self::Stamp, Self::Other];

    /// The key in `summary.json`.
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

    /// The reason why values fail a bound on their magnitude.
    pub fn of_values(values: &[f64]) -> Self {
        if values.iter().all(|value| value.is_finite()) { Self::OutOfRange } else { Self::NotFinite }
    }
}

/// Believes everything: for those who watch and do not act.
#[derive(Debug, Clone, Copy, Default)]
pub struct AcceptAll;

persist_fields!(AcceptAll,);

impl<S: ?Sized> Guard<S> for AcceptAll {
    #[inline]
    fn accepts(&mut self, _sample: &S) -> bool {
        true
    }
}

/// What N components of a body can be. Units are those of the components, and ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds<const N: usize> {
    /// The largest magnitude.
    pub magnitude: [f64; N],
    /// The largest change per tick; +inf where nothing bounds it.
    pub slew_per_tick: [f64; N],
    /// What may be added to a change however short the time: the noise of two samples.
    pub allowance: [f64; N],
    /// So often in a row a component may be the same to the last bit; then it is stuck.
    pub repeats: u64,
}

/// After a gap of so many ticks in what was believed, a sample must also continue what came just before it.
const SHORT_GAP_TICKS: u64 = 2;

/// Components that are checked against their bounds and against the last ones believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlausibilityCheck<const N: usize> {
    bounds: Bounds<N>,
    /// Per component, the last value that was believed, and its tick.
    believed: [f64; N],
    believed_tick: [Option<u64>; N],
    /// The sample before, believed or not, and how often its components have been repeated.
    before: [f64; N],
    before_tick: u64,
    repeated: [u64; N],
    /// Whether that one was believed.
    trusted: bool,
    /// Bit i set: component i of that sample was believed. Its `believed_tick` is `before_tick` then, which is not kept up: see
    /// [`spell_out`](Self::spell_out).
    current: u64,
    /// Why the last sample that was not believed was not.
    refusal: Refusal,
}

impl<const N: usize> PlausibilityCheck<N> {
    /// The bits of all components.
    const ALL: u64 = (1 << N) - 1;

    /// Nothing is known yet: the first value of a component is checked for its magnitude only.
    pub fn new(bounds: Bounds<N>) -> Self {
        Self {
            bounds,
            believed: [0.0; N],
            believed_tick: [None; N],
            before: [f64::NAN; N],
            before_tick: 0,
            repeated: [0; N],
            trusted: true,
            current: 0,
            refusal: Refusal::Other,
        }
    }

    /// Whether those components of a sample that `valid` has a bit for are possible; if so they are remembered.
    ///
    /// A sender that has been started anew speaks of the same body: its samples are compared with those before.
    #[inline]
    pub fn accepts(&mut self, stamp: &Stamp, values: &[f64; N], valid: u64) -> bool {
        self.accepts_within(stamp, values, valid, |bounds, i, _, ticks| bounds.slew_per_tick[i] * ticks)
    }

    /// The same where the change that is possible depends on where the body was: `change` tells that of a component, from
    /// the bounds, all components and the number of ticks.
    #[inline]
    pub fn accepts_within(
        &mut self,
        stamp: &Stamp,
        values: &[f64; N],
        valid: u64,
        change: impl Fn(&Bounds<N>, usize, &[f64; N], f64) -> f64,
    ) -> bool {
        // As a rule the same components were believed a tick ago, and are now: what follows says the same at greater length.
        let valid = valid & Self::ALL;
        let next = self.trusted && valid == self.current && self.before_tick.checked_add(1) == Some(stamp.tick);
        let near = |i: usize| {
            let bound = self.bounds.allowance[i] + change(&self.bounds, i, &self.believed, 1.0);
            valid >> i & 1 == 0 || self.in_range(i, values[i]) && (values[i] - self.believed[i]).abs() <= bound
        };
        // Not `(0..N).all(near)`, which is a call per component: see `vector`.
        let mut all_near = next && self.bounds.repeats == u64::MAX;
        for i in 0..N {
            all_near = all_near && near(i);
        }
        if all_near {
            for (i, &value) in values.iter().enumerate() {
                if valid >> i & 1 == 1 {
                    self.believed[i] = value;
                }
            }
            (self.before, self.before_tick) = (*values, stamp.tick);
            return true;
        }
        self.accepts_any(stamp, values, valid, change)
    }

    /// Apart, so that the short way has nothing to keep for it.
    #[inline(never)]
    fn accepts_any(
        &mut self,
        stamp: &Stamp,
        values: &[f64; N],
        valid: u64,
        change: impl Fn(&Bounds<N>, usize, &[f64; N], f64) -> f64,
    ) -> bool {
        self.spell_out();
        let counts = self.bounds.repeats != u64::MAX;
        let mut refusal = None;
        for (i, &value) in values.iter().enumerate() {
            if counts {
                self.repeated[i] = if value == self.before[i] { self.repeated[i] + 1 } else { 0 };
            }
            if valid >> i & 1 == 0 || refusal.is_some() {
                continue;
            }
            refusal = match () {
                () if !self.in_range(i, value) => Some(Refusal::of_values(&[value])),
                () if self.repeated[i] > self.bounds.repeats => Some(Refusal::Stuck),
                () if !self.reached(i, value, stamp.tick, &change) => Some(Refusal::TooFast),
                () => None,
            };
        }
        let believed = refusal.is_none();
        self.refusal = refusal.unwrap_or(self.refusal);
        if believed {
            self.record_accepted(stamp, values, valid);
        }
        (self.before, self.before_tick, self.trusted) = (*values, stamp.tick, believed);
        self.set_current();
        believed
    }

    /// Remembers a sample that was found to be right in another way.
    #[inline]
    pub fn record_accepted(&mut self, stamp: &Stamp, values: &[f64; N], valid: u64) {
        self.spell_out();
        for i in (0..N).filter(|i| valid >> i & 1 == 1) {
            (self.believed[i], self.believed_tick[i]) = (values[i], Some(stamp.tick));
        }
        self.trusted = true;
        self.set_current();
    }

    /// Brings up to date what is implied as long as the same components are believed, one sample after the other.
    fn spell_out(&mut self) {
        for i in (0..N).filter(|i| self.current >> i & 1 == 1) {
            self.believed_tick[i] = Some(self.before_tick);
        }
    }

    fn set_current(&mut self) {
        let current = |i: &usize| self.believed_tick[*i] == Some(self.before_tick);
        self.current = (0..N).filter(current).fold(0, |current, i| current | 1 << i);
    }

    /// Why the last sample that was not believed was not.
    pub fn refusal(&self) -> Refusal {
        self.refusal
    }

    /// The bounds that it judges by.
    pub fn bounds(&self) -> &Bounds<N> {
        &self.bounds
    }

    /// Whether all components lie in their range. What is not a number does not.
    #[inline]
    pub fn contains(&self, values: &[f64; N]) -> bool {
        (0..N).all(|i| self.in_range(i, values[i]))
    }

    /// What is not a number is in no range.
    #[inline]
    fn in_range(&self, i: usize, value: f64) -> bool {
        value.abs() <= self.bounds.magnitude[i]
    }

    /// Whether a component can have come to a value from where it was last believed to be. As the time grows so does what can
    /// be reached, and noise comes to be possible; so after doubts it must have come smoothly, too.
    #[inline]
    fn reached(
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
        self.believed_tick[i].is_none_or(|since| {
            let smooth = self.trusted || tick.saturating_sub(since) <= SHORT_GAP_TICKS;
            within(&self.believed, since) && (smooth || within(&self.before, self.before_tick))
        })
    }
}

impl<const N: usize> Persist for PlausibilityCheck<N> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.spell_out();
        self.believed.persist(words);
        self.believed_tick.persist(words);
        self.before.persist(words);
        self.before_tick.persist(words);
        self.repeated.persist(words);
        self.trusted.persist(words);
        self.set_current();
    }
}

/// So many samples in a row of a body beyond its range are not believed, however right they are.
pub const SUSPECT_SAMPLES: u64 = 8;
/// Of the way that a body moves, so much may be other than its equations say: its inertia is not known exactly.
const MISMATCH: f64 = 0.25;

/// Tells a body that moves beyond its range from a sensor that lies: the body moves as its equations and what is applied to
/// it say.
///
/// It is followed from a sample on, for [`SUSPECT_SAMPLES`] samples, and then from the last of them: small differences do not add up,
/// and a lie that hides in noise at first does not stay hidden. What stops following is doubted anew.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionCheck<const N: usize> {
    /// Where the body is at `next_tick` if it follows.
    next: [f64; N],
    next_tick: u64,
    /// How far it has moved since the sample that it is followed from.
    path: f64,
    /// How many samples have followed; 0 if none is followed.
    samples: u64,
}

impl<const N: usize> Default for MotionCheck<N> {
    fn default() -> Self {
        Self { next: [0.0; N], next_tick: 0, path: 0.0, samples: 0 }
    }
}

impl<const N: usize> MotionCheck<N> {
    /// Whether a body is being followed.
    #[inline]
    pub fn active(&self) -> bool {
        self.samples > 0
    }

    /// Follows no body any more.
    #[inline]
    pub fn stop(&mut self) {
        self.samples = 0;
    }

    /// Whether a body that was sampled at this tick has been found to move as it must. `allowance` is the noise of two
    /// samples; `flow` tells where it is one tick later. Call it with every sample as long as it is [active](Self::active).
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
        let anew = self.samples % SUSPECT_SAMPLES == 1;
        let from = if anew { *values } else { self.next };
        self.next = flow(&from);
        self.next_tick = tick + 1;
        let moved = from.iter().zip(&self.next).map(|(from, next)| (next - from) * (next - from)).sum::<f64>();
        self.path = if anew { 0.0 } else { self.path } + libm::sqrt(moved);
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

    /// Where repetitions are counted, the short way is not taken: it says the same, whatever comes.
    #[test]
    fn the_short_way_says_what_the_long_one_says() {
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
        let (mut tick, mut values, mut believed) = (0, [0.0; 3], 0);
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
            let told = accepts(&mut short, tick, shown, valid);
            assert_eq!(told, accepts(&mut long, tick, shown, valid), "tick {tick}, {shown:?}");
            believed += u64::from(told);
            long.repeated = [0; 3];
            short.spell_out();
            // As text: what is not a number is unequal to itself.
            assert_eq!(format!("{:?}", PlausibilityCheck { bounds: long.bounds, ..short }), format!("{long:?}"));
        }
        assert!((10_000..95_000).contains(&believed), "{believed}");
    }

    #[test]
    fn what_is_no_number_or_out_of_range_is_not_believed() {
        for wrong in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 2.1, -2.1, f64::MAX] {
            for component in 0..3 {
                let mut values = [0.5; 3];
                values[component] = wrong;
                assert!(!accepts(&mut guard(), 0, values, 7), "{wrong}");
                assert!(accepts(&mut guard(), 0, values, 7 & !(1 << component)), "what is not valid is not looked at");
            }
        }
        assert!(accepts(&mut guard(), 0, [2.0, -2.0, 0.0], 7));
    }

    #[test]
    fn a_jump_is_refused_until_there_was_time_for_it() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7));
        assert!(accepts(&mut guard, 1, [0.0109, 0.0, 1.9], 7), "slew and allowance");
        let jump = [0.5, 0.0, 0.0];
        let first = (2..100).find(|tick| accepts(&mut guard, *tick, jump, 7));
        assert_eq!(first, Some(50), "(0.5 - 0.0109 - 0.001) / 0.01 = 48.8 ticks after tick 1");
        assert!(accepts(&mut guard, 51, jump, 7), "and from then on at once");
    }

    #[test]
    fn every_flip_of_an_exponent_or_sign_is_seen_and_the_next_good_sample_is_believed() {
        let (value, mut refused) = (0.6, 0);
        for bit in 0..64 {
            let mut guard = guard();
            assert!(accepts(&mut guard, 0, [value; 3], 7));
            let wrong = f64::from_bits(f64::to_bits(value) ^ 1 << bit);
            let believed = accepts(&mut guard, 1, [wrong, value, value], 7);
            assert_eq!(believed, (wrong - value).abs() <= 0.011, "bit {bit}: {wrong}");
            refused += u32::from(!believed);
            assert!(accepts(&mut guard, 2, [value; 3], 7), "bit {bit}");
        }
        assert!(refused >= 12, "eleven bits of exponent, and the sign: {refused}");
    }

    #[test]
    fn a_new_life_of_the_sender_speaks_of_the_same_body() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 5, [0.0; 3], 7));
        let stamp = |tick| Stamp { tick, generation: 2, ..Stamp::default() };
        assert!(!guard.accepts(&stamp(6), &[1.0; 3], 7) && guard.accepts(&stamp(7), &[0.02; 3], 7));
    }

    #[test]
    fn a_guard_that_is_restored_judges_as_the_one_before() {
        let (mut one, samples) = (guard(), [(0, 0.0), (1, 0.3), (2, 0.3), (3, 0.301)]);
        for (tick, value) in samples {
            accepts(&mut one, tick, [value; 3], 7);
        }
        let mut kept = Vec::new();
        one.persist(&mut Kept(&mut kept));
        let mut other = guard();
        other.persist(&mut crate::state::Restore(&kept));
        // Why a sample was refused is asked at once or never.
        other.refusal = one.refusal;
        assert_eq!(one, other);
    }

    struct Kept<'a>(&'a mut Vec<u64>);

    impl Words for Kept<'_> {
        fn word(&mut self, value: &mut u64) {
            self.0.push(*value);
        }
    }

    #[test]
    fn noise_is_not_believed_because_it_has_lasted() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7));
        let wild = |tick: u64| if tick.is_multiple_of(2) { 0.2 } else { -0.2 };
        let believed = (1..500).filter(|tick| accepts(&mut guard, *tick, [wild(*tick), 0.0, 0.0], 7)).count();
        assert_eq!(believed, 0, "it could have been reached, but no body moves so");
        let good = (500..510).find(|tick| accepts(&mut guard, *tick, [0.1, 0.0, 0.0], 7));
        assert_eq!(good, Some(501), "the second one continues the first");
    }

    #[test]
    fn a_short_gap_needs_no_second_sample_and_a_lost_one_is_no_doubt() {
        let mut guard = guard();
        assert!(accepts(&mut guard, 0, [0.0; 3], 7) && !accepts(&mut guard, 1, [1.0; 3], 7));
        assert!(accepts(&mut guard, 2, [0.0; 3], 7));
        assert!(accepts(&mut guard, 100, [0.5, 0.0, 0.0], 7), "nothing came in between");
    }

    #[test]
    fn what_is_stuck_is_believed_for_a_while_only() {
        let mut guard = PlausibilityCheck::new(Bounds { repeats: 3, ..guard().bounds });
        let believed = (0..10).filter(|tick| accepts(&mut guard, *tick, [0.5; 3], 7)).count();
        assert_eq!(believed, 4, "the first, and three repetitions");
        assert!(!accepts(&mut guard, 10, [0.501, 0.501, 0.5], 7), "one component is stuck still");
        assert!(accepts(&mut guard, 11, [0.502, 0.502, 0.501], 7), "it moves again");
    }

    #[test]
    fn what_is_refused_has_its_reason() {
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
