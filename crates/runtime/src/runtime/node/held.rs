//! The last sample of a role that computes at every n-th tick only: it is sent again at the ticks in between.
//!
//! Must not allocate after it was created.

use crate::bus::Carried;
use crate::sample::Stamp;
use crate::state::{Persist, Words};
use std::borrow::{Borrow, BorrowMut};

/// The sample; nothing for a role that computes at every tick.
pub struct Held<S: Carried + ?Sized> {
    sample: Option<S::Owned>,
    every_ticks: u64,
    /// True once there was a sample.
    kept: bool,
}

impl<S: Carried + ?Sized> Held<S> {
    pub fn new(every_ticks: u64, bodies: usize) -> Self {
        Self { sample: (every_ticks > 1).then(|| S::blank(bodies)), every_ticks, kept: false }
    }

    /// Keeps the sample of a tick at which the role computes.
    #[inline]
    pub fn keep(&mut self, sample: &S) {
        if let Some(own) = &mut self.sample {
            own.borrow_mut().assign(sample);
            self.kept = true;
        }
    }

    /// Returns the sample to send again at a tick, if the last tick at which the role computes has one.
    pub fn at(&self, tick: u64) -> Option<&S> {
        let sample: &S = self.sample.as_ref().filter(|_| self.kept)?.borrow();
        (sample.stamp().tick == tick - tick % self.every_ticks).then_some(sample)
    }
}

/// Writes a sample again, as the answer to a later input.
pub fn repeat<S: Carried + ?Sized>(sample: &S, input: &Stamp, out: &mut S) {
    out.assign(sample);
    out.stamp_mut().answer(input);
}

impl<S: Carried + ?Sized> Persist for Held<S> {
    #[inline]
    fn persist<W: Words>(&mut self, words: &mut W) {
        if let Some(own) = &mut self.sample {
            own.borrow_mut().words_mut().persist(words);
            self.kept.persist(words);
        }
    }
}
