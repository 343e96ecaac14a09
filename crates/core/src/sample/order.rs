//! The order of one signal's samples: decides which sample counts for a tick.

use super::stamp::{NO_SAMPLE, Stamp};

/// The place of a sample in the order of its signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// A warm-up sample, before the first one that counts.
    WarmUp,
    /// Its tick has passed, or cannot have come yet.
    Extra,
    /// The first of its tick: the tick has no sample.
    NoSample,
    /// The first of its tick, but with the generation of a warm-up, which no role uses.
    Unused,
    /// The first sample of its tick.
    Sample,
}

/// The order of the samples that have come from one signal.
///
/// Recorder, views and reports read a signal by this order. A role's own input besides applies its guard, and accepts the
/// generations of a restarted sender.
///
/// ```
/// # extern crate corotate_core as corotate;
/// use corotate::sample::{Order, Place, Stamp};
///
/// let mut order = Order::default();
/// let mut place = |tick, generation| order.place(&Stamp { tick, generation, ..Stamp::default() }, 100);
/// assert_eq!([place(0, 0), place(0, 1)], [Place::WarmUp, Place::Sample]);
/// // A successor repeats the tick in which its predecessor ended.
/// assert_eq!([place(0, 2), place(1, 2)], [Place::Extra, Place::Sample]);
/// assert_eq!(place(101, 2), Place::Extra);
/// ```
#[derive(Debug, Clone, Copy, Default)]
pub struct Order {
    next: u64,
    begun: bool,
}

impl Order {
    /// Places the sample that came next. `max_tick` is the last tick that it can have.
    #[inline]
    pub fn place(&mut self, stamp: &Stamp, max_tick: u64) -> Place {
        if stamp.generation == 0 && !self.begun {
            return Place::WarmUp;
        }
        if stamp.tick < self.next || stamp.tick > max_tick {
            return Place::Extra;
        }
        *self = Self { next: stamp.tick.saturating_add(1), begun: true };
        match stamp.generation {
            0 => Place::Unused,
            generation if generation & NO_SAMPLE != 0 => Place::NoSample,
            _ => Place::Sample,
        }
    }

    /// Returns the last tick that the next sample can have. `due_tick` is the last tick that is due, in real time; a link that
    /// loses nothing delivers the next tick.
    #[inline]
    pub fn max_tick(&self, due_tick: Option<u64>, last_tick: u64) -> u64 {
        due_tick.unwrap_or(if self.begun { self.next } else { last_tick }).min(last_tick)
    }

    /// Returns the tick after the last one that counted.
    #[inline]
    pub fn next(&self) -> u64 {
        self.next
    }

    /// Returns true once a sample has counted.
    #[inline]
    pub fn begun(&self) -> bool {
        self.begun
    }
}
