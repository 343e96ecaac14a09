//! The names of signals: `corotate/<scenario>/<body>/<signal>`.

use std::fmt;

/// A kind of signal of a body or role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Signal {
    /// The true state, for recording and scoring only.
    Truth,
    /// The sensor values.
    Measurement,
    /// The observer's estimate.
    Estimate,
    /// The controller's command.
    Command,
    /// The heartbeat of a role.
    Health,
    /// The launcher's schedule for all roles.
    Schedule,
    /// The changes of inputs.
    Input,
}

impl Signal {
    /// Returns the last part of the service name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Truth => "truth",
            Self::Measurement => "measurement",
            Self::Estimate => "estimate",
            Self::Command => "command",
            Self::Health => "health",
            Self::Schedule => "schedule",
            Self::Input => "input",
        }
    }
}

/// A signal of one body or role of a scenario.
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
