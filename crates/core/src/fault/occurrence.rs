//! The occurrence of a fault: the ticks of its span at which it acts, as a function of seed and tick alone.
//!
//! It must not depend on the kind of fault. Where a tick depends on earlier ones, the whole past follows from the
//! seed: a restarted process evaluates it again with the same result.

use super::{Fault, unit};

/// The rule by which a fault acts on its ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Occurrence {
    /// On each tick independently with this probability; 1 means always.
    Independent(f64),
    /// On the first tick and on every n-th after it.
    Every(u64),
    /// In bursts.
    GilbertElliott(Channel),
    /// At most a number of times within any window.
    WeaklyHard(WeaklyHard),
}

/// The Gilbert-Elliott channel: a Markov chain of two states, good at the first tick, with a fault probability for
/// each.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Channel {
    /// The probability per tick that a good channel becomes bad.
    pub good_to_bad: f64,
    /// The probability per tick that a bad channel becomes good.
    pub bad_to_good: f64,
    /// The probability that the fault acts on a tick of a good channel.
    pub when_good: f64,
    /// The probability that the fault acts on a tick of a bad channel.
    pub when_bad: f64,
}

/// The weakly-hard constraint (m, K): of any K consecutive ticks the fault acts on at most m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WeaklyHard {
    /// m, at least 1 and less than K.
    pub misses: u32,
    /// K, at most [`WINDOW_MAX`].
    pub window: u32,
    /// The arrangement of the ticks.
    pub pattern: Pattern,
}

/// The longest window of a weakly-hard constraint, ticks.
pub const WINDOW_MAX: u32 = 64;

/// The arrangement of the ticks on which a weakly-hard fault acts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pattern {
    /// Each tick is drawn with this probability, but does not count if it would violate the constraint.
    Random(f64),
    /// m ticks in a row, then K − m without fault, repeatedly: the longest outage that the constraint allows, as
    /// often as possible.
    Burst,
    /// m of K ticks, spread as evenly as possible: the outages are as short as possible.
    Even,
}

impl Pattern {
    /// Returns true if a pattern of period K acts on the tick with this index.
    fn acts(self, index: u64, WeaklyHard { misses, window, .. }: WeaklyHard) -> bool {
        let (m, k) = (u64::from(misses), u64::from(window));
        let at = index % k;
        match self {
            Self::Burst => at < m,
            // The tick at which the share of m in K reaches another whole tick.
            _ => (at + 1) * m / k > at * m / k,
        }
    }
}

/// A fault evaluated tick by tick. The past is evaluated again when an earlier tick is queried.
#[derive(Debug, Clone, PartialEq)]
pub struct FaultSequence {
    fault: Fault,
    /// The first tick that is not evaluated.
    next: u64,
    /// The last evaluated ticks, the latest in bit 0, at which the fault acts; for a channel, 1 if it is bad.
    past: u64,
    /// True if the fault acts on the last evaluated tick.
    acts: bool,
}

impl FaultSequence {
    /// Creates a sequence without evaluated ticks.
    pub fn new(fault: Fault) -> Self {
        let next = fault.from_tick;
        Self { fault, next, past: 0, acts: false }
    }

    /// Returns the fault.
    pub fn fault(&self) -> &Fault {
        &self.fault
    }

    /// Returns true if the fault acts at this tick. Ticks may be queried in any order.
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

    /// Evaluates the next tick from those before it.
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
                let preceding = (1_u64 << (window - 1)) - 1;
                let full = (self.past & preceding).count_ones() >= misses;
                let acts = !full && self.fault.draws(tick, 0, probability);
                self.past = self.past << 1 | u64::from(acts);
                acts
            }
            // The other kinds do not depend on the past.
            _ => false,
        }
    }
}

impl Fault {
    /// Returns true with this probability, drawn for a tick and a purpose.
    fn draws(&self, tick: u64, purpose: u64, probability: f64) -> bool {
        probability >= 1.0 || unit(self.draw(tick, purpose)) < probability
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Action, Interruption, seed};
    use super::*;
    use proptest::prelude::*;

    fn sequence(from_tick: u64, ticks: u64, number: u64, occurrence: Occurrence) -> FaultSequence {
        let action = Action::Role(Interruption::Miss);
        FaultSequence::new(Fault { from_tick, ticks, occurrence, seed: seed(number, 0), action })
    }

