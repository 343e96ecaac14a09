//! Inputs: quantities of a loop that change while it runs. Their value is a function of the changes and of the tick.
//!
//! Pure: the same changes give the same bits under every clock and after every restart of a role. This module must not know
//! what an input means, nor where its changes come from.

use crate::sample::{InputChange, Stamp};
use core::f64::consts::TAU;

/// The most components of an input.
pub const COMPONENTS_MAX: usize = 6;
/// The number of words of a [`Change`].
pub const CHANGE_WORDS: usize = 6 + COMPONENTS_MAX;

/// The values of an input; components beyond its own are zero.
pub type Values = [f64; COMPONENTS_MAX];

/// A change of one input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Change {
    /// The tick from which it acts.
    pub tick: u64,
    /// The number of the input in its scenario.
    pub input: usize,
    /// The course of the change.
    pub shape: Shape,
    /// The new level for [`Shape::Step`] and [`Shape::Ramp`], otherwise the amplitude that is added to the level.
    pub values: Values,
}

/// The course of a change over time. Frequencies are in cycles per tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// The new level, at once.
    Step,
    /// A straight line from the present level to the new one.
    Ramp {
        /// The length, ticks.
        ticks: u64,
    },
    /// The same as a ramp, to the next row of a table.
    Row {
        /// The length, ticks.
        ticks: u64,
    },
    /// The amplitude, constant.
    Pulse {
        /// The length, ticks.
        ticks: u64,
    },
    /// A sine that begins at phase 0.
    Sine {
        /// The length, ticks.
        ticks: u64,
        /// The frequency.
        frequency: f64,
    },
    /// A sine whose frequency changes linearly.
    Chirp {
        /// The length, ticks.
        ticks: u64,
        /// The first frequency.
        frequency: f64,
        /// The last frequency.
        end_frequency: f64,
    },
    /// A pseudo-random binary sequence: plus or minus the amplitude.
    Prbs {
        /// The length, ticks.
        ticks: u64,
        /// The number of ticks for which a value is held, at least 1.
        hold_ticks: u64,
        /// The seed of the sequence.
        seed: u64,
    },
}

impl Shape {
    /// The names of all shapes, in the order of their numbers.
    pub const NAMES: [&str; 6] = ["step", "ramp", "pulse", "sine", "chirp", "prbs"];

    /// Returns true if it sets the level, false if it adds to the level for a while.
    pub fn sets_level(&self) -> bool {
        matches!(self, Self::Step | Self::Ramp { .. } | Self::Row { .. })
    }

    /// Returns the length, ticks; 0 for a step.
    pub fn ticks(&self) -> u64 {
        match *self {
            Self::Step => 0,
            Self::Ramp { ticks }
            | Self::Row { ticks }
            | Self::Pulse { ticks }
            | Self::Sine { ticks, .. }
            | Self::Chirp { ticks, .. }
            | Self::Prbs { ticks, .. } => ticks,
        }
    }

    /// Returns the factor of the amplitude `elapsed` ticks after the begin; of a level, the part of the way.
    fn factor(&self, elapsed: u64) -> f64 {
        let n = elapsed as f64;
        match *self {
            Self::Step | Self::Pulse { .. } => 1.0,
            Self::Ramp { ticks } | Self::Row { ticks } => n / ticks as f64,
            Self::Sine { frequency, .. } => libm::sin(TAU * (frequency * n)),
            Self::Chirp { ticks, frequency, end_frequency } => {
                let slope = (end_frequency - frequency) / ticks as f64;
                libm::sin(TAU * (frequency * n + 0.5 * slope * n * n))
            }
            Self::Prbs { hold_ticks, seed, .. } => {
                let bit = crate::fault::seed(seed, elapsed / hold_ticks.max(1)) >> 63;
                if bit == 0 { 1.0 } else { -1.0 }
            }
        }
    }

    fn words(&self) -> [u64; 4] {
        match *self {
            Self::Step => [0; 4],
            Self::Ramp { ticks } => [1, ticks, 0, 0],
            Self::Pulse { ticks } => [2, ticks, 0, 0],
            Self::Sine { ticks, frequency } => [3, ticks, frequency.to_bits(), 0],
            Self::Chirp { ticks, frequency, end_frequency } => [4, ticks, frequency.to_bits(), end_frequency.to_bits()],
            Self::Prbs { ticks, hold_ticks, seed } => [5, ticks, hold_ticks, seed],
            Self::Row { ticks } => [6, ticks, 0, 0],
        }
    }

