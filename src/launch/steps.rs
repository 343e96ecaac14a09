//! A run in one thread that its caller steps tick by tick, as the controller. All else, to the bit, is as in any run in one thread.
//!
//! Must not decide anything for the controller.

use super::error::LaunchError;
use super::outcome::Outcome;
use crate::bus::Port;
use crate::bus::memory::MemoryBus;
use crate::bus::{BusError, Reader, Signal, WordReader};
use crate::changes::{CHANGES_MAX, ReceivedChanges};
use crate::config::{ClockKind, InputInfo, InputUser, Variability};
use crate::input::Change;
use crate::inputs::{InputError, WantedChange, resolve};
use crate::runtime::{
    CurrentValues, ReadyNode, RoleFunction, RoleId, RoleImpl, TickSamples, depths, ports, private_ledger, report,
    run_in_turn,
};
use crate::sample::{Field, Order, Place, Stamp};
use crate::scenario::Scenario;
use crate::scenario::build;
use crate::scenario::scorer as open_scorer;
use crate::score::Scorer;
use crate::telemetry::Ledger;
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;
use toml::Value;

/// A run that its caller steps.
///
/// ```
/// use corotate::config::SHIPPED;
/// use corotate::launch::Steps;
/// use corotate::scenario::Scenario;
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let overrides = ["clock=in-process", "duration_s=1", "accept={}"].map(str::to_owned);
/// let scenario = Scenario::parse(SHIPPED[0].1, "rigid-pair.toml", &overrides)?;
/// let mut steps = Steps::new(scenario)?;
/// while steps.observe()? {
///     // Words 4 to 6 of the estimate, after its stamp, are the leader's angular velocity, rad/s.
///     let estimate = steps.inputs()[0].as_ref().map(|words| f64::from_bits(words[6]));
///     assert!(estimate.is_some());
///     let nothing = vec![0; steps.outputs()[0].size / 8 - 4];
///     steps.act(&[&nothing])?;
/// }
/// assert_eq!(steps.finish()?.score.scored_ticks, 1001);
/// # Ok(())
/// # }
/// ```
pub struct Steps {
    scenario: Scenario,
    seats: Vec<(RoleId, Ledger)>,
    nodes: Vec<ReadyNode>,
    scorer: Box<dyn Scorer>,
    /// The controller's inputs, and each sample of the current tick.
    readers: Vec<TickReader>,
    inputs: Vec<Option<Vec<u64>>>,
    values: CurrentValues,
    outputs: Vec<Port>,
    commands: Rc<RefCell<Vec<Vec<u64>>>>,
    truths: Vec<TruthReader>,
    tick: u64,
    /// True from `observe` to `act`.
    observed: bool,
    bus: MemoryBus,
}

/// A reader of the samples of one tick.
struct TickReader {
    reader: WordReader,
    order: Order,
}

impl TickReader {
    fn new(port: &Port, bus: &MemoryBus) -> Result<Self, BusError> {
        Ok(Self { reader: port.reader(bus, Reader::Scorer)?, order: Order::default() })
    }

    /// Reads what has arrived. Returns true if it has a sample of this tick, which then replaces `sample`.
    fn read(&mut self, tick: u64, sample: &mut Vec<u64>) -> Result<bool, BusError> {
        let mut found = false;
        while let Some(words) = self.reader.next()? {
            let stamp: &Stamp = bytemuck::from_bytes(bytemuck::cast_slice(&words[..STAMP]));
            if self.order.place(stamp, tick) == Place::Sample && stamp.tick == tick {
                sample.clear();
                sample.extend_from_slice(words);
                found = true;
            }
        }
        Ok(found)
    }
}

/// The state of a body at the current tick, which no controller sees.
#[derive(Debug, Clone, Default)]
pub struct BodyState {
    /// Its name.
    pub body: String,
    /// The bits of its status ([`status`](crate::sample::status)).
    pub status: u64,
    /// The command that acts, as numbers.
    pub applied: Vec<f64>,
    /// The end of its motion, as a verb with its object, if it has ended.
    pub loss: Option<&'static str>,
}

/// Reads the state of a body from its truth.
struct TruthReader {
    reader: WordReader,
    /// The first word and the count of the applied command, and the word of the status.
    applied: (usize, usize),
    status: Option<usize>,
    state: BodyState,
}

