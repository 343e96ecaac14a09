//! The counters of a running role: its ticks, and both ends of its links. They are part of its persistent state.
//!
//! Nodes and links decide which counter an event belongs to; this module only adds.

use super::hash::StateHash;
use super::late::{LateRecord, LateTicks};
use super::ledger::Ledger;
use super::report::{Excused, LinkRead, LinkWritten, Ticks, WatchReport, WatchedReport};
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
    late: u64,
    safe: u64,
    stalled: u64,
    scripted: u64,
    anew: u64,
    first_disturbed: Option<u64>,
    /// Of these, ticks before `grace_ticks`.
    excused: Excused,
    grace_ticks: u64,
    /// Late ticks of this process.
    late_ticks: LateTicks,
    /// True if a scripted fault stalled the role before the current tick.
    just_stalled: bool,
}

persist_fields!(
    TickCounters,
    next,
    executed,
    missed,
    starved,
    late,
    safe,
    stalled,
    scripted,
    anew,
    first_disturbed,
    excused
);
persist_fields!(Excused, missed, scripted, starved, late, safe);

impl TickCounters {
    /// Creates counters that are zero; ticks before `grace_ticks` are excused.
    pub fn new(grace_ticks: u64) -> Self {
        Self { grace_ticks, ..Self::default() }
    }

    /// The next tick to execute.
    #[inline]
    pub fn next(&self) -> u64 {
        self.next
    }

    /// Counts the ticks before `tick` that were not executed as missed, and returns their number.
    #[inline]
    pub fn skip_to(&mut self, tick: u64) -> u64 {
        let missed = tick.saturating_sub(self.next);
        if missed > 0 {
            self.disturbed(self.next);
            self.missed += missed;
            self.excused.missed += tick.min(self.grace_ticks).saturating_sub(self.next);
            self.next = tick;
            self.late_ticks.missed += missed;
            self.late_ticks.missed_end = tick;
            self.late_ticks.last.stalled = self.just_stalled;
        }
        missed
    }

    /// Counts the next tick as executed.
    #[inline]
    pub fn executed(&mut self) {
        self.executed += 1;
        self.next += 1;
    }

    /// Counts a tick at which an input was absent; the sender of that input as
    /// [`RoleId::number`](crate::runtime::RoleId::number).
    #[inline]
    pub fn starved(&mut self, tick: u64, sender: u64) {
        self.starved += 1;
        self.excused.starved += u64::from(tick < self.grace_ticks);
        self.disturbed(tick);
        self.enter_late(LateRecord { tick, sender, starved: true, ..LateRecord::default() });
    }

    /// Counts a tick that was executed late, with all its inputs.
    #[inline]
    pub fn late(&mut self, record: LateRecord) {
        self.late += 1;
        self.excused.late += u64::from(record.tick < self.grace_ticks);
        self.enter_late(record);
    }

    fn enter_late(&mut self, record: LateRecord) {
        self.late_ticks.executed += 1;
        self.late_ticks.last = LateRecord { stalled: self.just_stalled, ..record };
    }

    /// Returns the late ticks since this process started.
    #[inline]
    pub fn late_ticks(&self) -> &LateTicks {
        &self.late_ticks
    }

    /// Counts a tick at which the safe command was applied.
    #[inline]
    pub fn safe(&mut self) {
        self.safe += 1;
        self.excused.safe += u64::from(self.next < self.grace_ticks);
    }

    /// Counts the scripted stalls before a tick.
    #[inline]
    pub fn stalled(&mut self, stalls: u64) {
        self.stalled += stalls;
        self.just_stalled = stalls > 0;
    }

    /// Counts the next tick as missed: an input is missing, or, if `scripted`, a scripted fault takes the tick.
    pub fn pass(&mut self, scripted: bool) {
        self.scripted += u64::from(scripted);
        self.excused.scripted += u64::from(scripted && self.next < self.grace_ticks);
        self.skip_to(self.next + 1);
        // A tick that a fault takes has no other cause.
        self.late_ticks.missed -= u64::from(scripted);
    }

    /// Counts a restart that lost the predecessor's state. Every tick from here on may differ from an undisturbed run's.
    pub fn restarted_without_state(&mut self) {
        self.anew += 1;
        self.disturbed(self.next);
    }

    /// Records a tick whose result may differ from an undisturbed run's.
    pub fn disturbed(&mut self, tick: u64) {
        self.first_disturbed.get_or_insert(tick);
    }

