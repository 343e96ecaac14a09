//! The writing end of a link with its counters: what was sent, what was not, and its hash.
//!
//! A sample is staged, which nobody sees; the role commits its state; only then is the sample dispatched. So nothing is ever
//! sent that is not committed, and what is committed and was perhaps not sent is sent by a successor: readers tell a repeated
//! sample by its tick. A void stands for a sample that does not exist, where everybody waits for inputs. Must not commit.

use super::retained::RetainedSamples;
use crate::bus::{Bus, BusError, Carried, Topic, Write};
use crate::fault::Delivery;
use crate::runtime::disturb::Disturbance;
use crate::runtime::hooks::{self, Failpoint};
use crate::sample::{NO_SAMPLE, Stamp};
use crate::state::{Persist, Words, persist_fields};
use crate::telemetry::{Ledger, LinkWritten, Slots, WriteCounters};
use std::borrow::{Borrow, BorrowMut};

/// Words of a stamp.
const STAMP_WORDS: usize = size_of::<Stamp>() / size_of::<u64>();

/// The writing end of a signal.
pub struct Output<B: Bus, S: Carried + ?Sized> {
    port: S::Writer<B>,
    generation: u64,
    /// What is committed and not yet counted, and the sample that it is about, under the stamp that it was made with.
    staged: Staged,
    sample: S::Owned,
    /// Whether the port holds that sample already.
    filled: bool,
    /// Whether a void takes the place of a sample that does not go out.
    markers: bool,
    /// Whether samples are shown first, and published when there is time.
    writes_latest: bool,
    /// Whether one is shown and not published.
    unpublished: bool,
    disturbance: Option<Box<Disturbance<S>>>,
    counters: WriteCounters,
    /// How many samples have been sent, for a successor.
    progress: Option<Slots>,
    kept: Option<RetainedSamples>,
    /// Whether it continues a predecessor and has sent nothing yet.
    succeeds: bool,
}

/// What a writing end is about to send for a tick.
#[derive(Debug, Clone, Copy, Default)]
struct Staged {
    /// How many samples were sent before those of the tick.
    before: u64,
    tick: u64,
    /// One of the constants.
    kind: u64,
    /// The stamp as it goes out: a scripted fault may have broken it.
    stamp: [u64; STAMP_WORDS],
    /// Samples of earlier ticks, held back by scripted faults, that go out before this tick's.
    late: u64,
    /// How often this tick's sample goes out.
    copies: u64,
}

persist_fields!(Staged, before, tick, kind, stamp, late, copies);

impl Staged {
    /// Nothing, or what was staged is counted.
    const NOTHING: u64 = 0;
    /// The sample of the tick.
    const SAMPLE: u64 = 1;
    /// A sample was made, and does not go out as that of its tick.
    const WITHHELD: u64 = 2;
    /// No sample was made.
    const ABSENT: u64 = 3;

    /// How many samples go out.
    #[inline]
    fn samples(&self, markers: bool) -> u64 {
        let marker = markers && matches!(self.kind, Self::WITHHELD | Self::ABSENT);
        self.late + self.copies + u64::from(marker)
    }

