//! The plant: a body behind its sensors and actuators, and the actuators' own protection against silence.
//!
//! Commands have a logical execution time: the command computed from the measurement of tick k acts from tick k + d,
//! neither earlier nor later. d is 1 unless the scenario sets it. A plant must not depend on any other role being
//! alive.

use crate::sample::{Message, Sample, Stamp, status};
use crate::state::{Persist, Words};

/// A body with its sensors and the input that its actuators hold.
pub trait Body {
    /// The full state, for recording and scoring.
    type Truth: Message + ?Sized;
    /// The sensor readings.
    type Measurement: Message + ?Sized;
    /// The actuator input.
    type Command: Message + ?Sized;

    /// Holds a new input until the next one. Returns true if the input was usable; an unusable input changes nothing.
    fn apply(&mut self, command: &Self::Command) -> bool;
    /// Holds the safe input from now on.
    fn apply_safe(&mut self);
    /// Writes the full state with the given status bits, but not the stamp.
    fn truth(&self, status: u64, out: &mut Self::Truth);
    /// Writes the measurement of a tick with the given status bits, but not the stamp. Called once per executed tick.
    fn measure(&mut self, tick: u64, status: u64, out: &mut Self::Measurement);
    /// Replaces the fields of a measurement whose sensors have no new value at this tick. Called after
    /// [`measure`](Self::measure).
    #[inline(always)]
    fn hold(&mut self, _tick: u64, _out: &mut Self::Measurement) {}
    /// Moves the body by `dt_s` seconds under the held input.
    fn flow(&mut self, dt_s: f64);
    /// Takes new values of an input of the loop, such as a disturbance, from this tick on. `port` is the number that the rig gave
    /// to it. Called before everything else of the tick.
    fn set_input(&mut self, _port: usize, _values: &[f64]) {}
}

/// A single body, not a fleet: the size of its samples is known at compile time.
pub trait SingleBody: Body<Truth: Sample, Measurement: Sample, Command: Sample> {}

impl<B: Body<Truth: Sample, Measurement: Sample, Command: Sample>> SingleBody for B {}

/// The condition that ends the safe command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rearm {
    /// The next command that arrives in time.
    Auto,
    /// Nothing; the safe command holds until the end of the run.
    Manual,
}

/// Delay, expiry and re-arming of an actuator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Actuation {
    /// True if the body takes commands. A free body expects none and misses none.
    pub driven: bool,
    /// The number of ticks from a measurement to the tick at which its command acts. At least 1.
    pub delay_ticks: u64,
    /// The number of consecutive missing commands after which the safe command acts. At least 1.
    pub timeout_ticks: u64,
    /// The condition that ends the safe command.
    pub rearm: Rearm,
}

/// The outcome of the command that is due at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serial", derive(serde::Serialize, serde::Deserialize))]
pub enum CommandEvent {
    /// No command was due: the body is free, or no command can act yet.
    NotDue,
    /// The command arrived in time and acts.
    Applied,
    /// The command arrived in time, but the safe command is latched, or a switch has disconnected the body from its controller.
    Refused,
    /// The command was missing, late or unusable; the last input is held.
    Held,
    /// The command was missing for the timeout; the safe command acts from this tick.
    Expired,
    /// The command is still missing; the safe command acts.
    Safe,
}

impl CommandEvent {
    /// Returns true if a command was due and did not arrive in time.
    pub fn missed(self) -> bool {
        matches!(self, Self::Held | Self::Expired | Self::Safe)
    }
}

/// A body with the expiry logic of its actuators.
#[derive(Debug)]
pub struct Plant<B> {
    body: B,
    actuation: Actuation,
    tick_s: f64,
    substeps: u64,
    missing_ticks: u64,
    safe: bool,
    /// True while a switch demands the safe command.
    demanded_safe: bool,
    /// True while a switch keeps commands from the body.
    disconnected: bool,
    /// True if the command of this tick arrived and was not accepted.
    rejected: bool,
}

impl<B: Body> Plant<B> {
    /// Creates a plant at its initial state. `tick_s` is the period h in seconds.
    pub fn new(body: B, actuation: Actuation, tick_s: f64) -> Self {
        Self {
            body,
            actuation,
            tick_s,
            substeps: 1,
            missing_ticks: 0,
            safe: false,
            demanded_safe: false,
            disconnected: false,
            rejected: false,
        }
    }

    /// Moves the body over a tick in this number of equal steps.
    #[must_use]
    pub fn with_substeps(self, substeps: u64) -> Self {
        Self { substeps: substeps.max(1), ..self }
    }

    /// Returns true if the plant takes commands.
    pub fn driven(&self) -> bool {
        self.actuation.driven
    }

    /// Returns the number of ticks from `tick` on at which no command can act yet, apart from tick 0.
    fn ticks_before_commands(&self, tick: u64) -> u64 {
        (self.actuation.delay_ticks - 1).saturating_sub(tick)
    }

