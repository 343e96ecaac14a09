//! The reading end of a link with its counters and its guard.
//!
//! Samples of generation 0 are warm-up: they pass through the link and go no further. Must not return a sample that its
//! guard rejects.

use super::retained::RetainedSamples;
use crate::bus::{Bus, BusError, Carried, Read, Reader, Topic};
use crate::clock::{Grid, monotonic_ns};
use crate::role::{AcceptAll, Guard, Refusal};
use crate::runtime::disturb::LateSamples;
use crate::sample::{NO_SAMPLE, Stamp};
use crate::state::{Persist, Words};
use crate::telemetry::ReadCounters;
use std::borrow::{Borrow, BorrowMut};

/// Result of a search for the sample of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seek {
    /// The sample of the tick is available.
    Found,
    /// No sample of this or a later tick has arrived.
    NotYet,
    /// A later sample or a no-sample marker has arrived: the tick has no sample.
    Passed,
    /// The sample of the tick has arrived and was rejected.
    Rejected,
}

/// The ticks that a sample may have.
#[derive(Debug, Clone, Copy)]
pub enum AcceptedTicks {
    /// Any.
    Unknown,
    /// The next tick only: this link loses nothing.
    Next,
    /// Ticks that are due.
    Due(Grid),
}

/// State of the newest sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Newest {
    /// Accepted by the guard.
    Usable,
    /// Of the expected tick, and rejected.
    Rejected,
    /// Missing, a no-sample marker, or displaced by an unusable sample.
    None,
}

/// The reading end of a signal.
pub struct Input<B: Bus, S: Carried + ?Sized, G = AcceptAll> {
    port: S::Reader<B>,
    guard: G,
    accepted_ticks: AcceptedTicks,
    /// Tick and generation of the newest sample or marker.
    last: Option<(u64, u64)>,
    /// Every arrival replaces the previous sample, usable or not.
    newest: Newest,
    /// The lower generation of a rejected sample. If the next sample has it too, that one is accepted.
    suspect_generation: Option<u64>,
    /// True while arrivals may repeat what a predecessor of this end has counted.
    pub(super) repeated: bool,
    recovery: Option<Recovery<S>>,
    late: Option<Box<LateSamples>>,
    counters: ReadCounters,
}

/// Replaces the link by the writer's retained samples after a death at either end, because the link may then lose or
/// repeat samples. Ends once the link is known to deliver the next sample.
struct Recovery<S: Carried + ?Sized> {
    retained: RetainedSamples,
    /// True while samples come from the retained ones.
    active: bool,
    /// True if the last sample taken is the one in `sample`.
    found: bool,
    sample: S::Owned,
    /// Stamp of the last retained sample, and true if it is known to differ from the one before.
    taken: Option<(Stamp, bool)>,
    /// Stamp of the last sample that the link delivered meanwhile.
    brought: Option<Stamp>,
}

impl<S: Carried + ?Sized> Recovery<S> {
    /// Begins at a delivered sample of another generation of the writer, which may repeat an earlier one. Without
    /// retained samples the link is used as it is.
    #[cold]
    fn begin(&mut self, brought: Stamp) {
        self.active = self.retained.is_used();
        (self.brought, self.taken) = (Some(brought), None);
    }

    /// Copies the retained sample of this number, if present.
    #[cold]
    fn find(&mut self, number: u64) -> bool {
        let found = self.retained.find(number, self.sample.borrow_mut().words_mut());
        if found {
            let stamp = *self.sample.borrow().stamp();
            self.taken = Some((stamp, self.taken.is_some_and(|(last, _)| last != stamp)));
            self.found = true;
        }
        found
    }

    /// Returns true once the link delivers the sample after the retained ones. A sample is retained before it is sent:
    /// none is skipped, and none arrives twice.
    fn is_over(&self) -> bool {
        self.taken.is_some_and(|(taken, unique)| unique && self.brought == Some(taken))
    }
}

