//! One role on a bus: takes its samples, lets the pure role compute, sends, keeps the counters.
//!
//! Must not wait, and must not decide when it runs; a driver does.

mod bridge;
mod controller;
mod group;
mod missed;
mod observer;
mod plant;
mod ports;
mod role_id;

pub(crate) use ports::ports_of_rig;
pub use ports::{Port, Ports, ports};
pub use role_id::{RoleId, RoleImpl};

use super::bridge::DeviceError;
use super::compute::Computing;
use super::disturb::{Disturbance, Interruptions, LateSamples, extra_samples, late_samples};
use super::hooks::{self, Failpoint};
use super::link::{self, AcceptedTicks, Extent, Input, Kept, Output};
use super::share::{Computer, Share};
use crate::bus::iox::{COMMON_BYTES, footprint};
use crate::bus::{AnyBus, Bus, BusError, Carried, Reader, Signal, Topic};
use crate::clock::{Clock, Grid};
use crate::config::{ClockKind, Scenario};
use crate::control::Watchdog;
use crate::rig::{BodyInfo, Fleet, Rig};
use crate::role::Guard;
use crate::serial::LineCounters;
use crate::state::{Count, Persist, Restore, Words};
use crate::telemetry::{
    Grant, Ledger, LedgerError, Outage, ReadCounters, RoleReport, StageReport, TickCounters, Ticks, WatchReport,
};
use missed::MissedTicks;
use plant::PlantNode;
use std::path::Path;

/// Between two looks at a device's line, ns.
const LOOK_NS: u64 = 50_000;
/// An upper bound on the state of a role, bytes, but for samples and what is remembered of them.
const RECORD_BYTES: usize = 8 << 10;
/// So many times the size of what a role reads and writes is remembered at the most: samples made, bodies, guards.
const SAMPLES_KEPT: usize = 4;

/// When a node may execute its next tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunCondition {
    /// Lockstep: when every input of the tick is there and the tick is at most this one.
    Inputs {
        /// The farthest tick allowed.
        up_to: u64,
    },
    /// Real time, plants: now, whatever is there, skipping to the tick that is due.
    Now {
        /// The latest tick that is due.
        tick: u64,
        /// The time.
        now_ns: u64,
    },
    /// Real time, others: when the inputs are there.
    Arrived,
    /// Real time, others: with what is there, as long as the tick can be computed at all.
    Overdue,
}

/// Whether a node executed a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Poll {
    /// It did; [`Node::finish_tick`] is due.
    Executed,
    /// It waits for inputs, or has passed over a tick of which there are none.
    Waiting,
    /// It has given the tick up and counted it as missed.
    Missed,
}

/// Why a node cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// A link failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The device at the end of a serial line is gone for good.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The function that computes a role failed.
    #[error("{reason}")]
    Computed {
        /// As it says.
        reason: String,
    },
}

