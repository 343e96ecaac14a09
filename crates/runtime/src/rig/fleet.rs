//! What a rig has to give for bodies that are many: one process simulates them all, one sample tells of all of them.

use crate::role::{Body, Guard, Law};
use crate::sample::{CommandLayout, FleetLayout, FleetSample, MeasurementLayout, Sample, TruthLayout};
use crate::state::{Persist, Words};
use std::marker::PhantomData;

/// Many bodies of one kind, and everything that drives and guards them as one. `E` is what the law knows of the leader.
pub trait Fleet<E: Sample>: Sized + 'static {
    /// The state of all.
    type Truth: FleetLayout;
    /// What their sensors report.
    type Measurement: FleetLayout;
    /// What their actuators take.
    type Command: FleetLayout;
    /// All of them as one.
    type Body: Body<
            Truth = FleetSample<Self::Truth>,
            Measurement = FleetSample<Self::Measurement>,
            Command = FleetSample<Self::Command>,
        > + Persist;
    /// What drives them.
    type Law: Law<Estimate = E, Measurement = FleetSample<Self::Measurement>, Command = FleetSample<Self::Command>>
        + Persist;
    /// What keeps measurements that cannot be from the law: one that is impossible for one body is not believed for any.
    type MeasurementGuard: Guard<FleetSample<Self::Measurement>> + Persist;
    /// The same of commands.
    type CommandGuard: Guard<FleetSample<Self::Command>> + Persist;

    /// The bodies at their initial states.
    fn body(&self) -> Self::Body;
    /// The law.
    fn law(&self) -> Self::Law;
    /// A guard for measurements at a new reader.
    fn measurement_guard(&self) -> Self::MeasurementGuard;
    /// A guard for commands.
    fn command_guard(&self) -> Self::CommandGuard;
}

/// The fleet of a rig that has none: there is no value of it.
#[derive(Debug, Clone, Copy)]
pub enum NoFleet {}

/// Its law.
#[derive(Debug)]
pub struct NoLaw<E>(NoFleet, PhantomData<E>);

impl<E: Sample> Fleet<E> for NoFleet {
    type Truth = TruthLayout;
    type Measurement = MeasurementLayout;
    type Command = CommandLayout;
    type Body = Self;
    type Law = NoLaw<E>;
    type MeasurementGuard = Self;
    type CommandGuard = Self;

    fn body(&self) -> Self {
        *self
    }

    fn law(&self) -> NoLaw<E> {
        match *self {}
    }

    fn measurement_guard(&self) -> Self {
        *self
    }

    fn command_guard(&self) -> Self {
        *self
    }
}

impl Persist for NoFleet {
    fn persist<W: Words>(&mut self, _words: &mut W) {
        match *self {}
    }
}

impl<E> Persist for NoLaw<E> {
    fn persist<W: Words>(&mut self, _words: &mut W) {
        match self.0 {}
    }
}

impl Body for NoFleet {
    type Truth = FleetSample<TruthLayout>;
    type Measurement = FleetSample<MeasurementLayout>;
    type Command = FleetSample<CommandLayout>;

    fn apply(&mut self, _command: &Self::Command) -> bool {
        match *self {}
    }

    fn apply_safe(&mut self) {
        match *self {}
    }

    fn truth(&self, _status: u64, _out: &mut Self::Truth) {
        match *self {}
    }

    fn measure(&mut self, _tick: u64, _status: u64, _out: &mut Self::Measurement) {
        match *self {}
    }

    fn flow(&mut self, _dt_s: f64) {
        match *self {}
    }
}

impl<E: Sample> Law for NoLaw<E> {
    type Estimate = E;
    type Measurement = FleetSample<MeasurementLayout>;
    type Command = FleetSample<CommandLayout>;

    fn command(&mut self, _estimate: &E, _measurement: &Self::Measurement, _out: &mut Self::Command) {
        match self.0 {}
    }
}

impl<L: FleetLayout> Guard<FleetSample<L>> for NoFleet {
    fn accepts(&mut self, _sample: &FleetSample<L>) -> bool {
        match *self {}
    }
}
