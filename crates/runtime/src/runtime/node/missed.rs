//! Missed ticks of a role, for the latency distributions of its stages.
//!
//! Corrects for coordinated omission: each missed tick gets an entry from its due instant to the role's next tick. Must
//! not count ticks; the counters do.

use crate::clock::{Clock, Grid, monotonic_ns};

/// The first tick without an entry.
#[derive(Debug, Default)]
pub(super) struct MissedTicks {
    /// Set only in real time, once the ticks run.
    grid: Option<Grid>,
    next: u64,
}

impl MissedTicks {
    /// Begins at the tick `next`, which a predecessor may have left.
    pub fn start(&mut self, clock: Clock, grid: Grid, next: u64) {
        self.grid = (clock == Clock::Monotonic).then_some(grid);
        self.next = next;
    }

    /// Marks `tick` as entered; returns the due instants of the ticks before it without an entry, ns.
    #[inline]
    pub fn before(&mut self, tick: u64) -> impl Iterator<Item = u64> + use<> {
        let ticks = self.next..tick;
        self.next = tick + 1;
        self.grid.into_iter().flat_map(move |grid| ticks.clone().map(move |tick| grid.due_ns(tick)))
    }

    /// Returns the due instants of the ticks before `tick` without an entry at the end of the run, and the instant until
    /// which each counts as missed, ns.
    pub fn rest(&mut self, tick: u64) -> (impl Iterator<Item = u64> + use<>, u64) {
        let end_ns = self.grid.map_or(0, |grid| grid.due_ns(tick).max(monotonic_ns()));
        (self.before(tick), end_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::bus::iox::IoxBus;
    use crate::bus::{Bus, Signal, Write};
    use crate::config::SHIPPED;
    use crate::runtime::node::{Node, Poll, RoleId, RunCondition, topic};
    use crate::runtime::{depths, private_ledger};
    use crate::sample::{RateCommand, RateMeasurement, Stamp};
    use crate::scenario::Scenario;
    use crate::scenario::build;
    use crate::telemetry::Percentiles;

    const MS: u64 = 1_000_000;

    #[test]
    fn every_tick_has_one_entry_and_only_in_real_time() {
        let grid = Grid { epoch_ns: 1000, period_ns: 10 };
        let mut missed = MissedTicks::default();
        assert_eq!(missed.before(3).count(), 0, "the ticks do not run");
        missed.start(Clock::Monotonic, grid, 4);
        assert_eq!(missed.before(4).count(), 0);
        assert_eq!(missed.before(7).collect::<Vec<_>>(), [1050, 1060], "missed by a restart or a busy core");
        assert_eq!(missed.before(8).count(), 0);
        let (rest, end_ns) = missed.rest(11);
        assert_eq!(rest.collect::<Vec<_>>(), [1090, 1100]);
        assert!(end_ns >= 1110);
        missed.start(Clock::None, grid, 0);
        assert_eq!(missed.before(5).count(), 0);
    }

    fn scenario() -> Scenario {
        let (name, text) = SHIPPED[0];
        Scenario::parse(text, name, &["clock=realtime", "tick_hz=1000", "accept={}"].map(str::to_owned)).unwrap()
    }

    fn figures(node: &dyn Node, stage: &str) -> Percentiles {
        let stages = node.stages();
        stages.iter().find(|report| report.stage == stage).map(|report| report.latency().percentiles()).unwrap()
    }

    /// While the controller is stopped, the acting command grows older at every tick.
    #[test]
    fn the_age_is_that_of_the_command_that_acts_at_every_tick() {
        let scenario = scenario();
        let domain = OwnedDomain::create(0).unwrap();
        let bus = IoxBus::enter(domain.domain(), "test", depths(&scenario)).unwrap();
        let books = private_ledger(&scenario, RoleId::Plant(1));
        let mut follower = build(&scenario, RoleId::Plant(1), &bus, &books).unwrap();
        let mut commands = bus.writer::<RateCommand>(&topic(&scenario, "follower", Signal::Command), 1).unwrap();
        let grid = Grid { epoch_ns: monotonic_ns() - 1000 * MS, period_ns: MS };
        follower.start(grid, 0).unwrap();
        // Ticks 3 to 9 are missed, and only tick 0 has a command.
        for tick in [0, 1, 2, 10] {
            if tick == 1 {
                let stamp = Stamp { tick: 0, generation: 1, origin_ns: grid.due_ns(0), sent_ns: grid.due_ns(0) };
                commands.send(|command| command.stamp = stamp).unwrap();
            }
            follower.refresh().unwrap();
            let condition = RunCondition::Now { tick, now_ns: grid.due_ns(tick) };
            assert_eq!(follower.poll(condition).unwrap(), Poll::Executed);
            follower.finish_tick().unwrap();
        }
        assert_eq!((follower.ticks().missed, follower.ticks().starved), (7, 2));
        let age = figures(&*follower, "age");
        assert_eq!((age.count, age.missed), (10, 9), "of every tick since the first command");
        assert!((age.min_us - 1e3).abs() < 2.0 && (age.p50_us - 5e3).abs() < 10.0, "{age:?}");
        assert!((age.max_us - 1e4).abs() < 20.0, "{age:?}");
        let (lateness, step) = (figures(&*follower, "lateness"), figures(&*follower, "step"));
        assert_eq!((lateness.count, lateness.missed, step.count, step.missed), (11, 7, 11, 7));
        assert!((step.max_us - 7e3).abs() < 20.0, "tick 3 was back at tick 10: {step:?}");
    }

    /// A foreign leader with a clock that is ahead, and with missed ticks.
    #[test]
    fn stamps_of_another_clock_are_counted_and_give_no_figures() {
        let scenario = scenario();
        let domain = OwnedDomain::create(0).unwrap();
        let bus = IoxBus::enter(domain.domain(), "test", depths(&scenario)).unwrap();
        let books = private_ledger(&scenario, RoleId::Observer(0));
        let mut observer = build(&scenario, RoleId::Observer(0), &bus, &books).unwrap();
        let topic = topic(&scenario, "leader", Signal::Measurement);
        let mut measurements = bus.writer::<RateMeasurement>(&topic, 1).unwrap();
        let grid = Grid { epoch_ns: monotonic_ns() - 1000 * MS, period_ns: MS };
        observer.start(grid, 0).unwrap();
        for tick in [0, 1, 5] {
            let sent_ns = monotonic_ns() + 1000 * MS;
            let stamp = Stamp { tick, generation: 1, origin_ns: grid.due_ns(tick), sent_ns };
            let fill = |sample: &mut RateMeasurement| *sample = RateMeasurement { stamp, valid: 7, ..*sample };
            measurements.send(fill).unwrap();
            observer.refresh().unwrap();
            assert_eq!(observer.poll(RunCondition::Arrived).unwrap(), Poll::Executed);
            observer.finish_tick().unwrap();
        }
        let hop = figures(&*observer, "hop");
        assert_eq!((hop.ahead, hop.missed), (3, 3));
        assert!(!hop.are_shown() && hop.p50_us.is_nan() && hop.ahead_max_us > 9e5, "{hop:?}");
        let age = figures(&*observer, "age");
        assert!(age.are_shown() && (age.count, age.missed) == (6, 3), "its origin is on this clock: {age:?}");
    }
}
