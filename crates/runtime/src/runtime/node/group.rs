//! Several roles in one process (`launch.processes`), driven as one node in the order of a tick.
//!
//! Each role keeps its signals, state and counters, and its samples take the usual links. In real time a latest-value
//! channel serves the members at once; publishing and other work waits until all members have done their tick or one
//! has to wait. Must not compute, nor change what a member sends.

use super::contract::{Node, Poll, ReadyNode, RunCondition};
use crate::clock::{Grid, monotonic_ns};
use crate::runtime::error::NodeError;
use crate::runtime::role_id::RoleId;
use crate::telemetry::{LateTicks, LedgerError, StageReport, Ticks};

/// Longest sleep of a group that lacks several outside inputs, ns.
const NAP_NS: u64 = 50_000;

/// Several roles as one node.
pub struct GroupNode {
    /// In the order of a tick.
    members: Vec<Member>,
    realtime: bool,
    last_tick: u64,
    /// The tick in progress, in real time.
    open: Option<u64>,
}

struct Member {
    role: RoleId,
    node: ReadyNode,
    /// True while an executed tick is not finished.
    executed: bool,
}

impl Member {
    fn finish_tick(&mut self) -> Result<(), NodeError> {
        if std::mem::take(&mut self.executed) { self.node.finish_tick() } else { Ok(()) }
    }
}

impl GroupNode {
    /// Groups these roles, given in the order of a tick, for a run up to `last_tick`.
    pub fn new(nodes: Vec<(RoleId, ReadyNode)>, realtime: bool, last_tick: u64) -> Self {
        let members = nodes.into_iter().map(|(role, node)| Member { role, node, executed: false }).collect();
        Self { members, realtime, last_tick, open: None }
    }

    fn nodes(&mut self) -> impl Iterator<Item = &mut ReadyNode> {
        self.members.iter_mut().map(|member| &mut member.node)
    }

    /// Returns true if the time grid starts the member's next tick.
    fn timed(&self, member: &Member) -> bool {
        self.realtime && member.node.time_triggered() && member.node.next_tick() <= self.last_tick
    }

    /// Lockstep: every member executes what it can.
    fn poll_in_turn(&mut self, condition: RunCondition) -> Result<Poll, NodeError> {
        let mut polled = Poll::Waiting;
        for Member { node, .. } in &mut self.members {
            match node.poll(condition)? {
                Poll::Executed => node.finish_tick()?,
                Poll::Missed => {}
                Poll::Waiting => continue,
            }
            polled = Poll::Executed;
        }
        Ok(polled)
    }

    /// Real time: executes the tick in every member that has not done it.
    #[inline]
    fn poll_on_grid(&mut self, condition: RunCondition) -> Result<Poll, NodeError> {
        let tick =
            if let RunCondition::Now { tick, .. } = condition { tick.min(self.last_tick) } else { self.next_tick() };
        self.open = Some(tick);
        let mut complete = true;
        for index in 0..self.members.len() {
            let timed = self.timed(&self.members[index]);
            let member = &mut self.members[index];
            let condition = match condition {
                RunCondition::Now { .. } if !timed => RunCondition::Arrived,
                condition => condition,
            };
            let mut missed = false;
            while member.node.next_tick() <= tick {
                // A member that catches up executes several ticks here, and a link holds one sample at a time.
                member.finish_tick()?;
                match member.node.poll(condition)? {
                    Poll::Executed => member.executed = true,
                    Poll::Missed => missed = true,
                    Poll::Waiting => break,
                }
            }
            let next = member.node.next_tick();
            if missed {
                // Later members will not get the sample of a missed tick.
                return self.pass_over(index, next);
            }
            complete &= next > tick;
            if next > tick + 1 && member.executed && !timed {
                return self.pass_over(index, next - 1);
            }
        }
        if complete || condition == RunCondition::Overdue {
            self.open = None;
        }
        // If only the missing sample can start a later tick, the group sleeps on it: a spin would starve its writer.
        if complete || self.open.is_none() && self.next_tick() > tick {
            return Ok(Poll::Executed);
        }
        self.finish_tick()?;
        Ok(Poll::Waiting)
    }

    /// Skips members after one that executed a later tick or missed this one: their inputs will never arrive, and the
    /// next tick has its own cutoff.
    #[cold]
    fn pass_over(&mut self, index: usize, tick: u64) -> Result<Poll, NodeError> {
        for Member { node, .. } in &mut self.members[index + 1..] {
            if node.next_tick() < tick {
                node.skip_to(tick);
            }
        }
        self.finish_tick()?;
        self.open = None;
        Ok(Poll::Missed)
    }

