//! Scripted faults of a role or of its samples. Kind and ticks are a function of seed and tick alone.
//!
//! Pure: the same fault gives the same bits under every clock and after every restart of a role. This module must not
//! send, wait or count; the runtime applies its decisions.

mod delay;
mod occurrence;

pub use delay::{Delay, Distribution};
pub use occurrence::{Channel, FaultSequence, Occurrence, Pattern, WINDOW_MAX, WeaklyHard};

use crate::model::Noise;
use crate::sample::{Field, FieldKind, Message, Stamp};

/// The size of a word, bytes: every element of a sample is one.
const WORD: usize = 8;
/// The number of words of the stamp at the start of every sample.
const STAMP: usize = size_of::<Stamp>() / WORD;

/// One scripted fault.
#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    /// The first tick at which the fault may act.
    pub from_tick: u64,
    /// The number of ticks during which it may act.
    pub ticks: u64,
    /// The ticks among these at which it acts; evaluated by a [`FaultSequence`].
    pub occurrence: Occurrence,
    /// The seed of its draws; they depend on seed and tick alone.
    pub seed: u64,
    /// The kind of fault.
    pub action: Action,
}

/// The kind of a fault.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Action {
    /// A fault in the content of a sample, before the sample is handed to the link.
    Content(ContentFault),
    /// A fault in the delivery of a sample.
    Transport(Transport),
    /// A fault of the role itself, before it executes the tick.
    Role(Interruption),
}

/// A kind of delivery fault.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Transport {
    /// The sample is never sent.
    Drop,
    /// The sample is sent twice.
    Duplicate,
    /// The sample is sent late.
    Delay(Delay),
}

/// The faulty delivery of one sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// The sample is never sent.
    Dropped,
    /// The sample is sent twice.
    Twice,
    /// The sample is sent this number of ticks late, at least 1.
    Late(u64),
}

/// A kind of role fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interruption {
    /// The role does nothing for a while.
    Stall {
        /// The duration, ns.
        ns: u64,
    },
    /// The role's process is killed, in its first generation only.
    Kill,
    /// The role does not execute the tick.
    Miss,
}

/// A change of a sample's content, with the affected words.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContentFault {
    /// The change.
    pub change: Change,
    /// The affected words.
    pub words: WordRange,
}

/// Consecutive words of 8 bytes of a sample, counted from its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WordRange {
    /// The index of the first word.
    pub first: usize,
    /// The number of words, at least 1.
    pub count: usize,
}

impl WordRange {
    /// Returns all words after the stamp of a sample of `size` bytes.
    pub fn content(size: usize) -> Self {
        Self { first: STAMP, count: size / WORD - STAMP }
    }
}

/// A kind of change of words.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Change {
    /// The words keep their values of the previous sample.
    Freeze,
    /// The words become this number: NaN, infinity, or a value that no body has.
    Set(f64),
    /// One bit of one word is inverted: this bit, or a drawn one. 0 is the least significant.
    Flip(Option<u32>),
    /// White noise of this standard deviation is added.
    Noise(f64),
    /// The words become 0 and are marked as not valid in the word `valid`: bit i for the i-th word after the stamp.
    Lose {
        /// The index of the word that holds the valid bits.
        valid: usize,
    },
}

impl Fault {
    /// Returns true if the fault changes the content of samples.
    pub fn alters_content(&self) -> bool {
        matches!(self.action, Action::Content(_))
    }

    /// Returns the faulty delivery of the sample of `tick`. `None` for other kinds of fault, or if the sample is in
    /// time nevertheless.
    pub fn delivery(&self, tick: u64) -> Option<Delivery> {
        match self.action {
            Action::Transport(Transport::Drop) => Some(Delivery::Dropped),
            Action::Transport(Transport::Duplicate) => Some(Delivery::Twice),
            Action::Transport(Transport::Delay(delay)) => {
                Some(delay.draw(self.draw(tick, 4))).filter(|ticks| *ticks > delay.slack_ticks).map(Delivery::Late)
            }
            _ => None,
        }
    }

    /// Changes the content of the sample of `tick` if the fault is of that kind. `last` is the sample sent before.
    pub fn alter_content<S: Message + ?Sized>(&self, tick: u64, sample: &mut S, last: &S) {
        let Action::Content(ContentFault { change, words }) = self.action else { return };
        let (last, sample) = (last.words(), sample.words_mut());
        let range = words.first..words.first + words.count;
        match change {
            Change::Freeze => sample[range.clone()].copy_from_slice(&last[range]),
            Change::Set(value) => sample[range].fill(value.to_bits()),
            Change::Flip(bit) => {
                let word = words.first + (self.draw(tick, 1) % words.count as u64) as usize;
                sample[word] ^= 1 << bit.map_or(self.draw(tick, 2) % 64, u64::from);
            }
            Change::Noise(deviation) => {
                let mut noise = Noise::<1>::new(self.seed, tick, [deviation], [0.0]);
                for word in &mut sample[range] {
                    *word = (f64::from_bits(*word) + noise.sample().x).to_bits();
                }
            }
            Change::Lose { valid } => {
                for word in range {
                    sample[word] = 0;
                    sample[valid] &= !(1 << (word - STAMP));
                }
            }
        }
    }

    /// Draws a number that is specific to this fault, tick and purpose.
    fn draw(&self, tick: u64, purpose: u64) -> u64 {
        mix(mix(self.seed ^ purpose.rotate_left(48)) ^ tick)
    }
}

