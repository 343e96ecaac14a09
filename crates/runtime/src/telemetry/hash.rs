//! The state hash: one number over everything that was published, to compare two runs.
//!
//! It covers ticks and values, but no generations and no times. Checkpoints make it comparable up to any tick.

use super::ledger::{Ledger, Slots};
use crate::state::{Persist, Words};
use xxhash_rust::xxh3::{xxh3_64, xxh3_64_with_seed};

/// The largest number of checkpoints per writer. Longer runs keep every second, third, … tick.
const MAX_CHECKPOINTS: u64 = 16_384;

/// The hash of one signal, chained over its samples (XXH3-64, each sample's hash seeded by the last).
#[derive(Debug)]
pub struct StateHash {
    value: u64,
    /// The number of valid checkpoints. A process that died before it counted may have written more.
    count: u64,
    checkpoints: Slots,
    stride: u64,
    capacity: u64,
    /// The number of ticks after which the next checkpoint is due, even if there is no room for it.
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
    /// Returns the number of ledger words for a run whose last tick is `last_tick`.
    pub fn words(last_tick: u64) -> usize {
        Self::capacity(last_tick) as usize
    }

    /// Returns the number of ticks per checkpoint.
    fn stride(last_tick: u64) -> u64 {
        (last_tick + 1).div_ceil(MAX_CHECKPOINTS).max(1)
    }

    fn capacity(last_tick: u64) -> u64 {
        (last_tick + 1) / Self::stride(last_tick)
    }

    /// Creates the hash of a run whose last tick is `last_tick`, over no samples.
    pub fn open(ledger: &Ledger, last_tick: u64) -> Self {
        let checkpoints = ledger.take(Self::words(last_tick));
        let (stride, capacity) = (Self::stride(last_tick), Self::capacity(last_tick));
        Self { value: 0, count: 0, checkpoints, stride, capacity, due: stride }
    }

    /// Adds the sample content of a tick. Ticks must rise.
    #[inline(always)]
    pub fn absorb(&mut self, tick: u64, content: &[u8]) {
        if tick >= self.due {
            self.pass(tick);
        }
        self.value = chained(self.value, tick, content);
        if tick.saturating_add(1) >= self.due {
            self.checkpoint();
        }
    }

    /// Stores the hash at every checkpoint up to `ticks` that has passed since the last sample.
    #[cold]
    fn pass(&mut self, ticks: u64) {
        while self.due <= ticks && self.count < self.capacity {
            self.checkpoint();
        }
    }

    /// Stores the hash at the checkpoint that is due.
    #[inline(never)]
    fn checkpoint(&mut self) {
        if self.count < self.capacity {
            self.checkpoints.set(self.count as usize, self.value);
            self.count += 1;
            self.due += self.stride;
        } else {
            self.due = u64::MAX;
        }
    }

    /// Returns the checkpoints and the hash over all samples.
    pub fn checkpoints(&self) -> Checkpoints {
        let count = self.count.min(self.capacity) as usize;
        Checkpoints {
            stride: self.stride,
            hashes: (0..count).map(|index| self.checkpoints.get(index)).collect(),
            last: self.value,
        }
    }
}

impl Persist for StateHash {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.value.persist(words);
        self.count.persist(words);
        self.due = self.count.saturating_add(1).saturating_mul(self.stride);
    }
}

/// Returns the hash of a signal after the sample of a tick, from the hash before it. Inlined, because a length known at compile time
/// halves the cost.
#[inline(always)]
pub fn chained(before: u64, tick: u64, content: &[u8]) -> u64 {
    xxh3_64_with_seed(content, before ^ tick.rotate_left(32))
}

/// The checkpoints of several signals that all have a sample at every tick.
#[derive(Debug)]
pub struct CommonCheckpoints {
    /// The hashes of all signals at the first checkpoint, then at the second one, …
    hashes: Vec<u64>,
    signals: usize,
    stride: u64,
    due: u64,
}

