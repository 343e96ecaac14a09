//! When a fault acts: which ticks of its span, as a function of seed and tick alone.
//!
//! Must not know what the fault does. Where a tick depends on those before, the whole past follows from the seed: a successor
//! decides it again, and decides the same.

use super::{Fault, unit};

/// On which of its ticks a fault acts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Occurrence {
    /// On each by itself with this probability; 1 is always.
    Independent(f64),
    /// On the first and on every n-th after it.
    Every(u64),
    /// In bursts.
    GilbertElliott(Channel),
    /// At most so often within any window.
    WeaklyHard(WeaklyHard),
}

/// The channel of Gilbert and Elliott: a Markov chain of two states, good at the first tick, and the probability with which the
/// fault acts in each.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Channel {
    /// The probability, per tick, with which a good channel becomes a bad one.
    pub good_to_bad: f64,
    /// The probability, per tick, with which a bad channel becomes a good one.
    pub bad_to_good: f64,
    /// With which probability the fault acts on a tick of a good channel.
    pub when_good: f64,
    /// With which probability it acts on a tick of a bad one.
    pub when_bad: f64,
}

/// The weakly-hard constraint (m, K): of any K ticks in a row the fault acts on at most m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WeaklyHard {
    /// m, at least 1 and less than K.
    pub misses: u32,
    /// K, at most [`WINDOW_MAX`].
    pub window: u32,
    /// Which ticks these are.
    pub pattern: Pattern,
}

/// The longest window of a weakly-hard constraint, ticks.
pub const WINDOW_MAX: u32 = 64;

/// How the ticks on which a weakly-hard fault acts lie.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pattern {
    /// Each is drawn with this probability, and spared where it would be one too many.
    Random(f64),
    /// m in a row, then K − m spared, again and again: the longest silence that the constraint allows, as often as it does.
    Burst,
    /// m of K, as evenly spread as can be: no silence is long, and none of the K − m is far from one.
    Even,
}

impl Pattern {
    /// Whether a pattern that repeats itself after K ticks acts on the tick with this index.
    fn acts(self, index: u64, WeaklyHard { misses, window, .. }: WeaklyHard) -> bool {
        let (m, k) = (u64::from(misses), u64::from(window));
        let at = index % k;
        match self {
            Self::Burst => at < m,
            // That of the first ticks which makes the share of m in K full, or more than full.
            _ => (at + 1) * m / k > at * m / k,
        }
    }
}

/// A fault that is asked tick by tick. What is remembered of the past is computed anew where it is asked for an earlier tick.
#[derive(Debug, Clone, PartialEq)]
pub struct FaultSequence {
    fault: Fault,
    /// The first tick that is not decided.
    next: u64,
    /// Of ticks decided, the last in bit 0, on which the fault acts; or, of a channel, whether it is bad.
    past: u64,
    /// Whether the fault acts on the last tick decided.
    acts: bool,
}

impl FaultSequence {
    /// A fault of which nothing is decided.
    pub fn new(fault: Fault) -> Self {
        let next = fault.from_tick;
        Self { fault, next, past: 0, acts: false }
    }

    /// The fault.
    pub fn fault(&self) -> &Fault {
        &self.fault
    }

    /// Whether the fault acts at this tick.
    #[inline]
    pub fn acts(&mut self, tick: u64) -> bool {
        let Fault { from_tick, ticks, occurrence, .. } = self.fault;
        if tick < from_tick || tick - from_tick >= ticks {
            return false;
        }
        match occurrence {
            Occurrence::Independent(probability) => self.fault.draws(tick, 0, probability),
            Occurrence::Every(n) => (tick - from_tick).is_multiple_of(n),
            Occurrence::WeaklyHard(hard) if !matches!(hard.pattern, Pattern::Random(_)) => {
                hard.pattern.acts(tick - from_tick, hard)
            }
            Occurrence::GilbertElliott(_) | Occurrence::WeaklyHard(_) => self.decide_up_to(tick),
        }
    }

    fn decide_up_to(&mut self, tick: u64) -> bool {
        if tick + 1 < self.next {
            (self.next, self.past) = (self.fault.from_tick, 0);
        }
        while self.next <= tick {
            self.acts = self.decide(self.next);
            self.next += 1;
        }
        self.acts
    }

    /// The next tick, from those before it.
    fn decide(&mut self, tick: u64) -> bool {
        match self.fault.occurrence {
            Occurrence::GilbertElliott(channel) => {
                let bad = self.past == 1;
                let changes = if bad { channel.bad_to_good } else { channel.good_to_bad };
                let bad = bad ^ (tick > self.fault.from_tick && self.fault.draws(tick, 3, changes));
                self.past = u64::from(bad);
                self.fault.draws(tick, 0, if bad { channel.when_bad } else { channel.when_good })
            }
            Occurrence::WeaklyHard(WeaklyHard { misses, window, pattern: Pattern::Random(probability) }) => {
                let others = (1_u64 << (window - 1)) - 1;
                let full = (self.past & others).count_ones() >= misses;
                let acts = !full && self.fault.draws(tick, 0, probability);
                self.past = self.past << 1 | u64::from(acts);
                acts
            }
            // The others need no past.
            _ => false,
        }
    }
}

impl Fault {
    /// Whether what has this probability happens at a tick, for one purpose.
    fn draws(&self, tick: u64, purpose: u64, probability: f64) -> bool {
        probability >= 1.0 || unit(self.draw(tick, purpose)) < probability
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Action, Interruption, seed};
    use super::*;
    use proptest::prelude::*;

