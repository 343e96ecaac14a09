//! The plant: a body behind its sensors and actuators, and the actuators' own protection against silence.
//!
//! Logical execution time: what was computed from the measurement of tick k acts from tick k + d on, never earlier, never
//! later; d is 1 unless the scenario says otherwise. Must not need any other role to be alive.

use crate::sample::{Message, Sample, Stamp, status};
use crate::state::{Persist, Words};

/// A body: what moves, what is measured of it, and what holds its input.
pub trait Body {
    /// The full state, for recording and scoring.
    type Truth: Message + ?Sized;
    /// What the sensors report.
    type Measurement: Message + ?Sized;
    /// What the actuators take.
    type Command: Message + ?Sized;

    /// Takes a new input, to be held until the next. Returns whether it was usable; an unusable one changes nothing.
    fn apply(&mut self, command: &Self::Command) -> bool;
    /// Holds the safe input from now on.
    fn apply_safe(&mut self);
    /// Writes the full state, with the given status bits, everything but the stamp.
    fn truth(&self, status: u64, out: &mut Self::Truth);
    /// Writes the measurement of a tick, with the given status bits, everything but the stamp. Once per executed tick.
    fn measure(&mut self, tick: u64, status: u64, out: &mut Self::Measurement);
    /// Moves the body by `dt_s` seconds under the held input.
    fn flow(&mut self, dt_s: f64);
}

/// A body whose samples have a size that the compiler knows: one, not a fleet.
pub trait SingleBody: Body<Truth: Sample, Measurement: Sample, Command: Sample> {}

impl<B: Body<Truth: Sample, Measurement: Sample, Command: Sample>> SingleBody for B {}

/// What ends the safe command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rearm {
    /// The next command that is in time.
    Auto,
    /// Nothing in this run.
    Manual,
}

/// How an actuator treats its commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Actuation {
    /// Whether the body is driven at all; a free body expects no command and misses none.
    pub driven: bool,
    /// From so many ticks after its measurement on a command acts. At least 1.
    pub delay_ticks: u64,
    /// After so many consecutive missing commands the safe command takes over. At least 1.
    pub timeout_ticks: u64,
    /// What ends it.
    pub rearm: Rearm,
}

/// What became of the command due at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serial", derive(serde::Serialize, serde::Deserialize))]
pub enum CommandEvent {
    /// None was due: the body is free or no command can act yet.
    NotDue,
    /// It was in time and is applied.
    Applied,
    /// It was in time, but the safe command is latched for good.
    Refused,
    /// It was absent, late or unusable: the last input is held.
    Held,
    /// It was absent for so long that the safe command took over at this tick.
    Expired,
    /// It is still absent, and the safe command acts.
    Safe,
}

impl CommandEvent {
    /// Whether a command was due and did not come in time.
    pub fn missed(self) -> bool {
        matches!(self, Self::Held | Self::Expired | Self::Safe)
    }
}

/// A body with its actuators' expiry logic.
#[derive(Debug)]
pub struct Plant<B> {
    body: B,
    actuation: Actuation,
    tick_s: f64,
    silent_ticks: u64,
    safe: bool,
    /// Whether the command of this tick was there and was not believed.
    rejected: bool,
}

impl<B: Body> Plant<B> {
    /// A plant at its initial state. `tick_s` is the period h in seconds.
    pub fn new(body: B, actuation: Actuation, tick_s: f64) -> Self {
        Self { body, actuation, tick_s, silent_ticks: 0, safe: false, rejected: false }
    }

    /// Whether the plant takes commands.
    pub fn driven(&self) -> bool {
        self.actuation.driven
    }

    /// How many ticks, counted from `tick`, there can be no command yet, beside the very first.
    fn ticks_before_commands(&self, tick: u64) -> u64 {
        (self.actuation.delay_ticks - 1).saturating_sub(tick)
    }

