//! The contract of a fleet: many bodies that one process simulates and one sample describes.

use crate::role::{Body, Guard, Law, LawInputs};
use crate::sample::{CommandLayout, FleetLayout, FleetSample, MeasurementLayout, Sample, TruthLayout};
use crate::state::{Persist, Words};
use std::marker::PhantomData;

/// Many bodies of one kind, driven and guarded as one. `E` is the leader's estimate, which the law reads.
pub trait Fleet<E: Sample>: Sized + 'static {
    /// The layout of the full states.
    type Truth: FleetLayout;
    /// The layout of the sensor readings.
    type Measurement: FleetLayout;
    /// The layout of the actuator inputs.
    type Command: FleetLayout;
    /// All bodies, as one [`Body`].
    type Body: Body<
            Truth = FleetSample<Self::Truth>,
            Measurement = FleetSample<Self::Measurement>,
            Command = FleetSample<Self::Command>,
        > + Persist;
    /// The law that drives them.
    type Law: Law<Estimate = E, Measurement = FleetSample<Self::Measurement>, Command = FleetSample<Self::Command>>
        + Persist;
    /// The guard of measurements. It rejects a whole sample if the value of one body is impossible.
    type MeasurementGuard: Guard<FleetSample<Self::Measurement>> + Persist;
    /// The guard of commands. It rejects a whole sample if the value of one body is impossible.
    type CommandGuard: Guard<FleetSample<Self::Command>> + Persist;

    /// Creates the bodies at their initial states.
    fn body(&self) -> Self::Body;
    /// Creates the law.
    fn law(&self) -> Self::Law;
    /// Creates a reader's guard for measurements.
    fn measurement_guard(&self) -> Self::MeasurementGuard;
    /// Creates a guard for commands.
    fn command_guard(&self) -> Self::CommandGuard;
}

/// The fleet of a rig without fleets. The type has no values.
#[derive(Debug, Clone, Copy)]
pub enum NoFleet {}

/// The law of [`NoFleet`].
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

    fn command(&mut self, _inputs: &LawInputs<'_, Self>, _out: &mut Self::Command) {
        match self.0 {}
    }
}

impl<L: FleetLayout> Guard<FleetSample<L>> for NoFleet {
    fn accepts(&mut self, _sample: &FleetSample<L>) -> bool {
        match *self {}
    }
}
