//! Observer and controller as one node: as soon as the estimate is sent, and before anything else, it is used.
//!
//! Both are what they are in processes of their own, with all their signals and books, and the estimate takes the same link.
//! Where that has a fast lane the controller sees the estimate there, and all others get it once the commands are sent. Must
//! not compute, nor change what either of them sends.

use super::controller::ControllerNode;
use super::observer::ObserverNode;
use super::{Gate, Node, Poll, RoleId, Seat};
use crate::bus::{Bus, BusError};
use crate::clock::Grid;
use crate::rig::Rig;
use crate::telemetry::{LedgerError, StageReport, Ticks};

/// Both nodes.
pub struct FusedNode<R: Rig, B: Bus> {
    observer: ObserverNode<R, B>,
    controller: ControllerNode<R, B>,
    /// The tick of the estimate that the observer has sent and not settled.
    estimated: Option<u64>,
}

impl<R: Rig, B: Bus> FusedNode<R, B> {
    pub fn open(rig: &R, observer: &Seat<'_, B>, controller: &Seat<'_, B>) -> Result<Self, BusError> {
        let made = ObserverNode::open(rig, observer)?.shown_first();
        let used = ControllerNode::open(rig, controller)?;
        Ok(Self { observer: made, controller: used, estimated: None })
    }

    /// Whether it is the observer's input that the next tick lacks: nothing else could bring the estimate.
    #[inline]
    fn lacks_measurement(&self) -> bool {
        self.estimated.is_none() && self.controller.lacks_estimate()
    }

    fn settle_estimate(&mut self) -> Result<(), BusError> {
        if self.estimated.take().is_none() {
            return Ok(());
        }
        self.observer.publish()?;
        self.observer.settle()
    }
}

impl<R: Rig, B: Bus> Node for FusedNode<R, B> {
    fn time_triggered(&self) -> bool {
        false
    }

    fn next_tick(&self) -> u64 {
        self.observer.next_tick().min(self.controller.next_tick())
    }

