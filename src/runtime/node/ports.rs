//! Which signals a role writes and reads, with the layout of each: the one list, for counters and for foreign programs.
//!
//! In the order in which the nodes open them, which is that of their counters. Must not open anything.

use super::{RoleId, topic};
use crate::bus::iox::Qos;
use crate::bus::{AnyBus, BusError, Carried, Depths, Ends, Reader, Signal, Topic, WordReader, WordWriter};
use crate::config::Scenario;
use crate::rig::{BodyInfo, Command, Estimate, Fleet, Measurement, Rig, Truth};
use crate::sample::{Field, FleetSample, Health, Schedule};

/// One signal as it travels: where, and what its bytes mean.
#[derive(Debug, Clone)]
pub struct Port {
    /// The signal and its service.
    pub topic: Topic,
    /// Name and version of the layout.
    pub type_name: &'static str,
    /// The type name with a hash of the fields, by which services and devices know it.
    pub layout: &'static str,
    /// The length of a sample, bytes.
    pub size: usize,
    /// The fields after the stamp, in order.
    pub fields: Vec<Field>,
    /// Whether it tells of a fleet, and travels as a slice of words.
    pub fleet: bool,
    bodies: usize,
    ends: Ends,
}

impl Port {
    /// What to ask of its service.
    pub fn qos(&self, depths: Depths) -> Qos {
        let signal = self.topic.signal;
        if self.fleet { Qos::of_fleet(signal, depths) } else { Qos::of(signal, depths) }
    }

    /// Opens it for reading, as words.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn reader<'a>(&self, bus: impl Into<AnyBus<'a>>, reader: Reader) -> Result<WordReader, BusError> {
        self.ends.reader(bus.into(), &self.topic, self.bodies, reader)
    }

    /// Opens it for writing, as words.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn writer<'a>(&self, bus: impl Into<AnyBus<'a>>) -> Result<WordWriter, BusError> {
        self.ends.writer(bus.into(), &self.topic, self.bodies)
    }
}

/// The signals of a role.
#[derive(Debug, Clone)]
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

/// The signals of a role of a scenario.
pub fn ports(scenario: &Scenario, role: RoleId) -> Ports {
    let (writes, reads) = scenario.rig.face().ports(scenario, role);
    Ports {
        writes,
        reads,
        health: port::<Health>(topic(scenario, role.name(scenario), Signal::Health), None),
        schedule: port::<Schedule>(topic(scenario, "run", Signal::Schedule), None),
    }
}

/// The layouts of a rig's fleets.
type TruthOf<R> = <<R as Rig>::Fleet as Fleet<Estimate<R>>>::Truth;
type MeasurementOf<R> = <<R as Rig>::Fleet as Fleet<Estimate<R>>>::Measurement;
type CommandOf<R> = <<R as Rig>::Fleet as Fleet<Estimate<R>>>::Command;

/// A body's signals, single or fleet's.
struct Signals<'a, R> {
    rig: &'a R,
    scenario: &'a Scenario,
}

impl<R: Rig> Signals<'_, R> {
    fn topic(&self, body: &BodyInfo, signal: Signal) -> Topic {
        topic(self.scenario, &body.name, signal)
    }

    fn estimate(&self) -> Port {
        port::<Estimate<R>>(self.topic(&self.rig.bodies()[0], Signal::Estimate), None)
    }

    fn truth(&self, body: &BodyInfo) -> Port {
        either::<Truth<R>, FleetSample<TruthOf<R>>>(self.topic(body, Signal::Truth), body.fleet)
    }

    fn measurement(&self, body: &BodyInfo) -> Port {
        either::<Measurement<R>, FleetSample<MeasurementOf<R>>>(self.topic(body, Signal::Measurement), body.fleet)
    }

    fn command(&self, body: &BodyInfo) -> Port {
        either::<Command<R>, FleetSample<CommandOf<R>>>(self.topic(body, Signal::Command), body.fleet)
    }
}

/// The driven bodies in the order in which a controller serves them: single ones, then fleets.
pub(super) fn driven<R: Rig>(rig: &R) -> impl Iterator<Item = (usize, &BodyInfo)> {
    let driven = || rig.bodies().iter().enumerate().filter(|(_, body)| body.driven);
    driven().filter(|(_, body)| body.fleet.is_none()).chain(driven().filter(|(_, body)| body.fleet.is_some()))
}

/// What a role writes, and what it reads.
pub(crate) fn ports_of_rig<R: Rig>(rig: &R, scenario: &Scenario, role: RoleId) -> (Vec<Port>, Vec<Port>) {
    let signals = Signals { rig, scenario };
    match role {
        RoleId::Plant(index) => {
            let body = &rig.bodies()[index];
            let command = body.driven.then(|| signals.command(body));
            (vec![signals.measurement(body), signals.truth(body)], command.into_iter().collect())
        }
        RoleId::Observer => (vec![signals.estimate()], vec![signals.measurement(&rig.bodies()[0])]),
        RoleId::Controller => {
            let measurements = driven(rig).map(|(_, body)| signals.measurement(body));
            let reads = std::iter::once(signals.estimate()).chain(measurements);
            (driven(rig).map(|(_, body)| signals.command(body)).collect(), reads.collect())
        }
    }
}

/// The signal of a single body, or of a fleet.
fn either<One: Carried, Many: Carried + ?Sized>(topic: Topic, fleet: Option<usize>) -> Port {
    if fleet.is_some() { port::<Many>(topic, fleet) } else { port::<One>(topic, None) }
}

fn port<S: Carried + ?Sized>(topic: Topic, fleet: Option<usize>) -> Port {
    let bodies = fleet.unwrap_or(1);
    let size = S::length(bodies) * size_of::<u64>();
    let (type_name, layout) = (S::type_name(), S::layout());
    let (fields, ends) = (S::fields(bodies), Ends::of::<S>());
    Port { topic, type_name, layout, size, fields, fleet: fleet.is_some(), bodies, ends }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::Bus;
    use crate::bus::memory::MemoryBus;
    use crate::config::SHIPPED;
    use crate::runtime::{build_rig, depths, private_ledger};
    use crate::sample::{FleetLayout, Sample};
    use crate::with_shipped_rig;
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
