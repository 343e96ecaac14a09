//! Detects a run without progress.

use super::super::LaunchError;
use super::super::supervision::Member;
use crate::clock::monotonic_ns;
use crate::sample::RoleState;
use crate::scenario::Scenario;

/// Time without progress after which the run counts as hung, ns and periods.
pub const HUNG_NS: u64 = 30_000_000_000;
const HUNG_PERIODS: u64 = 10;

/// The progress of the members of a run.
pub struct Stall {
    limit_ns: u64,
    moved_ns: u64,
    ticks: Vec<u64>,
}

impl Stall {
    pub fn new(scenario: &Scenario) -> Self {
        // A role's own timeout comes first, because it names the role.
        let heartbeat_ns = (2e9 * scenario.supervision.heartbeat_timeout_s) as u64;
        let limit_ns = HUNG_NS.max(HUNG_PERIODS * scenario.period_ns).max(heartbeat_ns);
        Self { limit_ns, moved_ns: monotonic_ns(), ticks: Vec::new() }
    }

    pub fn look(&mut self, members: &[Member], now_ns: u64, excused: bool) -> Result<(), LaunchError> {
        let moved = excused
            || self.ticks.len() != members.len()
            || members.iter().zip(&self.ticks).any(|(member, tick)| member.last.stamp.tick != *tick);
        if moved {
            self.moved_ns = now_ns;
            self.ticks = members.iter().map(|member| member.last.stamp.tick).collect();
        }
        if now_ns.saturating_sub(self.moved_ns) < self.limit_ns {
            return Ok(());
        }
        let waiting = members.iter().filter(|member| member.state() < RoleState::Done);
        let behind = waiting.clone().map(|member| member.last.stamp.tick).min();
        let roles: Vec<&str> =
            waiting.filter(|member| Some(member.last.stamp.tick) == behind).map(|member| &*member.name).collect();
        Err(LaunchError::Hung { limit_s: self.limit_ns as f64 / 1e9, roles: roles.join(", ") })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    #[test]
    fn the_heartbeat_timeout_comes_before_that_of_a_run_without_progress() {
        let limit_s = |heartbeat_s: f64| {
            let patient = [format!("supervision.heartbeat_timeout_s={heartbeat_s:?}")];
            let scenario = Scenario::parse(SHIPPED[0].1, SHIPPED[0].0, &patient).unwrap();
            Stall::new(&scenario).limit_ns as f64 / 1e9
        };
        assert_eq!([2.0, 30.0, 3600.0].map(limit_s), [30.0, 60.0, 7200.0]);
    }
}
