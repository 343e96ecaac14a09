//! Which signals a role writes and reads, with the layout of each: the one list, for books and for foreign programs.
//!
//! In the order in which the nodes open them, which is that of their books. Must not open anything.

use super::{RoleId, topic};
use crate::bus::iox::Qos;
use crate::bus::{Carried, Depths, Signal, Topic};
use crate::config::Scenario;
use crate::rig::{BodyInfo, Command, Estimate, Fleet, Measurement, Rig, Truth};
use crate::sample::{Field, FleetLayout, FleetSample, Health, Sample, Schedule};
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
    pub fields: Vec<Field>,
    /// Whether it tells of a fleet, and travels as a slice of words.
    pub fleet: bool,
}

impl Port {
    /// What to ask of its service.
    pub fn qos(&self, depths: Depths) -> Qos {
        let signal = self.topic.signal;
        if self.fleet { Qos::of_fleet(signal, depths) } else { Qos::of(signal, depths) }
    }
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
    /// Does it where the signal is that of a fleet of so many bodies.
    fn visit_fleet<L: FleetLayout>(&mut self, topic: Topic, bodies: usize) -> Self::Made;
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

/// The layouts of a rig's fleets.
type TruthOf<R> = <<R as Rig>::Fleet as Fleet<Estimate<R>>>::Truth;
type MeasurementOf<R> = <<R as Rig>::Fleet as Fleet<Estimate<R>>>::Measurement;
type CommandOf<R> = <<R as Rig>::Fleet as Fleet<Estimate<R>>>::Command;

/// Which of a body's signals, single or fleet's.
struct Signals<'a, R, V> {
    rig: &'a R,
    scenario: &'a Scenario,
    visit: &'a mut V,
}

impl<R: Rig, V: Visit> Signals<'_, R, V> {
    fn estimate(&mut self) -> V::Made {
        self.visit.visit::<Estimate<R>>(topic(self.scenario, &self.rig.bodies()[0].name, Signal::Estimate))
    }

    fn truth(&mut self, body: &BodyInfo) -> V::Made {
        let topic = topic(self.scenario, &body.name, Signal::Truth);
        match body.fleet {
            None => self.visit.visit::<Truth<R>>(topic),
            Some(bodies) => self.visit.visit_fleet::<TruthOf<R>>(topic, bodies),
        }
    }

    fn measurement(&mut self, body: &BodyInfo) -> V::Made {
        let topic = topic(self.scenario, &body.name, Signal::Measurement);
        match body.fleet {
            None => self.visit.visit::<Measurement<R>>(topic),
            Some(bodies) => self.visit.visit_fleet::<MeasurementOf<R>>(topic, bodies),
        }
    }

    fn command(&mut self, body: &BodyInfo) -> V::Made {
        let topic = topic(self.scenario, &body.name, Signal::Command);
        match body.fleet {
            None => self.visit.visit::<Command<R>>(topic),
            Some(bodies) => self.visit.visit_fleet::<CommandOf<R>>(topic, bodies),
        }
    }
}

/// The driven bodies in the order in which a controller serves them: single ones, then fleets.
pub(super) fn driven<R: Rig>(rig: &R) -> impl Iterator<Item = (usize, &BodyInfo)> {
    let driven = || rig.bodies().iter().enumerate().filter(|(_, body)| body.driven);
    driven().filter(|(_, body)| body.fleet.is_none()).chain(driven().filter(|(_, body)| body.fleet.is_some()))
}

fn writes<R: Rig, V: Visit>(rig: &R, scenario: &Scenario, role: RoleId, visit: &mut V) -> Vec<V::Made> {
    let mut signals = Signals { rig, scenario, visit };
    match role {
        RoleId::Plant(index) => {
            let body = &rig.bodies()[index];
            vec![signals.measurement(body), signals.truth(body)]
        }
        RoleId::Observer => vec![signals.estimate()],
        RoleId::Controller => driven(rig).map(|(_, body)| signals.command(body)).collect(),
    }
}

fn reads<R: Rig, V: Visit>(rig: &R, scenario: &Scenario, role: RoleId, visit: &mut V) -> Vec<V::Made> {
    let mut signals = Signals { rig, scenario, visit };
    match role {
        RoleId::Plant(index) => {
            let driven = Some(&rig.bodies()[index]).filter(|body| body.driven);
            driven.map(|body| signals.command(body)).into_iter().collect()
        }
        RoleId::Observer => vec![signals.measurement(&rig.bodies()[0])],
        RoleId::Controller => {
            let estimate = signals.estimate();
            let measurements = driven(rig).map(|(_, body)| signals.measurement(body));
            std::iter::once(estimate).chain(measurements).collect()
        }
    }
}

/// Tells the layout.
struct Describe;

impl Visit for Describe {
    type Made = Port;

    fn visit<S: Sample>(&mut self, topic: Topic) -> Port {
        describe::<S>(topic, 1, false)
    }

    fn visit_fleet<L: FleetLayout>(&mut self, topic: Topic, bodies: usize) -> Port {
        describe::<FleetSample<L>>(topic, bodies, true)
    }
}

fn describe<S: Carried + ?Sized>(topic: Topic, bodies: usize, fleet: bool) -> Port {
    let size = S::length(bodies) * size_of::<u64>();
    Port { topic, type_name: S::type_name(), size, fields: S::fields(bodies), fleet }
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