    fn restore(&mut self) -> Result<(), LedgerError> {
        self.observer.restore()?;
        self.controller.restore()
    }

    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), BusError> {
        self.observer.start(grid, first_tick)?;
        self.controller.start(grid, first_tick)
    }

    #[inline]
    fn before_tick(&mut self) -> bool {
        let killed = self.observer.before_tick();
        self.controller.before_tick() || killed
    }

    #[inline]
    fn poll(&mut self, gate: Gate) -> Result<Poll, BusError> {
        if self.estimated.is_none() && self.observer.poll(gate)? == Poll::Executed {
            let tick = self.observer.next_tick() - 1;
            self.estimated = Some(tick);
            if gate == Gate::Overdue && self.controller.next_tick() < tick {
                // What was waited for will never come, and this tick has a cutoff of its own.
                self.controller.skip_to(tick);
                return Ok(Poll::Missed);
            }
        }
        let polled = self.controller.poll(gate)?;
        let passed_over = self.estimated.is_some_and(|tick| self.controller.next_tick() > tick);
        if polled == Poll::Waiting && (passed_over || gate == Gate::Overdue) {
            // The estimate is of no use to anybody; the next one may be.
            self.settle_estimate()?;
        } else if polled == Poll::Waiting {
            // For a controller that has no shorter way, and for everybody else: there is time.
            self.observer.publish()?;
        }
        Ok(polled)
    }

    /// Whom the observer awaits, and only then whom the controller does.
    fn awaits(&self) -> Option<RoleId> {
        if self.lacks_measurement() { self.observer.awaits() } else { self.controller.awaits() }
    }

    fn sleep(&mut self, until_ns: u64) -> Result<bool, BusError> {
        if self.lacks_measurement() { self.observer.sleep(until_ns) } else { self.controller.sleep(until_ns) }
    }

    /// The commands first: others wait for them.
    #[inline]
    fn settle(&mut self) -> Result<(), BusError> {
        self.controller.settle()?;
        self.settle_estimate()
    }

    /// The estimate may have been sent, and used, though the command waits for another input.
    fn finish(&mut self) -> Result<(), BusError> {
        self.settle_estimate()?;
        self.observer.finish()?;
        self.controller.finish()
    }

    fn skip_to(&mut self, tick: u64) {
        self.observer.skip_to(tick);
        self.controller.skip_to(tick);
    }

    fn warm_up(&mut self) -> Result<(), BusError> {
        self.observer.warm_up()?;
        self.controller.warm_up()
    }

    fn refresh(&mut self) -> Result<(), BusError> {
        self.observer.refresh()?;
        self.controller.refresh()
    }

    fn state_words(&mut self) -> usize {
        self.observer.state_words() + self.controller.state_words()
    }

    fn ticks(&self) -> Ticks {
        self.controller.ticks()
    }

    fn stages(&self) -> Vec<StageReport> {
        self.controller.stages()
    }

    fn of(&self, role: RoleId) -> Option<&dyn Node> {
        match role {
            RoleId::Observer => Some(&self.observer),
            RoleId::Controller => Some(&self.controller),
            RoleId::Plant(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{commit_last, ledger_file};
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::bus::iox::IoxBus;
    use crate::clock::Clock;
    use crate::config::{SHIPPED, Scenario};
    use crate::runtime::{ReadyNode, build, depths, private_ledger, report, shared_ledger};
    use crate::telemetry::Ledger;
    use crate::with_shipped_rig;

    const LAST: u64 = 6;
    /// The leader's measurement of this tick is dropped.
    const LOST: u64 = 3;

    fn enter(domain: &OwnedDomain, scenario: &Scenario) -> IoxBus {
        IoxBus::enter(domain.domain(), "test", depths(scenario)).unwrap()
    }

    fn open<R: Rig>(rig: &R, scenario: &Scenario, bus: &IoxBus, books: &[Ledger; 2]) -> FusedNode<R, IoxBus> {
        let ledgers = [books[0].reopened(), books[1].reopened()];
        let seat = |index: usize, role| {
            let generation = books[index].enter();
            Seat { bus, scenario, role, generation, ledger: &ledgers[index], clock: Clock::None }
        };
        FusedNode::open(rig, &seat(0, RoleId::Observer), &seat(1, RoleId::Controller)).unwrap()
    }

    fn turn(node: &mut dyn Node, up_to: u64) {
        node.refresh().unwrap();
        if node.poll(Gate::Inputs { up_to }).unwrap() == Poll::Executed {
            node.settle().unwrap();
        }
    }

    /// Both die when the observer has passed a tick over, by a void that the controller has not taken: nobody has it any more.
    fn die_with_a_void_between_them<R: Rig>(rig: &R, scenario: &Scenario) {
        let domain = OwnedDomain::create(0).unwrap();
        let roles = [RoleId::Plant(0), RoleId::Plant(1)];
        let bus = enter(&domain, scenario);
        let plant_books = roles.map(|role| private_ledger(scenario, role));
        let plant = |(role, books): (&RoleId, &Ledger)| build(scenario, *role, &bus, books).unwrap();
        let mut plants: Vec<ReadyNode> = roles.iter().zip(&plant_books).map(plant).collect();
        let directory = tempfile::tempdir().unwrap();
        let books = [RoleId::Observer, RoleId::Controller]
            .map(|role| shared_ledger(scenario, role, &directory.path().join(ledger_file(scenario, role))).unwrap());

        let first_bus = enter(&domain, scenario);
        let mut fused = open(rig, scenario, &first_bus, &books);
        while fused.next_tick() < LOST {
            plants.iter_mut().for_each(|plant| turn(&mut **plant, LOST));
            turn(&mut fused, LOST - 1);
        }
        while fused.observer.next_tick() == LOST {
            plants.iter_mut().for_each(|plant| turn(&mut **plant, LOST));
            turn(&mut fused.observer, LOST);
        }
        assert_eq!((fused.observer.next_tick(), fused.controller.next_tick()), (LOST + 1, LOST));
        commit_last(&mut fused.observer);
        commit_last(&mut fused.controller);
        drop((fused, first_bus));

        let second_bus = enter(&domain, scenario);
        let mut fused = open(rig, scenario, &second_bus, &books);
        fused.restore().unwrap();
        let first_tick = fused.next_tick();
        fused.start(Grid { epoch_ns: 0, period_ns: scenario.period_ns }, first_tick).unwrap();
        let mut looks = 0;
        while fused.next_tick() <= LAST {
            plants.iter_mut().for_each(|plant| turn(&mut **plant, LAST));
            turn(&mut fused, LAST);
            looks += 1;
            assert!(looks < 100_000, "they wait for each other");
        }
        fused.finish().unwrap();
        let report = report(scenario, RoleId::Controller, &books[1], Vec::new(), Vec::new());
        assert_eq!((report.read[0].void, report.read[0].gaps), (1, 0));
        assert_eq!((report.ticks.executed, report.ticks.missed), (LAST, 1));
    }

    #[test]
    fn a_void_that_was_on_its_way_between_the_two_is_not_lost_with_them() {
        let (name, text) = SHIPPED[0];
        let fault = format!("fault=[{{kind=\"drop\", role=\"leader\", from_tick={LOST}}}]");
        let overrides = ["clock=lockstep", "duration_s=0.1", "accept={}", &fault].map(str::to_owned);
        let scenario = Scenario::parse(text, name, &overrides).unwrap();
        with_shipped_rig!(scenario.rig, rig => die_with_a_void_between_them(rig, &scenario));
    }
}
