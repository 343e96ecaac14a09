//! Commands that a law has sent and that do not act yet, where a command acts more than one tick after its measurement.
//!
//! Must not decide what a missing command means; the plant's expiry does.

use crate::state::{Persist, Words};

/// The longest actuation delay, ticks.
pub const ACTUATION_DELAY_MAX: u64 = 64;

/// What a law has sent and what does not act yet at its next tick, for its prediction. `U` is what a command makes act.
#[derive(Debug)]
pub struct InFlight<U> {
    /// With the tick after that of the measurement, 0 if there is none; of a power of two of places, so that none is found by a
    /// division.
    sent: [(u64, U); ACTUATION_DELAY_MAX as usize],
    /// So many of them are in use, and so many commands are on their way at most.
    places: usize,
    count: u64,
}

impl<U: Default> InFlight<U> {
    /// Nothing sent yet, for a law whose commands act so many ticks after their measurement, up to [`ACTUATION_DELAY_MAX`].
    pub fn new(delay_ticks: u64, blank: impl Fn() -> U) -> Self {
        let count = delay_ticks.clamp(1, ACTUATION_DELAY_MAX) - 1;
        let places = if count > 0 { count.next_power_of_two() as usize } else { 0 };
        let place = |index| (0, if index < places { blank() } else { U::default() });
        Self { sent: core::array::from_fn(place), places, count }
    }
}

impl<U> InFlight<U> {
    /// Whether no command is ever on its way when the next is made: it acts from the next tick on.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// What acts in each tick after this one until its own command does, in turn. Where a command was not sent the one before
    /// goes on; none as long as that is what acts at this tick.
    pub fn after(&self, tick: u64) -> impl Iterator<Item = Option<&U>> {
        // The oldest is that of `tick` − count; it acts from `tick` + 1 on.
        let mut last = None;
        (0..self.count).map(move |step| {
            last = (tick + step).checked_sub(self.count).and_then(|sent| self.at(sent)).or(last);
            last
        })
    }

    fn at(&self, tick: u64) -> Option<&U> {
        let (filled, input) = &self.sent[self.place(tick)];
        (*filled == tick + 1).then_some(input)
    }

    /// Room for what was sent at a tick.
    pub fn sent(&mut self, tick: u64) -> Option<&mut U> {
        if self.is_empty() {
            return None;
        }
        let (filled, input) = &mut self.sent[self.place(tick)];
        *filled = tick + 1;
        Some(input)
    }

    fn place(&self, tick: u64) -> usize {
        tick as usize & self.places.wrapping_sub(1) & (ACTUATION_DELAY_MAX as usize - 1)
    }

    /// Passes the state, each input by this.
    pub fn persist_by<W: Words>(&mut self, words: &mut W, mut each: impl FnMut(&mut U, &mut W)) {
        for (filled, input) in &mut self.sent[..self.places] {
            filled.persist(words);
            each(input, words);
        }
    }
}

impl<U: Persist> Persist for InFlight<U> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.persist_by(words, U::persist);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    #[test]
    fn a_law_knows_what_will_act_until_its_command_does() {
        let mut sent = InFlight::new(4, || 0.0);
        let inputs = |sent: &InFlight<f64>, tick| {
            sent.after(tick).map(|input| input.copied().unwrap_or(-1.0)).collect::<Vec<_>>()
        };
        assert_eq!(inputs(&sent, 0), [-1.0; 3], "before the first, what acts goes on");
        for tick in (0..10).filter(|tick| *tick != 7) {
            *sent.sent(tick).unwrap() = tick as f64;
        }
        assert_eq!(inputs(&sent, 10), [-1.0, 8.0, 9.0], "that of tick 7 was not sent");
        assert_eq!(inputs(&sent, 11), [8.0, 9.0, 9.0]);
        let mut next = InFlight::new(1, || 0.0);
        assert!(next.is_empty() && next.sent(5).is_none() && inputs(&next, 5).is_empty());
    }
}
