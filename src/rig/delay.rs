//! Commands between the tick of their measurement and the tick from which they act, where that is more than one tick later: at
//! the plant that waits to apply them, and at the law that predicts what they will have done.
//!
//! Must not decide what a missing command means; the plant's expiry does.

use crate::state::{Persist, Words};

/// The longest actuation delay, ticks.
pub const ACTUATION_DELAY_MAX: u64 = 64;

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

/// What a law has sent and what does not act yet at its next tick, for its prediction. `U` is what a command makes act.
#[derive(Debug)]
pub struct InFlight<U> {
    /// With the tick after that of the measurement, 0 if there is none.
    sent: Vec<(u64, U)>,
}

impl<U> InFlight<U> {
    /// Nothing sent yet, for a law whose commands act so many ticks after their measurement.
    pub fn new(delay_ticks: u64, blank: impl Fn() -> U) -> Self {
        Self { sent: (1..delay_ticks).map(|_| (0, blank())).collect() }
    }

    /// Whether no command is ever on its way when the next is made: it acts from the next tick on.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.sent.is_empty()
    }

    /// What acts in each tick after this one until its own command does, in turn. Where a command was not sent the one before
    /// goes on; none as long as that is what acts at this tick.
    pub fn after(&self, tick: u64) -> impl Iterator<Item = Option<&U>> {
        let count = self.sent.len() as u64;
        // The oldest is that of `tick` − count; it acts from `tick` + 1 on.
        let mut last = None;
        (0..count).map(move |step| {
            last = (tick + step).checked_sub(count).and_then(|sent| self.at(sent)).or(last);
            last
        })
    }

    fn at(&self, tick: u64) -> Option<&U> {
        let (filled, input) = &self.sent[(tick % self.sent.len() as u64) as usize];
        (*filled == tick + 1).then_some(input)
    }

    /// Room for what was sent at a tick.
    pub fn sent(&mut self, tick: u64) -> Option<&mut U> {
        let count = self.sent.len() as u64;
        let (filled, input) = self.sent.get_mut(tick.checked_rem(count)? as usize)?;
        *filled = tick + 1;
        Some(input)
    }

    /// Passes the state, each input by this.
    pub fn persist_by<W: Words>(&mut self, words: &mut W, mut each: impl FnMut(&mut U, &mut W)) {
        for (filled, input) in &mut self.sent {
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
