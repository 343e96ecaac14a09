//! One role on a bus: takes its samples, lets the pure role compute, sends, keeps the books.
//!
//! Must not wait, and must not decide when it runs; a driver does.

mod controller;
mod observer;
mod plant;
mod ports;

pub use ports::{Port, Ports, Visit, ports, visit_writes};

use super::link::{Input, Output};
use crate::bus::iox::footprint;
use crate::bus::{Bus, BusError, Reader, Signal, Topic};
use crate::clock::{Clock, Grid};
use crate::config::{ClockKind, Scenario};
use crate::rig::{Rig, Truth};
use crate::sample::Sample;
use crate::telemetry::{Grant, Ledger, ReadBook, RoleReport, StageReport, TickBook, Ticks, WriteBook};
use crate::with_rig;

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
    /// Hands over the time grid, once the epoch is known, and the first tick to execute. What a predecessor left undone
    /// before that counts as missed.
    fn start(&mut self, grid: Grid, first_tick: u64);
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
    /// Lets readers that have come later know of this role's signals. Off the critical path.
    ///
    /// # Errors
    /// [`BusError`] if a link failed.
    fn refresh(&mut self) -> Result<(), BusError>;
    /// The tick books.
    fn ticks(&self) -> Ticks;
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
    ledger: &'a Ledger,
    clock: Clock,
}

impl<B: Bus> Seat<'_, B> {
    fn input<S: Sample>(&self, body: &str, signal: Signal) -> Result<Input<B, S>, BusError> {
        Input::open(self.bus, &topic(self.scenario, body, signal), Reader::Role, self.ledger)
    }

    fn output<S: Sample>(&self, body: &str, signal: Signal) -> Result<Output<B, S>, BusError> {
        let topic = topic(self.scenario, body, signal);
        Output::open(self.bus, &topic, self.generation, self.ledger, self.scenario.last_tick)
    }
}

/// How large the ledger of a role is, words.
pub(crate) fn ledger_words(scenario: &Scenario, role: RoleId) -> usize {
    fn state_words<R: Rig>(_: &R) -> usize {
        plant::StateBook::<Truth<R>>::WORDS
    }
    let ports = ports(scenario, role);
    let state = match role {
        RoleId::Plant(_) => with_rig!(&scenario.rig, rig => state_words(rig)),
        RoleId::Observer | RoleId::Controller => 0,
    };
    TickBook::WORDS
        + ports.writes.len() * WriteBook::words(scenario.last_tick)
        + ports.reads.len() * ReadBook::WORDS
        + state
}

/// A ledger for a role that no successor will need.
pub fn private_ledger(scenario: &Scenario, role: RoleId) -> Ledger {
    Ledger::private(ledger_words(scenario, role))
}

/// An upper bound on the shared memory that a run takes, bytes.
pub(crate) fn shared_memory_bytes(scenario: &Scenario) -> usize {
    let depths = super::depths(scenario);
    let role = |role: RoleId| {
        let writes = ports(scenario, role).writes;
        let signals = writes.iter().map(|port| port.topic.signal).chain([Signal::Health]);
        signals.map(|signal| footprint(depths, signal)).sum::<usize>() + ledger_words(scenario, role) * size_of::<u64>()
    };
    footprint(depths, Signal::Schedule) + RoleId::all(scenario).into_iter().map(role).sum::<usize>()
}

/// The tick that a role has not finished, by its ledger.
pub(crate) fn next_tick(ledger: &Ledger) -> u64 {
    TickBook::open(&ledger.reopened()).next()
}

/// What a role's ledger says, with what the role itself has to add.
pub fn report(
    scenario: &Scenario,
    role: RoleId,
    ledger: &Ledger,
    stages: Vec<StageReport>,
    grants: Vec<Grant>,
) -> RoleReport {
    let ports = ports(scenario, role);
    let ledger = ledger.reopened();
    RoleReport {
        role: role.name(scenario).to_owned(),
        ticks: TickBook::open(&ledger).report(),
        written: ports
            .writes
            .iter()
            .map(|port| WriteBook::open(&ledger, scenario.last_tick).report(&port.topic.to_string()))
            .collect(),
        read: ports.reads.iter().map(|port| ReadBook::open(&ledger).report(&port.topic.to_string())).collect(),
        stages,
        grants,
    }
}

/// The topic of a signal in a scenario.
pub fn topic(scenario: &Scenario, body: &str, signal: Signal) -> Topic {
    Topic { scenario: scenario.name.clone(), body: body.to_owned(), signal }
}

/// Opens a role's links and builds its node, with its books in the ledger: new, or a predecessor's.
///
/// # Errors
/// [`BusError::Open`].
pub fn build<R: Rig, B: Bus + 'static>(
    rig: &R,
    scenario: &Scenario,
    role: RoleId,
    bus: &B,
    ledger: &Ledger,
) -> Result<ReadyNode, BusError> {
    let generation = ledger.enter();
    let ledger = &ledger.reopened();
    let clock = if scenario.clock == ClockKind::Realtime { Clock::Monotonic } else { Clock::None };
    let seat = Seat { bus, scenario, generation, ledger, clock };
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
