//! Which signals a role writes and reads, with the layout of each: the one list, for books and for foreign programs.
//!
//! In the order in which the nodes open them, which is that of their books. Must not open anything.

use super::{RoleId, topic};
use crate::bus::{Signal, Topic};
use crate::config::Scenario;
use crate::rig::{BodyInfo, Command, Estimate, Measurement, Rig, Truth};
use crate::sample::{Field, Health, Sample, Schedule};
use crate::with_rig;

/// One signal as it travels: where, and what its bytes mean.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Port {
    /// The signal and its service.
    pub topic: Topic,
    /// Name and version of the layout.
    pub type_name: &'static str,
    /// The length of a sample, bytes.
    pub size: usize,
    /// The fields after the stamp, in order.
    pub fields: &'static [Field],
}

/// The signals of a role.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ports {
    /// What it writes for the loop.
    pub writes: Vec<Port>,
    /// What it reads of the loop.
    pub reads: Vec<Port>,
    /// Its word to the launcher.
    pub health: Port,
    /// The launcher's word to it.
    pub schedule: Port,
}

/// Does something with a signal whose type is known.
pub trait Visit {
    /// What comes of it.
    type Made;
    /// Does it.
    fn visit<S: Sample>(&mut self, topic: Topic) -> Self::Made;
}

/// The signals of a role of a scenario.
pub fn ports(scenario: &Scenario, role: RoleId) -> Ports {
    let describe = &mut Describe;
    Ports {
        writes: visit_writes(scenario, role, describe),
        reads: visit_reads(scenario, role, describe),
        health: describe.visit::<Health>(topic(scenario, role.name(scenario), Signal::Health)),
        schedule: describe.visit::<Schedule>(topic(scenario, "run", Signal::Schedule)),
    }
}

/// Visits the signals that a role writes for the loop, in their order.
pub fn visit_writes<V: Visit>(scenario: &Scenario, role: RoleId, visit: &mut V) -> Vec<V::Made> {
    with_rig!(&scenario.rig, rig => writes(rig, scenario, role, visit))
}

/// Visits the signals that a role reads of the loop, in their order.
pub fn visit_reads<V: Visit>(scenario: &Scenario, role: RoleId, visit: &mut V) -> Vec<V::Made> {
    with_rig!(&scenario.rig, rig => reads(rig, scenario, role, visit))
}

fn writes<R: Rig, V: Visit>(rig: &R, scenario: &Scenario, role: RoleId, visit: &mut V) -> Vec<V::Made> {
    let of = |body: &BodyInfo, signal| topic(scenario, &body.name, signal);
    let bodies = rig.bodies();
    match role {
        RoleId::Plant(index) => vec![
            visit.visit::<Measurement<R>>(of(&bodies[index], Signal::Measurement)),
            visit.visit::<Truth<R>>(of(&bodies[index], Signal::Truth)),
        ],
        RoleId::Observer => vec![visit.visit::<Estimate<R>>(of(&bodies[0], Signal::Estimate))],
        RoleId::Controller => {
            let driven = bodies.iter().filter(|body| body.driven);
            driven.map(|body| visit.visit::<Command<R>>(of(body, Signal::Command))).collect()
        }
    }
}

fn reads<R: Rig, V: Visit>(rig: &R, scenario: &Scenario, role: RoleId, visit: &mut V) -> Vec<V::Made> {
    let of = |body: &BodyInfo, signal| topic(scenario, &body.name, signal);
    let bodies = rig.bodies();
    match role {
        RoleId::Plant(index) => {
            let driven = Some(&bodies[index]).filter(|body| body.driven);
            driven.map(|body| visit.visit::<Command<R>>(of(body, Signal::Command))).into_iter().collect()
        }
        RoleId::Observer => vec![visit.visit::<Measurement<R>>(of(&bodies[0], Signal::Measurement))],
        RoleId::Controller => {
            let estimate = visit.visit::<Estimate<R>>(of(&bodies[0], Signal::Estimate));
            let driven = bodies.iter().filter(|body| body.driven);
            let measurements = driven.map(|body| visit.visit::<Measurement<R>>(of(body, Signal::Measurement)));
            std::iter::once(estimate).chain(measurements).collect()
        }
    }
}

/// Tells the layout.
struct Describe;

impl Visit for Describe {
    type Made = Port;

    fn visit<S: Sample>(&mut self, topic: Topic) -> Port {
        Port { topic, type_name: S::TYPE_NAME, size: size_of::<S>(), fields: S::FIELDS }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::memory::MemoryBus;
    use crate::bus::{Bus, BusError, Reader};
    use crate::config::SHIPPED;
    use crate::runtime::{build, depths, private_ledger};
    use std::cell::RefCell;

    type Opened = RefCell<Vec<(Topic, &'static str)>>;

    /// A bus that remembers what was opened.
    struct Watched {
        bus: MemoryBus,
        written: Opened,
        read: Opened,
    }

    impl Bus for Watched {
        type Writer<S: Sample> = <MemoryBus as Bus>::Writer<S>;
        type Reader<S: Sample> = <MemoryBus as Bus>::Reader<S>;

        fn writer<S: Sample>(&self, topic: &Topic, _generation: u64) -> Result<Self::Writer<S>, BusError> {
            self.written.borrow_mut().push((topic.clone(), S::TYPE_NAME));
            self.bus.writer(topic, 1)
        }

        fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<Self::Reader<S>, BusError> {
            self.read.borrow_mut().push((topic.clone(), S::TYPE_NAME));
            self.bus.reader(topic, reader)
        }
    }

    #[test]
    fn the_list_is_what_the_nodes_open() {
        for (name, text) in SHIPPED {
            let scenario = Scenario::parse(text, name, &[]).unwrap();
            for role in RoleId::all(&scenario) {
                let bus = MemoryBus::new(depths(&scenario));
                let bus = Watched { bus, written: Opened::default(), read: Opened::default() };
                let ledger = private_ledger(&scenario, role);
                with_rig!(&scenario.rig, rig => build(rig, &scenario, role, &bus, &ledger)).unwrap();
                let ports = ports(&scenario, role);
                let listed = |ports: &[Port]| -> Vec<_> {
                    ports.iter().map(|port| (port.topic.clone(), port.type_name)).collect()
                };
                let opened = (bus.written.into_inner(), bus.read.into_inner());
                assert_eq!((listed(&ports.writes), listed(&ports.reads)), opened, "{name} {role:?}");
            }
        }
    }

    #[test]
    fn the_order_is_the_nodes_and_the_layout_the_samples() {
        let scenario = Scenario::parse(SHIPPED[2].1, "rigid-trio", &[]).unwrap();
        let signals = |ports: &[Port]| ports.iter().map(|port| port.topic.to_string()).collect::<Vec<_>>();
        let controller = ports(&scenario, RoleId::Controller);
        let of = |name: &str| format!("corotate/rigid-trio/{name}");
        assert_eq!(signals(&controller.writes), [of("follower-a/command"), of("follower-b/command")]);
        let reads = ["leader/estimate", "follower-a/measurement", "follower-b/measurement"];
        assert_eq!(signals(&controller.reads), reads.map(of));
        let plant = ports(&scenario, RoleId::Plant(1));
        assert_eq!(plant.writes[0].type_name, "corotate/rigid-body/measurement/v1");
        assert_eq!(plant.writes[0].size, 32 + 8 * 8);
        assert_eq!((plant.writes[0].fields[0].name, plant.writes[0].fields[0].offset), ("omega_rad_s", 32));
        assert!(ports(&scenario, RoleId::Plant(0)).reads.is_empty(), "a leader takes no command");
    }
}
