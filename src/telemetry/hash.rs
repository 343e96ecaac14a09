//! The state hash: one number for everything that was published, so that two runs can be compared at a glance.
//!
//! It covers ticks and values, no generation and no time. Checkpoints make it comparable up to any tick.

use super::ledger::{Ledger, Words};
use crate::sample::Message;
use xxhash_rust::xxh3::{xxh3_64, xxh3_64_with_seed};

/// The most checkpoints that a writer keeps; longer runs keep every second, third, … tick.
const MAX_CHECKPOINTS: u64 = 16_384;

/// The hash of one signal, chained over its samples (XXH3-64, each sample's hash seeded by the last).
#[derive(Debug)]
pub struct StateHash {
    words: Words,
    stride: u64,
    capacity: u64,
    /// After how many ticks the next checkpoint is: seldom, so that a comparison must do.
    due: u64,
}

/// The hashes of one signal after ticks stride − 1, 2·stride − 1, …
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Checkpoints {
    /// Ticks per checkpoint.
    pub stride: u64,
    /// The hash over all samples of the first (n + 1)·stride ticks.
    pub hashes: Vec<u64>,
    /// The hash over all samples.
    pub last: u64,
}

impl StateHash {
    const VALUE: usize = 0;
    /// How many checkpoints there are; they follow.
    const COUNT: usize = 1;
    const FIRST: usize = 2;

    /// Words of the ledger for a run whose last tick is `last_tick`.
    pub fn words(last_tick: u64) -> usize {
        Self::FIRST + Self::capacity(last_tick) as usize
    }

    /// Ticks per checkpoint.
    fn stride(last_tick: u64) -> u64 {
        (last_tick + 1).div_ceil(MAX_CHECKPOINTS).max(1)
    }

    fn capacity(last_tick: u64) -> u64 {
        (last_tick + 1) / Self::stride(last_tick)
    }

    /// Opens the hash of a run whose last tick is `last_tick`, as it was left.
    pub fn open(ledger: &Ledger, last_tick: u64) -> Self {
        let words = ledger.take(Self::words(last_tick));
        let mut hash = Self { words, stride: Self::stride(last_tick), capacity: Self::capacity(last_tick), due: 0 };
        hash.checkpoint(0);
        hash
    }

    /// Takes in a sample. Ticks rise.
    #[inline]
    pub fn absorb(&mut self, sample: &(impl Message + ?Sized)) {
        let tick = sample.stamp().tick;
        if tick >= self.due {
            self.checkpoint(tick);
        }
        let value = self.words.get(Self::VALUE) ^ tick.rotate_left(32);
        self.words.set(Self::VALUE, xxh3_64_with_seed(sample.content(), value));
        if tick.saturating_add(1) >= self.due {
            self.checkpoint(tick.saturating_add(1));
        }
    }

    /// Notes the hash for every checkpoint up to `ticks` that has passed since the last sample.
    #[cold]
    fn checkpoint(&mut self, ticks: u64) {
        let mut count = self.words.get(Self::COUNT);
        while (count + 1) * self.stride <= ticks && count < self.capacity {
            self.words.set(Self::FIRST + count as usize, self.words.get(Self::VALUE));
            count += 1;
            self.words.set(Self::COUNT, count);
        }
        self.due = if count < self.capacity { (count + 1) * self.stride } else { u64::MAX };
    }

    /// What has been gathered.
    pub fn checkpoints(&self) -> Checkpoints {
        let count = self.words.get(Self::COUNT).min(self.capacity) as usize;
        Checkpoints {
            stride: self.stride,
            hashes: (0..count).map(|index| self.words.get(Self::FIRST + index)).collect(),
            last: self.words.get(Self::VALUE),
        }
    }
}

/// One hash for several signals' hashes; the order matters.
pub fn combine(hashes: impl IntoIterator<Item = u64>) -> u64 {
    let bytes: Vec<u8> = hashes.into_iter().flat_map(u64::to_le_bytes).collect();
    xxh3_64(&bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{RateCommand, Stamp};

    fn sample(tick: u64, value: f64, sent_ns: u64) -> RateCommand {
        let stamp = Stamp { tick, sent_ns, origin_ns: sent_ns / 2, generation: sent_ns };
        RateCommand { stamp, acceleration_rad_s2: [value, 0.0, 0.0], ..RateCommand::default() }
    }

    fn open(last_tick: u64) -> StateHash {
        StateHash::open(&Ledger::private(StateHash::words(last_tick)), last_tick)
    }

    fn hash(samples: &[(u64, f64, u64)]) -> Checkpoints {
        let mut hash = open(9);
        samples.iter().for_each(|&(tick, value, sent)| hash.absorb(&sample(tick, value, sent)));
        hash.checkpoints()
    }

    #[test]
    fn depends_on_ticks_and_values_and_on_no_time() {
        let reference = hash(&[(0, 1.0, 5), (1, 2.0, 6)]).last;
        assert_eq!(reference, hash(&[(0, 1.0, 50), (1, 2.0, 60)]).last);
        for other in [[(0, 1.0, 5), (2, 2.0, 6)], [(0, 1.0, 5), (1, -2.0, 6)], [(0, 2.0, 5), (1, 1.0, 6)]] {
            assert_ne!(reference, hash(&other).last);
        }
    }

    #[test]
    fn checkpoints_agree_up_to_the_first_difference_and_stay_aligned_across_gaps() {
        let (whole, gap) = (
            hash(&[(0, 1.0, 0), (1, 2.0, 0), (2, 3.0, 0), (3, 4.0, 0)]),
            hash(&[(0, 1.0, 0), (1, 2.0, 0), (3, 4.0, 0)]),
        );
        assert_eq!(whole.hashes.len(), gap.hashes.len());
        assert_eq!(whole.hashes[..2], gap.hashes[..2]);
        assert_eq!(gap.hashes[2], gap.hashes[1], "nothing was published at tick 2");
        assert_ne!(whole.hashes[3], gap.hashes[3]);
        assert_eq!(whole.hashes[3], whole.last);
    }

    #[test]
    fn a_long_run_keeps_a_bounded_number_of_checkpoints() {
        let mut hash = open(MAX_CHECKPOINTS * 5);
        (0..=MAX_CHECKPOINTS * 5).for_each(|tick| hash.absorb(&sample(tick, 0.5, 0)));
        let count = hash.checkpoints().hashes.len() as u64;
        assert_eq!(count, hash.capacity);
        assert!(count <= MAX_CHECKPOINTS && hash.stride == 6);
    }

    #[test]
    fn a_successor_continues_the_chain() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("books");
        for tick in 0..4 {
            let ledger = Ledger::shared(&path, StateHash::words(9)).unwrap();
            StateHash::open(&ledger, 9).absorb(&sample(tick, tick as f64, 0));
        }
        let ledger = Ledger::shared(&path, StateHash::words(9)).unwrap();
        let whole = hash(&[(0, 0.0, 0), (1, 1.0, 0), (2, 2.0, 0), (3, 3.0, 0)]);
        assert_eq!(StateHash::open(&ledger, 9).checkpoints(), whole);
    }
}
