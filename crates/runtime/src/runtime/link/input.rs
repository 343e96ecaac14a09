//! The reading end of a link with its counters and its guard: what was received, lost, not believed.
//!
//! Samples of generation 0 are warm-up: they pass through the link and go no further. Must not let a sample that its guard
//! does not believe be seen.

use super::retained::RetainedSamples;
use crate::bus::{Bus, BusError, Carried, Read, Reader, Topic};
use crate::clock::{Grid, monotonic_ns};
use crate::role::{AcceptAll, Guard, Refusal};
use crate::runtime::disturb::LateSamples;
use crate::sample::{NO_SAMPLE, Stamp};
use crate::state::{Persist, Words};
use crate::telemetry::ReadCounters;
use std::borrow::{Borrow, BorrowMut};

/// What a reading end has for a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seek {
    /// The sample of that tick is at hand.
    Found,
    /// Nothing so new has arrived.
    NotYet,
    /// Something later has arrived, or a void: that tick's will never come.
    Passed,
    /// That tick's has arrived and is not believed.
    Rejected,
}

/// Which ticks a sample can have.
#[derive(Debug, Clone, Copy)]
pub enum AcceptedTicks {
    /// Any.
    Unknown,
    /// The next only: nothing is lost on this link.
    Next,
    /// Those that are due.
    Due(Grid),
}

/// What has become of the newest sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Newest {
    /// It is at hand.
    Usable,
    /// It was of the tick that was due, and is not believed.
    Rejected,
    /// There is none, or it was a void, or it was displaced by one of no use.
    None,
}

/// The reading end of a signal.
pub struct Input<B: Bus, S: Carried + ?Sized, G = AcceptAll> {
    port: S::Reader<B>,
    guard: G,
    accepted_ticks: AcceptedTicks,
    /// Tick and generation of the newest tick that something is known of.
    last: Option<(u64, u64)>,
    /// Whatever arrives displaces what was at hand, usable or not.
    newest: Newest,
    /// The generation of a sample that was taken for a predecessor's: if the next says the same, it is to be believed.
    suspect_generation: Option<u64>,
    /// Whether what arrives may be what a predecessor of this end has counted already.
    pub(super) repeated: bool,
    recovery: Option<Recovery<S>>,
    late: Option<Box<LateSamples>>,
    counters: ReadCounters,
}

/// Goes on by what the writer keeps after a death at either end of the link, until the link is known to bring just what comes
/// next: by itself it may lack something, or repeat it.
struct Recovery<S: Carried + ?Sized> {
    kept: RetainedSamples,
    /// Whether it goes on so at present.
    active: bool,
    /// The sample that was found last, if that is the one that was taken last.
    found: bool,
    sample: S::Owned,
    /// The stamp of that sample, and whether it is known to differ from that of the sample before.
    taken: Option<(Stamp, bool)>,
    /// The stamp of the last sample that the link has brought meanwhile.
    brought: Option<Stamp>,
}

impl<S: Carried + ?Sized> Recovery<S> {
    /// Begins at a sample that the link has brought and that is of another life of the writer: its predecessor may have sent it
    /// too. A program that keeps nothing is believed.
    #[cold]
    fn begin(&mut self, brought: Stamp) {
        self.active = self.kept.is_used();
        (self.brought, self.taken) = (Some(brought), None);
    }

    /// Copies the sample of a number, if it is kept.
    #[cold]
    fn find(&mut self, number: u64) -> bool {
        let found = self.kept.find(number, self.sample.borrow_mut().words_mut());
        if found {
            let stamp = *self.sample.borrow().stamp();
            self.taken = Some((stamp, self.taken.is_some_and(|(last, _)| last != stamp)));
            self.found = true;
        }
        found
    }

    /// Whether what the link brings next comes next, once everything that is kept is taken. A sample is kept before it is sent,
    /// so nothing is taken that the link has still to bring, nor brought that is still to be taken.
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

    /// The same for a signal of so many bodies.
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

    /// The same with a guard.
    pub fn with_guard<G: Guard<S>>(self, guard: G) -> Input<B, S, G> {
        let Self { port, accepted_ticks, last, newest, suspect_generation, repeated, recovery, late, counters, .. } =
            self;
        Input { port, guard, accepted_ticks, last, newest, suspect_generation, repeated, recovery, late, counters }
    }

    /// The same where a scripted fault sends samples late.
    pub fn with_late(self, late: Option<Box<LateSamples>>) -> Self {
        Self { late, ..self }
    }

    /// The same with what the writer of a signal of so many bodies keeps; a successor begins with that.
    pub fn with_recovery(self, kept: Option<RetainedSamples>, bodies: usize, successor: bool) -> Self {
        let recovery = kept.map(|kept| Recovery {
            active: successor && kept.is_used(),
            kept,
            found: false,
            sample: S::blank(bodies),
            taken: None,
            brought: None,
        });
        Self { recovery, ..self }
    }
}

