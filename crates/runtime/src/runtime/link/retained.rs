//! The last samples of a signal in lockstep, retained beyond the life of either end of the link.
//!
//! A sample in flight is lost when its reader dies, and the successor of a writer repeats samples that may have been
//! sent. In lockstep nothing may be lost or counted twice: a reader finds every sent sample here, once and in order.
//! Used only for recovery; normally samples take the link.

use crate::telemetry::{Ledger, Slots, find, keep};
use std::sync::atomic::{AtomicU64, Ordering};

/// A ring of samples in the writer's ledger. Each slot holds the sample's number + 1 (0 while it is written), then its
/// words. Numbers begin at 0.
#[derive(Debug)]
pub struct RetainedSamples {
    slots: Slots,
    samples: u64,
    length: usize,
}

impl RetainedSamples {
    /// Returns the ledger words for this number of samples of `length` words.
    pub fn words(samples: u64, length: usize) -> usize {
        samples as usize * (1 + length)
    }

    /// Takes the words from a ledger. `None` for zero samples, and in a private ledger, which no successor could open.
    pub fn open(ledger: &Ledger, samples: u64, length: usize) -> Option<Self> {
        let slots = ledger.take(Self::words(samples, length));
        (samples > 0 && ledger.is_shared()).then_some(Self { slots, samples, length })
    }

    #[inline]
    fn place(&self, number: u64) -> &[AtomicU64] {
        let begin = (number % self.samples) as usize * (1 + self.length);
        &self.slots.words()[begin..=begin + self.length]
    }

    /// Retains a sample under its number.
    #[inline]
    pub fn keep(&self, number: u64, words: impl Iterator<Item = u64>) {
        keep(self.place(number), number, words);
    }

    /// Copies the sample of a number. If it is not retained, returns false and `words` is undefined.
    pub fn find(&self, number: u64, words: &mut [u64]) -> bool {
        find(self.place(number), number, words)
    }

    /// Returns true if the writer has retained anything: a foreign program does not.
    pub fn is_used(&self) -> bool {
        (0..self.samples).any(|number| self.place(number)[0].load(Ordering::Relaxed) > 0)
    }
}
