//! A role with its links and counters: reads samples, calls the role, sends its output.
//!
//! Must not wait or decide when it runs; a driver does.

mod bridge;
mod channel;
mod context;
mod contract;
mod controller;
mod group;
mod held;
mod missed;
mod observer;
mod persistent;
mod plant;
pub(super) mod ports;

pub use context::NodeContext;
#[cfg(feature = "hosts")]
pub use context::retained_samples;
pub use context::{accepted_ticks, late_log, ledger_file, ledger_words, next_tick};
pub use contract::{Node, Poll, ReadyNode, RunCondition};
pub use ports::{Ports, ports, topic};

use super::link;
use super::role_function::FunctionRole;
use super::role_id::RoleId;
use super::role_impl::RoleImpl;
use super::sample_source::{DeviceHandle, SampleSource};
use crate::bus::iox::{COMMON_BYTES, footprint};
use crate::bus::{Bus, BusError, Port, Signal};
use crate::changes::ReceivedChanges;
use crate::clock::Clock;
use crate::config::{ClockKind, Settings};
use crate::control::Watchdog;
use crate::rig::{Fleet, Rig, sensed_body};
use crate::state::{Persist, StoredWords};
use crate::telemetry::{
    Grant, Ledger, LedgerError, ReadCounters, RoleReport, StageReport, TickCounters, Ticks, WatchReport,
};
use context::{extent, words};
use plant::PlantNode;
use std::path::Path;

/// Upper bound on a role's state without samples, bytes.
const RECORD_BYTES: usize = 8 << 10;
/// Upper bound on the state that depends on samples (samples, bodies, guards), in multiples of the size of the role's
/// samples.
const SAMPLES_KEPT: usize = 4;

/// Returns an upper bound on the shared memory of a role's record, bytes: two copies of the role's state, which is
/// bounded by a multiple of the size of its samples, and of the commands in flight.
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

/// Creates a ledger in private memory, for a role without successor.
pub fn private_ledger(scenario: &Settings, role: RoleId) -> Ledger {
    Ledger::private(ledger_words(scenario, role))
}

/// Creates a ledger in a file, for a role that a successor may continue.
///
/// # Errors
/// [`LedgerError`].
pub fn shared_ledger(scenario: &Settings, role: RoleId, path: &Path) -> Result<Ledger, LedgerError> {
    Ledger::shared(path, ledger_words(scenario, role))
}

/// Returns an upper bound on the shared memory of a run, bytes.
pub fn shared_memory_bytes(scenario: &Settings) -> usize {
    let depths = super::depths(scenario);
    let port = |port: &Port| footprint(&port.qos(depths), port.size);
    let role = |role: RoleId| {
        let ports = ports(scenario, role);
        let signals = ports.writes.iter().chain([&ports.health]).map(port).sum::<usize>();
        signals + ledger_words(scenario, role) * size_of::<u64>() + record_bytes(scenario, &ports)
    };
    let Ports { schedule, health, input, .. } = ports(scenario, RoleId::Observer(0));
    // The recorder publishes health too.
    COMMON_BYTES
        + ReceivedChanges::BYTES
        + port(&schedule)
        + port(&input)
        + port(&health)
        + RoleId::all(scenario).into_iter().map(role).sum::<usize>()
}

/// Returns the ticks that a role has committed.
pub fn committed_ticks(ledger: &Ledger) -> Ticks {
    let record = ledger.record().unwrap_or_default();
    let mut ticks = TickCounters::default();
    ticks.persist(&mut StoredWords(&record));
    ticks.report()
}

/// Returns the report of a role: the counters in its ledger, with the stages and grants that the role adds.
pub fn report(
    scenario: &Settings,
    role: RoleId,
    ledger: &Ledger,
    stages: Vec<StageReport>,
    grants: Vec<Grant>,
) -> RoleReport {
    let (ports, ledger) = (ports(scenario, role), &ledger.reopened());
    // All counters are zero if the role has committed nothing.
    let record = ledger.record().unwrap_or_default();
    let record_words = &mut StoredWords(&record);
    let (mut ticks, markers) = (TickCounters::default(), scenario.clock != ClockKind::Realtime);
    ticks.persist(record_words);
    let written = |port: &Port| {
        link::written(record_words, &port.topic.to_string(), words(port), markers, (ledger, extent(scenario)))
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
        pace: None,
        late_inputs: 0,
        late_ticks: late_log(scenario, role, ledger).map_or_else(Vec::new, |log| log.records(0).collect()),
    }
}

/// Builds the node of a rig of known type on a bus of any type.
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
        RoleImpl::Device(role, companions, link) if companions.is_empty() => {
            let source = SampleSource::Device(DeviceHandle::all(link));
            return role_node(rig, &context(&(role, ledger.reopened())), Some(source));
        }
        RoleImpl::Device(_, _, link) => {
            let handles = roles.iter().zip(DeviceHandle::both(link));
            let open = |(entry, handle): (&(RoleId, Ledger), _)| {
                Ok((entry.0, role_node(rig, &context(entry), Some(SampleSource::Device(handle)))?))
            };
            let nodes = handles.map(open).collect::<Result<_, BusError>>()?;
            return Ok(Box::new(group::GroupNode::new(nodes, clock == Clock::Monotonic, scenario.last_tick)));
        }
        RoleImpl::Function(role, compute) => {
            let function = Box::new(FunctionRole::new(compute, scenario, role, (1 << R::AXES) - 1));
            return role_node(rig, &context(&(role, ledger.reopened())), Some(SampleSource::Function(function)));
        }
        RoleImpl::Role(..) => {}
    }
    let open = |entry: &(RoleId, Ledger)| Ok((entry.0, role_node(rig, &context(entry), None)?));
    if let [only] = &mut roles[..] {
        return open(only).map(|(_, node)| node);
    }
    let nodes = roles.iter().map(open).collect::<Result<_, BusError>>()?;
    Ok(Box::new(group::GroupNode::new(nodes, clock == Clock::Monotonic, scenario.last_tick)))
}

/// Opens the node of one role, with another source of its samples if given.
fn role_node<R: Rig, B: Bus + 'static>(
    rig: &R,
    context: &NodeContext<'_, B>,
    source: Option<SampleSource>,
) -> Result<ReadyNode, BusError> {
    Ok(match context.role {
        RoleId::Plant(index) => {
            let info = &rig.bodies()[index];
            match rig.fleet(index) {
                None => {
                    // A device that is a plant has a node of its own.
                    let function = match source {
                        Some(SampleSource::Function(function)) => Some(function),
                        Some(SampleSource::Device(_)) | None => None,
                    };
                    let body = sensed_body(rig, index, context.scenario);
                    Box::new(PlantNode::open(body, rig.command_guard(index), info, context, function)?)
                }
                Some(fleet) => Box::new(PlantNode::open(fleet.body(), fleet.command_guard(), info, context, None)?),
            }
        }
        RoleId::Observer(index) => Box::new(observer::ObserverNode::<R, B>::open(rig, index, context, source)?),
        RoleId::Controller => Box::new(controller::ControllerNode::<R, B>::open(rig, context, source)?),
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
            assert_eq!(names, scenario.roles(), "{name}");
        }
    }

    /// The requested memory is larger than the used memory, but not by more than a factor of two for fleets.
    #[test]
    fn the_requested_shared_memory_bounds_the_used_one() {
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
            assert!(signals > 100 * count, "{clock} {count}: {signals} bytes must include the samples");
        }
    }
}