/// Returns the words and the type of the field `name`. `fields` are those after the stamp; `tick` and `generation` of
/// the stamp are found too.
pub fn field(fields: &[Field], name: &str) -> Option<(WordRange, FieldKind)> {
    let stamp = [("tick", 0), ("generation", 1)].into_iter().find(|(known, _)| *known == name);
    let of_stamp = stamp.map(|(_, first)| (WordRange { first, count: 1 }, FieldKind::U64));
    let of_content = || {
        let field = fields.iter().find(|field| field.name == name)?;
        Some((WordRange { first: field.offset / WORD, count: field.count }, field.kind))
    };
    of_stamp.or_else(of_content)
}

/// Returns the seed of the fault with this number in a scenario's list. An additional fault does not change the draws
/// of others.
pub fn seed(scenario: u64, number: u64) -> u64 {
    mix(mix(scenario) ^ number.rotate_left(32))
}

/// Computes the finaliser of SplitMix64: every bit of the result depends on every bit of the argument.
pub fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ value >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ value >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ value >> 31
}

/// Converts a draw to a number in \[0, 1).
pub fn unit(draw: u64) -> f64 {
    (draw >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{RateMeasurement, Sample};

    fn fault(change: Change, words: WordRange) -> Fault {
        let action = Action::Content(ContentFault { change, words });
        Fault { from_tick: 10, ticks: 3, occurrence: Occurrence::Independent(1.0), seed: seed(7, 0), action }
    }

    fn sample() -> RateMeasurement {
        RateMeasurement {
            stamp: Stamp { tick: 10, generation: 1, ..Stamp::default() },
            omega_rad_s: [0.1, 0.2, 0.3],
            applied_rad_s2: [1.0, 2.0, 3.0],
            valid: 7,
            status: 0,
        }
    }

    fn tampered(fault: &Fault, tick: u64) -> RateMeasurement {
        let mut tampered = sample();
        fault.alter_content(tick, &mut tampered, &RateMeasurement { omega_rad_s: [9.0; 3], ..sample() });
        tampered
    }

    fn omega() -> WordRange {
        field(RateMeasurement::FIELDS, "omega_rad_s").unwrap().0
    }

    #[test]
    fn every_change_affects_only_its_words() {
        let second = WordRange { first: omega().first + 1, count: 1 };
        assert_eq!(tampered(&fault(Change::Freeze, second), 10).omega_rad_s, [0.1, 9.0, 0.3]);
        assert_eq!(tampered(&fault(Change::Set(5.0), second), 10).omega_rad_s, [0.1, 5.0, 0.3]);
        assert!(tampered(&fault(Change::Set(f64::NAN), omega()), 10).omega_rad_s.iter().all(|value| value.is_nan()));
        assert_eq!(tampered(&fault(Change::Flip(Some(63)), second), 10).omega_rad_s, [0.1, -0.2, 0.3]);
        let valid = field(RateMeasurement::FIELDS, "valid").unwrap().0.first;
        let lost = tampered(&fault(Change::Lose { valid }, second), 10);
        assert_eq!(lost, RateMeasurement { omega_rad_s: [0.1, 0.0, 0.3], valid: 0b101, ..sample() });
        let noisy = tampered(&fault(Change::Noise(1.0), omega()), 10);
        assert!(noisy.omega_rad_s.iter().zip(sample().omega_rad_s).all(|(noisy, was)| *noisy != was));
        assert_eq!((noisy.applied_rad_s2, noisy.stamp), (sample().applied_rad_s2, sample().stamp));
    }

    #[test]
    fn draws_depend_on_seed_and_tick_alone() {
        let flip = fault(Change::Flip(None), WordRange::content(size_of::<RateMeasurement>()));
        assert_eq!(tampered(&flip, 10), tampered(&flip, 10));
        let reseeded = Fault { seed: seed(8, 0), ..flip.clone() };
        let differ = |a: &Fault, b: &Fault| (0..64).filter(|tick| tampered(a, *tick) != tampered(b, *tick)).count();
        assert!(differ(&flip, &reseeded) > 50);
        assert!(differ(&flip, &Fault { seed: seed(7, 1), ..flip.clone() }) > 50);
        let changed = |tick| {
            let (before, after) = (sample(), tampered(&flip, tick));
            let bits = |a: &RateMeasurement, b: &RateMeasurement| -> u32 {
                let pairs = bytemuck::bytes_of(a).iter().zip(bytemuck::bytes_of(b));
                pairs.map(|(a, b)| (a ^ b).count_ones()).sum()
            };
            bits(&before, &after)
        };
        assert!((0..1000).all(|tick| changed(tick) == 1), "one bit, every time");
    }

    #[test]
    fn fields_of_content_and_stamp_are_found_by_name() {
        assert_eq!(field(RateMeasurement::FIELDS, "tick"), Some((WordRange { first: 0, count: 1 }, FieldKind::U64)));
        assert_eq!(
            field(RateMeasurement::FIELDS, "applied_rad_s2"),
            Some((WordRange { first: 7, count: 3 }, FieldKind::F64))
        );
        assert_eq!(field(RateMeasurement::FIELDS, "sent_ns"), None);
        assert_eq!(WordRange::content(size_of::<RateMeasurement>()), WordRange { first: 4, count: 8 });
    }
}