impl<B: Bus, S: Carried + ?Sized> Input<B, S> {
    /// Opens a signal of one body.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open(bus: &B, topic: &Topic, reader: Reader) -> Result<Self, BusError> {
        Self::open_many(bus, topic, 1, reader)
    }

    /// Opens a signal of `bodies` bodies.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open_many(bus: &B, topic: &Topic, bodies: usize, reader: Reader) -> Result<Self, BusError> {
        Ok(Self {
            port: S::reader(bus, topic, reader, bodies)?,
            guard: AcceptAll,
            accepted_ticks: AcceptedTicks::Unknown,
            last: None,
            newest: Newest::None,
            suspect_generation: None,
            repeated: false,
            recovery: None,
            late: None,
            counters: ReadCounters::default(),
        })
    }

    /// Adds a guard.
    pub fn with_guard<G: Guard<S>>(self, guard: G) -> Input<B, S, G> {
        let Self { port, accepted_ticks, last, newest, suspect_generation, repeated, recovery, late, counters, .. } =
            self;
        Input { port, guard, accepted_ticks, last, newest, suspect_generation, repeated, recovery, late, counters }
    }

    /// Adds the scripted delays of the signal.
    pub fn with_late(self, late: Option<Box<LateSamples>>) -> Self {
        Self { late, ..self }
    }

    /// Adds the writer's retained samples; a successor begins with those.
    pub fn with_recovery(self, retained: Option<RetainedSamples>, bodies: usize, successor: bool) -> Self {
        let recovery = retained.map(|retained| Recovery {
            active: successor && retained.is_used(),
            retained,
            found: false,
            sample: S::blank(bodies),
            taken: None,
            brought: None,
        });
        Self { recovery, ..self }
    }
}

impl<B: Bus, S: Carried + ?Sized, G: Guard<S>> Input<B, S, G> {
    /// Sets the ticks that samples may have from now on.
    pub fn expect(&mut self, accepted_ticks: AcceptedTicks) {
        self.accepted_ticks = accepted_ticks;
    }

    /// Moves to the sample of `tick`, or to the newest one before it.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    #[inline]
    pub fn seek(&mut self, tick: u64) -> Result<Seek, BusError> {
        loop {
            match (self.last, self.newest) {
                (Some((last, _)), Newest::Usable) if last == tick => return Ok(Seek::Found),
                (Some((last, _)), Newest::Rejected) if last == tick => return Ok(Seek::Rejected),
                (Some((last, _)), _) if last >= tick => return Ok(Seek::Passed),
                _ => {}
            }
            if !self.take()? {
                return Ok(Seek::NotYet);
            }
        }
    }