/// A role with its links and counters.
pub trait Node {
    /// Whether the tick alone starts it, or its inputs do. What is started by its tick may still wait for something that
    /// the tick sets off: then it is polled until that has arrived, or is overdue.
    fn time_triggered(&self) -> bool;
    /// The next tick to execute.
    fn next_tick(&self) -> u64;
    /// Continues from where a predecessor committed its state, if there was one. Before [`start`](Self::start).
    ///
    /// # Errors
    /// [`LedgerError`].
    fn restore(&mut self) -> Result<(), LedgerError>;
    /// Hands over the time grid, once the epoch is known, and the first tick to execute. What a predecessor was committed to
    /// send is sent; what it left undone before that tick counts as missed.
    ///
    /// # Errors
    /// [`NodeError`].
    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), NodeError>;
    /// Lets scripted interruptions of this role act: before every tick, once.
    fn before_tick(&mut self) -> bool;
    /// Executes the next tick if the condition allows it: takes inputs, computes, commits, sends. The critical path.
    ///
    /// # Errors
    /// [`NodeError`].
    fn poll(&mut self, condition: RunCondition) -> Result<Poll, NodeError>;
    /// Whose sample the next tick lacks, as far as it is known.
    fn awaits(&self) -> Option<RoleId>;
    /// Sleeps until the input that the next tick lacks may be there, at most until `until_ns`; false if it lacks none.
    ///
    /// # Errors
    /// [`NodeError`].
    fn sleep(&mut self, until_ns: u64) -> Result<bool, NodeError>;
    /// Does what the executed tick left to be done: integrates, counts, prepares the next sample.
    ///
    /// # Errors
    /// [`NodeError`].
    fn finish_tick(&mut self) -> Result<(), NodeError>;
    /// Settles what is left of a tick that the end of the run has come upon, and commits the state for the last time.
    ///
    /// # Errors
    /// [`NodeError`].
    fn finish(&mut self) -> Result<(), NodeError>;
    /// Counts every tick before `tick` that was not executed as missed.
    fn skip_to(&mut self, tick: u64);
    /// Exercises all links with a sample that no role uses.
    ///
    /// # Errors
    /// [`NodeError`].
    fn warm_up(&mut self) -> Result<(), NodeError>;
    /// Lets readers that have come later know of this role's signals, and finds the writers that have. Off the critical
    /// path.
    ///
    /// # Errors
    /// [`NodeError`].
    fn refresh(&mut self) -> Result<(), NodeError>;
    /// The tick counters.
    fn ticks(&self) -> Ticks;
    /// The latencies.
    fn stages(&self) -> Vec<StageReport>;
    /// How many words its state takes.
    fn state_words(&mut self) -> usize;
    /// Of several roles that are driven as one, the node of this role.
    fn of(&self, _role: RoleId) -> Option<&dyn Node> {
        None
    }
    /// The counters of its device's serial line, if it has one.
    fn line(&self) -> Option<LineCounters> {
        None
    }
    /// When that device was absent.
    fn outages(&self) -> Vec<Outage> {
        Vec::new()
    }
}

/// What of a node outlives its process.
trait Persistent {
    /// Where it is kept.
    fn ledger(&self) -> &Ledger;
    /// Passes the counters, and what is committed to be sent. Of any role in the order of its [`Ports`]: see [`report`].
    fn counters<W: Words>(&mut self, words: &mut W);
    /// Passes everything else.
    fn state<W: Words>(&mut self, words: &mut W);

    fn pass<W: Words>(&mut self, words: &mut W) {
        self.counters(words);
        self.state(words);
    }
}

/// Commits the state of a node, where another process may have to continue from it.
#[inline]
fn commit(node: &mut impl Persistent) {
    if node.ledger().is_shared() {
        let ledger = node.ledger().reopened();
        hooks::at(Failpoint::Committing);
        ledger.commit(|store| {
            node.counters(store);
            hooks::at(Failpoint::InCommit);
            node.state(store);
        });
        hooks::at(Failpoint::Committed);
    }
}

/// Commits the state of a node for the last time, wherever it is kept.
fn commit_last(node: &mut impl Persistent) {
    let ledger = node.ledger().reopened();
    // Room in private memory can always be had, and that in shared memory was taken before the first tick.
    if ledger.reserve(length(node)).is_ok() {
        ledger.commit(|store| node.pass(store));
    }
}

fn length(node: &mut impl Persistent) -> usize {
    let mut count = Count::default();
    node.pass(&mut count);
    count.0
}

/// What a node has of its predecessor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Inherited {
    /// There was none, or it had not begun.
    Nothing,
    /// The counters alone: the state is not trusted.
    Counters,
    /// All.
    All,
}

/// Reads what a predecessor committed.
fn restore(node: &mut impl Persistent) -> Result<Inherited, LedgerError> {
    let ledger = node.ledger().reopened();
    ledger.reserve(length(node))?;
    let Some(record) = ledger.record() else { return Ok(Inherited::Nothing) };
    let mut words = Restore(&record);
    node.counters(&mut words);
    if ledger.distrusted() {
        return Ok(Inherited::Counters);
    }
    node.state(&mut words);
    Ok(Inherited::All)
}