impl TruthReader {
    /// Reads `port`. The applied command is in the field `applied_…`, or else in that of the first field's name of `command`.
    fn new(port: &Port, command: Option<&Port>, bus: &MemoryBus) -> Result<Self, BusError> {
        let word = |field: &Field| field.offset / size_of::<u64>();
        let named = |matches: &dyn Fn(&str) -> bool| port.fields.iter().find(|field| matches(field.name));
        let first = command.and_then(|command| command.fields.first()).map(|field| field.name);
        let applied = named(&|name| name.starts_with("applied_")).or_else(|| named(&|name| first == Some(name)));
        Ok(Self {
            reader: port.reader(bus, Reader::Scorer)?,
            applied: applied.map_or((0, 0), |field| (word(field), field.count)),
            status: named(&|name| name == "status").map(word),
            state: BodyState { body: port.topic.body.clone(), ..BodyState::default() },
        })
    }

    /// Reads the newest truth; without one the state stays.
    fn read(&mut self, scenario: &Scenario) -> Result<(), BusError> {
        let ((first, count), state) = (self.applied, &mut self.state);
        while let Some(words) = self.reader.next()? {
            state.status = self.status.map_or(0, |word| words[word]);
            state.applied.clear();
            state.applied.extend(words[first..first + count].iter().map(|bits| f64::from_bits(*bits)));
            state.loss = scenario.rig.loss_words(words);
        }
        Ok(())
    }
}

/// The caller's commands.
struct CallerCommands(Rc<RefCell<Vec<Vec<u64>>>>);

impl RoleFunction for CallerCommands {
    fn compute(&mut self, tick: TickSamples<'_>) -> Result<(), String> {
        for (output, given) in tick.outputs.iter_mut().zip(self.0.borrow().iter()) {
            output.copy_from_slice(given);
        }
        Ok(())
    }
}

impl Steps {
    /// Creates a run of a scenario, before its first tick.
    ///
    /// # Errors
    /// [`LaunchError`]; [`LaunchError::NotStepped`] if it has no controller, a fleet, or a role that a fault kills.
    pub fn new(scenario: Scenario) -> Result<Self, LaunchError> {
        Self::open(scenario, true)
    }

    /// Creates a run whose controller is the caller, or the scenario's own.
    fn open(mut scenario: Scenario, called: bool) -> Result<Self, LaunchError> {
        scenario.clock = ClockKind::InProcess;
        scenario.inputs.receive_in(ReceivedChanges::default());
        let refuse = |reason| Err(LaunchError::NotStepped { reason });
        let roles = RoleId::all(&scenario);
        if !roles.contains(&RoleId::Controller) {
            return refuse("it has no controller");
        }
        let controller_ports = ports(&scenario, RoleId::Controller);
        if controller_ports.reads.iter().any(|port| port.fleet) {
            return refuse("a fleet accepts commands from the built-in controller only");
        }
        let bus = MemoryBus::new(depths(&scenario));
        let scorer = open_scorer(&scenario, &bus)?;
        let seats: Vec<(RoleId, Ledger)> =
            roles.into_iter().map(|role| (role, private_ledger(&scenario, role))).collect();
        let readers: Vec<TickReader> =
            controller_ports.reads.iter().map(|port| TickReader::new(port, &bus)).collect::<Result<_, _>>()?;
        let content = |port: &Port| vec![0; port.size / size_of::<u64>() - STAMP];
        let commands = Rc::new(RefCell::new(controller_ports.writes.iter().map(content).collect()));
        let node = |(role, ledger): &(RoleId, Ledger)| {
            let role_impl = match role {
                RoleId::Controller if called => {
                    RoleImpl::Function(*role, Box::new(CallerCommands(Rc::clone(&commands))))
                }
                role => RoleImpl::from(*role),
            };
            build(&scenario, role_impl, &bus, ledger)
        };
        let nodes = seats.iter().map(node).collect::<Result<Vec<_>, _>>()?;
        let (inputs, outputs) = (vec![None; readers.len()], controller_ports.writes);
        let written = seats.iter().flat_map(|(role, _)| ports(&scenario, *role).writes);
        let truths = written.filter(|port| port.topic.signal == Signal::Truth);
        let truth = |port: Port| {
            let command = outputs.iter().find(|command| command.topic.body == port.topic.body);
            TruthReader::new(&port, command, &bus)
        };
        let truths = truths.map(truth).collect::<Result<_, _>>()?;
        Ok(Self {
            values: CurrentValues::new(&scenario.inputs, RoleId::Controller),
            scenario,
            seats,
            nodes,
            scorer,
            readers,
            inputs,
            outputs,
            commands,
            truths,
            tick: 0,
            observed: false,
            bus,
        })
    }

