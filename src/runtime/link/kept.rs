//! The last samples of a signal in lockstep, where they outlive both ends of the link.
//!
//! What was on its way between two processes that die together is lost with them, and in lockstep nobody goes on without it:
//! the successor of the reader finds it here. Must not be looked at otherwise: the link is the way.

use crate::telemetry::{Ledger, Slots};
use std::sync::atomic::{Ordering, fence};

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

    fn begin(&self, tick: u64) -> usize {
        (tick % self.ticks) as usize * (1 + self.length)
    }

    /// Keeps what is sent for a tick.
    #[inline]
    pub fn keep(&self, tick: u64, words: impl Iterator<Item = u64>) {
        let begin = self.begin(tick);
        self.slots.set(begin, 0);
        // Whoever sees one of the words that follow sees that the one before is gone.
        fence(Ordering::Release);
        (begin + 1..).zip(words.take(self.length)).for_each(|(index, word)| self.slots.set(index, word));
        fence(Ordering::Release);
        self.slots.set(begin, tick + 1);
    }

    /// Copies what was sent for a tick; false if it is not kept, and then the words are of no use.
    pub fn find(&self, tick: u64, words: &mut [u64]) -> bool {
        let begin = self.begin(tick);
        let kept = || self.slots.get(begin) == tick + 1;
        if !kept() {
            return false;
        }
        fence(Ordering::Acquire);
        (begin + 1..).zip(words).for_each(|(index, word)| *word = self.slots.get(index));
        fence(Ordering::Acquire);
        kept()
    }
}