/// A node that can be driven.
pub type ReadyNode = Box<dyn Node>;

/// What every node of a run shares.
pub struct Seat<'a, B> {
    bus: &'a B,
    scenario: &'a Scenario,
    role: RoleId,
    generation: u64,
    ledger: Ledger,
    clock: Clock,
}

impl<B: Bus> Seat<'_, B> {
    fn input<S, G: Guard<S>>(&self, body: &BodyInfo, signal: Signal, guard: G) -> Result<Input<B, S, G>, BusError>
    where
        S: Carried + ?Sized,
    {
        // Where inputs of one tick may come ticks apart, the newest of each is not enough.
        let lags = self.scenario.lag_ticks(self.role.name(self.scenario)) > 1;
        self.input_of(body, signal, guard, if lags { Reader::Scorer } else { Reader::Role })
    }

    fn input_of<S, G: Guard<S>>(
        &self,
        body: &BodyInfo,
        signal: Signal,
        guard: G,
        reader: Reader,
    ) -> Result<Input<B, S, G>, BusError>
    where
        S: Carried + ?Sized,
    {
        let topic = topic(self.scenario, &body.name, signal);
        let mut input = Input::watch_many(self.bus, &topic, body.bodies(), reader)?
            .recovering(self.kept(&topic), body.bodies(), self.generation > 1)
            .with_late(LateSamples::of(self.scenario, signal, &body.name))
            .guarded(guard);
        input.expect(accepted_ticks(self.scenario, None));
        Ok(input)
    }

    /// What the writer of a signal keeps.
    fn kept(&self, topic: &Topic) -> Option<Kept> {
        kept(self.scenario, topic, |writer| {
            let path = self.ledger.path()?.with_file_name(ledger_file(self.scenario, writer));
            Ledger::shared(&path, ledger_words(self.scenario, writer)).ok()
        })
    }

    fn output<S: Carried + ?Sized>(&self, body: &BodyInfo, signal: Signal) -> Result<Output<B, S>, BusError> {
        let topic = topic(self.scenario, &body.name, signal);
        let (bodies, extent) = (body.bodies(), extent(self.scenario));
        let output = Output::open(self.bus, &topic, bodies, self.generation, &self.ledger, extent)?;
        // Nobody in the loop reads the truth, and the score is to tell what really happened.
        let disturbance = match signal {
            Signal::Truth => None,
            _ => {
                let role = self.role.name(self.scenario);
                Disturbance::of(self.scenario, role, &body.name, bodies, next_tick(&self.ledger))
            }
        };
        // In a process with others whoever has a short way is served at once, and all others when the tick is done.
        let alone = self.role.host(self.scenario).hosted(self.scenario).len() == 1;
        let output = if alone { output } else { output.shown_first() };
        Ok(output.with_voids(self.scenario.clock != ClockKind::Realtime).disturbed(disturbance))
    }

    fn interruptions(&self) -> Interruptions {
        let role = self.role.name(self.scenario);
        Interruptions::of(self.scenario, role, self.generation, next_tick(&self.ledger))
    }
}

/// Where the samples of a signal are kept for the successors of its readers: in its writer's ledger, which `open` opens.
pub(crate) fn kept(scenario: &Scenario, topic: &Topic, open: impl Fn(RoleId) -> Option<Ledger>) -> Option<Kept> {
    let extent = extent(scenario);
    let writers = if extent.kept_samples == 0 { Vec::new() } else { RoleId::all(scenario) };
    writers.into_iter().find_map(|writer| {
        let written = ports(scenario, writer).writes;
        let index = written.iter().position(|port| port.topic == *topic)?;
        let (ledger, length) = (open(writer)?, words(&written[index]));
        ledger.take(words_of(&written[..=index], extent) - Kept::words(extent.kept_samples, length));
        Kept::open(&ledger, extent.kept_samples, length)
    })
}

