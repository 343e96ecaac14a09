//! The two ends of a link with their books: what was sent, received, lost, not believed, and its hash.
//!
//! Samples of generation 0 are warm-up: they pass through the link and go no further. A void stands for a sample that does
//! not exist, where everybody waits for inputs. Must not let a sample that its guard does not believe be seen.

use super::disturb::Disturbance;
use super::hooks::{self, Place};
use crate::bus::{Bus, BusError, Carried, Read, Reader, Topic, Write};
use crate::clock::{Grid, monotonic_ns};
use crate::fault::Transport;
use crate::role::{Guard, Unguarded};
use crate::sample::{Stamp, VOID};
use crate::telemetry::{Ledger, ReadBook, WriteBook};
use std::borrow::{Borrow, BorrowMut};

/// The writing end of a signal.
pub struct Output<B: Bus, S: Carried + ?Sized> {
    port: S::Writer<B>,
    generation: u64,
    /// The last sample sent, until [`settle`](Self::settle) has taken it in.
    sent: S::Owned,
    /// Whether it went out as the one of its tick.
    delivered: bool,
    /// Whether a void takes the place of a sample that does not go out.
    voids: bool,
    /// Whether samples are shown first, and published when there is time.
    shows: bool,
    disturbance: Option<Box<Disturbance<S>>>,
    book: WriteBook,
}