    /// Returns the members whose next step lacks an outside sample and waits for no other member.
    fn lacking(&self) -> impl Iterator<Item = usize> {
        let inside = |role: RoleId| self.members.iter().find(|member| member.role == role).map(|member| &member.node);
        let lacks = move |member: &Member| {
            let next = member.node.next_tick();
            let due = self.open.is_none_or(|tick| next <= tick) && !self.timed(member);
            let mut observers = self.members.iter().filter(|member| matches!(member.role, RoleId::Observer(_)));
            let behind =
                member.role == RoleId::Controller && observers.any(|observer| observer.node.next_tick() <= next);
            due && !behind && member.node.awaits().is_some_and(|role| inside(role).is_none())
        };
        self.members.iter().enumerate().filter(move |(_, member)| lacks(member)).map(|(index, _)| index)
    }
}

impl Node for GroupNode {
    fn time_triggered(&self) -> bool {
        self.members.iter().any(|member| self.timed(member))
    }

    /// In real time the next tick of the members that the grid starts, while they have one.
    fn next_tick(&self) -> u64 {
        let timed = self.members.iter().filter(|member| self.timed(member)).map(|member| member.node.next_tick());
        let all = || self.members.iter().map(|member| member.node.next_tick()).min();
        self.open.or(timed.min()).or_else(all).unwrap_or(u64::MAX)
    }

    fn restore(&mut self) -> Result<(), LedgerError> {
        self.nodes().try_for_each(|node| node.restore())
    }

    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), NodeError> {
        self.nodes().try_for_each(|node| node.start(grid, first_tick))
    }

    #[inline]
    fn before_tick(&mut self) -> bool {
        self.nodes().filter_map(|node| node.before_tick().then_some(())).count() > 0
    }

    #[inline]
    fn poll(&mut self, condition: RunCondition) -> Result<Poll, NodeError> {
        if self.realtime { self.poll_on_grid(condition) } else { self.poll_in_turn(condition) }
    }

    /// The sender that the first member with a missing outside sample waits for.
    fn awaits(&self) -> Option<RoleId> {
        self.lacking().next().and_then(|index| self.members[index].node.awaits())
    }

    fn sleep(&mut self, until_ns: u64) -> Result<bool, NodeError> {
        let mut lacking = self.lacking();
        let (first, more) = (lacking.next(), lacking.next().is_some());
        drop(lacking);
        // A process can sleep on one input only.
        let until_ns = if more { until_ns.min(monotonic_ns() + NAP_NS) } else { until_ns };
        first.map_or(Ok(false), |index| self.members[index].node.sleep(until_ns))
    }

    /// The last member first: other roles wait for its samples.
    #[inline]
    fn finish_tick(&mut self) -> Result<(), NodeError> {
        self.members.iter_mut().rev().try_for_each(Member::finish_tick)
    }

    fn finish(&mut self) -> Result<(), NodeError> {
        self.finish_tick()?;
        self.nodes().try_for_each(|node| node.finish())
    }

    fn skip_to(&mut self, tick: u64) {
        self.open = None;
        self.nodes().for_each(|node| node.skip_to(tick));
    }

    fn warm_up(&mut self) -> Result<(), NodeError> {
        self.nodes().try_for_each(|node| node.warm_up())
    }

    fn refresh(&mut self) -> Result<(), NodeError> {
        self.nodes().try_for_each(|node| node.refresh())
    }

    fn state_words(&mut self) -> usize {
        self.nodes().map(|node| node.state_words()).sum()
    }

    fn ticks(&self) -> Ticks {
        self.members.last().map_or_else(Ticks::default, |member| member.node.ticks())
    }

    /// Of the last member; a driver asks each one.
    fn late_ticks(&self) -> Option<&LateTicks> {
        self.members.last().and_then(|member| member.node.late_ticks())
    }

    fn clear_stages(&mut self) {
        self.members.iter_mut().for_each(|member| member.node.clear_stages());
    }

    fn stages(&self) -> Vec<StageReport> {
        self.members.last().map_or_else(Vec::new, |member| member.node.stages())
    }

    fn member(&self, role: RoleId) -> Option<&dyn Node> {
        self.members.iter().find(|member| member.role == role).map(|member| &*member.node as &dyn Node)
    }
}

#[cfg(test)]
mod tests {
    use super::super::ledger_file;
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::bus::iox::IoxBus;
    use crate::config::SHIPPED;
    use crate::runtime::{RoleImpl, depths, private_ledger, report, shared_ledger};
    use crate::scenario::Scenario;
    use crate::scenario::build;
    use crate::telemetry::Ledger;

    const LAST: u64 = 6;
    /// The tick whose measurement of the leader is dropped.
    const LOST: u64 = 3;
    const GROUP: [RoleId; 2] = [RoleId::Observer(0), RoleId::Controller];

