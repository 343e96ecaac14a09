//! The last samples of a signal in lockstep, where they outlive both ends of the link.
//!
//! What was on its way to a process that dies is lost with it, and whoever continues a writer sends again what it may not have
//! sent. In lockstep nobody goes on without what is lost, and nothing may count twice: a reader finds here what was sent, once
//! each and in order. Must not be looked at otherwise: the link is the way.

use crate::telemetry::{Ledger, Slots, find, keep};
use std::sync::atomic::{AtomicU64, Ordering};

/// So many samples in the ledger of their writer, each in the place of the one that many before it. Beside the words of a
/// sample there is its number + 1, or 0 while they are written. The first that is sent has number 0.
#[derive(Debug)]
pub struct RetainedSamples {
    slots: Slots,
    samples: u64,
    length: usize,
}

impl RetainedSamples {
    /// Words of the ledger for so many samples of so many words.
    pub fn words(samples: u64, length: usize) -> usize {
        samples as usize * (1 + length)
    }

    /// Takes the words from a ledger. Nothing is kept of no samples, nor where nobody could find it.
    pub fn open(ledger: &Ledger, samples: u64, length: usize) -> Option<Self> {
        let slots = ledger.take(Self::words(samples, length));
        (samples > 0 && ledger.is_shared()).then_some(Self { slots, samples, length })
    }

    #[inline]
    fn place(&self, number: u64) -> &[AtomicU64] {
        let begin = (number % self.samples) as usize * (1 + self.length);
        &self.slots.words()[begin..=begin + self.length]
    }

    /// Keeps what is sent under a number.
    #[inline]
    pub fn keep(&self, number: u64, words: impl Iterator<Item = u64>) {
        keep(self.place(number), number, words);
    }

    /// Copies what was sent under a number; false if it is not kept, and then the words are of no use.
    pub fn find(&self, number: u64, words: &mut [u64]) -> bool {
        find(self.place(number), number, words)
    }

    /// Whether the writer has ever kept anything: a foreign program does not.
    pub fn is_used(&self) -> bool {
        (0..self.samples).any(|number| self.place(number)[0].load(Ordering::Relaxed) > 0)
    }
}
