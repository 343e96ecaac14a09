//! The two ends of a link with their books: what was sent, received, lost, and its hash.
//!
//! Samples of generation 0 are warm-up: they pass through the link and go no further.

use crate::bus::{Bus, BusError, Read, Reader, Topic, Write};
use crate::sample::{Sample, Stamp};
use crate::telemetry::{LinkRead, LinkWritten, StateHash};

/// The writing end of a signal.
pub struct Output<B: Bus, S: Sample> {
    port: B::Writer<S>,
    service: String,
    generation: u64,
    /// The last sample sent, until [`settle`](Self::settle) has taken it in.
    sent: S,
    hash: StateHash,
    published: u64,
    skipped: u64,
    last_tick: Option<u64>,
}

impl<B: Bus, S: Sample> Output<B, S> {
    /// Opens a signal for a run that ends with `last_tick`.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open(bus: &B, topic: &Topic, generation: u64, last_tick: u64) -> Result<Self, BusError> {
        Ok(Self {
            port: bus.writer(topic)?,
            service: topic.to_string(),
            generation,
            sent: S::default(),
            hash: StateHash::new(last_tick),
            published: 0,
            skipped: 0,
            last_tick: None,
        })
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
        })
    }

    /// Does what a sent sample leaves to be done: books, hash, memory for the next. Off the critical path.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn settle(&mut self) -> Result<(), BusError> {
        let tick = self.sent.stamp().tick;
        self.hash.absorb(&self.sent);
        self.skipped += tick - self.last_tick.map_or(0, |last| last + 1);
        self.published += 1;
        self.last_tick = Some(tick);
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

    /// The books.
    pub fn report(&self) -> LinkWritten {
        LinkWritten {
            service: self.service.clone(),
            published: self.published,
            skipped: self.skipped,
            last_tick: self.last_tick,
            hash: Some(self.hash.checkpoints()),
        }
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
    service: String,
    /// Tick and generation of the last real sample.
    last: Option<(u64, u64)>,
    /// Whether that sample is still at hand: whatever arrives after it displaces it, usable or not.
    at_hand: bool,
    received: u64,
    gaps: u64,
    stale: u64,
}

impl<B: Bus, S: Sample> Input<B, S> {
    /// Opens a signal.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open(bus: &B, topic: &Topic, reader: Reader) -> Result<Self, BusError> {
        let port = bus.reader(topic, reader)?;
        Ok(Self { port, service: topic.to_string(), last: None, at_hand: false, received: 0, gaps: 0, stale: 0 })
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
    #[inline]
    fn account(&mut self, stamp: &Stamp) -> bool {
        let expected = match self.last {
            Some((tick, generation)) if generation == stamp.generation => tick + 1,
            // A restarted sender goes on with the grid's tick: nothing of its past is owed.
            Some(_) => stamp.tick,
            None => 0,
        };
        if stamp.tick < expected {
            self.stale += 1;
            return false;
        }
        self.received += 1;
        self.gaps += stamp.tick - expected;
        self.last = Some((stamp.tick, stamp.generation));
        true
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

    /// The books.
    pub fn report(&self) -> LinkRead {
        LinkRead {
            service: self.service.clone(),
            received: self.received,
            gaps: self.gaps,
            stale: self.stale,
            last_tick: self.last.map(|(tick, _)| tick),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::memory::MemoryBus;
    use crate::bus::{Depths, Signal};
    use crate::sample::RateCommand;

    fn ends(depth: usize) -> (Output<MemoryBus, RateCommand>, Input<MemoryBus, RateCommand>) {
        let bus = MemoryBus::new(Depths { role: depth, scorer: 1 });
        let topic = Topic { scenario: "s".to_owned(), body: "b".to_owned(), signal: Signal::Command };
        let output = Output::open(&bus, &topic, 1, 100).unwrap();
        (output, Input::open(&bus, &topic, Reader::Role).unwrap())
    }

    fn send(output: &mut Output<MemoryBus, RateCommand>, ticks: &[u64]) {
        for &tick in ticks {
            output.send(|sample| sample.stamp.tick = tick).unwrap();
            output.settle().unwrap();
        }
    }

    #[test]
    fn the_books_of_both_ends_agree() {
        let (mut output, mut input) = ends(8);
        output.warm_up().unwrap();
        send(&mut output, &[0, 1, 4, 5]);
        assert_eq!(input.seek(4).unwrap(), Seek::Found);
        assert_eq!(input.seek(2).unwrap(), Seek::Passed);
        assert_eq!(input.seek(6).unwrap(), Seek::NotYet);
        let (written, read) = (output.report(), input.report());
        assert_eq!((written.published, written.skipped, written.last_tick), (4, 2, Some(5)));
        assert_eq!((read.received, read.gaps, read.stale, read.last_tick), (4, 2, 0, Some(5)));
    }

    #[test]
    fn a_shallow_reader_counts_what_it_was_too_late_for() {
        let (mut output, mut input) = ends(1);
        send(&mut output, &[0, 1, 2, 3]);
        assert_eq!(input.seek(3).unwrap(), Seek::Found);
        assert_eq!((input.report().received, input.report().gaps), (1, 3));
    }

    #[test]
    fn an_older_sample_is_counted_and_never_seen() {
        let (mut output, mut input) = ends(8);
        for tick in [3, 2, 3, 4] {
            output.send(|sample| sample.stamp.tick = tick).unwrap();
        }
        assert!(input.advance().unwrap());
        assert!(input.advance().unwrap());
        assert_eq!(input.sample().unwrap().stamp.tick, 4);
        assert_eq!(input.report().stale, 2);
        output.send(|sample| sample.stamp.tick = 4).unwrap();
        assert!(!input.advance().unwrap() && input.sample().is_none(), "displaced, not mistaken for the good one");
    }
}
