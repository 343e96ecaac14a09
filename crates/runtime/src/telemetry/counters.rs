//! The counters of a role while it runs: its ticks, and both ends of its links. They are part of its persistent state.
//!
//! Must not decide what counts as what; nodes and links do.

use super::ledger::Ledger;
use super::{LinkRead, LinkWritten, StateHash, Ticks, WatchReport, WatchedReport};
use crate::control::{Breaches, Watchdog};
use crate::role::Refusal;
use crate::state::persist_fields;

/// The counters of a role's ticks.
#[derive(Debug, Default)]
pub struct TickCounters {
    next: u64,
    executed: u64,
    missed: u64,
    starved: u64,
    safe: u64,
    stalled: u64,
    scripted: u64,
    anew: u64,
    first_disturbed: Option<u64>,
}

persist_fields!(TickCounters, next, executed, missed, starved, safe, stalled, scripted, anew, first_disturbed);

impl TickCounters {
    /// The next tick to execute.
    #[inline]
    pub fn next(&self) -> u64 {
        self.next
    }

    /// Counts the ticks before `tick` that were not executed as missed, and tells how many.
    #[inline]
    pub fn skip_to(&mut self, tick: u64) -> u64 {
        let missed = tick.saturating_sub(self.next);
        if missed > 0 {
            self.disturbed(self.next);
            self.missed += missed;
            self.next = tick;
        }
        missed
    }

    /// Counts the next tick as executed.
    #[inline]
    pub fn executed(&mut self) {
        self.executed += 1;
        self.next += 1;
    }

    /// Counts a tick at which an input was absent.
    #[inline]
    pub fn starved(&mut self, tick: u64) {
        self.starved += 1;
        self.disturbed(tick);
    }

    /// Counts a tick at which the safe command was applied.
    #[inline]
    pub fn safe(&mut self) {
        self.safe += 1;
    }

    /// Counts scripted stalls.
    #[inline]
    pub fn stalled(&mut self, stalls: u64) {
        self.stalled += stalls;
    }

    /// Counts the next tick as missed, because a scripted fault takes it or for want of inputs.
    pub fn pass(&mut self, scripted: bool) {
        self.scripted += u64::from(scripted);
        self.skip_to(self.next + 1);
    }

    /// Counts a life that began without the state of the one before: nothing from here on is as it would have been.
    pub fn restarted_without_state(&mut self) {
        self.anew += 1;
        self.disturbed(self.next);
    }

    /// Notes a tick whose result may differ from an undisturbed run's.
    pub fn disturbed(&mut self, tick: u64) {
        self.first_disturbed.get_or_insert(tick);
    }

    /// The present state.
    pub fn report(&self) -> Ticks {
        Ticks {
            elapsed: self.next,
            executed: self.executed,
            missed: self.missed,
            starved: self.starved,
            safe: self.safe,
            stalled: self.stalled,
            scripted: self.scripted,
            anew: self.anew,
            first_disturbed: self.first_disturbed,
        }
    }
}

/// The counters of a signal's writing end, with its hash.
#[derive(Debug)]
pub struct WriteCounters {
    published: u64,
    skipped: u64,
    void: u64,
    extra: u64,
    injected: u64,
    last_tick: Option<u64>,
    hash: StateHash,
}

persist_fields!(WriteCounters, published, skipped, void, extra, injected, last_tick, hash);

impl WriteCounters {
    /// Words of the ledger beside the record, for a run that ends with `last_tick`.
    pub fn words(last_tick: u64) -> usize {
        StateHash::words(last_tick)
    }

    /// The counters of a signal of which nothing was sent.
    pub fn open(ledger: &Ledger, last_tick: u64) -> Self {
        let hash = StateHash::open(ledger, last_tick);
        Self { published: 0, skipped: 0, void: 0, extra: 0, injected: 0, last_tick: None, hash }
    }

    /// Enters the sample of a tick that was sent.
    #[inline]
    pub fn enter(&mut self, tick: u64, content: &[u8]) {
        self.hash.absorb(tick, content);
        self.published += 1;
        self.cover(tick);
    }

    /// Enters a tick of which there is no sample: a void was sent in its place, or nothing was.
    pub fn enter_without_sample(&mut self, tick: u64, sent: bool) {
        *(if sent { &mut self.void } else { &mut self.skipped }) += 1;
        self.cover(tick);
    }