    fn from_words([number, ticks, first, second]: [u64; 4]) -> Option<Self> {
        let frequency = f64::from_bits(first);
        Some(match number {
            0 => Self::Step,
            1 => Self::Ramp { ticks },
            2 => Self::Pulse { ticks },
            3 => Self::Sine { ticks, frequency },
            4 => Self::Chirp { ticks, frequency, end_frequency: f64::from_bits(second) },
            5 => Self::Prbs { ticks, hold_ticks: first, seed: second },
            6 => Self::Row { ticks },
            _ => return None,
        })
    }
}

impl Change {
    /// Returns the change as words.
    pub fn words(&self) -> [u64; CHANGE_WORDS] {
        let mut words = [0; CHANGE_WORDS];
        let (head, values) = words.split_at_mut(6);
        let [number, ticks, first, second] = self.shape.words();
        head.copy_from_slice(&[self.tick, self.input as u64, number, ticks, first, second]);
        values.iter_mut().zip(self.values).for_each(|(word, value)| *word = value.to_bits());
        words
    }

    /// Returns the change as the sample with this number, with the tick as its stamp.
    pub fn sample(&self, number: u64) -> InputChange {
        let [shape, length_ticks, first, second] = self.shape.words();
        InputChange {
            stamp: Stamp { tick: self.tick, generation: 1, ..Stamp::default() },
            number,
            input: self.input as u64,
            shape,
            length_ticks,
            parameters: [first, second],
            values: self.values,
        }
    }

    /// Returns the change with these words; `None` if no change has them.
    pub fn from_words(words: &[u64; CHANGE_WORDS]) -> Option<Self> {
        let [tick, input, number, ticks, first, second, values @ ..] = *words;
        let shape = Shape::from_words([number, ticks, first, second])?;
        Some(Self { tick, input: usize::try_from(input).ok()?, shape, values: values.map(f64::from_bits) })
    }
}

/// The course of one input: its level, and what is added to it at present.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Course {
    from: Values,
    level: Change,
    added: Option<Change>,
}

impl Course {
    /// Creates the course of an input that keeps its initial values until the first change.
    pub fn new(initial: Values) -> Self {
        let level = Change { tick: 0, input: 0, shape: Shape::Step, values: initial };
        Self { from: initial, level, added: None }
    }

    /// Adds a change. Changes are added in the order of their ticks.
    pub fn enter(&mut self, change: &Change) {
        if change.shape.sets_level() {
            self.from = self.level_at(change.tick);
            self.level = *change;
        } else {
            self.added = Some(*change);
        }
    }

    fn level_at(&self, tick: u64) -> Values {
        let elapsed = tick.saturating_sub(self.level.tick);
        if elapsed >= self.level.shape.ticks() {
            return self.level.values;
        }
        let part = self.level.shape.factor(elapsed);
        core::array::from_fn(|i| self.from[i] + (self.level.values[i] - self.from[i]) * part)
    }

    /// Returns the values at a tick, at or after that of the last change.
    pub fn at(&self, tick: u64) -> Values {
        let mut values = self.level_at(tick);
        if let Some(added) = self.added.filter(|added| is_under_way(added, tick)) {
            let factor = added.shape.factor(tick - added.tick);
            values.iter_mut().zip(added.values).for_each(|(value, amplitude)| *value += amplitude * factor);
        }
        values
    }

    /// Returns true if the values at the next tick may differ from those at this one, without another change.
    pub fn moves(&self, tick: u64) -> bool {
        is_under_way(&self.level, tick) || self.added.is_some_and(|added| is_under_way(&added, tick))
    }
}

