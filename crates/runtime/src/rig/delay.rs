//! Commands between the tick of their measurement and the tick from which they act, where that is more than one tick later, at
//! the plant that waits to apply them.
//!
//! Must not decide what a missing command means; the plant's expiry does.

use crate::state::{Persist, Words};

/// What has become of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Due<C> {
    /// It is here.
    Here(C),
    /// It has come and is not believed.
    Rejected,
    /// It has not come.
    Missing,
}

/// A command's place in the line.
#[derive(Debug)]
struct Place<C> {
    /// The tick after that of the command, or of the rejected one, that was put here last; 0 if none was.
    filled: u64,
    rejected: bool,
    command: C,
}

/// The commands that a plant has got and does not apply yet. `C` owns a sample.
#[derive(Debug)]
pub struct DelayLine<C> {
    places: Vec<Place<C>>,
    /// The first tick of which it is not known whether there is a command.
    next: u64,
}

impl<C> DelayLine<C> {
    /// An empty line for commands that act so many ticks after their measurement.
    pub fn new(delay_ticks: u64, blank: impl Fn() -> C) -> Self {
        let place = || Place { filled: 0, rejected: false, command: blank() };
        Self { places: (0..delay_ticks).map(|_| place()).collect(), next: 0 }
    }

    /// The tick whose command is applied at a tick, if there is one.
    pub fn due_at(&self, tick: u64) -> Option<u64> {
        tick.checked_sub(self.places.len() as u64)
    }

    /// The first tick of which nothing is known and whose command can still be applied at this tick or later.
    pub fn wanted_at(&self, tick: u64) -> u64 {
        self.next.max(self.due_at(tick).unwrap_or(0))
    }

    fn place(&mut self, tick: u64) -> &mut Place<C> {
        self.next = tick + 1;
        let at = (tick % self.places.len() as u64) as usize;
        &mut self.places[at]
    }

    /// Room for the command of a tick, which is here.
    pub fn put(&mut self, tick: u64) -> &mut C {
        let place = self.place(tick);
        (place.filled, place.rejected) = (tick + 1, false);
        &mut place.command
    }

    /// The command of a tick has come and is not believed.
    pub fn reject(&mut self, tick: u64) {
        let place = self.place(tick);
        (place.filled, place.rejected) = (tick + 1, true);
    }

    /// The command of a tick will not come.
    pub fn lack(&mut self, tick: u64) {
        self.next = tick + 1;
    }

    /// What has become of the command that is applied at a tick.
    pub fn due(&self, tick: u64) -> Due<&C> {
        let Some(due) = self.due_at(tick) else { return Due::Missing };
        match &self.places[(due % self.places.len() as u64) as usize] {
            place if place.filled != due + 1 => Due::Missing,
            Place { rejected: true, .. } => Due::Rejected,
            place => Due::Here(&place.command),
        }
    }

    /// Passes the state, each command by this.
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
    fn a_command_is_due_when_its_delay_is_over_and_then_gone() {
        let mut line = DelayLine::new(3, || 0_u64);
        assert_eq!((line.due_at(2), line.due_at(3), line.due(0)), (None, Some(0), Due::Missing));
        for tick in 1..20 {
            match tick - 1 {
                5 => line.lack(5),
                7 => line.reject(7),
                before => *line.put(before) = 100 + before,
            }
            assert_eq!(line.wanted_at(tick), tick, "all before it is known");
            let expected = match tick.checked_sub(3) {
                None | Some(5) => Due::Missing,
                Some(7) => Due::Rejected,
                Some(due) => Due::Here(&(100 + due)),
            };
            assert_eq!(line.due(tick), expected);
        }
        assert_eq!(line.wanted_at(100), 97, "what can be applied no more is not wanted");
        assert_eq!(line.due(100), Due::Missing);
    }
}