    #[inline]
    fn cover(&mut self, tick: u64) {
        let covered = self.last_tick.map_or(0, |last| last + 1);
        self.skipped += tick.saturating_sub(covered);
        self.last_tick = self.last_tick.max(Some(tick));
    }

    /// Counts a sample that a scripted fault touched.
    pub fn injected(&mut self) {
        self.injected += 1;
    }

    /// Counts samples beyond the one that a tick has: a second, a late or a broken one.
    pub fn extra(&mut self, samples: u64) {
        self.extra += samples;
    }

    /// The present state.
    pub fn report(&self, service: &str) -> LinkWritten {
        LinkWritten {
            service: service.to_owned(),
            published: self.published,
            skipped: self.skipped,
            void: self.void,
            extra: self.extra,
            injected: self.injected,
            last_tick: self.last_tick,
            hash: Some(self.hash.checkpoints()),
        }
    }
}

/// The counters of a signal's reading end.
#[derive(Debug, Default)]
pub struct ReadCounters {
    /// Samples that were taken off the link, whatever they were worth.
    taken: u64,
    received: u64,
    gaps: u64,
    stale: u64,
    /// The tick after the last that is counted.
    covered: u64,
    void: u64,
    /// In the order of [`Refusal::ALL`].
    rejected: [u64; Refusal::ALL.len()],
}

persist_fields!(ReadCounters, taken, received, gaps, stale, covered, void, rejected);

impl ReadCounters {
    /// Returns the number of samples received, rejected ones too.
    pub fn samples(&self) -> u64 {
        self.received
    }

    /// How many samples were taken off the link, whatever they were worth.
    #[inline]
    pub fn taken(&self) -> u64 {
        self.taken
    }

    /// Takes one.
    #[inline]
    pub fn take(&mut self) {
        self.taken += 1;
    }

    /// The tick after the last that is counted.
    #[inline]
    pub fn covered(&self) -> u64 {
        self.covered
    }

    /// Enters the sample of a tick; one that is counted already, because a predecessor received it, is not counted again.
    #[inline]
    pub fn received(&mut self, tick: u64) {
        self.received += self.enter(tick);
    }

    /// Enters a void in the place of a tick's sample.
    pub fn void(&mut self, tick: u64) {
        self.void += self.enter(tick);
    }

    /// Enters the sample of a tick that was received and is not believed.
    pub fn rejected(&mut self, tick: u64, refusal: Refusal) {
        if tick >= self.covered {
            self.rejected[refusal as usize] += 1;
        }
        self.received(tick);
    }

    /// Enters a sample that is not believed and may not even be of the tick that it names.
    pub fn stray(&mut self) {
        self.rejected[Refusal::Stamp as usize] += 1;
    }

    #[inline]
    fn enter(&mut self, tick: u64) -> u64 {
        let new = tick >= self.covered;
        if new {
            self.gaps += tick - self.covered;
            self.covered = tick.saturating_add(1);
        }
        u64::from(new)
    }

    /// Enters a sample that was not newer than the one before.
    #[inline]
    pub fn stale(&mut self) {
        self.stale += 1;
    }

    /// The present state.
    pub fn report(&self, service: &str) -> LinkRead {
        LinkRead {
            service: service.to_owned(),
            received: self.received,
            gaps: self.gaps,
            stale: self.stale,
            void: self.void,
            rejected: self.rejected.iter().sum(),
            rejected_by: Refusal::ALL
                .into_iter()
                .zip(self.rejected)
                .filter(|(_, count)| *count > 0)
                .map(|(refusal, count)| (refusal.name().to_owned(), count))
                .collect(),
            last_tick: self.covered.checked_sub(1),
        }
    }
}

impl WatchReport {
    /// What a watchdog has seen of its quantities, by their names; nothing where nothing is watched.
    pub fn of(watchdog: &Watchdog, names: &[&str]) -> Option<Self> {
        let quantities = names.iter().zip(watchdog.bounds().max).zip(watchdog.breaches());
        let one = |((name, max), breaches): ((&&str, f64), &Breaches)| {
            let Breaches { judged, count, first_tick, largest } = *breaches;
            let largest = Some(largest).filter(|largest| largest.is_finite());
            let quantity = (*name).to_owned();
            WatchedReport { quantity, max, judged, breaches: count, first_tick, largest }
        };
        let watched: Vec<_> = quantities.filter(|((_, max), _)| *max < f64::INFINITY).map(one).collect();
        (!watched.is_empty()).then(|| Self { watched, latched_at_tick: watchdog.latched_at() })
    }
}
