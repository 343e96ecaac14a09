//! The writing end of a link with its counters and hash.
//!
//! A sample is staged, invisible to readers; the role commits its state; then the sample is dispatched. So nothing is
//! sent that is not committed. A successor sends what is committed and perhaps not sent; readers recognise a repeated
//! sample by its tick. In lockstep a no-sample marker replaces a sample that does not exist. Must not commit.

use super::retained::RetainedSamples;
use crate::bus::{Bus, BusError, Carried, Topic, Write};
use crate::fault::Delivery;
use crate::runtime::disturb::Disturbance;
use crate::runtime::hooks::{self, Failpoint};
use crate::sample::{NO_SAMPLE, Stamp};
use crate::state::{Persist, Words, persist_fields};
use crate::telemetry::{Ledger, LinkWritten, Slots, WriteCounters};
use std::borrow::{Borrow, BorrowMut};

/// Length of a stamp, words.
const STAMP_WORDS: usize = size_of::<Stamp>() / size_of::<u64>();

/// The writing end of a signal.
pub struct Output<B: Bus, S: Carried + ?Sized> {
    port: S::Writer<B>,
    generation: u64,
    /// The staged sample: committed, not yet counted. `sample` holds its content under its original stamp.
    staged: Staged,
    sample: S::Owned,
    /// True if the port already holds the sample.
    filled: bool,
    /// True if a no-sample marker replaces a sample that is not sent.
    markers: bool,
    /// True if samples are first written to the latest-value channel and published later.
    writes_latest: bool,
    /// True while a sample is in the channel and not published.
    unpublished: bool,
    disturbance: Option<Box<Disturbance<S>>>,
    counters: WriteCounters,
    /// Number of samples sent, for a successor.
    progress: Option<Slots>,
    retained: Option<RetainedSamples>,
    /// True until a successor has sent its first sample.
    succeeds: bool,
}

/// The samples to send for one tick.
#[derive(Debug, Clone, Copy, Default)]
struct Staged {
    /// Number of samples sent before this tick.
    before: u64,
    tick: u64,
    /// One of the constants below.
    kind: u64,
    /// The stamp to send; a scripted fault may have broken it.
    stamp: [u64; STAMP_WORDS],
    /// Number of delayed samples of earlier ticks that go out before this one.
    late: u64,
    /// Number of copies of this tick's sample.
    copies: u64,
}

persist_fields!(Staged, before, tick, kind, stamp, late, copies);

impl Staged {
    /// Nothing staged, or already counted.
    const NOTHING: u64 = 0;
    /// The sample of the tick.
    const SAMPLE: u64 = 1;
    /// A sample that is not sent as that of its tick.
    const WITHHELD: u64 = 2;
    /// No sample.
    const ABSENT: u64 = 3;

    /// Returns the number of samples to send.
    #[inline]
    fn samples(&self, markers: bool) -> u64 {
        let marker = markers && matches!(self.kind, Self::WITHHELD | Self::ABSENT);
        self.late + self.copies + u64::from(marker)
    }

    /// Counts the staged sample with the given content.
    #[inline]
    fn count(&mut self, counters: &mut WriteCounters, content: &[u8], markers: bool) {
        self.before += self.samples(markers);
        (self.late, self.copies) = (0, 0);
        match std::mem::take(&mut self.kind) {
            Self::SAMPLE => counters.enter(self.tick, content),
            Self::WITHHELD | Self::ABSENT => counters.enter_without_sample(self.tick, markers),
            _ => {}
        }
    }
}

/// Length of the run and number of [retained samples](RetainedSamples): together the size of a writing end's part of
/// the ledger.
#[derive(Debug, Clone, Copy)]
pub struct Extent {
    /// The last tick.
    pub last_tick: u64,
    /// Number of retained samples.
    pub retained_samples: u64,
}

impl Extent {
    /// Returns the ledger words besides the record, for samples of `length` words.
    pub fn words(self, length: usize) -> usize {
        1 + WriteCounters::words(self.last_tick) + RetainedSamples::words(self.retained_samples, length)
    }
}

