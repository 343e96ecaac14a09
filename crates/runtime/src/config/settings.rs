//! The settings of a run: all of a scenario except its rig, which is a type parameter of the code that runs it.

use super::accept::Accept;
use super::body::{BodyInfo, role_names};
use super::fault::ScriptedFault;
use super::hosts::Hosts;
use super::input::Inputs;
use super::rates::Rates;
use super::raw::{ClockKind, Realtime, Supervision, Trace};
use super::run_id::RunId;
use super::sensor::Sensor;
use crate::bus::Port;
use crate::control::WatchBounds;
use crate::role::{Actuation, Rearm};

/// The settings of a run.
#[derive(Debug)]
pub struct Settings {
    /// The name, part of service names and of the run directory's name.
    pub name: String,
    /// The clock that drives the ticks.
    pub clock: ClockKind,
    /// The requested tick rate, Hz.
    pub tick_hz: f64,
    /// The period h, ns.
    pub period_ns: u64,
    /// The last tick; the first is 0.
    pub last_tick: u64,
    /// The seed of all randomness.
    pub seed: u64,
    /// True if every sample is recorded.
    pub record: bool,
    /// The number of missing commands after which a driven body applies its safe command.
    pub command_timeout_ticks: u64,
    /// The delay from a measurement to the command's effect, ticks.
    pub actuation_delay_ticks: u64,
    /// The rates of the roles.
    pub rates: Rates,
    /// The sensors that are slower than the tick.
    pub sensors: Vec<Sensor>,
    /// The event that ends the safe command.
    pub rearm: Rearm,
    /// The requests of a real-time run to the machine.
    pub realtime: Realtime,
    /// The longest time until all roles are ready, s.
    pub startup_timeout_s: f64,
    /// The longest time that the run waits for an external role, s. `None`: without limit before the first tick, then 30 s.
    pub external_timeout_s: Option<f64>,
    /// The groups of roles that share a process, if roles are processes.
    pub processes: Vec<Vec<String>>,
    /// Roles that the launcher does not start: hardware, or another program.
    pub external: Vec<String>,
    /// Roles that wait for a debugger before the first tick.
    pub debug: Vec<String>,
    /// The launcher's reaction to failed roles.
    pub supervision: Supervision,
    /// The hosts of a distributed run, and the network between them.
    pub hosts: Hosts,
    /// The faults to inject.
    pub faults: Vec<ScriptedFault>,
    /// The inputs, and their changes.
    pub inputs: Inputs,
    /// The numbers of the reference at tick 0, in the order of the rig's fields.
    pub reference: Vec<f64>,
    /// The bounds that the controller watches.
    pub watch: WatchBounds,
    /// The acceptance criteria.
    pub accept: Accept,
    /// The run to which this scenario belongs, if any. Each new run gets a new identifier.
    pub run: Option<RunId>,
    /// The bodies of the rig with their observers; the first is always observed.
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

    /// Checks that another program may run this role.
    ///
    /// # Errors
    /// [`NotExternal`] with the remedy.
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
        let shared = self.processes.iter().any(|roles| roles.iter().any(|shared| shared == role));
        if shared { Err(NotExternal::SharedAndExternal { role: role.to_owned() }) } else { Ok(()) }
    }

    /// Returns the ticks after its own tick during which a role may still wait for inputs that cross hosts.
    pub fn lag_ticks(&self, role: &str) -> u64 {
        self.hosts.lag_ticks(role, &self.bodies)
    }

    /// Returns the longest silence of another host, s. A starting host is loaded, and its session may have to be replaced, so it
    /// gets as long as a role may take to start.
    pub fn host_silence_s(&self, running: bool) -> f64 {
        let limit_s = self.hosts.network.silence_timeout_s;
        if running { limit_s } else { limit_s.max(self.startup_timeout_s) }
    }

    /// Returns true if roles keep records of their late ticks.
    pub fn keeps_late_ticks(&self) -> bool {
        self.clock == ClockKind::Realtime && self.realtime.trace != Trace::Off
    }

    /// Returns the period h, s.
    pub fn tick_s(&self) -> f64 {
        self.period_ns as f64 / 1e9
    }

    /// Returns the time from the first tick to this one, s.
    pub fn time_s(&self, tick: u64) -> f64 {
        tick as f64 * self.tick_s()
    }

    /// Returns the actuator settings of a body.
    pub fn actuation(&self, driven: bool) -> Actuation {
        let (delay_ticks, timeout_ticks) = (self.actuation_delay_ticks, self.command_timeout_ticks);
        Actuation { driven, delay_ticks, timeout_ticks, rearm: self.rearm }
    }
}

/// The reason why another program cannot run a role.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum NotExternal {
    /// The run has a single process.
    #[error("one process has no room for another's role; give --clock realtime or lockstep")]
    OneProcess,
    /// The scenario has no such role.
    #[error("there is no such role; this scenario has: {known}")]
    UnknownRole {
        /// The roles of the scenario.
        known: String,
    },
    /// The role is in `launch.debug`.
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