    /// Selects the input from tick `tick` on: the command computed `delay_ticks` earlier, if it is present.
    #[inline]
    pub fn command(&mut self, tick: u64, command: Option<&B::Command>) -> CommandEvent {
        if !self.actuation.driven || tick < self.actuation.delay_ticks {
            return CommandEvent::NotDue;
        }
        self.rejected = false;
        let latched = self.safe && (self.actuation.rearm == Rearm::Manual || self.demanded_safe);
        match command.filter(|command| command.stamp().tick == tick - self.actuation.delay_ticks) {
            Some(_) if latched => CommandEvent::Refused,
            Some(_) if self.disconnected => {
                self.miss_command();
                CommandEvent::Refused
            }
            Some(command) if self.body.apply(command) => {
                self.missing_ticks = 0;
                self.safe = false;
                CommandEvent::Applied
            }
            _ => self.miss_command(),
        }
    }

    /// Treats the command due at `tick` as missing: it arrived but was not accepted.
    #[inline]
    pub fn reject(&mut self, tick: u64) -> CommandEvent {
        let event = self.command(tick, None);
        self.rejected = event.missed();
        event
    }

    /// Returns the number of further ticks without a command until the safe command acts; 0 if it acts now.
    pub fn ticks_until_safe(&self) -> u64 {
        if self.safe { 0 } else { self.actuation.timeout_ticks.saturating_sub(self.missing_ticks).max(1) }
    }

    /// Passes new values of an input to the body.
    pub fn set_input(&mut self, port: usize, values: &[f64]) {
        self.body.set_input(port, values);
    }

    /// Applies the safe command until this is called with `false`, which also ends a safe command that is latched.
    pub fn demand_safe(&mut self, safe: bool) {
        self.demanded_safe = safe;
        if safe {
            self.expire();
        } else {
            (self.safe, self.missing_ticks) = (false, 0);
        }
    }

    /// Keeps commands from the body until this is called with `false`: it holds its input, then the safe command acts after the
    /// timeout, as if the controller were off.
    pub fn disconnect(&mut self, disconnected: bool) {
        self.disconnected = disconnected;
    }

    /// Applies the safe command at once, as after the command timeout.
    pub fn expire(&mut self) {
        self.safe = true;
        self.body.apply_safe();
    }

    fn miss_command(&mut self) -> CommandEvent {
        self.missing_ticks += 1;
        if self.safe {
            CommandEvent::Safe
        } else if self.missing_ticks >= self.actuation.timeout_ticks {
            self.expire();
            CommandEvent::Expired
        } else {
            CommandEvent::Held
        }
    }

    /// Writes the measurement of the current state under the given stamp.
    #[inline]
    pub fn measure(&mut self, stamp: &Stamp, out: &mut B::Measurement) {
        self.measure_with(stamp, out, |_| {});
    }

    /// Does the same with values that `replace` writes, before slower sensors hold theirs.
    #[inline]
    pub fn measure_with(&mut self, stamp: &Stamp, out: &mut B::Measurement, replace: impl FnOnce(&mut B::Measurement)) {
        let status = self.status();
        self.body.measure(stamp.tick, status, out);
        replace(out);
        self.body.hold(stamp.tick, out);
        *out.stamp_mut() = *stamp;
    }

    /// Writes the current state under the given stamp.
    #[inline]
    pub fn truth(&self, stamp: &Stamp, out: &mut B::Truth) {
        self.body.truth(self.status(), out);
        *out.stamp_mut() = *stamp;
    }

    /// Moves the body by `ticks` ticks under the held input. As many calls of `flow` as for one tick, so that a process that missed
    /// many ticks does not miss more by catching up.
    #[inline]
    pub fn advance(&mut self, ticks: u64) {
        if ticks > 0 {
            let dt_s = ticks as f64 * self.tick_s;
            if self.substeps == 1 {
                self.body.flow(dt_s);
            } else {
                self.advance_in_steps(dt_s);
            }
        }
    }

    /// Not inlined, so that the usual way has one call of `flow`.
    #[cold]
    #[inline(never)]
    fn advance_in_steps(&mut self, dt_s: f64) {
        (0..self.substeps).for_each(|_| self.body.flow(dt_s / self.substeps as f64));
    }

    /// Moves the body over the `ticks` ticks before `tick` that were not executed: no command arrived, so the
    /// actuators' expiry applies.
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
        self.missing_ticks += ticks;
        if ticks > held && !self.safe {
            self.expire();
        }
        self.advance(ticks - held);
    }

    #[inline]
    fn status(&self) -> u64 {
        if self.missing_ticks | u64::from(self.safe) | u64::from(self.rejected) == 0 {
            return 0;
        }
        let rejected = if self.rejected { status::REJECTED } else { 0 };
        rejected
            | match (self.safe, self.missing_ticks > 0) {
                (true, _) => status::SAFE,
                (false, true) => status::HOLDING,
                (false, false) => 0,
            }
    }
}

impl<B: Persist> Persist for Plant<B> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.body.persist(words);
        self.missing_ticks.persist(words);
        self.safe.persist(words);
        self.demanded_safe.persist(words);
        self.disconnected.persist(words);
        self.rejected.persist(words);
    }
}