    fn enter(domain: &OwnedDomain, scenario: &Scenario) -> IoxBus {
        IoxBus::enter(domain.domain(), "test", depths(scenario)).unwrap()
    }

    fn open(scenario: &Scenario, bus: &IoxBus, books: &[Ledger; 2]) -> ReadyNode {
        let observer = vec![(RoleId::Observer(0), books[0].reopened())];
        build(scenario, RoleImpl::Role(RoleId::Controller, observer), bus, &books[1]).unwrap()
    }

    fn turn(node: &mut dyn Node, up_to: u64) {
        node.refresh().unwrap();
        if node.poll(RunCondition::Inputs { up_to }).unwrap() == Poll::Executed {
            node.finish_tick().unwrap();
        }
    }

    /// A silent leader may need the core of the group.
    #[test]
    fn a_group_sleeps_on_an_input_that_is_overdue() {
        let (name, text) = SHIPPED[0];
        let overrides = ["clock=realtime", "duration_s=0.1", "accept={}"].map(str::to_owned);
        let scenario = &Scenario::parse(text, name, &overrides).unwrap();
        let domain = OwnedDomain::create(0).unwrap();
        let bus = enter(&domain, scenario);
        let books = GROUP.map(|role| private_ledger(scenario, role));
        let mut both = open(scenario, &bus, &books);
        both.start(Grid { epoch_ns: monotonic_ns(), period_ns: scenario.period_ns }, 0).unwrap();
        for condition in [RunCondition::Arrived, RunCondition::Overdue, RunCondition::Overdue] {
            assert_eq!((both.poll(condition).unwrap(), both.next_tick()), (Poll::Waiting, 0), "{condition:?}");
            assert!(both.sleep(monotonic_ns()).unwrap(), "there is an input to sleep on");
        }
    }

    /// The observer has passed over a tick with a marker that the controller has not read. Then both die.
    #[test]
    fn a_marker_in_flight_between_members_survives_their_death() {
        let (name, text) = SHIPPED[0];
        let fault = format!("fault=[{{kind=\"drop\", role=\"leader\", from_tick={LOST}}}]");
        let overrides = ["clock=lockstep", "duration_s=0.1", "accept={}", &fault].map(str::to_owned);
        let scenario = &Scenario::parse(text, name, &overrides).unwrap();
        let domain = OwnedDomain::create(0).unwrap();
        let roles = [RoleId::Plant(0), RoleId::Plant(1)];
        let bus = enter(&domain, scenario);
        let plant_books = roles.map(|role| private_ledger(scenario, role));
        let plant = |(role, books): (&RoleId, &Ledger)| build(scenario, *role, &bus, books).unwrap();
        let mut plants: Vec<ReadyNode> = roles.iter().zip(&plant_books).map(plant).collect();
        let directory = tempfile::tempdir().unwrap();
        let books = GROUP
            .map(|role| shared_ledger(scenario, role, &directory.path().join(ledger_file(scenario, role))).unwrap());

        // Separate nodes, so that one can be ahead of the other.
        let first_bus = enter(&domain, scenario);
        let [mut observer, mut controller] = [0, 1].map(|index: usize| {
            let mut node = build(scenario, GROUP[index], &first_bus, &books[index]).unwrap();
            node.restore().unwrap();
            node
        });
        while observer.next_tick() <= LOST {
            plants.iter_mut().for_each(|plant| turn(&mut **plant, LOST));
            turn(&mut *observer, LOST);
            turn(&mut *controller, LOST - 1);
        }
        assert_eq!((observer.next_tick(), controller.next_tick()), (LOST + 1, LOST));
        observer.finish().unwrap();
        controller.finish().unwrap();
        drop((observer, controller, first_bus));

        let second_bus = enter(&domain, scenario);
        let mut both = open(scenario, &second_bus, &books);
        both.restore().unwrap();
        let first_tick = both.next_tick();
        both.start(Grid { epoch_ns: 0, period_ns: scenario.period_ns }, first_tick).unwrap();
        let mut looks = 0;
        while both.next_tick() <= LAST {
            plants.iter_mut().for_each(|plant| turn(&mut **plant, LAST));
            turn(&mut *both, LAST);
            looks += 1;
            assert!(looks < 100_000, "they wait for each other");
        }
        both.finish().unwrap();
        let report = report(scenario, RoleId::Controller, &books[1], Vec::new(), Vec::new());
        assert_eq!((report.read[0].void, report.read[0].gaps), (1, 0));
        assert_eq!((report.ticks.executed, report.ticks.missed), (LAST, 1));
    }
}