impl<B: Bus, S: Carried + ?Sized> Output<B, S> {
    /// Opens a signal of `bodies` bodies.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open(
        bus: &B,
        topic: &Topic,
        bodies: usize,
        generation: u64,
        ledger: &Ledger,
        extent: Extent,
    ) -> Result<Self, BusError> {
        let progress = Some(ledger.take(1)).filter(|_| ledger.is_shared());
        let counters = WriteCounters::open(ledger, extent.last_tick);
        let retained = RetainedSamples::open(ledger, extent.retained_samples, S::length(bodies));
        Ok(Self {
            port: S::writer(bus, topic, bodies, generation)?,
            generation,
            staged: Staged::default(),
            sample: S::blank(bodies),
            filled: false,
            markers: false,
            writes_latest: false,
            unpublished: false,
            disturbance: None,
            counters,
            progress,
            retained,
            succeeds: generation > 1,
        })
    }

    /// Sends a no-sample marker in place of a missing sample, for readers that wait for every tick.
    pub fn with_markers(self, markers: bool) -> Self {
        Self { markers, ..self }
    }

    /// Writes samples to the latest-value channel first; [`finish`](Self::finish) publishes them.
    pub fn latest_first(self) -> Self {
        Self { writes_latest: true, ..self }
    }

    /// Adds scripted faults.
    pub fn disturbed(self, disturbance: Option<Box<Disturbance<S>>>) -> Self {
        Self { disturbance, ..self }
    }

    /// Stages the sample of a tick. `fill` writes everything but the generation.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn stage(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        if self.disturbance.is_some() {
            self.stage_disturbed(fill);
            return Ok(());
        }
        let (generation, retained) = (self.generation, self.sample.borrow_mut());
        self.port.fill(|sample| {
            fill(sample);
            sample.stamp_mut().generation = generation;
            retained.assign(sample);
        })?;
        self.filled = true;
        let stamp = *retained.stamp();
        let (before, stamp_words) = (self.staged.before, bytemuck::cast(stamp));
        self.staged = Staged { before, tick: stamp.tick, kind: Staged::SAMPLE, stamp: stamp_words, late: 0, copies: 1 };
        hooks::at(Failpoint::Staged);
        Ok(())
    }

    /// Stages a sample with scripted faults applied.
    #[cold]
    fn stage_disturbed(&mut self, fill: impl FnOnce(&mut S)) {
        let Some(disturbance) = &mut self.disturbance else { return };
        let mut made = disturbance.blank();
        let sample: &mut S = made.borrow_mut();
        fill(sample);
        sample.stamp_mut().generation = self.generation;
        let stamp = *sample.stamp();
        let tampered = disturbance.alter_content(stamp.tick, sample, self.sample.borrow());
        let way = disturbance.delivery(stamp.tick);
        if tampered || way.is_some() {
            self.counters.injected();
        }
        let late = disturbance.due(stamp.tick);
        // A sample with a broken stamp is sent, but does not count as that of its tick.
        let sound = (sample.stamp().tick, sample.stamp().generation) == (stamp.tick, stamp.generation);
        let delivered = sound && !matches!(way, Some(Delivery::Dropped | Delivery::Late(_)));
        let copies = match way {
            Some(Delivery::Dropped) => 0,
            Some(Delivery::Late(ticks)) => {
                disturbance.keep(stamp.tick + ticks, sample);
                0
            }
            Some(Delivery::Twice) => 2,
            None => 1,
        };
        self.counters.extra(late + copies - u64::from(delivered));
        let kind = if delivered { Staged::SAMPLE } else { Staged::WITHHELD };
        let (before, stamp_words) = (self.staged.before, bytemuck::cast(*sample.stamp()));
        self.staged = Staged { before, tick: stamp.tick, kind, stamp: stamp_words, late, copies };
        let retained = self.sample.borrow_mut();
        retained.assign(sample);
        *retained.stamp_mut() = stamp;
        hooks::at(Failpoint::Staged);
    }

    /// Stages a no-sample marker for a tick, if readers wait for one.
    pub fn stage_marker(&mut self, tick: u64) {
        let kind = if self.markers { Staged::ABSENT } else { Staged::NOTHING };
        self.staged = Staged { before: self.staged.before, tick, kind, ..Staged::default() };
    }

    /// Sends the staged sample, or the part of it that is not sent.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn dispatch(&mut self) -> Result<(), BusError> {
        if !std::mem::take(&mut self.filled) {
            return self.dispatch_rest();
        }
        if let Some(retained) = &self.retained {
            let sample: &S = self.sample.borrow();
            retained.keep(self.staged.before, sample.words().iter().copied());
        }
        if self.writes_latest {
            self.port.write_latest()?;
            self.unpublished = true;
        } else {
            self.port.deliver()?;
            hooks::at(Failpoint::Sent);
            self.sent(1);
        }
        Ok(())
    }

    /// Records that this number of samples of the tick has been sent.
    #[inline]
    fn sent(&self, samples: u64) {
        if let Some(progress) = &self.progress {
            progress.set(0, self.staged.before + samples);
        }
    }

    /// Returns the number of samples of the tick that a predecessor has sent.
    fn already_sent(&self) -> u64 {
        let sent = self.progress.as_ref().map_or(0, |progress| progress.get(0));
        sent.saturating_sub(self.staged.before)
    }

    /// Sends the staged samples that a predecessor has not sent.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[cold]
    pub fn dispatch_rest(&mut self) -> Result<(), BusError> {
        self.filled = false;
        let Staged { before, tick, kind, late, copies, .. } = self.staged;
        let made = *self.sample.borrow().stamp();
        // A sample of an earlier generation gets the current one, also if a scripted fault has broken it.
        let lives = if kind == Staged::ABSENT { 0 } else { made.generation ^ self.generation };
        let own: Stamp = bytemuck::cast(self.staged.stamp);
        let marker = if kind == Staged::ABSENT {
            Stamp { tick, generation: self.generation | NO_SAMPLE, ..Stamp::default() }
        } else {
            Stamp { generation: made.generation | NO_SAMPLE, ..made }
        };
        for index in self.already_sent()..self.staged.samples(self.markers) {
            self.port.prepare()?;
            let late =
                self.disturbance.as_ref().and_then(|disturbance| disturbance.late(index)).filter(|_| index < late);
            let (sample, retained): (&S, _) = (self.sample.borrow(), self.retained.as_ref());
            // The predecessor may have sent this first sample. The new generation makes readers check the retained
            // samples, or ignore a repeated late sample.
            let (first, generation) = (std::mem::take(&mut self.succeeds), self.generation);
            self.port.fill(|slot| {
                match late {
                    Some(late) => slot.assign(late),
                    None if index < self.staged.late + copies => {
                        slot.assign(sample);
                        *slot.stamp_mut() = own;
                    }
                    None => {
                        slot.words_mut().fill(0);
                        *slot.stamp_mut() = marker;
                    }
                }
                // Before a reader can see it.
                if let Some(retained) = retained {
                    retained.keep(before + index, slot.words().iter().copied());
                }
                let stamp = slot.stamp_mut();
                if late.is_none() {
                    stamp.generation ^= lives;
                }
                if first && (retained.is_some() || late.is_some()) {
                    stamp.generation = generation | stamp.generation & NO_SAMPLE;
                }
            })?;
            self.port.deliver()?;
            hooks::at(Failpoint::Sent);
            self.sent(index + 1);
        }
        Ok(())
    }

    /// Completes a dispatched sample: publishes, counts, hashes, loans the next one. Off the critical path.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn finish(&mut self) -> Result<(), BusError> {
        if std::mem::take(&mut self.unpublished) {
            self.port.publish()?;
            hooks::at(Failpoint::Sent);
            self.sent(1);
        }
        if let Some(disturbance) = &mut self.disturbance {
            disturbance.forget(self.staged.late);
        }
        self.staged.count(&mut self.counters, self.sample.borrow().content(), self.markers);
        self.port.prepare()
    }

    /// Stages, dispatches and finishes a sample.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn send(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        self.stage(fill)?;
        self.dispatch()?;
        self.finish()
    }

    /// Sends a warm-up sample, which no role uses.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn warm_up(&mut self) -> Result<(), BusError> {
        self.port.send(|sample| *sample.stamp_mut() = Stamp::default())?;
        self.port.prepare()
    }

    /// Connects to readers that came later. Off the critical path.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn refresh(&mut self) -> Result<(), BusError> {
        self.port.refresh()
    }

    /// Returns the last sample made.
    #[inline]
    pub fn last(&self) -> &S {
        self.sample.borrow()
    }

    /// Returns the counters, without the staged sample.
    pub fn counters(&self) -> &WriteCounters {
        &self.counters
    }
}