    fn course(from_tick: u64, ticks: u64, number: u64, occurrence: Occurrence) -> FaultSequence {
        let action = Action::Role(Interruption::Miss);
        FaultSequence::new(Fault { from_tick, ticks, occurrence, seed: seed(number, 0), action })
    }

    fn acted(course: &mut FaultSequence, ticks: core::ops::Range<u64>) -> Vec<bool> {
        ticks.map(|tick| course.acts(tick)).collect()
    }

    #[test]
    fn acts_within_its_ticks_and_as_often_as_it_is_told() {
        let acted = |probability, ticks| {
            let course = &mut course(10, ticks, 7, Occurrence::Independent(probability));
            (0..10_020).filter(|tick| course.acts(*tick)).count()
        };
        assert_eq!(acted(1.0, 3), 3);
        assert!((2_300..2_700).contains(&acted(0.25, 10_000)), "{}", acted(0.25, 10_000));
        assert_eq!(acted(0.0, 10_000), 0);
        assert!(!course(10, u64::MAX, 7, Occurrence::Independent(1.0)).acts(9), "no overflow");
    }

    #[test]
    fn every_nth_tick_begins_with_the_first() {
        let course = &mut course(10, 8, 1, Occurrence::Every(3));
        assert_eq!((0..30).filter(|tick| course.acts(*tick)).collect::<Vec<_>>(), [10, 13, 16]);
    }

    /// Share of losses and mean length of a burst, as the chain's stationary distribution has them.
    #[test]
    fn a_channel_is_as_bad_and_for_as_long_as_it_is_told() {
        let channel = Channel { good_to_bad: 0.01, bad_to_good: 0.2, when_good: 0.0, when_bad: 1.0 };
        let ticks = 200_000;
        let lost = acted(&mut course(0, ticks, 3, Occurrence::GilbertElliott(channel)), 0..ticks);
        let share = lost.iter().filter(|lost| **lost).count() as f64 / ticks as f64;
        let begun = lost.windows(2).filter(|two| !two[0] && two[1]).count();
        let length = share * ticks as f64 / begun as f64;
        assert!((share - 0.01 / 0.21).abs() < 0.005, "{share}");
        assert!((length - 5.0).abs() < 0.4, "{length}");
        assert!(!lost[0], "it begins good");
        let partly = Channel { when_good: 0.5, when_bad: 0.5, ..channel };
        let lost = acted(&mut course(0, ticks, 3, Occurrence::GilbertElliott(partly)), 0..ticks);
        let share = lost.iter().filter(|lost| **lost).count() as f64 / ticks as f64;
        assert!((share - 0.5).abs() < 0.005, "where both states are alike it is white: {share}");
    }

    fn occurrences() -> impl Strategy<Value = Occurrence> {
        let probability = 0.0..=1.0_f64;
        let channel = [probability.clone(), probability.clone(), probability.clone(), probability.clone()];
        let channel = channel.prop_map(|[good_to_bad, bad_to_good, when_good, when_bad]| {
            Occurrence::GilbertElliott(Channel { good_to_bad, bad_to_good, when_good, when_bad })
        });
        prop_oneof![channel, probability.prop_map(Occurrence::Independent), hard().prop_map(Occurrence::WeaklyHard)]
    }

    fn hard() -> impl Strategy<Value = WeaklyHard> {
        let pattern = prop_oneof![Just(Pattern::Burst), Just(Pattern::Even), (0.0..=1.0_f64).prop_map(Pattern::Random)];
        (2..=WINDOW_MAX, pattern).prop_flat_map(|(window, pattern)| {
            (1..window).prop_map(move |misses| WeaklyHard { misses, window, pattern })
        })
    }

    proptest! {
        /// No window of K has more than m, wherever it lies; a worst case has m in every one.
        #[test]
        fn a_weakly_hard_fault_keeps_its_constraint(hard in hard(), from in 0..1000_u64, number in any::<u64>()) {
            let mut course = course(from, 500, number, Occurrence::WeaklyHard(hard));
            let lost = acted(&mut course, from..from + 500);
            let in_window = |window: &[bool]| window.iter().filter(|lost| **lost).count();
            for window in lost.windows(hard.window as usize) {
                prop_assert!(in_window(window) <= hard.misses as usize, "{:?}", hard);
                let worst = !matches!(hard.pattern, Pattern::Random(_));
                prop_assert!(!worst || in_window(window) == hard.misses as usize, "{:?}", hard);
            }
        }

        /// Whoever comes later, or looks back, is told the same.
        #[test]
        fn the_past_is_decided_again_as_it_was(
            occurrence in occurrences(),
            number in any::<u64>(),
            looks in prop::collection::vec(0..300_u64, 1..30),
        ) {
            let straight = acted(&mut course(5, 200, number, occurrence), 0..300);
            let mut other = course(5, 200, number, occurrence);
            for tick in looks {
                prop_assert_eq!(other.acts(tick), straight[tick as usize], "{:?} at {}", occurrence, tick);
            }
        }
    }

    #[test]
    fn a_draw_that_is_bound_to_nothing_uses_up_what_the_constraint_allows() {
        let hard = WeaklyHard { misses: 3, window: 10, pattern: Pattern::Random(0.5) };
        let lost = acted(&mut course(0, 10_000, 9, Occurrence::WeaklyHard(hard)), 0..10_000);
        let windows = lost.windows(10).map(|window| window.iter().filter(|lost| **lost).count());
        let [full, some] = [3, 1].map(|at_least| windows.clone().filter(|lost| *lost >= at_least).count());
        assert!(full > 5_000 && some > 9_000, "{full} {some}");
    }
}