fn is_under_way(change: &Change, tick: u64) -> bool {
    tick.checked_sub(change.tick).is_some_and(|elapsed| elapsed < change.shape.ticks())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn change(tick: u64, shape: Shape, value: f64) -> Change {
        let mut values = [0.0; COMPONENTS_MAX];
        values[0] = value;
        Change { tick, input: 3, shape, values }
    }

    fn first(course: &Course, ticks: core::ops::RangeInclusive<u64>) -> Vec<f64> {
        ticks.map(|tick| course.at(tick)[0]).collect()
    }

    #[test]
    fn a_ramp_begins_at_the_present_level_even_within_another() {
        let mut course = Course::new([1.0, 2.0, 0.0, 0.0, 0.0, 0.0]);
        course.enter(&change(10, Shape::Ramp { ticks: 4 }, 3.0));
        assert_eq!(first(&course, 9..=15), [1.0, 1.0, 1.5, 2.0, 2.5, 3.0, 3.0]);
        assert!(course.moves(13) && !course.moves(14));
        course.enter(&change(12, Shape::Ramp { ticks: 2 }, 0.0));
        assert_eq!(first(&course, 12..=15), [2.0, 1.0, 0.0, 0.0]);
        course.enter(&change(20, Shape::Step, -0.0));
        assert_eq!(course.at(20)[0].to_bits(), (-0.0_f64).to_bits());
        assert!(!course.moves(20));
    }

    #[test]
    fn an_excitation_is_added_to_the_level_and_ends() {
        let mut course = Course::new([1.0; COMPONENTS_MAX]);
        course.enter(&change(5, Shape::Pulse { ticks: 2 }, 10.0));
        assert_eq!(first(&course, 4..=7), [1.0, 11.0, 11.0, 1.0]);
        assert!(course.moves(6) && !course.moves(7), "the tick after the last one differs");
        course.enter(&change(6, Shape::Step, 2.0));
        assert_eq!(first(&course, 6..=7), [12.0, 2.0]);
        course.enter(&change(8, Shape::Sine { ticks: 8, frequency: 0.25 }, 1.0));
        let sine = first(&course, 8..=11);
        assert!(sine.iter().zip([2.0, 3.0, 2.0, 1.0]).all(|(a, b)| (a - b).abs() < 1e-15), "{sine:?}");
    }

    #[test]
    fn a_binary_sequence_is_balanced_and_held() {
        let mut course = Course::new([0.0; COMPONENTS_MAX]);
        course.enter(&change(0, Shape::Prbs { ticks: 30_000, hold_ticks: 3, seed: 7 }, 2.0));
        let values = first(&course, 0..=29_999);
        assert!(values.chunks(3).all(|held| held == [held[0]; 3]) && values.iter().all(|value| value.abs() == 2.0));
        assert!((values.iter().sum::<f64>() / 60_000.0).abs() < 0.03);
    }

    #[test]
    fn a_chirp_passes_through_its_frequencies() {
        let mut course = Course::new([0.0; COMPONENTS_MAX]);
        course.enter(&change(0, Shape::Chirp { ticks: 100_000, frequency: 0.001, end_frequency: 0.01 }, 1.0));
        let values = first(&course, 0..=99_999);
        let crossings = values.windows(2).filter(|pair| pair[0] <= 0.0 && pair[1] > 0.0).count();
        // The mean frequency times the length.
        assert!((549..=551).contains(&crossings), "{crossings}");
    }

    #[test]
    fn words_keep_a_change() {
        let shapes = [
            Shape::Step,
            Shape::Ramp { ticks: 9 },
            Shape::Pulse { ticks: u64::MAX },
            Shape::Sine { ticks: 9, frequency: 0.1 },
            Shape::Chirp { ticks: 9, frequency: 0.1, end_frequency: 0.2 },
            Shape::Prbs { ticks: 9, hold_ticks: 2, seed: 3 },
            Shape::Row { ticks: u64::MAX },
        ];
        for shape in shapes {
            let written = change(u64::MAX, shape, -0.0);
            assert_eq!(Change::from_words(&written.words()), Some(written));
        }
        assert_eq!(Change::from_words(&[7; CHANGE_WORDS]), None);
    }

    proptest! {
        /// Whatever comes from outside, evaluation neither panics nor divides by zero.
        #[test]
        fn any_words_give_a_course(words: [u64; CHANGE_WORDS], tick: u64) {
            let mut course = Course::new([0.0; COMPONENTS_MAX]);
            if let Some(change) = Change::from_words(&words) {
                course.enter(&change);
                let _ = (course.at(tick), course.at(change.tick.saturating_add(1)), course.moves(tick));
            }
        }
    }
}