    /// Runs the loop up to the controller's next turn. Returns false after the last tick.
    ///
    /// # Errors
    /// [`LaunchError`].
    pub fn observe(&mut self) -> Result<bool, LaunchError> {
        while self.tick <= self.scenario.last_tick && !self.tick.is_multiple_of(self.scenario.rates.controller_ticks) {
            self.run_others()?;
            self.end_tick()?;
        }
        if self.tick > self.scenario.last_tick {
            return Ok(false);
        }
        self.run_others()?;
        for (reader, input) in self.readers.iter_mut().zip(&mut self.inputs) {
            let mut sample = input.take().unwrap_or_default();
            *input = reader.read(self.tick, &mut sample)?.then_some(sample);
        }
        self.truths.iter_mut().try_for_each(|truth| truth.read(&self.scenario))?;
        self.observed = true;
        Ok(true)
    }

    /// Runs bodies and observer of the current tick.
    fn run_others(&mut self) -> Result<(), LaunchError> {
        let controller = self.nodes.len() - 1;
        self.nodes[..controller].iter_mut().try_for_each(|node| step(node, self.tick))
    }

    /// Runs the controller of the current tick, and ends the tick.
    fn end_tick(&mut self) -> Result<(), LaunchError> {
        if let Some(controller) = self.nodes.last_mut() {
            step(controller, self.tick)?;
        }
        self.scorer.poll(1)?;
        self.tick += 1;
        self.observed = false;
        Ok(())
    }

