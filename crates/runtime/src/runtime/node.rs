//! One role on a bus: takes its samples, lets the pure role compute, sends, keeps the counters.
//!
//! Must not wait, and must not decide when it runs; a driver does.

mod bridge;
mod context;
mod contract;
mod controller;
mod group;
mod missed;
mod observer;
mod persistent;
mod plant;
pub(super) mod ports;

pub use context::NodeContext;
#[cfg(feature = "hosts")]
pub use context::retained_samples;
pub use context::{accepted_ticks, ledger_file, ledger_words, next_tick};
pub use contract::{Node, Poll, ReadyNode, RunCondition};
pub use ports::{Ports, ports, topic};

use super::link;
use super::role_function::FunctionRole;
use super::role_id::RoleId;
use super::role_impl::RoleImpl;
use super::sample_source::{DeviceHandle, SampleSource};
use crate::bus::iox::{COMMON_BYTES, footprint};
use crate::bus::{Bus, BusError, Port, Signal};
use crate::clock::Clock;
use crate::config::{ClockKind, Settings};
use crate::control::Watchdog;
use crate::rig::{Fleet, Rig};
use crate::state::{Persist, Restore};
use crate::telemetry::{Grant, Ledger, LedgerError, ReadCounters, RoleReport, StageReport, TickCounters, WatchReport};
use context::{extent, words};
use plant::PlantNode;
use std::path::Path;

/// An upper bound on the state of a role, bytes, but for samples and what is remembered of them.
const RECORD_BYTES: usize = 8 << 10;
/// So many times the size of what a role reads and writes is remembered at the most: samples made, bodies, guards.
const SAMPLES_KEPT: usize = 4;

/// An upper bound on the shared memory that a role's record takes, bytes: two copies of what it writes, and of what bodies,
/// filters, laws and guards remember, which is at most so many times what is said of them; and of commands, as many as are on
/// their way.
fn record_bytes(scenario: &Settings, ports: &Ports) -> usize {
    let all = || ports.writes.iter().chain(&ports.reads);
    let samples: usize = all().map(|port| port.size).sum();
    let commands: usize = all().filter(|port| port.topic.signal == Signal::Command).map(|port| port.size).sum();
    let in_flight = if scenario.actuation_delay_ticks > 1 {
        scenario.actuation_delay_ticks.next_power_of_two() as usize
    } else {
        0
    };
    2 * (RECORD_BYTES + SAMPLES_KEPT * samples + in_flight * commands)
}

/// A ledger for a role that no successor will need.
pub fn private_ledger(scenario: &Settings, role: RoleId) -> Ledger {
    Ledger::private(ledger_words(scenario, role))
}

/// A ledger in a file, for a role that a successor may continue.
///
/// # Errors
/// [`LedgerError`].
pub fn shared_ledger(scenario: &Settings, role: RoleId, path: &Path) -> Result<Ledger, LedgerError> {
    Ledger::shared(path, ledger_words(scenario, role))
}

/// An upper bound on the shared memory that a run takes, bytes.
pub fn shared_memory_bytes(scenario: &Settings) -> usize {
    let depths = super::depths(scenario);
    let port = |port: &Port| footprint(&port.qos(depths), port.size);
    let role = |role: RoleId| {
        let ports = ports(scenario, role);
        let signals = ports.writes.iter().chain([&ports.health]).map(port).sum::<usize>();
        signals + ledger_words(scenario, role) * size_of::<u64>() + record_bytes(scenario, &ports)
    };
    let Ports { schedule, health, .. } = ports(scenario, RoleId::Observer);
    // The recorder says how it is, as the roles do.
    COMMON_BYTES + port(&schedule) + port(&health) + RoleId::all(scenario).into_iter().map(role).sum::<usize>()
}

/// What a role's ledger says, with what the role itself has to add.
pub fn report(
    scenario: &Settings,
    role: RoleId,
    ledger: &Ledger,
    stages: Vec<StageReport>,
    grants: Vec<Grant>,
) -> RoleReport {
    let (ports, ledger) = (ports(scenario, role), &ledger.reopened());
    // Of a role that has committed nothing there are zeros.
    let record = ledger.record().unwrap_or_default();
    let record_words = &mut Restore(&record);
    let (mut ticks, voids) = (TickCounters::default(), scenario.clock != ClockKind::Realtime);
    ticks.persist(record_words);
    let written = |port: &Port| {
        link::written(record_words, &port.topic.to_string(), words(port), voids, (ledger, extent(scenario)))
    };
    let written = ports.writes.iter().map(written).collect();
    let read = |port: &Port| {
        let mut read = ReadCounters::default();
        read.persist(record_words);
        read.report(&port.topic.to_string())
    };
    let read = ports.reads.iter().map(read).collect();
    let watchdog = (role == RoleId::Controller).then(|| {
        let mut watchdog = Watchdog::new(scenario.watch);
        watchdog.persist(record_words);
        watchdog
    });
    RoleReport {
        role: role.name(scenario).to_owned(),
        ticks: ticks.report(),
        written,
        read,
        watchdog: watchdog.and_then(|watchdog| WatchReport::from_watchdog(&watchdog, &scenario.monitors)),
        stages,
        grants,
        line: None,
        outages: Vec::new(),
    }
}

