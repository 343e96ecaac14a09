//! Samples by which the launcher and the roles of a run agree on its phases. The same in every rig.

use super::sample;

sample! {
    /// The launcher's word to all roles. The stamp's tick counts the announcements.
    Schedule = "corotate/run/schedule/v1" {
        /// A [`Phase`] as a number.
        phase: u64,
        /// T_0 on the monotonic clock, ns; meaningful from [`Phase::Run`] on, in real time.
        epoch_ns: u64,
        /// Ticks up to this one have been seen by the slowest consumer (lockstep).
        credit_tick: u64,
    }
}

sample! {
    /// A role's word to the launcher. The stamp's tick is the next one that the role will execute.
    Health = "corotate/run/health/v1" {
        /// A [`RoleState`] as a number.
        state: u64,
        /// Ticks executed.
        executed: u64,
        /// Ticks missed.
        missed: u64,
        /// Privileges that were asked for and not granted.
        denied: u64,
    }
}

/// Where a run stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u64)]
pub enum Phase {
    /// Roles open their links.
    Gather = 0,
    /// Roles exercise their links with samples of generation 0.
    WarmUp = 1,
    /// The epoch is set; ticks run.
    Run = 2,
    /// Roles end after the tick at hand.
    Stop = 3,
}

impl Phase {
    /// Every phase with its name.
    pub const NAMES: [(&str, Self); 4] =
        [("gather", Self::Gather), ("warm_up", Self::WarmUp), ("run", Self::Run), ("stop", Self::Stop)];

    /// The phase with this number; an unknown number reads as [`Phase::Stop`], the safe one.
    pub fn from_number(number: u64) -> Self {
        Self::NAMES.into_iter().find(|(_, phase)| *phase as u64 == number).map_or(Self::Stop, |(_, phase)| phase)
    }
}

/// Where a role stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u64)]
pub enum RoleState {
    /// Not heard of yet.
    Absent = 0,
    /// All links are open.
    Open = 1,
    /// All links have been exercised; waits for the epoch.
    Ready = 2,
    /// Ticks run.
    Running = 3,
    /// The last tick is done and the report written.
    Done = 4,
}

impl RoleState {
    /// Every state with its name.
    pub const NAMES: [(&str, Self); 5] = [
        ("absent", Self::Absent),
        ("open", Self::Open),
        ("ready", Self::Ready),
        ("running", Self::Running),
        ("done", Self::Done),
    ];

    /// The state with this number; an unknown number reads as [`RoleState::Absent`].
    pub fn from_number(number: u64) -> Self {
        Self::NAMES.into_iter().find(|(_, state)| *state as u64 == number).map_or(Self::Absent, |(_, state)| state)
    }
}
