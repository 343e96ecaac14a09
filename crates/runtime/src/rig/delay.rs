//! The line of commands that a plant has received and not applied yet, for commands that act more than one tick after their
//! measurement.
//!
//! The plant's command expiry decides what a missing command means.

use crate::state::{Persist, Words};

/// The state of a command that is due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Due<C> {
    /// It has arrived and is accepted.
    Here(C),
    /// It has arrived and was rejected.
    Rejected,
    /// It has not arrived.
    Missing,
}

/// The place of a command in the line.
#[derive(Debug)]
struct Place<C> {
    /// The tick after that of the last command stored here, or 0 before the first.
    filled: u64,
    rejected: bool,
    command: C,
}

/// The commands that a plant has received and not applied yet. `C` owns a sample.
#[derive(Debug)]
pub struct DelayLine<C> {
    places: Vec<Place<C>>,
    /// The first tick without a known outcome.
    next: u64,
}

impl<C> DelayLine<C> {
    /// Creates an empty line for commands that act `delay_ticks` after their measurement.
    pub fn new(delay_ticks: u64, blank: impl Fn() -> C) -> Self {
        let place = || Place { filled: 0, rejected: false, command: blank() };
        Self { places: (0..delay_ticks).map(|_| place()).collect(), next: 0 }
    }

    /// Returns the tick whose command is applied at `tick`, if there is one.
    pub fn due_at(&self, tick: u64) -> Option<u64> {
        tick.checked_sub(self.places.len() as u64)
    }

    /// Returns the first tick without a known outcome whose command can still be applied at `tick` or later.
    pub fn wanted_at(&self, tick: u64) -> u64 {
        self.next.max(self.due_at(tick).unwrap_or(0))
    }

    /// Returns the places of the commands that are applied after the latest tick, the oldest first.
    pub fn in_flight_mut(&mut self) -> impl Iterator<Item = &mut C> {
        let oldest = (self.next % self.places.len() as u64) as usize;
        let (newer, older) = self.places.split_at_mut(oldest);
        older.iter_mut().chain(newer).skip(1).map(|place| &mut place.command)
    }

    fn place(&mut self, tick: u64) -> &mut Place<C> {
        self.next = tick + 1;
        let at = (tick % self.places.len() as u64) as usize;
        &mut self.places[at]
    }

    /// Returns the place for the accepted command of a tick.
    pub fn put(&mut self, tick: u64) -> &mut C {
        let place = self.place(tick);
        (place.filled, place.rejected) = (tick + 1, false);
        &mut place.command
    }

    /// Records that the command of a tick was rejected.
    pub fn reject(&mut self, tick: u64) {
        let place = self.place(tick);
        (place.filled, place.rejected) = (tick + 1, true);
    }

    /// Records that the command of a tick will not arrive.
    pub fn lack(&mut self, tick: u64) {
        self.next = tick + 1;
    }

    /// Returns the command that is applied at `tick`, or its state if it is not here.
    pub fn due(&self, tick: u64) -> Due<&C> {
        let Some(due) = self.due_at(tick) else { return Due::Missing };
        match &self.places[(due % self.places.len() as u64) as usize] {
            place if place.filled != due + 1 => Due::Missing,
            Place { rejected: true, .. } => Due::Rejected,
            place => Due::Here(&place.command),
        }
    }

    /// Saves or restores the state; `command` does so for one command.
    pub fn persist<W: Words>(&mut self, words: &mut W, mut command: impl FnMut(&mut C, &mut W)) {
        self.next.persist(words);
        for place in &mut self.places {
            place.filled.persist(words);
            place.rejected.persist(words);
            command(&mut place.command, words);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_is_due_once_after_its_delay() {
        let mut line = DelayLine::new(3, || 0_u64);
        assert_eq!((line.due_at(2), line.due_at(3), line.due(0)), (None, Some(0), Due::Missing));
        for tick in 1..20 {
            match tick - 1 {
                5 => line.lack(5),
                7 => line.reject(7),
                before => *line.put(before) = 100 + before,
            }
            assert_eq!(line.wanted_at(tick), tick, "every earlier outcome is known");
            let expected = match tick.checked_sub(3) {
                None | Some(5) => Due::Missing,
                Some(7) => Due::Rejected,
                Some(due) => Due::Here(&(100 + due)),
            };
            assert_eq!(line.due(tick), expected);
        }
        // Ticks 16 and 17 are in flight after tick 18; that of tick 15 has been applied at it.
        let mut moved = DelayLine::new(3, || 0_u64);
        (0..18).for_each(|tick| *moved.put(tick) = 100 + tick);
        assert_eq!(moved.in_flight_mut().map(|command| *command).collect::<Vec<_>>(), [116, 117]);
        assert_eq!(line.wanted_at(100), 97, "commands that can no longer be applied are not wanted");
        assert_eq!(line.due(100), Due::Missing);
    }
}