    /// Counts it, the content of the sample given.
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

/// How far a run goes, and how many samples are [kept](RetainedSamples): what decides how much a writing end keeps in a ledger.
#[derive(Debug, Clone, Copy)]
pub struct Extent {
    /// The last tick.
    pub last_tick: u64,
    /// How many samples are kept.
    pub retained_samples: u64,
}

impl Extent {
    /// Words of the ledger beside the record, for samples of so many words.
    pub fn words(self, length: usize) -> usize {
        1 + WriteCounters::words(self.last_tick) + RetainedSamples::words(self.retained_samples, length)
    }
}

impl<B: Bus, S: Carried + ?Sized> Output<B, S> {
    /// Opens a signal of so many bodies.
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
        let kept = RetainedSamples::open(ledger, extent.retained_samples, S::length(bodies));
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
            kept,
            succeeds: generation > 1,
        })
    }

    /// With voids in the place of samples that do not go out, for readers that wait for every tick.
    pub fn with_markers(self, markers: bool) -> Self {
        Self { markers, ..self }
    }

    /// Whose samples are shown to readers of the newest at first, and sent to the others by [`finish`](Self::finish).
    pub fn latest_first(self) -> Self {
        Self { writes_latest: true, ..self }
    }

    /// With scripted faults.
    pub fn disturbed(self, disturbance: Option<Box<Disturbance<S>>>) -> Self {
        Self { disturbance, ..self }
    }

    /// Makes the sample of a tick. `fill` writes everything but the generation.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn stage(&mut self, fill: impl FnOnce(&mut S)) -> Result<(), BusError> {
        if self.disturbance.is_some() {
            self.stage_disturbed(fill);
            return Ok(());
        }
        let (generation, kept) = (self.generation, self.sample.borrow_mut());
        self.port.fill(|sample| {
            fill(sample);
            sample.stamp_mut().generation = generation;
            kept.assign(sample);
        })?;
        self.filled = true;
        let stamp = *kept.stamp();
        let (before, stamp_words) = (self.staged.before, bytemuck::cast(stamp));
        self.staged = Staged { before, tick: stamp.tick, kind: Staged::SAMPLE, stamp: stamp_words, late: 0, copies: 1 };
        hooks::at(Failpoint::Staged);
        Ok(())
    }

    /// Makes a sample as the scripted faults have it.
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
        // A sample with a broken stamp goes out as it is, but not as the one of its tick.
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
        let kept = self.sample.borrow_mut();
        kept.assign(sample);
        *kept.stamp_mut() = stamp;
        hooks::at(Failpoint::Staged);
    }

    /// Says that there is no sample for this tick, where readers wait for one: an input was missing.
    pub fn stage_marker(&mut self, tick: u64) {
        let kind = if self.markers { Staged::ABSENT } else { Staged::NOTHING };
        self.staged = Staged { before: self.staged.before, tick, kind, ..Staged::default() };
    }

    /// Sends what was staged, or what is left of it.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[inline]
    pub fn dispatch(&mut self) -> Result<(), BusError> {
        if !std::mem::take(&mut self.filled) {
            return self.dispatch_rest();
        }
        if let Some(kept) = &self.kept {
            let sample: &S = self.sample.borrow();
            kept.keep(self.staged.before, sample.words().iter().copied());
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

    /// Leaves word that so many samples of the tick have been sent.
    #[inline]
    fn sent(&self, samples: u64) {
        if let Some(progress) = &self.progress {
            progress.set(0, self.staged.before + samples);
        }
    }

    /// How many samples of the tick have been sent, by a predecessor.
    fn already_sent(&self) -> u64 {
        let sent = self.progress.as_ref().map_or(0, |progress| progress.get(0));
        sent.saturating_sub(self.staged.before)
    }

    /// Sends what a predecessor has not sent of what was staged.
    ///
    /// # Errors
    /// [`BusError::Send`].
    #[cold]
    pub fn dispatch_rest(&mut self) -> Result<(), BusError> {
        self.filled = false;
        let Staged { before, tick, kind, late, copies, .. } = self.staged;
        let made = *self.sample.borrow().stamp();
        // What was made in an earlier life goes out in this one, also where a scripted fault has broken the generation.
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
            let (sample, kept): (&S, _) = (self.sample.borrow(), self.kept.as_ref());
            // The predecessor may have sent the successor's first sample: its readers have to look at what is kept, or do not
            // count it if it is late.
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
                // Before anybody sees it.
                if let Some(kept) = kept {
                    kept.keep(before + index, slot.words().iter().copied());
                }
                let stamp = slot.stamp_mut();
                if late.is_none() {
                    stamp.generation ^= lives;
                }
                if first && (kept.is_some() || late.is_some()) {
                    stamp.generation = generation | stamp.generation & NO_SAMPLE;
                }
            })?;
            self.port.deliver()?;
            hooks::at(Failpoint::Sent);
            self.sent(index + 1);
        }
        Ok(())
    }

    /// Does what a dispatched sample leaves to be done: all readers, counters, hash, memory for the next. Off the critical path.
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

    /// The last sample that was made.
    #[inline]
    pub fn last(&self) -> &S {
        self.sample.borrow()
    }

    /// The counters, without what is staged.
    pub fn counters(&self) -> &WriteCounters {
        &self.counters
    }
}

/// Its counters, and what it is committed to send.
impl<B: Bus, S: Carried + ?Sized> Persist for Output<B, S> {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.counters.persist(words);
        self.staged.persist(words);
        self.sample.borrow_mut().words_mut().persist(words);
    }
}

impl<B: Bus, S: Carried + ?Sized> Output<B, S> {
    /// Passes what scripted faults hold back; see [`Persist`].
    pub fn persist_late<W: Words>(&mut self, words: &mut W) {
        self.disturbance.iter_mut().for_each(|disturbance| disturbance.persist(words));
    }
}

/// What the record of a role says of a signal of `length` words that it writes; what is committed counts as sent.
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
