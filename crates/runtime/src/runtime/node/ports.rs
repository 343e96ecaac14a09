//! The signals that a role writes and reads: one list for counters and for foreign programs.
//!
//! In the order in which nodes open them and persist their counters. Must not open anything.

use crate::bus::{Port, Signal, Topic};
use crate::config::{BodyInfo, Settings};
use crate::runtime::role_id::RoleId;
use crate::sample::{Health, InputChange, Schedule};

/// The signals of a role.
#[derive(Debug, Clone)]
pub struct Ports {
    /// The loop's signals that the role writes.
    pub writes: Vec<Port>,
    /// The loop's signals that the role reads.
    pub reads: Vec<Port>,
    /// The role's heartbeat.
    pub health: Port,
    /// The launcher's schedule.
    pub schedule: Port,
    /// The changes of inputs, for roles of foreign programs: the others read the shared list.
    pub input: Port,
}

/// Returns the driven bodies in the controller's order: single bodies, then fleets.
pub(super) fn driven(bodies: &[BodyInfo]) -> impl Iterator<Item = (usize, &BodyInfo)> {
    let driven = || bodies.iter().enumerate().filter(|(_, body)| body.driven);
    driven().filter(|(_, body)| body.fleet.is_none()).chain(driven().filter(|(_, body)| body.fleet.is_some()))
}

/// Returns true if the controller reads the estimate of this driven body beside that of the first body.
pub(super) fn is_self_observed(index: usize, body: &BodyInfo) -> bool {
    index > 0 && body.observer.is_some()
}

/// Returns the signals of a role.
///
/// # Panics
/// If the settings do not have the role.
pub fn ports(settings: &Settings, role: RoleId) -> Ports {
    let bodies = &settings.bodies;
    let port = |body: &BodyInfo, signal: Signal| {
        let matches = |port: &&Port| port.topic.body == body.name && port.topic.signal == signal;
        settings.signals.iter().find(matches).expect("a body has the signals of its role").clone()
    };
    let (writes, reads) = match role {
        RoleId::Plant(index) => {
            let body = &bodies[index];
            let command = body.driven.then(|| port(body, Signal::Command));
            (vec![port(body, Signal::Measurement), port(body, Signal::Truth)], command.into_iter().collect())
        }
        RoleId::Observer(index) => {
            (vec![port(&bodies[index], Signal::Estimate)], vec![port(&bodies[index], Signal::Measurement)])
        }
        RoleId::Controller => {
            let measurements = driven(bodies).map(|(_, body)| port(body, Signal::Measurement));
            let own_estimates = driven(bodies).filter(|(index, body)| is_self_observed(*index, body));
            let own_estimates = own_estimates.map(|(_, body)| port(body, Signal::Estimate));
            let reads = std::iter::once(port(&bodies[0], Signal::Estimate)).chain(measurements).chain(own_estimates);
            (driven(bodies).map(|(_, body)| port(body, Signal::Command)).collect(), reads.collect())
        }
    };
    Ports {
        writes,
        reads,
        health: Port::new::<Health>(topic(settings, role.name(settings), Signal::Health), None),
        schedule: Port::new::<Schedule>(topic(settings, "run", Signal::Schedule), None),
        input: Port::new::<InputChange>(topic(settings, "run", Signal::Input), None),
    }
}

/// Returns the topic of a signal in a scenario.
pub fn topic(scenario: &Settings, body: &str, signal: Signal) -> Topic {
    Topic { scenario: scenario.name.clone(), body: body.to_owned(), signal }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::memory::MemoryBus;
    use crate::bus::{Bus, BusError, Reader, Topic};
    use crate::config::SHIPPED;
    use crate::runtime::{build_rig, depths, private_ledger};
    use crate::sample::{FleetLayout, Sample};
    use crate::scenario::Scenario;
    use crate::with_shipped_rig;
    use std::cell::RefCell;

    type Opened = RefCell<Vec<(Topic, &'static str)>>;

    /// A bus that records the opened signals.
    struct Watched {
        bus: MemoryBus,
        written: Opened,
        read: Opened,
    }

    impl Bus for Watched {
        const REPEATS: bool = false;
        type Writer<S: Sample> = <MemoryBus as Bus>::Writer<S>;
        type Reader<S: Sample> = <MemoryBus as Bus>::Reader<S>;
        type FleetWriter<L: FleetLayout> = <MemoryBus as Bus>::FleetWriter<L>;
        type FleetReader<L: FleetLayout> = <MemoryBus as Bus>::FleetReader<L>;

        fn writer<S: Sample>(&self, topic: &Topic, _generation: u64) -> Result<Self::Writer<S>, BusError> {
            self.written.borrow_mut().push((topic.clone(), S::TYPE_NAME));
            self.bus.writer(topic, 1)
        }

        fn reader<S: Sample>(&self, topic: &Topic, reader: Reader) -> Result<Self::Reader<S>, BusError> {
            self.read.borrow_mut().push((topic.clone(), S::TYPE_NAME));
            self.bus.reader(topic, reader)
        }

        fn fleet_writer<L: FleetLayout>(&self, topic: &Topic, bodies: usize) -> Result<Self::FleetWriter<L>, BusError> {
            self.written.borrow_mut().push((topic.clone(), L::TYPE_NAME));
            self.bus.fleet_writer(topic, bodies)
        }

        fn fleet_reader<L: FleetLayout>(
            &self,
            topic: &Topic,
            reader: Reader,
            bodies: usize,
        ) -> Result<Self::FleetReader<L>, BusError> {
            self.read.borrow_mut().push((topic.clone(), L::TYPE_NAME));
            self.bus.fleet_reader(topic, reader, bodies)
        }
    }

    #[test]
    fn ports_lists_what_the_nodes_open() {
        for (name, text) in SHIPPED {
            let scenario = Scenario::parse(text, name, &[]).unwrap();
            for role in RoleId::all(&scenario) {
                let bus = MemoryBus::new(depths(&scenario));
                let bus = Watched { bus, written: Opened::default(), read: Opened::default() };
                let ledger = private_ledger(&scenario, role);
                with_shipped_rig!(scenario.rig, rig => build_rig(rig, &scenario, role, &bus, &ledger)).unwrap();
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
    fn ports_have_the_order_of_the_nodes_and_the_layout_of_the_samples() {
        let scenario = Scenario::parse(SHIPPED[2].1, "rigid-trio", &[]).unwrap();
        let signals = |ports: &[Port]| ports.iter().map(|port| port.topic.to_string()).collect::<Vec<_>>();
        let controller = ports(&scenario, RoleId::Controller);
        let service = |name: &str| format!("corotate/rigid-trio/{name}");
        assert_eq!(signals(&controller.writes), [service("follower-a/command"), service("follower-b/command")]);
        let reads = ["leader/estimate", "follower-a/measurement", "follower-b/measurement"];
        assert_eq!(signals(&controller.reads), reads.map(service));
        let plant = ports(&scenario, RoleId::Plant(1));
        assert_eq!(plant.writes[0].type_name, "corotate/rigid-body/measurement/v1");
        assert_eq!(plant.writes[0].size, 32 + 8 * 8);
        assert_eq!((plant.writes[0].fields[0].name, plant.writes[0].fields[0].offset), ("omega_rad_s", 32));
        assert!(ports(&scenario, RoleId::Plant(0)).reads.is_empty(), "a leader takes no command");
    }
}
