//! A loop in this thread, over links in memory.

use corotate::bus::memory::MemoryBus;
use corotate::bus::{Carried, Reader, Signal};
use corotate::runtime::{Ended, Input, ReadyNode, RoleId, depths, drive_in_turn, private_ledger, topic};
use corotate::sample::Sample;
use corotate::scenario::{Scenario, build};
use corotate::telemetry::Ledger;

/// All roles of a scenario.
pub struct Loop<'a> {
    scenario: &'a Scenario,
    pub bus: MemoryBus,
    pub roles: Vec<(RoleId, Ledger)>,
    pub nodes: Vec<ReadyNode>,
}

impl<'a> Loop<'a> {
    pub fn open(scenario: &'a Scenario) -> Self {
        let bus = MemoryBus::new(depths(scenario));
        let roles: Vec<_> =
            RoleId::all(scenario).into_iter().map(|role| (role, private_ledger(scenario, role))).collect();
        let nodes = roles.iter().map(|(role, ledger)| build(scenario, *role, &bus, ledger).unwrap()).collect();
        Self { scenario, bus, roles, nodes }
    }

    /// Opens a reader of every sample of a body.
    pub fn input<S: Carried + ?Sized>(&self, body: &str, signal: Signal) -> Input<MemoryBus, S> {
        let bodies = self.scenario.rig.bodies();
        let count = bodies.iter().find(|info| *info.name == *body).unwrap().bodies();
        Input::open_many(&self.bus, &topic(self.scenario, body, signal), count, Reader::Scorer).unwrap()
    }

    /// Runs all ticks, and calls `each` after every one.
    pub fn run(&mut self, mut each: impl FnMut(u64)) {
        let after_tick = |tick| {
            each(tick);
            true
        };
        let ended = drive_in_turn(&mut self.nodes, self.scenario.last_tick, |_| Ok(None), after_tick);
        assert_eq!(ended.unwrap(), Ended::Finished);
    }
}

/// Returns the next sample, which must be there.
#[track_caller]
pub fn next<S: Sample>(input: &mut Input<MemoryBus, S>) -> S {
    assert!(input.advance().unwrap());
    *input.sample().unwrap()
}
