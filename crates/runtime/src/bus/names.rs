//! The names of signals: `corotate/<scenario>/<body>/<signal>`.

use std::fmt;

/// What is said about a body, or by a role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Signal {
    /// The state as it is. For recording and scoring only.
    Truth,
    /// What the sensors report.
    Measurement,
    /// What the observer makes of it.
    Estimate,
    /// What the actuators are to apply.
    Command,
    /// How a role is doing.
    Health,
    /// What the launcher tells all roles.
    Schedule,
}

impl Signal {
    /// Its part of the service's name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Truth => "truth",
            Self::Measurement => "measurement",
            Self::Estimate => "estimate",
            Self::Command => "command",
            Self::Health => "health",
            Self::Schedule => "schedule",
        }
    }
}

/// One signal of one body or role of a scenario.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// The scenario's name.
    pub scenario: String,
    /// The body's or the role's name.
    pub body: String,
    /// The signal.
    pub signal: Signal,
}

impl fmt::Display for Topic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "corotate/{}/{}/{}", self.scenario, self.body, self.signal.name())
    }
}