/// Which ticks samples can have; in real time only once the grid is known.
pub(crate) fn accepted_ticks(scenario: &Scenario, grid: Option<Grid>) -> AcceptedTicks {
    match (scenario.clock, grid) {
        (ClockKind::Realtime, None) => AcceptedTicks::Unknown,
        (ClockKind::Realtime, Some(grid)) => AcceptedTicks::Due(grid),
        (ClockKind::Lockstep | ClockKind::InProcess, _) => AcceptedTicks::Next,
    }
}

/// How many words of a role's ledger lie beside its record.
pub(crate) fn ledger_words(scenario: &Scenario, role: RoleId) -> usize {
    words_of(&ports(scenario, role).writes, extent(scenario))
}

fn words_of(written: &[Port], extent: Extent) -> usize {
    written.iter().map(|port| extent.words(words(port))).sum()
}

/// The length of a sample, words.
fn words(port: &Port) -> usize {
    port.size / size_of::<u64>()
}

/// The name of the file that has a role's ledger.
pub(super) fn ledger_file(scenario: &Scenario, role: RoleId) -> String {
    format!("{}.books", role.name(scenario))
}

/// What the writing ends of a scenario keep. Where every sample is waited for, one may be under way for as long as the fastest
/// role may be ahead of what is scored, and a little longer: a tick is scored before its command is used. As links, twice that.
fn extent(scenario: &Scenario) -> Extent {
    let lockstep = scenario.clock == ClockKind::Lockstep;
    let kept_samples = if lockstep {
        2 * super::window_ticks(scenario) * (1 + extra_samples(scenario) as u64) + late_samples(scenario) as u64
    } else {
        0
    };
    Extent { last_tick: scenario.last_tick, kept_samples }
}

/// An upper bound on the shared memory that a role's record takes, bytes: two copies of what it writes, and of what bodies,
/// filters, laws and guards remember, which is at most so many times what is said of them; and of commands, as many as are on
/// their way.
fn record_bytes(scenario: &Scenario, ports: &Ports) -> usize {
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
pub fn private_ledger(scenario: &Scenario, role: RoleId) -> Ledger {
    Ledger::private(ledger_words(scenario, role))
}

/// A ledger in a file, for a role that a successor may continue.
///
/// # Errors
/// [`LedgerError`].
pub fn shared_ledger(scenario: &Scenario, role: RoleId, path: &Path) -> Result<Ledger, LedgerError> {
    Ledger::shared(path, ledger_words(scenario, role))
}

/// An upper bound on the shared memory that a run takes, bytes.
pub(crate) fn shared_memory_bytes(scenario: &Scenario) -> usize {
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

/// The tick that a role has not executed, by its ledger.
pub(crate) fn next_tick(ledger: &Ledger) -> u64 {
    let mut ticks = TickCounters::default();
    ticks.persist(&mut Restore(&ledger.record().unwrap_or_default()));
    ticks.next()
}

/// What a role's ledger says, with what the role itself has to add.
pub fn report(
    scenario: &Scenario,
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
        watchdog: watchdog.and_then(|watchdog| {
            let names: Vec<&str> = scenario.rig.monitors().into_iter().map(|(name, _)| name).collect();
            WatchReport::of(&watchdog, &names)
        }),
        stages,
        grants,
        line: None,
        outages: Vec::new(),
    }
}

/// The topic of a signal in a scenario.
pub fn topic(scenario: &Scenario, body: &str, signal: Signal) -> Topic {
    Topic { scenario: scenario.name.clone(), body: body.to_owned(), signal }
}

/// Opens a role's links and builds its node, with its counters in the ledger: new, or a predecessor's.
///
/// # Errors
/// [`BusError::Open`].
pub fn build<'a>(
    scenario: &Scenario,
    occupant: impl Into<RoleImpl>,
    bus: impl Into<AnyBus<'a>>,
    ledger: &Ledger,
) -> Result<ReadyNode, BusError> {
    scenario.rig.face().node(scenario, occupant.into(), bus.into(), ledger)
}