impl<B: Bus, S: Carried + ?Sized> Output<B, S> {
    /// Opens a signal of so many bodies for a run that ends with `last_tick`, with its book in the ledger.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open(
        bus: &B,
        topic: &Topic,
        bodies: usize,
        generation: u64,
        ledger: &Ledger,
        last_tick: u64,
    ) -> Result<Self, BusError> {
        let book = WriteBook::open(ledger, last_tick);
        let (port, sent) = (S::writer(bus, topic, bodies, generation)?, S::blank(bodies));
        Ok(Self { port, generation, sent, delivered: true, voids: false, shows: false, disturbance: None, book })
    }

    /// With voids in the place of samples that do not go out, for readers that wait for every tick.
    pub fn with_voids(self, voids: bool) -> Self {
        Self { voids, ..self }
    }

    /// Whose samples are shown to readers of the newest at first, and sent to the others by [`publish`](Self::publish).
    pub fn shown_first(self) -> Self {
        Self { shows: true, ..self }
    }

    /// With scripted faults.
    pub fn disturbed(self, disturbance: Option<Box<Disturbance<S>>>) -> Self {
        Self { disturbance, ..self }
    }

    /// Fills and sends one sample. `fill` writes everything but the generation.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn send(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        if self.disturbance.is_some() {
            return self.send_disturbed(fill);
        }
        let (generation, sent) = (self.generation, self.sent.borrow_mut());
        let fill = |sample: &mut S| {
            fill(sample);
            sample.stamp_mut().generation = generation;
            sent.assign(sample);
            hooks::at(Place::Loaned);
        };
        if self.shows {
            self.port.show(fill)?
        } else {
            self.port.send(fill)?
        }
        hooks::at(Place::Sent);
        Ok(())
    }

    /// Sends what was only shown, if anything was.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn publish(&mut self) -> Result<(), BusError> {
        self.port.publish()
    }

    /// Sends a sample as the scripted faults have it.
    #[cold]
    fn send_disturbed(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        let Some(disturbance) = &mut self.disturbance else { return Ok(()) };
        let mut own = disturbance.blank();
        let sample: &mut S = own.borrow_mut();
        fill(sample);
        sample.stamp_mut().generation = self.generation;
        let stamp = *sample.stamp();
        let (mut injected, way) =
            (disturbance.tamper(stamp.tick, sample, self.sent.borrow()), disturbance.way(stamp.tick));
        injected |= way.is_some();
        while let Some(late) = disturbance.due(stamp.tick) {
            self.port.prepare()?;
            self.port.send(|slot| slot.assign(late.borrow()))?;
            self.book.extra();
        }
        // A sample with a broken stamp goes out as it is, but not as the one of its tick.
        let own = (sample.stamp().tick, sample.stamp().generation) == (stamp.tick, stamp.generation);
        self.delivered = own && !matches!(way, Some(Transport::Drop | Transport::Delay { .. }));
        let copies = match way {
            Some(Transport::Drop) => 0,
            Some(Transport::Delay { ticks }) => {
                disturbance.keep(stamp.tick + ticks, sample);
                0
            }
            Some(Transport::Duplicate) => 2,
            None => 1,
        };
        for _ in 0..copies {
            self.port.prepare()?;
            self.port.send(|slot| {
                slot.assign(sample);
                hooks::at(Place::Loaned);
            })?;
        }
        (self.delivered as u64..copies).for_each(|_| self.book.extra());
        if injected {
            self.book.injected();
        }
        let sent = self.sent.borrow_mut();
        sent.assign(sample);
        *sent.stamp_mut() = stamp;
        if !self.delivered {
            self.send_void(&stamp)?;
        }
        hooks::at(Place::Sent);
        Ok(())
    }

    /// Says that there is no sample for this tick, where readers wait for one. Without its having been made, if it never
    /// was: an input was missing.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn pass_over(&mut self, tick: u64) -> Result<(), BusError> {
        if self.voids {
            self.send_void(&Stamp { tick, generation: self.generation, ..Stamp::default() })?;
            self.book.enter_void(tick, true);
            self.port.prepare()?;
        }
        Ok(())
    }

    /// Sends a void that is in the books again.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn repeat_void(&mut self, tick: u64) -> Result<(), BusError> {
        self.send_void(&Stamp { tick, generation: self.generation, ..Stamp::default() })
    }

    fn send_void(&mut self, stamp: &Stamp) -> Result<(), BusError> {
        if !self.voids {
            return Ok(());
        }
        self.port.prepare()?;
        self.port.send(|slot| {
            slot.words_mut().fill(0);
            *slot.stamp_mut() = Stamp { generation: stamp.generation | VOID, ..*stamp };
        })
    }

    /// Does what a sent sample leaves to be done: books, hash, memory for the next. Off the critical path.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn settle(&mut self) -> Result<(), BusError> {
        if self.delivered {
            self.book.enter(self.sent.borrow());
        } else {
            self.book.withheld();
            self.book.enter_void(self.sent.borrow().stamp().tick, self.voids);
        }
        self.port.prepare()
    }

    /// Sends a sample that no role uses, to exercise the link.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn warm_up(&mut self) -> Result<(), BusError> {
        self.port.send(|sample| *sample.stamp_mut() = Stamp::default())?;
        self.port.prepare()
    }

    /// Lets readers that have come later know of this end. Off the critical path.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn refresh(&mut self) -> Result<(), BusError> {
        self.port.refresh()
    }

    /// The last sample that was sent.
    #[inline]
    pub fn sent(&self) -> &S {
        self.sent.borrow()
    }

    /// How many samples were made, sent or withheld, also by predecessors.
    pub fn made(&self) -> u64 {
        self.book.made()
    }
}

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
pub enum Horizon {
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
    AtHand,
    /// It was of the tick that was due, and is not believed.
    Rejected,
    /// There is none, or it was a void, or it was displaced by one of no use.
    None,
}

/// The reading end of a signal.
pub struct Input<B: Bus, S: Carried + ?Sized, G = Unguarded> {
    port: S::Reader<B>,
    guard: G,
    horizon: Horizon,
    /// Tick and generation of the newest tick that something is known of.
    last: Option<(u64, u64)>,
    /// Whatever arrives displaces what was at hand, usable or not.
    newest: Newest,
    /// The generation of a sample that was taken for a predecessor's: if the next says the same, it is to be believed.
    doubted: Option<u64>,
    book: ReadBook,
}