    /// Decides the input from tick `tick` on: the command computed `delay_ticks` before, if it is there.
    #[inline]
    pub fn command(&mut self, tick: u64, command: Option<&B::Command>) -> CommandEvent {
        if !self.actuation.driven || tick < self.actuation.delay_ticks {
            return CommandEvent::NotDue;
        }
        self.rejected = false;
        let latched = self.safe && self.actuation.rearm == Rearm::Manual;
        match command.filter(|command| command.stamp().tick == tick - self.actuation.delay_ticks) {
            Some(_) if latched => CommandEvent::Refused,
            Some(command) if self.body.apply(command) => {
                self.silent_ticks = 0;
                self.safe = false;
                CommandEvent::Applied
            }
            _ => self.silence(),
        }
    }

    /// The command due at tick `tick` was there and is not believed: as if it were not.
    #[inline]
    pub fn reject(&mut self, tick: u64) -> CommandEvent {
        let event = self.command(tick, None);
        self.rejected = event.missed();
        event
    }

    /// How many more ticks without a command until the safe command takes over; 0 if it acts.
    pub fn ticks_until_safe(&self) -> u64 {
        if self.safe { 0 } else { self.actuation.timeout_ticks.saturating_sub(self.silent_ticks).max(1) }
    }

    /// Goes to the safe command at once, as if commands had been missing for long enough.
    pub fn expire(&mut self) {
        self.safe = true;
        self.body.apply_safe();
    }

    fn silence(&mut self) -> CommandEvent {
        self.silent_ticks += 1;
        if self.safe {
            CommandEvent::Safe
        } else if self.silent_ticks >= self.actuation.timeout_ticks {
            self.expire();
            CommandEvent::Expired
        } else {
            CommandEvent::Held
        }
    }

    /// Writes the measurement of the present state under the given stamp.
    #[inline]
    pub fn measure(&mut self, stamp: &Stamp, out: &mut B::Measurement) {
        let status = self.status();
        self.body.measure(stamp.tick, status, out);
        *out.stamp_mut() = *stamp;
    }

    /// Writes the present state under the given stamp.
    #[inline]
    pub fn truth(&self, stamp: &Stamp, out: &mut B::Truth) {
        self.body.truth(self.status(), out);
        *out.stamp_mut() = *stamp;
    }

    /// Moves the body on by `ticks` ticks, the input held: in one flow, so that whoever has missed many ticks does not miss
    /// more for it.
    #[inline]
    pub fn advance(&mut self, ticks: u64) {
        if ticks > 0 {
            self.body.flow(ticks as f64 * self.tick_s);
        }
    }

    /// Moves the body on over the `ticks` ticks before `tick`, which nobody served: no command came, and the actuators protect
    /// themselves.
    pub fn advance_alone_to(&mut self, tick: u64, ticks: u64) {
        let early = self.ticks_before_commands(tick - ticks).min(ticks);
        self.advance(early);
        self.advance_alone(ticks - early);
    }

    fn advance_alone(&mut self, ticks: u64) {
        if !self.actuation.driven {
            return self.advance(ticks);
        }
        let held = if self.safe { 0 } else { ticks.min(self.ticks_until_safe() - 1) };
        self.advance(held);
        self.silent_ticks += ticks;
        if ticks > held && !self.safe {
            self.expire();
        }
        self.advance(ticks - held);
    }

    #[inline]
    fn status(&self) -> u64 {
        if self.silent_ticks | u64::from(self.safe) | u64::from(self.rejected) == 0 {
            return 0;
        }
        let rejected = if self.rejected { status::REJECTED } else { 0 };
        rejected
            | match (self.safe, self.silent_ticks > 0) {
                (true, _) => status::SAFE,
                (false, true) => status::HOLDING,
                (false, false) => 0,
            }
    }
}

impl<B: Persist> Persist for Plant<B> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.body.persist(words);
        self.silent_ticks.persist(words);
        self.safe.persist(words);
        self.rejected.persist(words);
    }
}
