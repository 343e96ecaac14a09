//! The roles of a scenario by name and number, and the process of each. Must not open anything.

use crate::config::{ClockKind, InputUser, Settings};

/// The number from which those of observers of other bodies than the first are counted.
const OBSERVERS: u64 = 1 << 32;

/// A role of a scenario.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoleId {
    /// The plant of the body with this index.
    Plant(usize),
    /// The observer of the body with this index.
    Observer(usize),
    /// The controller of all driven bodies.
    Controller,
}

impl RoleId {
    /// Returns the roles that a user of an input belongs to; none for the score.
    pub fn using(scenario: &Settings, user: InputUser) -> impl Iterator<Item = Self> {
        Self::all(scenario).into_iter().filter(move |role| role.takes(user))
    }

    /// Returns all roles of a scenario in the order of a tick.
    pub fn all(scenario: &Settings) -> Vec<Self> {
        let plants = (0..scenario.bodies.len()).map(Self::Plant);
        let driven = scenario.bodies.iter().any(|body| body.driven);
        let bodies = scenario.bodies.iter().enumerate();
        let observers = bodies.filter(|(_, body)| body.observer.is_some()).map(|(index, _)| Self::Observer(index));
        plants.chain(observers).chain(driven.then_some(Self::Controller)).collect()
    }

    /// Returns the role's name: a body's, `observer`, `observer-` with the body's name, or `controller`.
    pub fn name(self, scenario: &Settings) -> &str {
        match self {
            Self::Plant(index) => &scenario.bodies[index].name,
            Self::Observer(index) => scenario.bodies[index].observer.as_deref().unwrap_or("observer"),
            Self::Controller => "controller",
        }
    }

    /// Returns the role of this name, if the scenario has one.
    pub fn named(scenario: &Settings, name: &str) -> Option<Self> {
        Self::all(scenario).into_iter().find(|role| role.name(scenario) == name)
    }

    /// Returns the role that the role's process is named after: itself, or the last one, in the order of a tick, of the
    /// roles that share the process.
    pub fn process_role(self, scenario: &Settings) -> Self {
        let name = self.name(scenario);
        let process = scenario.processes.iter().find(|roles| roles.iter().any(|role| role == name));
        let Some(process) = process.filter(|_| scenario.clock != ClockKind::InProcess) else { return self };
        let mut roles = Self::all(scenario);
        roles.retain(|role| process.iter().any(|name| name == role.name(scenario)));
        roles.pop().unwrap_or(self)
    }

    /// Returns the roles in this role's process in the order of a tick; empty if the process is named after another
    /// role.
    pub fn process_members(self, scenario: &Settings) -> Vec<Self> {
        let mut hosted = Self::all(scenario);
        hosted.retain(|role| role.process_role(scenario) == self);
        hosted
    }

    /// Returns true if a user of inputs is a part of this role.
    pub fn takes(self, user: InputUser) -> bool {
        match (self, user) {
            (Self::Plant(index), InputUser::Body(body) | InputUser::Actuator(body)) => index == body,
            (Self::Observer(_), InputUser::Observer) => true,
            (Self::Controller, InputUser::Law(_) | InputUser::Reference) => true,
            _ => false,
        }
    }

    /// Returns a number for records of fixed size: 1 for the observer of the first body, 2 for the controller, then the plants; the
    /// other observers from 2^32 on. 0 is no role.
    pub fn number(self) -> u64 {
        match self {
            Self::Observer(0) => 1,
            Self::Observer(index) => OBSERVERS + index as u64,
            Self::Controller => 2,
            Self::Plant(index) => 3 + index as u64,
        }
    }

    /// Returns the role with this [number](Self::number).
    pub fn from_number(number: u64) -> Option<Self> {
        match number {
            0 => None,
            1 => Some(Self::Observer(0)),
            2 => Some(Self::Controller),
            other @ OBSERVERS.. => Some(Self::Observer((other - OBSERVERS) as usize)),
            plant => Some(Self::Plant(plant as usize - 3)),
        }
    }

    /// Returns the kind of role as on the command line.
    pub fn kind(self) -> &'static str {
        match self {
            Self::Plant(_) => "plant",
            Self::Observer(_) => "observer",
            Self::Controller => "controller",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::RoleId::{self, Controller, Observer, Plant};

    /// Records of earlier versions have them too.
    #[test]
    fn numbers_of_roles_stay_and_can_be_read() {
        let roles = [Observer(0), Controller, Plant(0), Plant(3), Observer(2)];
        assert_eq!(roles.map(RoleId::number), [1, 2, 3, 6, (1 << 32) + 2]);
        assert_eq!(roles.map(|role| RoleId::from_number(role.number())), roles.map(Some));
        assert_eq!(RoleId::from_number(0), None);
    }
}