    fn acted(sequence: &mut FaultSequence, ticks: core::ops::Range<u64>) -> Vec<bool> {
        ticks.map(|tick| sequence.acts(tick)).collect()
    }

    #[test]
    fn a_fault_acts_within_its_ticks_with_its_probability() {
        let acted = |probability, ticks| {
            let sequence = &mut sequence(10, ticks, 7, Occurrence::Independent(probability));
            (0..10_020).filter(|tick| sequence.acts(*tick)).count()
        };
        assert_eq!(acted(1.0, 3), 3);
        assert!((2_300..2_700).contains(&acted(0.25, 10_000)), "{}", acted(0.25, 10_000));
        assert_eq!(acted(0.0, 10_000), 0);
        assert!(!sequence(10, u64::MAX, 7, Occurrence::Independent(1.0)).acts(9), "no overflow");
    }

    #[test]
    fn every_nth_tick_begins_with_the_first() {
        let sequence = &mut sequence(10, 8, 1, Occurrence::Every(3));
        assert_eq!((0..30).filter(|tick| sequence.acts(*tick)).collect::<Vec<_>>(), [10, 13, 16]);
    }

    /// Compares the share of losses and the mean length of a burst with the chain's stationary distribution.
    #[test]
    fn a_channel_has_its_share_of_losses_and_length_of_bursts() {
        let channel = Channel { good_to_bad: 0.01, bad_to_good: 0.2, when_good: 0.0, when_bad: 1.0 };
        let ticks = 200_000;
        let lost = acted(&mut sequence(0, ticks, 3, Occurrence::GilbertElliott(channel)), 0..ticks);
        let share = lost.iter().filter(|lost| **lost).count() as f64 / ticks as f64;
        let begun = lost.windows(2).filter(|two| !two[0] && two[1]).count();
        let length = share * ticks as f64 / begun as f64;
        assert!((share - 0.01 / 0.21).abs() < 0.005, "{share}");
        assert!((length - 5.0).abs() < 0.4, "{length}");
        assert!(!lost[0], "a channel begins good");
        let partly = Channel { when_good: 0.5, when_bad: 0.5, ..channel };
        let lost = acted(&mut sequence(0, ticks, 3, Occurrence::GilbertElliott(partly)), 0..ticks);
        let share = lost.iter().filter(|lost| **lost).count() as f64 / ticks as f64;
        assert!((share - 0.5).abs() < 0.005, "equal states give white losses: {share}");
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
        /// No window of K ticks has more than m faults; a worst case has m in every one.
        #[test]
        fn a_weakly_hard_fault_keeps_its_constraint(hard in hard(), from in 0..1000_u64, number in any::<u64>()) {
            let mut sequence = sequence(from, 500, number, Occurrence::WeaklyHard(hard));
            let lost = acted(&mut sequence, from..from + 500);
            let in_window = |window: &[bool]| window.iter().filter(|lost| **lost).count();
            for window in lost.windows(hard.window as usize) {
                prop_assert!(in_window(window) <= hard.misses as usize, "{:?}", hard);
                let worst = !matches!(hard.pattern, Pattern::Random(_));
                prop_assert!(!worst || in_window(window) == hard.misses as usize, "{:?}", hard);
            }
        }

        /// Queries in any order give the same result.
        #[test]
        fn queries_in_any_order_are_consistent(
            occurrence in occurrences(),
            number in any::<u64>(),
            looks in prop::collection::vec(0..300_u64, 1..30),
        ) {
            let straight = acted(&mut sequence(5, 200, number, occurrence), 0..300);
            let mut queried = sequence(5, 200, number, occurrence);
            for tick in looks {
                prop_assert_eq!(queried.acts(tick), straight[tick as usize], "{:?} at {}", occurrence, tick);
            }
        }
    }

    #[test]
    fn random_faults_reach_the_limit_of_the_constraint() {
        let hard = WeaklyHard { misses: 3, window: 10, pattern: Pattern::Random(0.5) };
        let lost = acted(&mut sequence(0, 10_000, 9, Occurrence::WeaklyHard(hard)), 0..10_000);
        let windows = lost.windows(10).map(|window| window.iter().filter(|lost| **lost).count());
        let [full, some] = [3, 1].map(|at_least| windows.clone().filter(|lost| *lost >= at_least).count());
        assert!(full > 5_000 && some > 9_000, "{full} {some}");
    }
}
