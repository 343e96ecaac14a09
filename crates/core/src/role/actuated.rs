//! A body whose actuators hold a command: the smallest form of a [`Body`]. It also tells the command that acts.
//!
//! This module must not decide which command acts; the plant does.

use super::plant::Body;
use crate::sample::{Applied, Message, Sample};
use crate::state::{Persist, Words};

/// The motion and the sensors of a body whose input is the held command.
pub trait Dynamics {
    /// The full state, for recording and scoring.
    type Truth: Sample;
    /// The sensor readings.
    type Measurement: Sample;
    /// The actuator input.
    type Command: Sample;

    /// Writes the full state with the given status bits, but not the stamp.
    fn truth(&self, status: u64, out: &mut Self::Truth);
    /// Writes the measurement with the given status bits, but not the stamp. Called once per executed tick.
    fn measure(&mut self, status: u64, out: &mut Self::Measurement);
    /// Moves the body by `dt_s` seconds under a command.
    fn advance(&mut self, command: &Self::Command, dt_s: f64);
    /// Writes the safe command, if it is not zero.
    fn safe_command(&self, _out: &mut Self::Command) {}
    /// Takes new values of an input of the loop, as [`Body::set_input`].
    fn set_input(&mut self, _port: usize, _values: &[f64]) {}
}

/// A body that holds its command. Its measurements and truths also have the command that acts from their tick on ([`Applied`]), so
/// that an estimator or a law with a model knows it.
#[derive(Debug, Clone)]
pub struct Actuated<D: Dynamics> {
    dynamics: D,
    acting: D::Command,
}

impl<D: Dynamics> Actuated<D> {
    /// Creates the body. Until a command acts, the safe command does.
    pub fn new(dynamics: D) -> Self {
        let mut body = Self { dynamics, acting: D::Command::default() };
        body.apply_safe();
        body
    }
}

impl<D: Dynamics> Body for Actuated<D> {
    type Truth = Applied<D::Truth, D::Command>;
    type Measurement = Applied<D::Measurement, D::Command>;
    type Command = D::Command;

    fn apply(&mut self, command: &D::Command) -> bool {
        let usable = command.finite();
        if usable {
            self.acting = *command;
            let stamp = self.acting.stamp_mut();
            (stamp.generation, stamp.origin_ns, stamp.sent_ns) = (0, 0, 0);
        }
        usable
    }

    fn apply_safe(&mut self) {
        self.acting = D::Command::default();
        self.dynamics.safe_command(&mut self.acting);
    }

    fn truth(&self, status: u64, out: &mut Self::Truth) {
        self.dynamics.truth(status, &mut out.sample);
        out.applied = self.acting;
    }

    fn measure(&mut self, _tick: u64, status: u64, out: &mut Self::Measurement) {
        self.dynamics.measure(status, &mut out.sample);
        out.applied = self.acting;
    }

    fn flow(&mut self, dt_s: f64) {
        self.dynamics.advance(&self.acting, dt_s);
    }

    fn set_input(&mut self, port: usize, values: &[f64]) {
        self.dynamics.set_input(port, values);
    }
}

impl<D: Dynamics<Command: Persist> + Persist> Persist for Actuated<D> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        self.dynamics.persist(words);
        self.acting.persist(words);
    }
}