impl<B: Bus, S: Carried + ?Sized, G: Guard<S>> Input<B, S, G> {
    /// Says which ticks samples can have from now on.
    pub fn expect(&mut self, accepted_ticks: AcceptedTicks) {
        self.accepted_ticks = accepted_ticks;
    }

    /// Moves on to the sample of `tick`, or as far as there are older ones.
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

    /// Moves on to the next real sample; false if there is none.
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

    /// Takes one sample off the link, whatever it is worth; false if there is none.
    #[inline]
    fn take(&mut self) -> Result<bool, BusError> {
        if self.recovers() {
            return self.recover();
        }
        if !self.port.advance()? {
            return Ok(false);
        }
        let Some(stamp) = self.port.current().map(|sample| *sample.stamp()) else { return Ok(false) };
        if let Some(recovery) = &mut self.recovery
            && self.last.is_some_and(|(_, known)| stamp.generation & !NO_SAMPLE != known)
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

    /// The same by what the writer keeps.
    #[cold]
    fn recover(&mut self) -> Result<bool, BusError> {
        while let Some(recovery) = &mut self.recovery {
            if recovery.find(self.counters.taken()) {
                let stamp = *recovery.sample.borrow().stamp();
                self.newest = self.account(&stamp);
                return Ok(true);
            }
            if recovery.is_over() {
                // The link has brought the same, and is as far.
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

    /// The sample that was taken last.
    #[inline]
    fn current(&self) -> Option<&S> {
        let recovered = self.recovery.as_ref().filter(|recovery| recovery.found);
        recovered.map_or(self.port.current(), |recovery| Some(recovery.sample.borrow()))
    }

    /// Enters a sample into the counters.
    ///
    /// Ticks rise also from one generation of the sender to the next: a successor goes on with the grid. It may repeat the
    /// tick in which its predecessor died.
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
            // What came before the last sample that a predecessor counted, and that one, are counted. Warm-up tells nothing.
            if self.repeated {
                self.repeated = stamp.tick < tick || generation == 0;
            } else if generation == known || self.lossless() && !stamp.is_warm_up() {
                self.counters.stale();
            }
            return Newest::None;
        }
        if self.late.as_mut().is_some_and(|late| late.contains(stamp.tick)) {
            // One that a successor of the writer sends may be a repetition: see `Output::dispatch_rest`.
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
        // Not by `current`: the guard is another part of this end.
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

    /// Whether nothing is lost on this link, so that in every life of the writer a sample comes once.
    #[inline]
    fn lossless(&self) -> bool {
        matches!(self.accepted_ticks, AcceptedTicks::Next)
    }

    /// Whether a sample can be of this tick, which is newer than the newest.
    #[inline]
    fn possible(&self, tick: u64) -> bool {
        // Where samples are late, one with a broken tick may come after the next one was sent.
        tick <= self.counters.covered() && self.late.is_none()
            || match self.accepted_ticks {
                AcceptedTicks::Unknown => true,
                AcceptedTicks::Next => false,
                AcceptedTicks::Due(grid) => tick <= grid.tick_at(monotonic_ns()),
            }
    }

    /// Sleeps until there may be something new, at most until `until_ns`.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn sleep(&mut self, until_ns: u64) -> Result<(), BusError> {
        self.port.sleep(until_ns)
    }

    /// Whether something is known of this tick or of a later one: it is of no use to wait for it.
    #[inline]
    pub fn knows(&self, tick: u64) -> bool {
        self.last.is_some_and(|(last, _)| last >= tick)
    }

    /// The newest tick of which something is known: there was a sample, believed or not, or a void.
    #[inline]
    pub fn last_tick(&self) -> Option<u64> {
        self.last.map(|(tick, _)| tick)
    }

    /// The sample at hand, if there is one that can be used.
    #[inline]
    pub fn sample(&self) -> Option<&S> {
        self.current().filter(|_| self.newest == Newest::Usable)
    }

    /// The stamp of the newest sample, if it was of the tick that was due and is not believed.
    #[inline]
    pub fn rejected(&self) -> Option<&Stamp> {
        self.current().filter(|_| self.newest == Newest::Rejected).map(S::stamp)
    }

    /// Takes what waits and forgets it, to exercise the link. Before the first tick only.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn warm_up(&mut self) -> Result<(), BusError> {
        self.port.refresh();
        while self.port.advance()? {}
        Ok(())
    }

    /// Finds the shortest way to the writer that there is now. Off the critical path.
    pub fn refresh(&mut self) {
        self.port.refresh();
    }
}

impl<B: Bus, S: Carried + ?Sized, G> Input<B, S, G> {
    /// Whether it goes on by what the writer keeps.
    #[inline]
    fn recovers(&self) -> bool {
        self.recovery.as_ref().is_some_and(|recovery| recovery.active)
    }

    /// The counters.
    pub fn counters(&mut self) -> &mut ReadCounters {
        &mut self.counters
    }

    /// Expects what a predecessor, which this end continues, may have had already.
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
