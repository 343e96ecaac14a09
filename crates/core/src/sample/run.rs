//! Samples that coordinate the phases of a run between the launcher and the roles. The same for every rig.

use crate::sample;

sample! {
    /// The phase of the run, published by the launcher to all roles. The stamp's tick counts the announcements.
    Schedule = "corotate/run/schedule/v1" {
        /// The number of a [`Phase`].
        phase: u64,
        /// T_0 on the monotonic clock, ns; valid from [`Phase::Run`] on, in real time.
        epoch_ns: u64,
        /// The last tick that the slowest consumer has read (lockstep).
        credit_tick: u64,
    }
}

sample! {
    /// The heartbeat of a role, published to the launcher. The stamp's tick is the next one that the role will
    /// execute.
    Health = "corotate/run/health/v1" {
        /// The number of a [`RoleState`].
        state: u64,
        /// The number of ticks executed.
        executed: u64,
        /// The number of ticks missed.
        missed: u64,
        /// The number of privileges requested and not granted.
        denied: u64,
    }
}

sample! {
    /// A change of an input, published by the launcher before it acts. The stamp's tick is the one from which it acts.
    InputChange = "corotate/run/input/v1" {
        /// The number of the change, counted from 0: those of the scenario first, then received ones.
        number: u64,
        /// The number of the input.
        input: u64,
        /// The number of a shape.
        shape: u64,
        /// The length of the shape, ticks.
        length_ticks: u64,
        /// The parameters of the shape: frequencies in cycles per tick as bits of an f64, or hold ticks and seed.
        parameters: [u64; 2],
        /// The new level or the amplitude; components beyond those of the input are zero.
        values: [f64; 6],
    }
}

/// The phase of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u64)]
pub enum Phase {
    /// Roles open their links.
    Gather = 0,
    /// Roles exercise their links with samples of generation 0.
    WarmUp = 1,
    /// The epoch is set; roles execute ticks.
    Run = 2,
    /// Roles end after the current tick.
    Stop = 3,
}

impl Phase {
    /// All phases with their names.
    pub const NAMES: [(&str, Self); 4] =
        [("gather", Self::Gather), ("warm_up", Self::WarmUp), ("run", Self::Run), ("stop", Self::Stop)];

    /// Returns the phase with this number; an unknown number yields [`Phase::Stop`], the safe one.
    pub fn from_number(number: u64) -> Self {
        Self::NAMES.into_iter().find(|(_, phase)| *phase as u64 == number).map_or(Self::Stop, |(_, phase)| phase)
    }
}

/// The state of a role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u64)]
pub enum RoleState {
    /// No heartbeat has been received.
    Absent = 0,
    /// All links are open.
    Open = 1,
    /// All links have been exercised; the role waits for the epoch.
    Ready = 2,
    /// The role executes ticks.
    Running = 3,
    /// The last tick is done and the report is written.
    Done = 4,
}

impl RoleState {
    /// All states with their names.
    pub const NAMES: [(&str, Self); 5] = [
        ("absent", Self::Absent),
        ("open", Self::Open),
        ("ready", Self::Ready),
        ("running", Self::Running),
        ("done", Self::Done),
    ];

    /// Returns the state with this number; an unknown number yields [`RoleState::Absent`].
    pub fn from_number(number: u64) -> Self {
        Self::NAMES.into_iter().find(|(_, state)| *state as u64 == number).map_or(Self::Absent, |(_, state)| state)
    }
}
