//! The books of a role while it runs: its ticks, and both ends of its links. They live in a ledger, so they outlive it.
//!
//! Must not decide what counts as what; nodes and links do.

use super::ledger::{Ledger, Words};
use super::{LinkRead, LinkWritten, StateHash, Ticks};

/// The books of a role's ticks.
#[derive(Debug)]
pub struct TickBook {
    words: Words,
}

impl TickBook {
    /// Words of the ledger.
    pub const WORDS: usize = 6;
    const NEXT: usize = 0;
    const EXECUTED: usize = 1;
    const MISSED: usize = 2;
    const STARVED: usize = 3;
    const SAFE: usize = 4;
    /// The first disturbed tick + 1; 0 if there is none.
    const DISTURBED: usize = 5;

    /// Opens the book, as it was left, to be read.
    pub fn open(ledger: &Ledger) -> Self {
        Self { words: ledger.take(Self::WORDS) }
    }

    /// Opens the book, as it was left, to go on with it. A successor lacks what its predecessor had in mind: nothing from
    /// here on is as it would have been.
    pub fn go_on(ledger: &Ledger) -> Self {
        let mut book = Self::open(ledger);
        if ledger.generation() > 1 {
            book.disturbed(book.next());
        }
        book
    }

    /// The next tick to execute.
    #[inline]
    pub fn next(&self) -> u64 {
        self.words.get(Self::NEXT)
    }

    /// Counts the ticks before `tick` that were not executed as missed, and tells how many.
    #[inline]
    pub fn skip_to(&mut self, tick: u64) -> u64 {
        let missed = tick.saturating_sub(self.next());
        if missed > 0 {
            self.disturbed(self.next());
            self.words.add(Self::MISSED, missed);
            self.words.set(Self::NEXT, tick);
        }
        missed
    }

    /// Counts the next tick as executed.
    #[inline]
    pub fn executed(&mut self) {
        self.words.add(Self::EXECUTED, 1);
        self.words.add(Self::NEXT, 1);
    }

    /// Counts a tick at which an input was absent.
    #[inline]
    pub fn starved(&mut self, tick: u64) {
        self.words.add(Self::STARVED, 1);
        self.disturbed(tick);
    }

    /// Counts a tick at which the safe command was applied.
    #[inline]
    pub fn safe(&mut self) {
        self.words.add(Self::SAFE, 1);
    }

    /// Notes a tick whose result may differ from an undisturbed run's.
    pub fn disturbed(&mut self, tick: u64) {
        if self.words.get(Self::DISTURBED) == 0 {
            self.words.set(Self::DISTURBED, tick + 1);
        }
    }

    /// The book's present state.
    pub fn report(&self) -> Ticks {
        Ticks {
            elapsed: self.next(),
            executed: self.words.get(Self::EXECUTED),
            missed: self.words.get(Self::MISSED),
            starved: self.words.get(Self::STARVED),
            safe: self.words.get(Self::SAFE),
            first_disturbed: self.words.get(Self::DISTURBED).checked_sub(1),
        }
    }
}

/// The books of a signal's writing end, with its hash.
#[derive(Debug)]
pub struct WriteBook {
    words: Words,
    hash: StateHash,
}

impl WriteBook {
    const PUBLISHED: usize = 0;
    const SKIPPED: usize = 1;
    /// The last tick + 1; 0 before the first.
    const COVERED: usize = 2;

    /// Words of the ledger for a run that ends with `last_tick`.
    pub fn words(last_tick: u64) -> usize {
        3 + StateHash::words(last_tick)
    }

    /// Opens the book, as it was left.
    pub fn open(ledger: &Ledger, last_tick: u64) -> Self {
        Self { words: ledger.take(3), hash: StateHash::open(ledger, last_tick) }
    }

    /// Enters a sample that was sent.
    #[inline]
    pub fn enter(&mut self, sample: &impl crate::sample::Sample) {
        let tick = sample.stamp().tick;
        let covered = self.words.get(Self::COVERED);
        self.hash.absorb(sample);
        self.words.add(Self::SKIPPED, tick.saturating_sub(covered));
        self.words.add(Self::PUBLISHED, 1);
        self.words.set(Self::COVERED, covered.max(tick + 1));
    }

    /// How many samples were sent.
    pub fn published(&self) -> u64 {
        self.words.get(Self::PUBLISHED)
    }

    /// The book's present state.
    pub fn report(&self, service: &str) -> LinkWritten {
        LinkWritten {
            service: service.to_owned(),
            published: self.published(),
            skipped: self.words.get(Self::SKIPPED),
            last_tick: self.words.get(Self::COVERED).checked_sub(1),
            hash: self.hash.checkpoints(),
        }
    }
}

/// The books of a signal's reading end.
#[derive(Debug)]
pub struct ReadBook {
    words: Words,
}

impl ReadBook {
    /// Words of the ledger.
    pub const WORDS: usize = 4;
    const RECEIVED: usize = 0;
    const GAPS: usize = 1;
    const STALE: usize = 2;
    /// The last tick + 1; 0 before the first.
    const COVERED: usize = 3;

    /// Opens the book, as it was left.
    pub fn open(ledger: &Ledger) -> Self {
        Self { words: ledger.take(Self::WORDS) }
    }

    /// Enters the sample of a tick; one that the book has already, because a predecessor received it, is not counted again.
    #[inline]
    pub fn received(&mut self, tick: u64) {
        let covered = self.words.get(Self::COVERED);
        if tick >= covered {
            self.words.add(Self::GAPS, tick - covered);
            self.words.add(Self::RECEIVED, 1);
            self.words.set(Self::COVERED, tick + 1);
        }
    }

    /// Enters a sample that was not newer than the one before.
    #[inline]
    pub fn stale(&mut self) {
        self.words.add(Self::STALE, 1);
    }

    /// The book's present state.
    pub fn report(&self, service: &str) -> LinkRead {
        LinkRead {
            service: service.to_owned(),
            received: self.words.get(Self::RECEIVED),
            gaps: self.words.get(Self::GAPS),
            stale: self.words.get(Self::STALE),
            last_tick: self.words.get(Self::COVERED).checked_sub(1),
        }
    }
}
