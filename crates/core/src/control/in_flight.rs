//! Commands that a law has sent and that do not act yet, for loops where a command acts more than one tick after its
//! measurement.
//!
//! This buffer must not decide what a missing command means; the plant's expiry does.

use crate::state::{Persist, Words};

/// The maximum actuation delay, ticks.
pub const ACTUATION_DELAY_MAX: u64 = 64;

/// The commands that a law has sent and that do not act yet at its next tick, for its prediction. `U` is the actuator
/// input of a command.
#[derive(Debug)]
pub struct InFlightCommands<U> {
    /// The inputs, each with the tick after that of its measurement, or 0 if empty. The number of slots is a power of
    /// two, so that none is located by a division.
    sent: [(u64, U); ACTUATION_DELAY_MAX as usize],
    /// The number of slots in use, and the largest number of commands in flight.
    places: usize,
    count: u64,
}

impl<U: Default> InFlightCommands<U> {
    /// Creates an empty buffer for a law whose commands act `delay_ticks` after their measurement, at most
    /// [`ACTUATION_DELAY_MAX`].
    pub fn new(delay_ticks: u64, blank: impl Fn() -> U) -> Self {
        let count = delay_ticks.clamp(1, ACTUATION_DELAY_MAX) - 1;
        let places = if count > 0 { count.next_power_of_two() as usize } else { 0 };
        let place = |index| (0, if index < places { blank() } else { U::default() });
        Self { sent: core::array::from_fn(place), places, count }
    }
}

impl<U> InFlightCommands<U> {
    /// Returns true if a command acts from the next tick on, so that none is ever in flight.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Returns the input of each tick after `tick` until the law's own command acts, in order. A command that was not
    /// sent is replaced by the one before; `None` stands for the input at `tick`.
    pub fn after(&self, tick: u64) -> impl Iterator<Item = Option<&U>> {
        // The oldest command is that of `tick` − count; it acts from `tick` + 1 on.
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

    /// Returns the slot for the command sent at a tick; `None` if no command is ever in flight.
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

    /// Persists the buffer, each input by `each`.
    pub fn persist_by<W: Words>(&mut self, words: &mut W, mut each: impl FnMut(&mut U, &mut W)) {
        for (filled, input) in &mut self.sent[..self.places] {
            filled.persist(words);
            each(input, words);
        }
    }
}

impl<U: Persist> Persist for InFlightCommands<U> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.persist_by(words, U::persist);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    #[test]
    fn the_inputs_until_the_next_command_are_known() {
        let mut sent = InFlightCommands::new(4, || 0.0);
        let inputs = |sent: &InFlightCommands<f64>, tick| {
            sent.after(tick).map(|input| input.copied().unwrap_or(-1.0)).collect::<Vec<_>>()
        };
        assert_eq!(inputs(&sent, 0), [-1.0; 3], "before the first command the acting input stays");
        for tick in (0..10).filter(|tick| *tick != 7) {
            *sent.sent(tick).unwrap() = tick as f64;
        }
        assert_eq!(inputs(&sent, 10), [-1.0, 8.0, 9.0], "the command of tick 7 was not sent");
        assert_eq!(inputs(&sent, 11), [8.0, 9.0, 9.0]);
        let mut next = InFlightCommands::new(1, || 0.0);
        assert!(next.is_empty() && next.sent(5).is_none() && inputs(&next, 5).is_empty());
    }
}
