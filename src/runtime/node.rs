//! One role on a bus: takes its samples, lets the pure role compute, sends, keeps the books.
//!
//! Must not wait, and must not decide when it runs; a driver does.

mod controller;
mod observer;
mod plant;
mod ports;

pub use ports::{Port, Ports, ports};

use super::link::{Input, Output};
use crate::bus::{Bus, BusError, Reader, Signal, Topic};
use crate::clock::{Clock, Grid};
use crate::config::{ClockKind, Scenario};
use crate::rig::Rig;
use crate::sample::Sample;
use crate::telemetry::{LinkRead, LinkWritten, StageReport, Ticks};

/// Which role of a scenario.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoleId {
    /// The plant of the body with this index.
    Plant(usize),
    /// The observer of the first body.
    Observer,
    /// The controller of all driven bodies.
    Controller,
}

impl RoleId {
    /// All roles of a scenario, in the order in which one tick passes through them.
    pub fn all(scenario: &Scenario) -> Vec<Self> {
        let plants = (0..scenario.rig.bodies().len()).map(Self::Plant);
        let driven = scenario.rig.bodies().iter().any(|body| body.driven);
        plants.chain([Self::Observer]).chain(driven.then_some(Self::Controller)).collect()
    }

    /// The role's name: a body's, `observer` or `controller`.
    pub fn name(self, scenario: &Scenario) -> &str {
        match self {
            Self::Plant(index) => &scenario.rig.bodies()[index].name,
            Self::Observer => "observer",
            Self::Controller => "controller",
        }
    }

    /// The role of this name, if the scenario has one.
    pub fn named(scenario: &Scenario, name: &str) -> Option<Self> {
        Self::all(scenario).into_iter().find(|role| role.name(scenario) == name)
    }

    /// What kind of role it is, as the command line calls it.
    pub fn kind(self) -> &'static str {
        match self {
            Self::Plant(_) => "plant",
            Self::Observer => "observer",
            Self::Controller => "controller",
        }
    }
}

/// When a node may execute its next tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Gate {
    /// Lockstep: when every input of the tick is there and the tick is at most this one.
    Inputs {
        /// The farthest tick allowed.
        up_to: u64,
    },
    /// Real time, plants: now, whatever is there, skipping to the tick that is due.
    Now {
        /// The latest tick that is due.
        tick: u64,
        /// The time.
        now_ns: u64,
    },
    /// Real time, others: when the inputs are there.
    Arrived,
    /// Real time, others: with what is there, as long as the tick can be computed at all.
    Overdue,
}

/// Whether a node executed a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Poll {
    /// It did; [`Node::settle`] is due.
    Executed,
    /// It waits for inputs.
    Waiting,
}

/// A role with its links and books.
pub trait Node {
    /// Whether the tick alone starts it, or its inputs do.
    fn time_triggered(&self) -> bool;
    /// The next tick to execute.
    fn next_tick(&self) -> u64;
    /// Hands over the time grid, once the epoch is known.
    fn start(&mut self, grid: Grid);
    /// Executes the next tick if the gate allows it: takes inputs, computes, sends. The critical path.
    ///
    /// # Errors
    /// [`BusError`] if a link failed.
    fn poll(&mut self, gate: Gate) -> Result<Poll, BusError>;
    /// Does what the executed tick left to be done: integrates, counts, prepares the next sample.
    ///
    /// # Errors
    /// [`BusError`] if a link failed.
    fn settle(&mut self) -> Result<(), BusError>;
    /// Counts every tick before `tick` that was not executed as missed.
    fn skip_to(&mut self, tick: u64);
    /// Exercises all links with a sample that no role uses.
    ///
    /// # Errors
    /// [`BusError`] if a link failed.
    fn warm_up(&mut self) -> Result<(), BusError>;
    /// The tick books.
    fn ticks(&self) -> Ticks;
    /// The books of all written signals.
    fn written(&self) -> Vec<LinkWritten>;
    /// The books of all read signals.
    fn read(&self) -> Vec<LinkRead>;
    /// The latencies.
    fn stages(&self) -> Vec<StageReport>;
}

/// A node that can be driven.
pub type ReadyNode = Box<dyn Node>;

/// What every node of a run shares.
pub struct Seat<'a, B> {
    bus: &'a B,
    scenario: &'a Scenario,
    generation: u64,
    clock: Clock,
}

impl<B: Bus> Seat<'_, B> {
    fn input<S: Sample>(&self, body: &str, signal: Signal) -> Result<Input<B, S>, BusError> {
        Input::open(self.bus, &topic(self.scenario, body, signal), Reader::Role)
    }

    fn output<S: Sample>(&self, body: &str, signal: Signal) -> Result<Output<B, S>, BusError> {
        Output::open(self.bus, &topic(self.scenario, body, signal), self.generation, self.scenario.last_tick)
    }
}

/// The books of a role's ticks while it runs.
#[derive(Debug, Default)]
struct TickBook {
    next: u64,
    ticks: Ticks,
}

impl TickBook {
    /// Counts the ticks before `tick` that were not executed as missed, and tells how many.
    #[inline]
    fn skip_to(&mut self, tick: u64) -> u64 {
        let missed = tick.saturating_sub(self.next);
        if missed > 0 {
            self.disturbed(self.next);
            self.ticks.missed += missed;
            self.next = tick;
        }
        missed
    }

    #[inline]
    fn executed(&mut self) {
        self.ticks.executed += 1;
        self.next += 1;
    }

    /// Counts a tick at which an input was absent.
    #[inline]
    fn starved(&mut self, tick: u64) {
        self.ticks.starved += 1;
        self.disturbed(tick);
    }

    fn disturbed(&mut self, tick: u64) {
        self.ticks.first_disturbed.get_or_insert(tick);
    }

    fn report(&self) -> Ticks {
        Ticks { elapsed: self.next, ..self.ticks }
    }
}

/// The topic of a signal in a scenario.
pub fn topic(scenario: &Scenario, body: &str, signal: Signal) -> Topic {
    Topic { scenario: scenario.name.clone(), body: body.to_owned(), signal }
}

/// Opens a role's links and builds its node.
///
/// # Errors
/// [`BusError::Open`].
pub fn build<R: Rig, B: Bus + 'static>(
    rig: &R,
    scenario: &Scenario,
    role: RoleId,
    bus: &B,
    generation: u64,
) -> Result<ReadyNode, BusError> {
    let clock = if scenario.clock == ClockKind::Realtime { Clock::Monotonic } else { Clock::None };
    let seat = Seat { bus, scenario, generation, clock };
    Ok(match role {
        RoleId::Plant(index) => Box::new(plant::PlantNode::<R, B>::open(rig, index, &seat)?),
        RoleId::Observer => Box::new(observer::ObserverNode::<R, B>::open(rig, &seat)?),
        RoleId::Controller => Box::new(controller::ControllerNode::<R, B>::open(rig, &seat)?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    #[test]
    fn every_role_of_a_scenario_has_the_name_that_the_rig_gives_it() {
        for (name, text) in SHIPPED {
            let scenario = Scenario::parse(text, name, &[]).unwrap();
            let names: Vec<&str> = RoleId::all(&scenario).iter().map(|role| role.name(&scenario)).collect();
            assert_eq!(names, scenario.rig.roles(), "{name}");
        }
    }
}