impl<B: Bus, S: Carried + ?Sized> Input<B, S> {
    /// Opens a signal of so many bodies, with its book in the ledger.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open(bus: &B, topic: &Topic, bodies: usize, reader: Reader, ledger: &Ledger) -> Result<Self, BusError> {
        let book = ReadBook::open(ledger);
        Ok(Self {
            port: S::reader(bus, topic, reader, bodies)?,
            guard: Unguarded,
            horizon: Horizon::Unknown,
            last: None,
            newest: Newest::None,
            doubted: None,
            book,
        })
    }

    /// Opens a signal for a reader whose books nobody asks for.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn watch(bus: &B, topic: &Topic, reader: Reader) -> Result<Self, BusError> {
        Self::watch_many(bus, topic, 1, reader)
    }

    /// The same for a signal of so many bodies.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn watch_many(bus: &B, topic: &Topic, bodies: usize, reader: Reader) -> Result<Self, BusError> {
        Self::open(bus, topic, bodies, reader, &Ledger::private(ReadBook::WORDS))
    }

    /// The same with a guard.
    pub fn guarded<G: Guard<S>>(self, guard: G) -> Input<B, S, G> {
        let Self { port, horizon, last, newest, doubted, book, .. } = self;
        Input { port, guard, horizon, last, newest, doubted, book }
    }
}

impl<B: Bus, S: Carried + ?Sized, G: Guard<S>> Input<B, S, G> {
    /// Says which ticks samples can have from now on.
    pub fn expect(&mut self, horizon: Horizon) {
        self.horizon = horizon;
    }

