//! The last samples of a signal in lockstep, where they outlive both ends of the link.
//!
//! What was on its way between two processes that die together is lost with them, and in lockstep nobody goes on without it:
//! the successor of the reader finds it here. Must not be looked at otherwise: the link is the way.

use crate::telemetry::{Ledger, Slots, find, keep};
use std::sync::atomic::AtomicU64;

/// So many samples in the ledger of their writer, each in the place of the one that many ticks before it. Beside the words of
/// a sample there is its tick + 1, or 0 while they are written.
#[derive(Debug)]
pub struct Kept {
    slots: Slots,
    ticks: u64,
    length: usize,
}

impl Kept {
    /// Words of the ledger for samples of so many words and so many ticks.
    pub fn words(ticks: u64, length: usize) -> usize {
        ticks as usize * (1 + length)
    }

    /// Takes the words from a ledger. Nothing is kept of no ticks, nor where nobody could find it.
    pub fn open(ledger: &Ledger, ticks: u64, length: usize) -> Option<Self> {
        let slots = ledger.take(Self::words(ticks, length));
        (ticks > 0 && ledger.is_shared()).then_some(Self { slots, ticks, length })
    }

    #[inline]
    fn place(&self, tick: u64) -> &[AtomicU64] {
        let begin = (tick % self.ticks) as usize * (1 + self.length);
        &self.slots.words()[begin..=begin + self.length]
    }

    /// Keeps what is sent for a tick.
    #[inline]
    pub fn keep(&self, tick: u64, words: impl Iterator<Item = u64>) {
        keep(self.place(tick), tick, words);
    }

    /// Copies what was sent for a tick; false if it is not kept, and then the words are of no use.
    pub fn find(&self, tick: u64, words: &mut [u64]) -> bool {
        find(self.place(tick), tick, words)
    }
}
