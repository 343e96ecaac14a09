//! The roles of a scenario by name and number, in whose process each runs, and who takes its seat. Must not open anything.

use crate::config::{ClockKind, Scenario};
use crate::runtime::bridge::DeviceLink;
use crate::runtime::compute::Compute;
use crate::telemetry::Ledger;

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

    /// The role in whose process it runs: its own, unless the scenario gives it one together with others. Then it is the last of
    /// them in the order of a tick.
    pub fn host(self, scenario: &Scenario) -> Self {
        let name = self.name(scenario);
        let process = scenario.processes.iter().find(|roles| roles.iter().any(|role| role == name));
        let Some(process) = process.filter(|_| scenario.clock != ClockKind::InProcess) else { return self };
        let mut roles = Self::all(scenario);
        roles.retain(|role| process.iter().any(|name| name == role.name(scenario)));
        roles.pop().unwrap_or(self)
    }

    /// The roles that run in its process, in the order of a tick; none if it is in another's.
    pub fn hosted(self, scenario: &Scenario) -> Vec<Self> {
        let mut hosted = Self::all(scenario);
        hosted.retain(|role| role.host(scenario) == self);
        hosted
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

/// Who takes a role's seat.
pub enum RoleImpl {
    /// This program, with other roles in the same process: these, in the order of a tick, with their ledgers.
    Role(RoleId, Vec<(RoleId, Ledger)>),
    /// This program's node, whose samples a function computes.
    Computed(RoleId, Box<dyn Compute>),
    /// A device: a role, with others in the same device, as above.
    Device(RoleId, Vec<(RoleId, Ledger)>, Box<DeviceLink>),
}

impl RoleImpl {
    /// The seat.
    pub fn role(&self) -> RoleId {
        match self {
            Self::Role(role, _) | Self::Computed(role, _) | Self::Device(role, ..) => *role,
        }
    }

    /// Its roles with their ledgers, in the order of a tick; `ledger` is that of the seat.
    pub(in crate::runtime) fn books(&self, ledger: &Ledger) -> Vec<(RoleId, Ledger)> {
        let others = match self {
            Self::Role(_, others) | Self::Device(_, others, _) => &others[..],
            Self::Computed(..) => &[],
        };
        let others = others.iter().map(|(role, ledger)| (*role, ledger.reopened()));
        others.chain([(self.role(), ledger.reopened())]).collect()
    }
}

impl From<RoleId> for RoleImpl {
    fn from(role: RoleId) -> Self {
        Self::Role(role, Vec::new())
    }
}
