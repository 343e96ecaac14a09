//! The settings of a run: all of a scenario but its rig, which is a type parameter of the code that runs it.

use super::accept::Accept;
use super::body::{BodyInfo, role_names};
use super::fault::ScriptedFault;
use super::hosts::Hosts;
use super::raw::{ClockKind, Realtime, Supervision};
use super::run_id::RunId;
use crate::bus::Port;
use crate::control::WatchBounds;
use crate::role::{Actuation, Rearm};

/// The settings of a run.
#[derive(Debug)]
pub struct Settings {
    /// Its name: part of service names and of the run directory's.
    pub name: String,
    /// What drives the ticks.
    pub clock: ClockKind,
    /// The rate that was asked for, Hz.
    pub tick_hz: f64,
    /// The period h, ns.
    pub period_ns: u64,
    /// The last tick; the first is 0.
    pub last_tick: u64,
    /// The seed of all randomness.
    pub seed: u64,
    /// Whether every sample is to be recorded.
    pub record: bool,
    /// After how many missing commands a driven body goes to its safe command.
    pub command_timeout_ticks: u64,
    /// From so many ticks after its measurement on a command acts.
    pub actuation_delay_ticks: u64,
    /// What ends the safe command.
    pub rearm: Rearm,
    /// What a real-time run asks of the machine.
    pub realtime: Realtime,
    /// How long the roles may take until all are ready, s.
    pub startup_timeout_s: f64,
    /// For how long an external role may keep the run waiting, s; if none, for ever until the ticks run, and then 30 s.
    pub external_timeout_s: Option<f64>,
    /// The roles that share a process, where roles are processes.
    pub processes: Vec<Vec<String>>,
    /// Roles that somebody else starts: hardware, or a foreign program.
    pub external: Vec<String>,
    /// Roles that wait for a debugger before the first tick.
    pub debug: Vec<String>,
    /// What the launcher does about roles that fail.
    pub supervision: Supervision,
    /// The computers, if there are several, and what holds between them.
    pub hosts: Hosts,
    /// What is to go wrong.
    pub faults: Vec<ScriptedFault>,
    /// What the controller watches.
    pub watch: WatchBounds,
    /// What the run is judged by.
    pub accept: Accept,
    /// The run whose scenario this is, where there is one. Whoever starts another gives it another.
    pub run: Option<RunId>,
    /// The bodies of the rig; the first is the observed one.
    pub bodies: Vec<BodyInfo>,
    /// The signals of the bodies.
    pub signals: Vec<Port>,
    /// The names of the quantities that the controller can watch.
    pub monitors: Vec<&'static str>,
}

impl Settings {
    /// Returns the names of all roles, in the order in which one tick passes through them.
    pub fn roles(&self) -> Vec<&str> {
        role_names(&self.bodies)
    }

    /// Why somebody else cannot start this role in a run of the scenario, if it is so.
    ///
    /// # Errors
    /// The reason, with what to do.
    pub fn check_external(&self, role: &str) -> Result<(), NotExternal> {
        let roles = self.roles();
        if self.clock == ClockKind::InProcess {
            return Err(NotExternal::OneProcess);
        }
        if !roles.contains(&role) {
            return Err(NotExternal::UnknownRole { known: roles.join(", ") });
        }
        if self.debug.iter().any(|debugged| debugged == role) {
            return Err(NotExternal::DebuggedAndExternal { role: role.to_owned() });
        }
        let shared = self.processes.iter().any(|roles| roles.iter().any(|other| other == role));
        if shared { Err(NotExternal::SharedAndExternal { role: role.to_owned() }) } else { Ok(()) }
    }

    /// How many ticks after its tick a role may still wait for what crosses hosts on the way to it.
    pub fn lag_ticks(&self, role: &str) -> u64 {
        self.hosts.lag_ticks(role, self.bodies.iter().map(|body| (&*body.name, body.driven)))
    }

    /// Returns how long another host may be silent, s. One that starts is loaded, and its session may have to be replaced: it has
    /// as long as a role has to come up.
    pub fn host_silence_s(&self, running: bool) -> f64 {
        let limit_s = self.hosts.network.silence_timeout_s;
        if running { limit_s } else { limit_s.max(self.startup_timeout_s) }
    }

    /// The period h, s.
    pub fn tick_s(&self) -> f64 {
        self.period_ns as f64 / 1e9
    }

    /// The time of a tick since the first, s.
    pub fn time_s(&self, tick: u64) -> f64 {
        tick as f64 * self.tick_s()
    }

    /// How the actuators of a body treat their commands.
    pub fn actuation(&self, driven: bool) -> Actuation {
        let (delay_ticks, timeout_ticks) = (self.actuation_delay_ticks, self.command_timeout_ticks);
        Actuation { driven, delay_ticks, timeout_ticks, rearm: self.rearm }
    }
}

/// Why a role cannot be another program's.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum NotExternal {
    /// The run has one process.
    #[error("one process has no room for another's role; give --clock realtime or lockstep")]
    OneProcess,
    /// The scenario has no such role.
    #[error("there is no such role; this scenario has: {known}")]
    UnknownRole {
        /// The roles that it has.
        known: String,
    },
    /// The run waits for a debugger of this role.
    #[error(
        "another program takes the {role}: start that in a debugger, as `gdb --args …`, and take it out of launch.debug"
    )]
    DebuggedAndExternal {
        /// The role.
        role: String,
    },
    /// The role is external and in `launch.processes`.
    #[error(
        "launch.processes places the {role} in a process of the launcher, so it cannot be external; remove it there"
    )]
    SharedAndExternal {
        /// The role.
        role: String,
    },
}