    /// Returns the current counts.
    pub fn report(&self) -> Ticks {
        Ticks {
            elapsed: self.next,
            executed: self.executed,
            missed: self.missed,
            starved: self.starved,
            late: Some(self.late),
            safe: self.safe,
            stalled: self.stalled,
            scripted: self.scripted,
            anew: self.anew,
            first_disturbed: self.first_disturbed,
            excused: self.excused,
        }
    }
}

/// The counters of a signal's writing end, with the hash of what was sent.
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
    /// Returns the number of ledger words needed beside the record, for a run that ends with `last_tick`.
    pub fn words(last_tick: u64) -> usize {
        StateHash::words(last_tick)
    }

    /// Creates the counters of a signal of which nothing was sent.
    pub fn open(ledger: &Ledger, last_tick: u64) -> Self {
        let hash = StateHash::open(ledger, last_tick);
        Self { published: 0, skipped: 0, void: 0, extra: 0, injected: 0, last_tick: None, hash }
    }

    /// Counts the sample that was sent for a tick, and adds its content to the hash.
    #[inline]
    pub fn enter(&mut self, tick: u64, content: &[u8]) {
        self.hash.absorb(tick, content);
        self.published += 1;
        self.cover(tick);
    }

    /// Counts a tick without a sample. If `sent`, a no-sample marker was sent in its place.
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

    /// Counts a sample that a scripted fault changed.
    pub fn injected(&mut self) {
        self.injected += 1;
    }

    /// Counts samples beyond the one of each tick: duplicated, late or corrupted ones.
    pub fn extra(&mut self, samples: u64) {
        self.extra += samples;
    }

    /// Returns the current counts.
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
    /// The number of samples taken off the link, including stale and rejected ones.
    taken: u64,
    received: u64,
    gaps: u64,
    stale: u64,
    /// The tick after the last counted one.
    covered: u64,
    void: u64,
    /// The counts by reason, in the order of [`Refusal::ALL`].
    rejected: [u64; Refusal::ALL.len()],
}

persist_fields!(ReadCounters, taken, received, gaps, stale, covered, void, rejected);

impl ReadCounters {
    /// Returns the number of samples received, including rejected ones.
    pub fn samples(&self) -> u64 {
        self.received
    }

    /// Returns the number of samples taken off the link, including stale and rejected ones.
    #[inline]
    pub fn taken(&self) -> u64 {
        self.taken
    }

    /// Counts a sample that was taken off the link.
    #[inline]
    pub fn take(&mut self) {
        self.taken += 1;
    }

    /// Returns the tick after the last counted one.
    #[inline]
    pub fn covered(&self) -> u64 {
        self.covered
    }

    /// Counts the sample of a tick. A tick that a predecessor has counted is not counted again.
    #[inline]
    pub fn received(&mut self, tick: u64) {
        self.received += self.enter(tick);
    }

    /// Counts a no-sample marker that arrived in the place of a tick's sample.
    pub fn void(&mut self, tick: u64) {
        self.void += self.enter(tick);
    }

    /// Counts the sample of a tick that was received and rejected.
    pub fn rejected(&mut self, tick: u64, refusal: Refusal) {
        if tick >= self.covered {
            self.rejected[refusal as usize] += 1;
        }
        self.received(tick);
    }

    /// Counts a rejected sample whose tick cannot be trusted.
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

    /// Counts a sample that was not newer than the one before.
    #[inline]
    pub fn stale(&mut self) {
        self.stale += 1;
    }

    /// Returns the current counts.
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
    /// Reports the quantities that a watchdog has judged, with their `names`. Returns `None` if it watches nothing.
    pub fn from_watchdog(watchdog: &Watchdog, names: &[&str]) -> Option<Self> {
        let quantities = names.iter().zip(watchdog.bounds().max).zip(watchdog.breaches());
        let report = |((name, max), breaches): ((&&str, f64), &Breaches)| {
            let Breaches { judged, count, first_tick, largest } = *breaches;
            let largest = Some(largest).filter(|largest| largest.is_finite());
            let quantity = (*name).to_owned();
            WatchedReport { quantity, max, judged, breaches: count, first_tick, largest }
        };
        let watched: Vec<_> = quantities.filter(|((_, max), _)| *max < f64::INFINITY).map(report).collect();
        (!watched.is_empty()).then(|| Self { watched, latched_at_tick: watchdog.latched_at() })
    }
}
