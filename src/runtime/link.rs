//! The two ends of a link with their books: what was sent, received, lost, and its hash.
//!
//! Samples of generation 0 are warm-up: they pass through the link and go no further.

use super::hooks::{self, Place};
use crate::bus::{Bus, BusError, Read, Reader, Topic, Write};
use crate::sample::{Sample, Stamp};
use crate::telemetry::{Ledger, ReadBook, WriteBook};

/// The writing end of a signal.
pub struct Output<B: Bus, S: Sample> {
    port: B::Writer<S>,
    generation: u64,
    /// The last sample sent, until [`settle`](Self::settle) has taken it in.
    sent: S,
    book: WriteBook,
}

impl<B: Bus, S: Sample> Output<B, S> {
    /// Opens a signal for a run that ends with `last_tick`, with its book in the ledger.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open(bus: &B, topic: &Topic, generation: u64, ledger: &Ledger, last_tick: u64) -> Result<Self, BusError> {
        let book = WriteBook::open(ledger, last_tick);
        Ok(Self { port: bus.writer(topic)?, generation, sent: S::default(), book })
    }

    /// Fills and sends one sample. `fill` writes everything but the generation.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn send(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        let (generation, sent) = (self.generation, &mut self.sent);
        self.port.send(|sample| {
            fill(sample);
            sample.stamp_mut().generation = generation;
            *sent = *sample;
            hooks::at(Place::Loaned);
        })?;
        hooks::at(Place::Sent);
        Ok(())
    }

    /// Does what a sent sample leaves to be done: books, hash, memory for the next. Off the critical path.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn settle(&mut self) -> Result<(), BusError> {
        self.book.enter(&self.sent);
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
        &self.sent
    }

    /// How many samples were sent, also by predecessors.
    pub fn published(&self) -> u64 {
        self.book.published()
    }
}

/// What a reading end has for a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seek {
    /// The sample of that tick is at hand.
    Found,
    /// Nothing so new has arrived.
    NotYet,
    /// A later sample is at hand: that tick's will never come.
    Passed,
}

/// The reading end of a signal.
pub struct Input<B: Bus, S: Sample> {
    port: B::Reader<S>,
    /// Tick and generation of the last real sample.
    last: Option<(u64, u64)>,
    /// Whether that sample is still at hand: whatever arrives after it displaces it, usable or not.
    at_hand: bool,
    book: ReadBook,
}

impl<B: Bus, S: Sample> Input<B, S> {
    /// Opens a signal, with its book in the ledger.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open(bus: &B, topic: &Topic, reader: Reader, ledger: &Ledger) -> Result<Self, BusError> {
        let book = ReadBook::open(ledger);
        Ok(Self { port: bus.reader(topic, reader)?, last: None, at_hand: false, book })
    }

    /// Opens a signal for a reader whose books nobody asks for.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn watch(bus: &B, topic: &Topic, reader: Reader) -> Result<Self, BusError> {
        Self::open(bus, topic, reader, &Ledger::private(ReadBook::WORDS))
    }

    /// Moves on to the sample of `tick`, or as far as there are older ones.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    #[inline]
    pub fn seek(&mut self, tick: u64) -> Result<Seek, BusError> {
        loop {
            match self.last {
                Some((last, _)) if last == tick && self.at_hand => return Ok(Seek::Found),
                Some((last, _)) if last >= tick => return Ok(Seek::Passed),
                _ => {}
            }
            if !self.advance()? {
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
        while self.port.advance()? {
            let Some(stamp) = self.port.current().map(|sample| *sample.stamp()) else { return Ok(false) };
            self.at_hand = stamp.generation != 0 && self.account(&stamp);
            if self.at_hand {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Enters a sample into the books; false if it is not newer than the one before.
    ///
    /// Ticks rise also from one generation of the sender to the next: a successor goes on with the grid. It may repeat the
    /// tick in which its predecessor died.
    #[inline]
    fn account(&mut self, stamp: &Stamp) -> bool {
        match self.last {
            Some((tick, generation)) if stamp.tick <= tick => {
                if generation == stamp.generation {
                    self.book.stale();
                }
                return false;
            }
            _ => {}
        }
        self.book.received(stamp.tick);
        self.last = Some((stamp.tick, stamp.generation));
        true
    }

    /// The tick of the last real sample.
    pub fn last_tick(&self) -> Option<u64> {
        self.last.map(|(tick, _)| tick)
    }

    /// The sample at hand, if it is a real one.
    #[inline]
    pub fn sample(&self) -> Option<&S> {
        self.port.current().filter(|_| self.at_hand)
    }

    /// Takes what waits and forgets it, to exercise the link. Before the first tick only.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn warm_up(&mut self) -> Result<(), BusError> {
        while self.port.advance()? {}
        Ok(())
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
        let output = Output::open(&bus, &topic, 1, &ledger, LAST).unwrap();
        Ends { output, input: Input::open(&bus, &topic, Reader::Role, &ledger).unwrap(), ledger }
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
        let mut output = Output::<_, RateCommand>::open(&bus, &topic, 2, &again, LAST).unwrap();
        let mut input = Input::<_, RateCommand>::open(&bus, &topic, Reader::Role, &again).unwrap();
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