    /// Runs a scenario with its own controller, and returns the words of the commands of its first turns, turn by turn, without stamps:
    /// zeros where it sent none. They are fewer if the run has fewer turns.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn own_commands(scenario: Scenario, turns: u64) -> Result<Vec<u64>, LaunchError> {
        let mut steps = Self::open(scenario, false)?;
        let mut readers =
            steps.outputs.iter().map(|port| TickReader::new(port, &steps.bus)).collect::<Result<Vec<_>, _>>()?;
        let lengths: Vec<usize> = steps.outputs.iter().map(|port| port.size / size_of::<u64>()).collect();
        let (mut commands, mut sample) = (Vec::new(), Vec::new());
        for _ in 0..turns {
            if !steps.observe()? {
                break;
            }
            let tick = steps.tick;
            steps.end_tick()?;
            for (reader, length) in readers.iter_mut().zip(&lengths) {
                if !reader.read(tick, &mut sample)? {
                    sample.clear();
                    sample.resize(*length, 0);
                }
                commands.extend_from_slice(&sample[STAMP..]);
            }
        }
        Ok(commands)
    }

    /// Returns the state of every body at the current tick.
    pub fn bodies(&self) -> impl Iterator<Item = &BodyState> {
        self.truths.iter().map(|truth| &truth.state)
    }

    /// Returns the controller's samples of the current tick: the first body's estimate, each driven body's measurement, then the own
    /// estimates of driven bodies, as words with stamps.
    pub fn inputs(&self) -> &[Option<Vec<u64>>] {
        &self.inputs
    }

    /// Returns the values, at the current tick, of the inputs that the controller uses: gains, set points, the reference. Their order is
    /// that of [`role_values`](crate::runtime::role_values).
    pub fn values(&mut self) -> &[f64] {
        self.values.at(self.tick)
    }

    /// Returns the numbers of the loop's state after [`observe`](Self::observe): those that each role passes to
    /// [`Persist`](crate::state::Persist), role by role, bodies first. Commands that are in flight are among them, but not the one that
    /// [`act`](Self::act) sends next.
    pub fn state(&mut self) -> Vec<(&str, Vec<f64>)> {
        let scenario = &self.scenario;
        let numbers = |((role, _), node): (&(RoleId, Ledger), &mut ReadyNode)| {
            let mut numbers = Vec::new();
            node.numbers(&mut |number| numbers.push(*number));
            (role.name(scenario), numbers)
        };
        let own = |((role, _), _): &(&(RoleId, Ledger), &mut ReadyNode)| *role != RoleId::Controller;
        self.seats.iter().zip(&mut self.nodes).filter(own).map(numbers).collect()
    }

    /// Replaces the numbers of the loop's state, in the order of [`state`](Self::state). Counters, flags, noise generators and the
    /// memory of guards stay.
    ///
    /// # Panics
    /// If their number differs.
    pub fn set_state(&mut self, numbers: &[f64]) {
        let (mut rest, controller) = (numbers.iter(), self.nodes.len() - 1);
        for node in &mut self.nodes[..controller] {
            node.numbers(&mut |number| *number = *rest.next().expect("a number for each state"));
        }
        assert_eq!(rest.len(), 0, "one number for each state");
    }

    /// Returns the ports of its commands, one for each driven body.
    pub fn outputs(&self) -> &[Port] {
        &self.outputs
    }

    /// Returns the current tick.
    pub fn tick(&self) -> u64 {
        self.tick
    }

    /// Returns the latest value of the rig's first metric.
    pub fn metric(&self) -> f64 {
        self.scorer.latest()
    }

    /// Sends the commands of the current tick, as words without stamps, and ends the tick.
    ///
    /// # Errors
    /// [`LaunchError`].
    ///
    /// # Panics
    /// If their number or lengths differ from [`outputs`](Self::outputs).
    pub fn act(&mut self, commands: &[&[u64]]) -> Result<(), LaunchError> {
        let mut given = self.commands.borrow_mut();
        assert_eq!(commands.len(), given.len(), "one command for each driven body");
        given.iter_mut().zip(commands).for_each(|(given, command)| given.copy_from_slice(command));
        drop(given);
        self.end_tick()
    }

    /// Changes an input from the tick on that [`observe`](Self::observe) runs next, and returns this tick. A change after the last
    /// tick has no effect. The caller is the controller: it applies set points itself, and has no gains that could change.
    ///
    /// ```
    /// # use corotate::{config::SHIPPED, launch::Steps, scenario::Scenario};
    /// # fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// # let overrides = ["clock=in-process", "duration_s=1", "accept={}"].map(str::to_owned);
    /// let mut steps = Steps::new(Scenario::parse(SHIPPED[0].1, "rigid-pair.toml", &overrides)?)?;
    /// steps.observe()?;
    /// assert_eq!(steps.set_input("follower.0.disturbance_rad_s2", &vec![0.0, 0.0, 0.05].into())?, 1);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// [`InputError::Refused`]: the key is not that of an input, the value is out of range, only the controller uses the parameter, or
    /// the run has taken all changes that it can take.
    pub fn set_input(&mut self, key: &str, value: &Value) -> Result<u64, InputError> {
        let refused = |code: &str, reason| InputError::Refused { code: code.to_owned(), reason };
        let wanted = WantedChange { key: key.to_owned(), value: value.clone(), ramp_s: 0.0 };
        let change = resolve(&self.scenario, &wanted, &|_| false)?;
        if self.scenario.inputs.infos.get(change.input).is_some_and(is_of_controller) {
            let reason = format!("{key} is used by the controller, which the caller is: it has no effect");
            return Err(refused("external-role", reason));
        }
        let tick = self.tick + u64::from(self.observed);
        match self.received().append(&[Change { tick, ..change }], || true) {
            true => Ok(tick),
            false => Err(refused("too-many", format!("a run takes at most {CHANGES_MAX} changes; start another run"))),
        }
    }

    /// Returns the changes of inputs so far, to share them with another copy of the scenario.
    pub fn received(&self) -> Arc<ReceivedChanges> {
        self.scenario.inputs.received()
    }

    /// Ends the run at any tick, and returns its scores and counters.
    ///
    /// # Errors
    /// [`LaunchError`].
    pub fn finish(mut self) -> Result<Outcome, LaunchError> {
        self.nodes.iter_mut().try_for_each(|node| node.finish())?;
        let score = self.scorer.finish()?;
        let role_report =
            |(role, ledger): &(RoleId, Ledger)| report(&self.scenario, *role, ledger, Vec::new(), Vec::new());
        Ok(Outcome::in_one_thread(self.seats.iter().map(role_report).collect(), score))
    }
}

/// Returns true if no role but the controller uses the parameter. A set point is not a parameter: the score uses it too.
fn is_of_controller(info: &InputInfo) -> bool {
    let elsewhere = |user| matches!(user, InputUser::Body(_) | InputUser::Actuator(_) | InputUser::Observer);
    info.variability == Variability::Tunable && !info.uses.iter().any(|by| elsewhere(by.user))
}

/// Length of a stamp, words.
const STAMP: usize = size_of::<Stamp>() / size_of::<u64>();

fn step(node: &mut ReadyNode, tick: u64) -> Result<(), LaunchError> {
    if node.before_tick() {
        return Err(LaunchError::NotStepped { reason: "a fault kills one of its roles" });
    }
    Ok(run_in_turn(node, tick)?)
}