impl CommonCheckpoints {
    /// Creates the checkpoints of a run whose last tick is `last_tick`; without one, nothing is stored.
    pub fn new(signals: usize, last_tick: Option<u64>) -> Self {
        let (stride, capacity) = last_tick.map_or((1, 0), |last| (StateHash::stride(last), StateHash::capacity(last)));
        let due = last_tick.map_or(u64::MAX, |_| stride);
        Self { hashes: Vec::with_capacity(signals * capacity as usize), signals, stride, due }
    }

    /// Returns true if a checkpoint is due after this tick. Its hashes must then be stored. Ticks must rise by one.
    #[inline(always)]
    pub fn is_due(&mut self, tick: u64) -> bool {
        let due = tick + 1 == self.due;
        if due {
            self.due += self.stride;
        }
        due
    }

    /// Stores the hashes of the next signals at the checkpoint that is due.
    #[inline(always)]
    pub fn store(&mut self, hashes: &[u64]) {
        self.hashes.extend_from_slice(hashes);
    }

    /// Returns the checkpoints of a signal, whose hash over all samples is `last`.
    pub fn of_signal(&self, signal: usize, last: u64) -> Checkpoints {
        let hashes = self.hashes.iter().skip(signal).step_by(self.signals).copied().collect();
        Checkpoints { stride: self.stride, hashes, last }
    }
}

/// Combines the hashes of several signals into one; the order matters.
pub fn combine(hashes: impl IntoIterator<Item = u64>) -> u64 {
    let bytes: Vec<u8> = hashes.into_iter().flat_map(u64::to_le_bytes).collect();
    xxh3_64(&bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{Message, RateCommand, Stamp};
    use crate::state::StoredWords;

    fn sample(tick: u64, value: f64, sent_ns: u64) -> RateCommand {
        let stamp = Stamp { tick, sent_ns, origin_ns: sent_ns / 2, generation: sent_ns };
        RateCommand { stamp, acceleration_rad_s2: [value, 0.0, 0.0], ..RateCommand::default() }
    }

    fn open(last_tick: u64) -> StateHash {
        StateHash::open(&Ledger::private(StateHash::words(last_tick)), last_tick)
    }

    fn hash(samples: &[(u64, f64, u64)]) -> Checkpoints {
        let mut hash = open(9);
        samples.iter().for_each(|&(tick, value, sent)| hash.absorb(tick, sample(tick, value, sent).content()));
        hash.checkpoints()
    }

    #[test]
    fn depends_on_ticks_and_values_but_not_on_time() {
        let reference = hash(&[(0, 1.0, 5), (1, 2.0, 6)]).last;
        assert_eq!(reference, hash(&[(0, 1.0, 50), (1, 2.0, 60)]).last);
        for changed in [[(0, 1.0, 5), (2, 2.0, 6)], [(0, 1.0, 5), (1, -2.0, 6)], [(0, 2.0, 5), (1, 1.0, 6)]] {
            assert_ne!(reference, hash(&changed).last);
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
        (0..=MAX_CHECKPOINTS * 5).for_each(|tick| hash.absorb(tick, sample(tick, 0.5, 0).content()));
        let count = hash.checkpoints().hashes.len() as u64;
        assert_eq!(count, hash.capacity);
        assert!(count <= MAX_CHECKPOINTS && hash.stride == 6);
    }

    #[test]
    fn a_successor_continues_the_chain() {
        let ledger = Ledger::private(StateHash::words(9));
        let mut kept = [0; 2];
        for tick in 0..4 {
            let mut hash = StateHash::open(&ledger.reopened(), 9);
            hash.persist(&mut StoredWords(&kept));
            hash.absorb(tick, sample(tick, tick as f64, 0).content());
            kept = [hash.value, hash.count];
        }
        let whole = self::hash(&[(0, 0.0, 0), (1, 1.0, 0), (2, 2.0, 0), (3, 3.0, 0)]);
        let mut hash = StateHash::open(&ledger.reopened(), 9);
        hash.persist(&mut StoredWords(&kept));
        assert_eq!(hash.checkpoints(), whole);
    }
}
