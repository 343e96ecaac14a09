//! Watches for roles that overrun: that miss a tick without a scripted fault. What follows is `realtime.overrun`.
//!
//! Must not end anything; [`super::processes`] does.

use super::incident::RoleFailure;
use super::supervision::Member;
use crate::config::{ClockKind, Overrun};
use crate::runtime::committed_ticks;
use crate::scenario::Scenario;

/// A role that has overrun.
pub(super) struct Overran {
    /// The role.
    pub role: String,
    /// The next tick that it will execute.
    pub tick: u64,
    /// The failure, for an incident.
    pub failure: RoleFailure,
}

/// The watch for the first role that overruns.
pub(super) struct OverrunWatch {
    policy: Overrun,
    /// True once a role has overrun: nothing further is looked for.
    over: bool,
}

impl OverrunWatch {
    pub fn new(scenario: &Scenario) -> Self {
        let policy = if scenario.clock == ClockKind::Realtime { scenario.realtime.overrun } else { Overrun::Skip };
        Self { policy, over: false }
    }

    /// Creates a watch that finds nothing.
    #[cfg(feature = "hosts")]
    pub fn off() -> Self {
        Self { policy: Overrun::Skip, over: false }
    }

    /// Returns the reaction to an overrun.
    pub fn policy(&self) -> Overrun {
        self.policy
    }

    /// Returns the first role that has overrun, once. Roles without counters are not watched.
    pub fn look(&mut self, scenario: &Scenario, members: &[Member]) -> Option<Overran> {
        if self.policy == Overrun::Skip || self.over {
            return None;
        }
        let counted = members.iter().flat_map(Member::books).map(|(role, ledger)| (role, committed_ticks(ledger)));
        let mut overruns = counted.map(|(role, ticks)| (role, ticks, ticks.overruns()));
        let (role, ticks, overruns) = overruns.find(|(.., overruns)| *overruns > 0)?;
        self.over = true;
        let cause = format!(
            "it missed {overruns} ticks by tick {}, and realtime.overrun does not skip them",
            ticks.elapsed.saturating_sub(1)
        );
        let failure = RoleFailure::new("overrun", cause, String::new());
        Some(Overran { role: role.name(scenario).to_owned(), tick: ticks.elapsed, failure })
    }
}