/// The same for a rig whose type is known, on a bus of any type.
///
/// # Errors
/// [`BusError::Open`].
pub fn build_rig<R: Rig, B: Bus + 'static>(
    rig: &R,
    scenario: &Settings,
    role_impl: impl Into<RoleImpl>,
    bus: &B,
    ledger: &Ledger,
) -> Result<ReadyNode, BusError> {
    let role_impl = role_impl.into();
    let clock = if scenario.clock == ClockKind::Realtime { Clock::Monotonic } else { Clock::None };
    let mut roles = role_impl.ledgers(ledger);
    let context = |(role, ledger): &(RoleId, Ledger)| {
        let generation = ledger.enter();
        NodeContext { bus, scenario, role: *role, generation, ledger: ledger.reopened(), clock }
    };
    match role_impl {
        RoleImpl::Device(RoleId::Plant(index), _, link) => {
            let context = context(&(RoleId::Plant(index), ledger.reopened()));
            return Ok(Box::new(bridge::BridgeNode::<R, B>::open(rig, index, link, &context)?));
        }
        RoleImpl::Device(role, others, link) if others.is_empty() => {
            let computer = SampleSource::Device(DeviceHandle::all(link));
            return role_node(rig, &context(&(role, ledger.reopened())), Some(computer));
        }
        RoleImpl::Device(_, _, link) => {
            let shares = roles.iter().zip(DeviceHandle::both(link));
            let open = |(of, share): (&(RoleId, Ledger), _)| {
                Ok((of.0, role_node(rig, &context(of), Some(SampleSource::Device(share)))?))
            };
            let nodes = shares.map(open).collect::<Result<_, BusError>>()?;
            return Ok(Box::new(group::GroupNode::new(nodes, clock == Clock::Monotonic, scenario.last_tick)));
        }
        RoleImpl::Function(role, compute) => {
            let computing = FunctionRole::new(compute, &ports(scenario, role), (1 << R::AXES) - 1);
            return role_node(rig, &context(&(role, ledger.reopened())), Some(SampleSource::Function(computing)));
        }
        RoleImpl::Role(..) => {}
    }
    let open = |of: &(RoleId, Ledger)| Ok((of.0, role_node(rig, &context(of), None)?));
    if let [only] = &mut roles[..] {
        return open(only).map(|(_, node)| node);
    }
    let nodes = roles.iter().map(open).collect::<Result<_, BusError>>()?;
    Ok(Box::new(group::GroupNode::new(nodes, clock == Clock::Monotonic, scenario.last_tick)))
}

/// The node of one role of this program, whose samples somebody else may compute.
fn role_node<R: Rig, B: Bus + 'static>(
    rig: &R,
    context: &NodeContext<'_, B>,
    computer: Option<SampleSource>,
) -> Result<ReadyNode, BusError> {
    Ok(match context.role {
        RoleId::Plant(index) => {
            let info = &rig.bodies()[index];
            match rig.fleet(index) {
                None => {
                    // A device in its place has a node of its own.
                    let function = match computer {
                        Some(SampleSource::Function(function)) => Some(function),
                        Some(SampleSource::Device(_)) | None => None,
                    };
                    Box::new(PlantNode::open(rig.body(index), rig.command_guard(index), info, context, function)?)
                }
                Some(fleet) => Box::new(PlantNode::open(fleet.body(), fleet.command_guard(), info, context, None)?),
            }
        }
        RoleId::Observer => Box::new(observer::ObserverNode::<R, B>::open(rig, context, computer)?),
        RoleId::Controller => Box::new(controller::ControllerNode::<R, B>::open(rig, context, computer)?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::bus::iox::IoxBus;
    use crate::config::SHIPPED;
    use crate::scenario::{Scenario, build};

    #[test]
    fn every_role_of_a_scenario_has_the_name_that_the_rig_gives_it() {
        for (name, text) in SHIPPED {
            let scenario = Scenario::parse(text, name, &[]).unwrap();
            let names: Vec<&str> = RoleId::all(&scenario).iter().map(|role| role.name(&scenario)).collect();
            assert_eq!(names, scenario.rig.roles(), "{name}");
        }
    }

    /// What is asked for before a run is more than it takes, and not much more, whatever the size of a fleet.
    #[test]
    fn the_room_that_a_fleet_needs_is_known_beforehand() {
        for (clock, count) in [("lockstep", 1), ("lockstep", 1000), ("realtime", 1000), ("realtime", 20_000)] {
            let overrides = [format!("clock={clock}"), format!("follower.0.count={count}")];
            let text = SHIPPED.iter().find(|(name, _)| *name == "rigid-fleet").unwrap().1;
            let scenario = Scenario::parse(text, "test", &overrides).unwrap();
            let domain = OwnedDomain::create(0).unwrap();
            let bus = IoxBus::enter(domain.domain(), "test", crate::runtime::depths(&scenario)).unwrap();
            let node = |role| {
                let ledger = private_ledger(&scenario, role);
                build(&scenario, role, &bus, &ledger).unwrap()
            };
            let mut nodes: Vec<ReadyNode> = RoleId::all(&scenario).into_iter().map(node).collect();
            nodes.iter_mut().for_each(|node| node.warm_up().unwrap());
            let prefix = domain.domain().prefix();
            let ours = |entry: &std::fs::DirEntry| entry.file_name().to_string_lossy().starts_with(&prefix);
            let files = std::fs::read_dir("/dev/shm").unwrap().filter_map(Result::ok).filter(ours);
            let signals: u64 = files.map(|file| file.metadata().unwrap().len()).sum();
            let beside = |role| ledger_words(&scenario, role);
            let words: usize = RoleId::all(&scenario).into_iter().map(beside).sum();
            let records: usize = nodes.iter_mut().map(|node| 2 * node.state_words()).sum();
            let (taken, asked) = (signals as usize + 8 * (words + records), shared_memory_bytes(&scenario));
            println!("{clock} {count}: {taken} bytes of {asked}");
            assert!(taken <= asked, "{clock} {count}: {taken} bytes of {asked}");
            assert!(count == 1 || asked < 2 * taken, "{clock} {count}: {taken} bytes of {asked}");
            assert!(signals > 100 * count, "{clock} {count}: the samples are among them, {signals} bytes");
        }
    }
}