/// The counters and the staged sample.
impl<B: Bus, S: Carried + ?Sized> Persist for Output<B, S> {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.counters.persist(words);
        self.staged.persist(words);
        self.sample.borrow_mut().words_mut().persist(words);
    }
}

impl<B: Bus, S: Carried + ?Sized> Output<B, S> {
    /// Passes the delayed samples; see [`Persist`].
    pub fn persist_late<W: Words>(&mut self, words: &mut W) {
        self.disturbance.iter_mut().for_each(|disturbance| disturbance.persist(words));
    }
}

/// Returns the counters of a written signal of `length` words from a role's record; a committed sample counts as sent.
pub fn written(
    words: &mut impl Words,
    service: &str,
    length: usize,
    markers: bool,
    (ledger, extent): (&Ledger, Extent),
) -> LinkWritten {
    ledger.take(1);
    let (mut counters, mut staged) = (WriteCounters::open(ledger, extent.last_tick), Staged::default());
    ledger.take(RetainedSamples::words(extent.retained_samples, length));
    let mut sample = vec![0_u64; length];
    counters.persist(words);
    staged.persist(words);
    sample.persist(words);
    staged.count(&mut counters, &bytemuck::cast_slice(&sample)[size_of::<Stamp>()..], markers);
    counters.report(service)
}