    /// Moves to the next usable sample; returns false if no sample waits.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    #[inline]
    pub fn advance(&mut self) -> Result<bool, BusError> {
        while self.take()? {
            if self.newest == Newest::Usable {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Takes one sample or marker off the link, usable or not; returns false if the link is empty.
    #[inline]
    fn take(&mut self) -> Result<bool, BusError> {
        if self.recovers() {
            return self.recover();
        }
        if !self.port.advance()? {
            return Ok(false);
        }
        let Some(stamp) = self.port.current().map(|sample| *sample.stamp()) else { return Ok(false) };
        let generation = stamp.generation & !NO_SAMPLE;
        if let Some(recovery) = &mut self.recovery
            && self.last.map_or(generation > 1, |(_, known)| generation != known)
            && !stamp.is_warm_up()
        {
            self.newest = Newest::None;
            recovery.begin(stamp);
            if recovery.active {
                return self.recover();
            }
        }
        self.newest = self.account(&stamp);
        Ok(true)
    }

    /// Takes one sample from the retained ones, or from the link once it has caught up.
    #[cold]
    fn recover(&mut self) -> Result<bool, BusError> {
        while let Some(recovery) = &mut self.recovery {
            if recovery.find(self.counters.taken()) {
                let stamp = *recovery.sample.borrow().stamp();
                self.newest = self.account(&stamp);
                return Ok(true);
            }
            if recovery.is_over() {
                // The link has caught up.
                (recovery.active, recovery.found) = (false, false);
                return self.take();
            }
            if !self.port.advance()? {
                return Ok(false);
            }
            recovery.brought = self.port.current().map(|sample| *sample.stamp());
            if !recovery.found {
                self.newest = Newest::None;
            }
        }
        Ok(false)
    }

    /// Returns the last sample taken, usable or not.
    #[inline]
    fn current(&self) -> Option<&S> {
        let recovered = self.recovery.as_ref().filter(|recovery| recovery.found);
        recovered.map_or(self.port.current(), |recovery| Some(recovery.sample.borrow()))
    }

    /// Counts a sample and returns its state.
    ///
    /// Ticks also increase from one generation of the sender to the next, because a successor continues on the grid. It
    /// may repeat the tick in which its predecessor died.
    #[inline]
    fn account(&mut self, stamp: &Stamp) -> Newest {
        if !stamp.is_warm_up() {
            self.counters.take();
        }
        let generation = stamp.generation & !NO_SAMPLE;
        let (newest_tick, known) = match self.last {
            Some((tick, known)) => (Some(tick), known),
            // Warm-up.
            None if generation == 0 => return Newest::None,
            None => (None, 0),
        };
        if let Some(tick) = newest_tick.filter(|tick| stamp.tick <= *tick) {
            // All samples up to the last one that the predecessor counted are counted already. Warm-up is ignored.
            if self.repeated {
                self.repeated = stamp.tick < tick || generation == 0;
            } else if generation == known || self.lossless() && !stamp.is_warm_up() {
                self.counters.stale();
            }
            return Newest::None;
        }
        if self.late.as_mut().is_some_and(|late| late.contains(stamp.tick)) {
            // A successor of the writer may repeat a late sample: see `Output::dispatch_rest`.
            if !self.repeated && generation == known {
                self.counters.stale();
            }
            return Newest::None;
        }
        self.repeated = false;
        if !self.possible(stamp.tick) {
            self.counters.stray();
            return Newest::None;
        }
        if generation < known && self.suspect_generation.replace(generation) != Some(generation) {
            self.last = Some((stamp.tick, known));
            self.counters.rejected(stamp.tick, Refusal::Stamp);
            return Newest::Rejected;
        }
        self.suspect_generation = None;
        self.last = Some((stamp.tick, generation));
        if stamp.generation & NO_SAMPLE != 0 {
            self.counters.void(stamp.tick);
            return Newest::None;
        }
        // `current` would borrow the guard too.
        let recovered = self.recovery.as_ref().filter(|recovery| recovery.found);
        let sample = recovered.map_or(self.port.current(), |recovery| Some(recovery.sample.borrow()));
        if sample.is_some_and(|sample| self.guard.accepts(sample)) {
            self.counters.received(stamp.tick);
            return Newest::Usable;
        }
        let refusal = sample.map_or(Refusal::Other, |sample| self.guard.refusal(sample));
        self.counters.rejected(stamp.tick, refusal);
        Newest::Rejected
    }

    /// Returns true if this link loses nothing, so that each generation of the writer sends a sample once.
    #[inline]
    fn lossless(&self) -> bool {
        matches!(self.accepted_ticks, AcceptedTicks::Next)
    }

    /// Returns true if a newer sample may have this tick.
    #[inline]
    fn possible(&self, tick: u64) -> bool {
        // With delayed samples, one with a broken tick may arrive after the next one was sent.
        tick <= self.counters.covered() && self.late.is_none()
            || match self.accepted_ticks {
                AcceptedTicks::Unknown => true,
                AcceptedTicks::Next => false,
                AcceptedTicks::Due(grid) => tick <= grid.tick_at(monotonic_ns()),
            }
    }

    /// Sleeps until a sample may have arrived, at most until `until_ns`.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn sleep(&mut self, until_ns: u64) -> Result<(), BusError> {
        self.port.sleep(until_ns)
    }

    /// Returns true once a sample or marker of this tick or a later one has arrived: waiting is useless then.
    #[inline]
    pub fn knows(&self, tick: u64) -> bool {
        self.last.is_some_and(|(last, _)| last >= tick)
    }

    /// Returns the newest tick with a sample, accepted or rejected, or a marker.
    #[inline]
    pub fn last_tick(&self) -> Option<u64> {
        self.last.map(|(tick, _)| tick)
    }

    /// Returns the newest sample if it was accepted.
    #[inline]
    pub fn sample(&self) -> Option<&S> {
        self.current().filter(|_| self.newest == Newest::Usable)
    }

    /// Returns the stamp of the newest sample if it was of the expected tick and rejected.
    #[inline]
    pub fn rejected(&self) -> Option<&Stamp> {
        self.current().filter(|_| self.newest == Newest::Rejected).map(S::stamp)
    }

    /// Discards waiting samples, to exercise the link. Before the first tick only.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn warm_up(&mut self) -> Result<(), BusError> {
        self.port.refresh();
        while self.port.advance()? {}
        Ok(())
    }

    /// Connects to the current writer by the fastest path. Off the critical path.
    pub fn refresh(&mut self) {
        self.port.refresh();
    }
}

impl<B: Bus, S: Carried + ?Sized, G> Input<B, S, G> {
    /// Returns true while samples come from the retained ones.
    #[inline]
    fn recovers(&self) -> bool {
        self.recovery.as_ref().is_some_and(|recovery| recovery.active)
    }

    /// Returns the counters.
    pub fn counters(&mut self) -> &mut ReadCounters {
        &mut self.counters
    }

    /// Expects samples that the predecessor of this end may have counted.
    pub fn expect_repeats(&mut self) {
        self.repeated = B::REPEATS && !self.recovers();
    }
}

/// All but the counters.
impl<B: Bus, S: Carried + ?Sized, G: Persist> Persist for Input<B, S, G> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.last.persist(words);
        self.suspect_generation.persist(words);
        self.guard.persist(words);
    }
}