    /// Moves on to the sample of `tick`, or as far as there are older ones.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    #[inline]
    pub fn seek(&mut self, tick: u64) -> Result<Seek, BusError> {
        loop {
            match (self.last, self.newest) {
                (Some((last, _)), Newest::AtHand) if last == tick => return Ok(Seek::Found),
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
            if self.newest == Newest::AtHand {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Takes one sample off the link, whatever it is worth; false if there is none.
    #[inline]
    fn take(&mut self) -> Result<bool, BusError> {
        if !self.port.advance()? {
            return Ok(false);
        }
        let stamp = self.port.current().map(|sample| *sample.stamp());
        self.newest = stamp.map_or(Newest::None, |stamp| self.account(&stamp));
        Ok(true)
    }

    /// Enters a sample into the books.
    ///
    /// Ticks rise also from one generation of the sender to the next: a successor goes on with the grid. It may repeat the
    /// tick in which its predecessor died.
    #[inline]
    fn account(&mut self, stamp: &Stamp) -> Newest {
        let generation = stamp.generation & !VOID;
        let (newest_tick, known) = match self.last {
            Some((tick, known)) => (Some(tick), known),
            // Warm-up.
            None if generation == 0 => return Newest::None,
            None => (None, 0),
        };
        if newest_tick.is_some_and(|tick| stamp.tick <= tick) {
            if generation == known {
                self.book.stale();
            }
            return Newest::None;
        }
        if !self.possible(stamp.tick) {
            self.book.stray();
            return Newest::None;
        }
        if generation < known && self.doubted.replace(generation) != Some(generation) {
            self.last = Some((stamp.tick, known));
            self.book.rejected(stamp.tick);
            return Newest::Rejected;
        }
        self.doubted = None;
        self.last = Some((stamp.tick, generation));
        if stamp.generation & VOID != 0 {
            self.book.void(stamp.tick);
            return Newest::None;
        }
        if self.port.current().is_some_and(|sample| self.guard.accepts(sample)) {
            self.book.received(stamp.tick);
            return Newest::AtHand;
        }
        self.book.rejected(stamp.tick);
        Newest::Rejected
    }

    /// Whether a sample can be of this tick, which is newer than the newest.
    #[inline]
    fn possible(&self, tick: u64) -> bool {
        tick <= self.book.covered()
            || match self.horizon {
                Horizon::Unknown => true,
                Horizon::Next => false,
                Horizon::Due(grid) => tick <= grid.tick_at(monotonic_ns()),
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
        self.port.current().filter(|_| self.newest == Newest::AtHand)
    }

    /// The stamp of the newest sample, if it was of the tick that was due and is not believed.
    #[inline]
    pub fn rejected(&self) -> Option<&Stamp> {
        self.port.current().filter(|_| self.newest == Newest::Rejected).map(S::stamp)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::memory::MemoryBus;
    use crate::bus::{Depths, Signal};
    use crate::sample::RateCommand;
    use crate::telemetry::{LinkRead, LinkWritten};

    struct Ends {
        output: Output<MemoryBus, RateCommand>,
        input: Input<MemoryBus, RateCommand>,
        ledger: Ledger,
    }

    const LAST: u64 = 100;

    fn ledger() -> Ledger {
        Ledger::private(WriteBook::words(LAST) + ReadBook::WORDS)
    }

    fn ends(depth: usize) -> Ends {
        let bus = MemoryBus::new(Depths { role: depth, scorer: 1, history: 0 });
        let topic = Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Command };
        let ledger = ledger();
        let output = Output::open(&bus, &topic, 1, 1, &ledger, LAST).unwrap();
        Ends { output, input: Input::open(&bus, &topic, 1, Reader::Role, &ledger).unwrap(), ledger }
    }

    impl Ends {
        fn send(&mut self, ticks: &[u64]) {
            for &tick in ticks {
                self.output.send(|sample| sample.stamp.tick = tick).unwrap();
                self.output.settle().unwrap();
            }
        }

        /// The books as whoever takes these seats next would find them.
        fn books(&self) -> (LinkWritten, LinkRead) {
            let again = self.ledger.reopened();
            (WriteBook::open(&again, LAST).report(""), ReadBook::open(&again).report(""))
        }
    }

    #[test]
    fn the_books_of_both_ends_agree() {
        let mut ends = ends(8);
        ends.output.warm_up().unwrap();
        ends.send(&[0, 1, 4, 5]);
        assert_eq!(ends.input.seek(4).unwrap(), Seek::Found);
        assert_eq!(ends.input.seek(2).unwrap(), Seek::Passed);
        assert_eq!(ends.input.seek(6).unwrap(), Seek::NotYet);
        let (written, read) = ends.books();
        assert_eq!((written.published, written.skipped, written.last_tick), (4, 2, Some(5)));
        assert_eq!((read.received, read.gaps, read.stale, read.last_tick), (4, 2, 0, Some(5)));
    }

    #[test]
    fn a_shallow_reader_counts_what_it_was_too_late_for() {
        let mut ends = ends(1);
        ends.send(&[0, 1, 2, 3]);
        assert_eq!(ends.input.seek(3).unwrap(), Seek::Found);
        let read = ends.books().1;
        assert_eq!((read.received, read.gaps), (1, 3));
    }

    #[test]
    fn an_older_sample_is_counted_and_never_seen() {
        let Ends { mut output, mut input, ledger } = ends(8);
        for tick in [3, 2, 3, 4] {
            output.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        assert!(input.advance().unwrap());
        assert!(input.advance().unwrap());
        assert_eq!(input.sample().unwrap().stamp.tick, 4);
        output.send(|sample| sample.stamp.tick = 4).unwrap();
        assert!(!input.advance().unwrap() && input.sample().is_none(), "displaced, not mistaken for the good one");
        assert_eq!(Ends { output, input, ledger }.books().1.stale, 3);
    }

    #[test]
    fn a_successor_goes_on_with_the_books_and_counts_nothing_twice() {
        let mut ends = ends(8);
        ends.send(&[0, 1, 2]);
        assert_eq!(ends.input.seek(2).unwrap(), Seek::Found);
        let again = ends.ledger.reopened();
        let bus = MemoryBus::new(Depths { role: 8, scorer: 1, history: 0 });
        let topic = Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Command };
        let mut output = Output::<_, RateCommand>::open(&bus, &topic, 1, 2, &again, LAST).unwrap();
        let mut input = Input::<_, RateCommand>::open(&bus, &topic, 1, Reader::Role, &again).unwrap();
        // Tick 2 is repeated to it, as a link with history does; ticks 3 and 4 fell into the gap.
        for tick in [2, 5] {
            output.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        output.settle().unwrap();
        assert_eq!((input.seek(2).unwrap(), input.seek(5).unwrap()), (Seek::Found, Seek::Found));
        let (written, read) = ends.books();
        assert_eq!((written.published, written.skipped, written.last_tick), (4, 2, Some(5)));
        assert_eq!((read.received, read.gaps, read.stale, read.last_tick), (4, 2, 0, Some(5)));
    }
}