/// The same for a rig whose type is known, on a bus of any type.
///
/// # Errors
/// [`BusError::Open`].
pub fn build_rig<R: Rig, B: Bus + 'static>(
    rig: &R,
    scenario: &Scenario,
    occupant: impl Into<RoleImpl>,
    bus: &B,
    ledger: &Ledger,
) -> Result<ReadyNode, BusError> {
    let occupant = occupant.into();
    let clock = if scenario.clock == ClockKind::Realtime { Clock::Monotonic } else { Clock::None };
    let mut roles = occupant.books(ledger);
    let seat = |(role, ledger): &(RoleId, Ledger)| {
        let generation = ledger.enter();
        Seat { bus, scenario, role: *role, generation, ledger: ledger.reopened(), clock }
    };
    match occupant {
        RoleImpl::Device(RoleId::Plant(index), _, link) => {
            let seat = seat(&(RoleId::Plant(index), ledger.reopened()));
            return Ok(Box::new(bridge::BridgeNode::<R, B>::open(rig, index, link, &seat)?));
        }
        RoleImpl::Device(role, others, link) if others.is_empty() => {
            let computer = Computer::Device(Share::all(link));
            return role_node(rig, &seat(&(role, ledger.reopened())), Some(computer));
        }
        RoleImpl::Device(_, _, link) => {
            let shares = roles.iter().zip(Share::both(link));
            let open = |(of, share): (&(RoleId, Ledger), _)| {
                Ok((of.0, role_node(rig, &seat(of), Some(Computer::Device(share)))?))
            };
            let nodes = shares.map(open).collect::<Result<_, BusError>>()?;
            return Ok(Box::new(group::GroupNode::new(nodes, clock == Clock::Monotonic, scenario.last_tick)));
        }
        RoleImpl::Computed(role, compute) => {
            let computing = Computing::new(compute, &ports(scenario, role), (1 << R::AXES) - 1);
            return role_node(rig, &seat(&(role, ledger.reopened())), Some(Computer::Function(computing)));
        }
        RoleImpl::Role(..) => {}
    }
    let open = |of: &(RoleId, Ledger)| Ok((of.0, role_node(rig, &seat(of), None)?));
    if let [only] = &mut roles[..] {
        return open(only).map(|(_, node)| node);
    }
    let nodes = roles.iter().map(open).collect::<Result<_, BusError>>()?;
    Ok(Box::new(group::GroupNode::new(nodes, clock == Clock::Monotonic, scenario.last_tick)))
}

/// The node of one role of this program, whose samples somebody else may compute.
fn role_node<R: Rig, B: Bus + 'static>(
    rig: &R,
    seat: &Seat<'_, B>,
    computer: Option<Computer>,
) -> Result<ReadyNode, BusError> {
    Ok(match seat.role {
        RoleId::Plant(index) => {
            let info = &rig.bodies()[index];
            match rig.fleet(index) {
                None => {
                    // A device in its place has a node of its own.
                    let function = match computer {
                        Some(Computer::Function(function)) => Some(function),
                        Some(Computer::Device(_)) | None => None,
                    };
                    Box::new(PlantNode::open(rig.body(index), rig.command_guard(index), info, seat, function)?)
                }
                Some(fleet) => Box::new(PlantNode::open(fleet.body(), fleet.command_guard(), info, seat, None)?),
            }
        }
        RoleId::Observer => Box::new(observer::ObserverNode::<R, B>::open(rig, seat, computer)?),
        RoleId::Controller => Box::new(controller::ControllerNode::<R, B>::open(rig, seat, computer)?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::domain::OwnedDomain;
    use crate::bus::iox::IoxBus;
    use crate::config::SHIPPED;

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
