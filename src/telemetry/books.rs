//! The books of a role while it runs: its ticks, and both ends of its links. They live in a ledger, so they outlive it.
//!
//! Must not decide what counts as what; nodes and links do.

use super::ledger::{Ledger, Words};
use super::{LinkRead, LinkWritten, StateHash, Ticks, WatchReport, WatchedReport};
use crate::control::{Breaches, WatchBounds, Watchdog, Watched};

/// The books of a role's ticks.
#[derive(Debug)]
pub struct TickBook {
    words: Words,
}

impl TickBook {
    /// Words of the ledger.
    pub const WORDS: usize = 7;
    const NEXT: usize = 0;
    const EXECUTED: usize = 1;
    const MISSED: usize = 2;
    const STARVED: usize = 3;
    const SAFE: usize = 4;
    /// The first disturbed tick + 1; 0 if there is none.
    const DISTURBED: usize = 5;
    const STALLED: usize = 6;

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

    /// Counts scripted stalls.
    #[inline]
    pub fn stalled(&mut self, stalls: u64) {
        if stalls > 0 {
            self.words.add(Self::STALLED, stalls);
        }
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
            stalled: self.words.get(Self::STALLED),
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
    const VOID: usize = 3;
    const WITHHELD: usize = 4;
    const EXTRA: usize = 5;
    const INJECTED: usize = 6;
    const COUNTERS: usize = 7;

    /// Words of the ledger for a run that ends with `last_tick`.
    pub fn words(last_tick: u64) -> usize {
        Self::COUNTERS + StateHash::words(last_tick)
    }

    /// Opens the book, as it was left.
    pub fn open(ledger: &Ledger, last_tick: u64) -> Self {
        Self { words: ledger.take(Self::COUNTERS), hash: StateHash::open(ledger, last_tick) }
    }

    /// Enters a sample that was sent.
    #[inline]
    pub fn enter(&mut self, sample: &(impl crate::sample::Message + ?Sized)) {
        self.hash.absorb(sample);
        self.words.add(Self::PUBLISHED, 1);
        self.cover(sample.stamp().tick);
    }

    /// Enters a tick of which there is no sample: a void was sent in its place, or nothing was.
    pub fn enter_void(&mut self, tick: u64, sent: bool) {
        self.words.add(if sent { Self::VOID } else { Self::SKIPPED }, 1);
        self.cover(tick);
    }

    #[inline]
    fn cover(&mut self, tick: u64) {
        let covered = self.words.get(Self::COVERED);
        self.words.add(Self::SKIPPED, tick.saturating_sub(covered));
        self.words.set(Self::COVERED, covered.max(tick + 1));
    }

    /// Counts a sample that a scripted fault touched.
    pub fn injected(&mut self) {
        self.words.add(Self::INJECTED, 1);
    }

    /// Counts a sample that was made and did not go out as its tick's.
    pub fn withheld(&mut self) {
        self.words.add(Self::WITHHELD, 1);
    }

    /// Counts a sample beyond the one that its tick has: a second, a late or a broken one.
    pub fn extra(&mut self) {
        self.words.add(Self::EXTRA, 1);
    }

    /// How many samples were made, sent or withheld.
    pub fn made(&self) -> u64 {
        self.words.get(Self::PUBLISHED) + self.words.get(Self::WITHHELD)
    }

    /// The book's present state.
    pub fn report(&self, service: &str) -> LinkWritten {
        LinkWritten {
            service: service.to_owned(),
            published: self.words.get(Self::PUBLISHED),
            skipped: self.words.get(Self::SKIPPED),
            void: self.words.get(Self::VOID),
            extra: self.words.get(Self::EXTRA),
            injected: self.words.get(Self::INJECTED),
            last_tick: self.words.get(Self::COVERED).checked_sub(1),
            hash: Some(self.hash.checkpoints()),
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
    pub const WORDS: usize = 6;
    const RECEIVED: usize = 0;
    const GAPS: usize = 1;
    const STALE: usize = 2;
    /// The last tick + 1; 0 before the first.
    const COVERED: usize = 3;
    const VOID: usize = 4;
    const REJECTED: usize = 5;

    /// Opens the book, as it was left.
    pub fn open(ledger: &Ledger) -> Self {
        Self { words: ledger.take(Self::WORDS) }
    }

    /// The tick after the last that the book has.
    #[inline]
    pub fn covered(&self) -> u64 {
        self.words.get(Self::COVERED)
    }

    /// Enters the sample of a tick; one that the book has already, because a predecessor received it, is not counted again.
    #[inline]
    pub fn received(&mut self, tick: u64) {
        self.enter(tick, Self::RECEIVED);
    }

    /// Enters a void in the place of a tick's sample.
    pub fn void(&mut self, tick: u64) {
        self.enter(tick, Self::VOID);
    }

    /// Enters the sample of a tick that was received and is not believed.
    pub fn rejected(&mut self, tick: u64) {
        if tick >= self.covered() {
            self.stray();
        }
        self.received(tick);
    }

    /// Enters a sample that is not believed and may not even be of the tick that it names.
    pub fn stray(&mut self) {
        self.words.add(Self::REJECTED, 1);
    }

    #[inline]
    fn enter(&mut self, tick: u64, counter: usize) {
        let covered = self.covered();
        if tick >= covered {
            self.words.add(Self::GAPS, tick - covered);
            self.words.add(counter, 1);
            self.words.set(Self::COVERED, tick.saturating_add(1));
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
            void: self.words.get(Self::VOID),
            rejected: self.words.get(Self::REJECTED),
            last_tick: self.words.get(Self::COVERED).checked_sub(1),
        }
    }
}

/// The books of a watchdog: a latch must outlive whoever latched it.
#[derive(Debug)]
pub struct WatchBook {
    words: Words,
}

impl WatchBook {
    /// Words of the ledger.
    pub const WORDS: usize = Self::EACH * Watched::ALL.len() + 1;
    /// Judged, breaches, first tick + 1 (0: none), bits of the largest value.
    const EACH: usize = 4;
    /// The tick of the latch + 1; 0 if there is none.
    const LATCHED: usize = Self::EACH * Watched::ALL.len();

    /// Opens the book, as it was left.
    pub fn open(ledger: &Ledger) -> Self {
        Self { words: ledger.take(Self::WORDS) }
    }

    /// A watchdog that goes on from here.
    pub fn watchdog(&self, bounds: WatchBounds) -> Watchdog {
        Watchdog::resume(bounds, Watched::ALL.map(|watched| self.breaches(watched)), self.latched_at())
    }

    /// Enters what a watchdog has seen so far.
    #[inline]
    pub fn store(&self, watchdog: &Watchdog) {
        for (watched, breaches) in Watched::ALL.into_iter().zip(watchdog.breaches()) {
            let begin = Self::EACH * watched as usize;
            self.words.set(begin, breaches.judged);
            self.words.set(begin + 1, breaches.count);
            self.words.set(begin + 2, breaches.first_tick.map_or(0, |tick| tick + 1));
            self.words.set(begin + 3, breaches.largest.to_bits());
        }
        self.words.set(Self::LATCHED, watchdog.latched_at().map_or(0, |tick| tick + 1));
    }

    fn breaches(&self, watched: Watched) -> Breaches {
        let word = |index| self.words.get(Self::EACH * watched as usize + index);
        Breaches {
            judged: word(0),
            count: word(1),
            first_tick: word(2).checked_sub(1),
            largest: f64::from_bits(word(3)),
        }
    }

    fn latched_at(&self) -> Option<u64> {
        self.words.get(Self::LATCHED).checked_sub(1)
    }

    /// The book's present state; nothing where nothing is watched.
    pub fn report(&self, bounds: &WatchBounds) -> Option<WatchReport> {
        let one = |watched: Watched| {
            let Breaches { judged, count, first_tick, largest } = self.breaches(watched);
            let (quantity, max) = (watched.name().to_owned(), bounds.max[watched as usize]);
            let largest = Some(largest).filter(|largest| largest.is_finite());
            WatchedReport { quantity, max, judged, breaches: count, first_tick, largest }
        };
        let watched = |watched: &Watched| bounds.max[*watched as usize] < f64::INFINITY;
        let reports: Vec<WatchedReport> = Watched::ALL.into_iter().filter(watched).map(one).collect();
        (!reports.is_empty()).then(|| WatchReport { watched: reports, latched_at_tick: self.latched_at() })
    }
}
