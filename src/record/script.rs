//! Reconstructs what a role did in a recorded run: its generations, the ticks that it executed, and its inputs at each.
//!
//! The script feeds a role as in lockstep: one sample or no-sample marker per tick. A lockstep recording has exactly these.
//! In real time, a role that missed a tick or an input must miss it again: its outputs tell which ticks it executed, a
//! body's status word tells which commands it applied, and everything else becomes a no-sample marker. Where an injected
//! fault withheld samples, the role's final counters decide. From the first tick that the recording leaves open, nothing is
//! claimed ([`Limit`]). Must not run a role.

use super::error::RecordError;
use super::reader::Recording;
use super::track::{SignalInfo, Track};
use crate::bus::Port;
use crate::clock::Grid;
use crate::config::{ClockKind, ScriptedFault};
use crate::fault::{Action, Change, ContentFault, FaultSequence, Interruption, Transport};
use crate::runtime::{RoleId, ports};
use crate::sample::{NO_SAMPLE, Stamp, status};
use crate::scenario::Scenario;
use crate::telemetry::Ticks;
use std::collections::{BTreeMap, BTreeSet};

/// Largest accepted step from one generation of a role to the next; a larger one is a malformed stamp.
const GENERATION_STEP_MAX: u64 = 1000;
/// Words of a stamp, with which a sample begins.
const STAMP_WORDS: usize = size_of::<Stamp>() / size_of::<u64>();

/// One executed tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Step {
    /// The tick.
    pub tick: u64,
    /// The generation of the role.
    pub generation: u64,
    /// True if the role finished the tick before it died.
    pub finished: bool,
}

/// One sample to feed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Item {
    /// Index of a recorded sample.
    Recorded(usize),
    /// A no-sample marker: its tick, and the generation of its sender.
    NoSample(u64, u64),
}

/// One input of a role.
#[derive(Debug)]
pub struct InputScript {
    /// The recorded samples.
    pub track: Track,
    /// The samples and markers to feed.
    pub items: Vec<Item>,
    /// Per step, the range of the items to feed: first, and one past the last.
    pub spans: Vec<[usize; 2]>,
}

impl InputScript {
    /// Writes the bytes of an item to `bytes`.
    pub fn write(&self, item: usize, bytes: &mut Vec<u8>) {
        bytes.clear();
        match self.items[item] {
            Item::Recorded(index) => bytes.extend_from_slice(self.track.sample(index)),
            Item::NoSample(tick, generation) => {
                let stamp = Stamp { tick, generation: generation | NO_SAMPLE, ..Stamp::default() };
                bytes.extend_from_slice(bytemuck::bytes_of(&stamp));
                bytes.resize(self.track.info.layout.size(), 0);
            }
        }
    }
}

/// The end of the part of a recording that can be compared.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Limit {
    /// The first tick that cannot be compared.
    pub tick: u64,
    /// The reason.
    pub reason: String,
}

/// The executed ticks of one role, with inputs and outputs.
#[derive(Debug)]
pub struct Script {
    /// The role.
    pub role: RoleId,
    /// Its name.
    pub name: String,
    /// The executed ticks.
    pub steps: Vec<Step>,
    /// The inputs to feed.
    pub inputs: Vec<InputScript>,
    /// The recorded outputs.
    pub outputs: Vec<Track>,
    /// The end of the part that can be compared; `None` if all of it can.
    pub limit: Option<Limit>,
    /// Largest delay that an injected fault gives an output, ticks.
    pub late_ticks: u64,
    /// The time grid of the run.
    pub grid: Grid,
    /// True if the run was in real time, where links lose late samples.
    pub realtime: bool,
}

impl Script {
    /// Reads the script of a role from a recording and its scenario.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn read(recording: &Recording, scenario: &Scenario, role: RoleId) -> Result<Self, RecordError> {
        let ports = ports(scenario, role);
        let named = |ports: &[Port]| -> Vec<String> { ports.iter().map(|port| port.topic.to_string()).collect() };
        let (reads, writes) = (named(&ports.reads), named(&ports.writes));
        let wanted = |info: &SignalInfo| reads.contains(&info.service) || writes.contains(&info.service);
        let mut tracks = recording.tracks(wanted)?;
        let mut take = |services: &[String]| -> Vec<Track> {
            let mut take_track = |service: &String| {
                let index = tracks.iter().position(|track| track.info.service == *service)?;
                Some(tracks.swap_remove(index))
            };
            services.iter().filter_map(&mut take_track).collect()
        };
        let (inputs, outputs) = (take(&reads), take(&writes));
        let realtime = recording.info().clock == ClockKind::Realtime.name();
        let grid = Grid { epoch_ns: recording.info().epoch_ns, period_ns: recording.info().period_ns.max(1) };
        let index_by_tick = |track: &Track| {
            let mut by_tick = BTreeMap::new();
            let indexed = if realtime { track.len() } else { 0 };
            (0..indexed).for_each(|index| _ = by_tick.entry(track.stamp(index).tick).or_insert(index));
            by_tick
        };
        let mut builder = ScriptBuilder {
            recording,
            scenario,
            role,
            grid,
            inputs: inputs.into_iter().map(Input::new).collect(),
            output_by_tick: outputs.iter().map(index_by_tick).collect(),
            outputs,
            faults: FaultTicks::on_role(scenario, role.name(scenario)),
            limit: None,
        };
        if !recording.info().whole {
            builder.limit(0, || "recording began during the run, without the state of the role".to_owned());
        }
        let steps = if realtime { builder.realtime_steps() } else { builder.lockstep_steps() };
        let inputs = if realtime { builder.realtime_inputs(&steps) } else { builder.lockstep_inputs(&steps) };
        builder.limit_to_recorded();
        let ScriptBuilder { outputs, limit, .. } = builder;
        let name = role.name(scenario).to_owned();
        let late = |scripted: &ScriptedFault| match scripted.fault.action {
            Action::Transport(Transport::Delay(delay)) if scripted.role == name => Some(delay.bound()),
            _ => None,
        };
        let late_ticks = scenario.faults.iter().filter_map(late).max().unwrap_or(0);
        Ok(Self { role, name, steps, inputs, outputs, limit, late_ticks, grid, realtime })
    }
}

impl Script {
    /// Returns the rounds of a step, one per tick: the tick, and pairs of input and item to feed.
    ///
    /// All inputs reach the step's own tick in the last round. A role without inputs has one empty round.
    pub fn rounds(&self, number: usize) -> impl Iterator<Item = (u64, Vec<(usize, usize)>)> + '_ {
        let (step, realtime) = (self.steps[number], self.realtime);
        let rounds = self.inputs.iter().map(|input| input.spans[number]).map(|[begin, end]| end - begin).max();
        let rounds = rounds.unwrap_or(0).max(1);
        (0..rounds).map(move |round| {
            let item = |(input, script): (usize, &InputScript)| {
                let [begin, end] = script.spans[number];
                let item = (end + round).checked_sub(rounds).filter(|item| *item >= begin)?;
                Some((input, item))
            };
            // In lockstep, repeated samples belong to the step's own tick.
            let before = if realtime { (rounds - 1 - round) as u64 } else { 0 };
            (step.tick.saturating_sub(before), self.inputs.iter().enumerate().filter_map(item).collect())
        })
    }
}

/// An input of the role.
struct Input {
    track: Track,
    /// Indexes of the accepted samples; in real time only.
    by_tick: BTreeMap<u64, usize>,
}

impl Input {
    fn new(track: Track) -> Self {
        Self { track, by_tick: BTreeMap::new() }
    }
}

/// A script under construction.
struct ScriptBuilder<'a> {
    recording: &'a Recording,
    scenario: &'a Scenario,
    role: RoleId,
    grid: Grid,
    inputs: Vec<Input>,
    outputs: Vec<Track>,
    /// In real time, per output, the index of the first sample of each tick. A fault may have reordered the samples.
    output_by_tick: Vec<BTreeMap<u64, usize>>,
    /// The injected faults of the role.
    faults: Vec<FaultTicks<'a>>,
    limit: Option<Limit>,
}

/// An injected fault with the ticks at which it acts.
struct FaultTicks<'a> {
    scripted: &'a ScriptedFault,
    /// One bit per tick, from the fault's first tick on.
    bits: Vec<u64>,
}

impl<'a> FaultTicks<'a> {
    fn on_role(scenario: &'a Scenario, role: &str) -> Vec<Self> {
        let acting = |scripted: &'a ScriptedFault| {
            let (mut sequence, from) = (FaultSequence::new(scripted.fault.clone()), scripted.fault.from_tick);
            let ticks = scripted.fault.ticks.min((scenario.last_tick + 1).saturating_sub(from));
            let mut bits = vec![0; ticks.div_ceil(64) as usize];
            (0..ticks).filter(|at| sequence.acts(from + at)).for_each(|at| bits[(at / 64) as usize] |= 1 << (at % 64));
            Self { scripted, bits }
        };
        scenario.faults.iter().filter(|scripted| scripted.role == role).map(acting).collect()
    }

    /// Returns true if the fault acts at the tick.
    fn contains(&self, tick: u64) -> bool {
        let at = tick.checked_sub(self.scripted.fault.from_tick);
        at.is_some_and(|at| self.bits.get((at / 64) as usize).is_some_and(|word| word >> (at % 64) & 1 == 1))
    }
}

impl ScriptBuilder<'_> {
    /// Ends the part that can be compared at a tick, unless it ends earlier.
    fn limit(&mut self, tick: u64, reason: impl FnOnce() -> String) {
        if self.limit.as_ref().is_none_or(|limit| tick < limit.tick) {
            self.limit = Some(Limit { tick, reason: reason() });
        }
    }

    /// Returns true if a fault may change or withhold the sample of an output at a tick.
    fn is_disturbed(&self, output: &Track, tick: u64) -> bool {
        self.is_faulty(output, tick, |action| !matches!(action, Action::Role(_)))
    }

    /// Returns true if a fault may change the stamp of an output at a tick.
    fn has_uncertain_stamp(&self, output: &Track, tick: u64) -> bool {
        let flips =
            |content: &ContentFault| matches!(content.change, Change::Flip(_)) && content.words.first < STAMP_WORDS;
        self.is_faulty(output, tick, |action| matches!(action, Action::Content(content) if flips(content)))
    }

    /// Returns true if a matching fault acts on an output at a tick. No fault acts on truth.
    fn is_faulty(&self, output: &Track, tick: u64, matches: impl Fn(&Action) -> bool) -> bool {
        let same_body = |body: &Option<String>| body.as_ref() == Some(&output.info.body);
        output.info.signal != "truth"
            && self.faults.iter().any(|ticks| {
                let ScriptedFault { body, fault, .. } = ticks.scripted;
                same_body(body) && matches(&fault.action) && ticks.contains(tick)
            })
    }

    /// Returns true if a fault makes the role miss the tick.
    fn is_missed(&self, tick: u64) -> bool {
        let miss = Action::Role(Interruption::Miss);
        self.faults.iter().any(|ticks| ticks.scripted.fault.action == miss && ticks.contains(tick))
    }

    /// Returns every tick of a lockstep run, with the generations that the outputs show.
    fn lockstep_steps(&mut self) -> Vec<Step> {
        let (mut steps, mut next, mut current) = (Vec::<Step>::new(), 0, 1);
        let mut gap = None;
        if let Some(output) = self.outputs.first() {
            for index in 0..output.len() {
                let stamp = output.stamp(index);
                let generation = stamp.generation & !NO_SAMPLE;
                let disturbed = self.is_disturbed(output, next) || self.is_disturbed(output, stamp.tick);
                if !disturbed && stamp.tick <= next && is_successor(current, generation) {
                    // The successor repeats the ticks that were not finished.
                    while steps.last().is_some_and(|step| step.tick > stamp.tick) {
                        steps.pop();
                    }
                    if let Some(last) = steps.last_mut().filter(|last| last.tick == stamp.tick) {
                        last.finished = false;
                    }
                    (next, current) = (stamp.tick, generation);
                }
                if stamp.tick == next {
                    steps.push(Step { tick: next, generation: current, finished: true });
                    next += 1;
                } else if stamp.tick > next && !disturbed {
                    gap = Some(next);
                    break;
                }
            }
        }
        if let Some(tick) = gap {
            self.limit(tick, || format!("tick {tick} is not recorded"));
        }
        steps
    }

    /// Returns all inputs of a lockstep run. Each step takes the samples up to the one that it needs.
    fn lockstep_inputs(&mut self, steps: &[Step]) -> Vec<InputScript> {
        let delay = self.input_delay();
        let mut scripts = Vec::new();
        for Input { track, .. } in std::mem::take(&mut self.inputs) {
            let (mut spans, mut at, mut generation, mut lacking) = (Vec::new(), 0, 1, None);
            for step in steps {
                let Some(needed) = step.tick.checked_sub(delay) else {
                    spans.push([at, at]);
                    continue;
                };
                if step.generation != generation {
                    // A successor receives the last inputs of its predecessor again.
                    generation = step.generation;
                    at = (0..track.len()).find(|index| track.stamp(*index).tick == needed).unwrap_or(at).min(at);
                }
                let begin = at;
                match (at..track.len()).find(|index| track.stamp(*index).tick == needed) {
                    Some(found) => at = found + 1,
                    None => {
                        lacking.get_or_insert(step.tick);
                    }
                }
                spans.push([begin, at]);
            }
            if let Some(tick) = lacking {
                let service = track.info.service.clone();
                self.limit(tick, || not_recorded(&service, tick - delay));
            }
            let items = (0..track.len()).map(Item::Recorded).collect();
            scripts.push(InputScript { track, items, spans });
        }
        scripts
    }

    /// Returns the age in ticks of the input that a step takes: a plant takes the command of the previous tick.
    fn input_delay(&self) -> u64 {
        u64::from(matches!(self.role, RoleId::Plant(_)))
    }

    /// Returns true if a stamp is plausible: no sample is sent before its tick is due.
    fn is_plausible(&self, stamp: &Stamp) -> bool {
        stamp.generation != 0 && stamp.tick <= self.scenario.last_tick && stamp.tick <= self.grid.tick_at(stamp.sent_ns)
    }

    /// Returns the executed ticks of a run in real time: those with an output, and those whose output a fault withheld.
    fn realtime_steps(&mut self) -> Vec<Step> {
        for index in 0..self.inputs.len() {
            let mut by_tick = BTreeMap::new();
            let (track, mut next) = (&self.inputs[index].track, 0);
            for sample in 0..track.len() {
                let stamp = track.stamp(sample);
                if stamp.tick >= next && self.is_plausible(&stamp) {
                    by_tick.insert(stamp.tick, sample);
                    next = stamp.tick + 1;
                }
            }
            self.inputs[index].by_tick = by_tick;
        }
        let mut ticks = BTreeMap::new();
        let mut withheld = BTreeSet::new();
        // A plant publishes its truth after the measurement, once the tick is executed.
        let decisive = if self.input_delay() == 1 { 1..2 } else { 0..self.outputs.len() };
        for output in &self.outputs[decisive] {
            for index in 0..output.len() {
                let stamp = output.stamp(index);
                if self.is_plausible(&stamp) {
                    let generation = if self.has_uncertain_stamp(output, stamp.tick) { 0 } else { stamp.generation };
                    ticks.entry(stamp.tick).or_insert((generation, true));
                }
            }
            if let Some(input) = self.inputs.first() {
                withheld.extend(input.by_tick.keys().filter(|tick| self.is_disturbed(output, **tick)));
            }
        }
        withheld.retain(|tick| !ticks.contains_key(tick) && !self.is_missed(*tick));
        self.add_unfinished(&mut ticks);
        if let Some(first) = withheld.first().filter(|_| !self.executed_all(&ticks, withheld.len() as u64)) {
            let first = *first;
            self.limit(first, || "a fault withheld outputs: unknown which ticks were executed".to_owned());
        } else {
            ticks.extend(withheld.into_iter().map(|tick| (tick, (0, true))));
        }
        let mut current = 1;
        let step = |(tick, (generation, finished)): (u64, (u64, bool))| {
            if is_successor(current, generation) {
                current = generation;
            }
            Step { tick, generation: current, finished }
        };
        let steps: Vec<Step> = ticks.into_iter().map(step).collect();
        self.limit_to_inherited_state(&steps);
        steps
    }

    /// Returns the role's final counters, if it reached the end of the run.
    fn final_ticks(&self) -> Option<Ticks> {
        let ticks = self.recording.info().end.as_ref()?.ticks.get(self.role.name(self.scenario))?;
        Some(*ticks).filter(|ticks| ticks.elapsed > self.scenario.last_tick)
    }

    /// Returns true if, by its final counters, the role executed all ticks with output and all `withheld` ones.
    ///
    /// Returns false if the role starved, because the effect of a missing input is unknown.
    fn executed_all(&self, ticks: &BTreeMap<u64, (u64, bool)>, withheld: u64) -> bool {
        let published = ticks.len() as u64;
        self.final_ticks().is_some_and(|ticks| ticks.starved == 0 && ticks.executed == published + withheld)
    }

    /// Ends the comparable part at the first successor if one began without its predecessor's state: the recording does not
    /// tell which.
    fn limit_to_inherited_state(&mut self, steps: &[Step]) {
        let successor = steps.iter().find(|step| step.generation > 1).map(|step| step.tick);
        let ticks = self.recording.info().end.as_ref().and_then(|end| end.ticks.get(self.role.name(self.scenario)));
        if let Some(tick) = successor.filter(|_| ticks.is_some_and(|ticks| ticks.anew > 0)) {
            self.limit(tick, || "a successor began without the state of its predecessor".to_owned());
        }
    }

    /// Adds the ticks in which a plant died between its measurement and its truth, before it moved.
    fn add_unfinished(&mut self, ticks: &mut BTreeMap<u64, (u64, bool)>) {
        let mut unknown = None;
        if let Some(output) = self.outputs.first().filter(|_| self.input_delay() == 1) {
            for index in 0..output.len() {
                let stamp = output.stamp(index);
                if !self.is_plausible(&stamp) || ticks.contains_key(&stamp.tick) {
                    continue;
                }
                if self.has_uncertain_stamp(output, stamp.tick) {
                    unknown.get_or_insert(stamp.tick);
                } else {
                    ticks.insert(stamp.tick, (stamp.generation, false));
                }
            }
        }
        if let Some(tick) = unknown {
            self.limit(tick, || "a fault changed stamps: unknown whether the tick was executed".to_owned());
        }
    }

    /// Returns the inputs that the role used in real time, as far as its outputs show.
    fn realtime_inputs(&mut self, steps: &[Step]) -> Vec<InputScript> {
        let delay = self.input_delay();
        let starves = self.final_ticks().is_none_or(|ticks| ticks.starved > 0);
        let mut scripts = Vec::new();
        let inputs = std::mem::take(&mut self.inputs);
        for (number, input) in inputs.into_iter().enumerate() {
            // Every input of a controller except the first body's estimate belongs to the command of its body.
            let commands = |output: &Track| output.info.body == input.track.info.body;
            let output = if delay == 1 || number == 0 { None } else { self.outputs.iter().position(commands) };
            let output_ticks: Option<Vec<u64>> = output.map(|output| self.output_ticks(output));
            let (mut items, mut spans, mut at_tick, mut generation) = (Vec::new(), Vec::new(), 0, 1);
            let mut role_generation = 1;
            for step in steps {
                let begin = items.len();
                let Some(needed) = step.tick.checked_sub(delay) else {
                    spans.push([begin, begin]);
                    continue;
                };
                if step.generation != role_generation {
                    (role_generation, at_tick) = (step.generation, at_tick.min(needed));
                }
                let delayed = delay == 1 && self.scenario.actuation_delay_ticks > 1;
                if delayed {
                    // A body applies a command later than it takes it, or never.
                    for tick in at_tick..=needed {
                        let index = self.index_if_applied(&input, tick, steps);
                        generation = index.map_or(generation, |index| input.track.stamp(index).generation);
                        items.push(index.map_or(Item::NoSample(tick, generation), Item::Recorded));
                    }
                    at_tick = needed + 1;
                    spans.push([begin, items.len()]);
                    continue;
                }
                items.extend((at_tick..needed).map(|tick| Item::NoSample(tick, generation)));
                at_tick = needed + 1;
                let used = match (&output_ticks, delay) {
                    (None, 1) => self.is_command_applied(step.tick),
                    (None, _) => true,
                    (Some(ticks), _) => ticks.binary_search(&step.tick).is_ok(),
                };
                let withheld = |output: usize| {
                    self.output_by_tick.get(output).is_some_and(|by_tick| !by_tick.contains_key(&step.tick))
                };
                if used && starves && output.is_some_and(withheld) {
                    self.limit(step.tick, || {
                        "a fault withheld an output: unknown whether its input arrived".to_owned()
                    });
                }
                match input.by_tick.get(&needed).filter(|_| used) {
                    Some(index) => {
                        generation = input.track.stamp(*index).generation;
                        items.push(Item::Recorded(*index));
                    }
                    None => {
                        items.push(Item::NoSample(needed, generation));
                        if used {
                            self.limit(step.tick, || not_recorded(&input.track.info.service, needed));
                        }
                    }
                }
                spans.push([begin, items.len()]);
            }
            scripts.push(InputScript { track: input.track, items, spans });
        }
        scripts
    }

    /// Returns the index of the command of a tick, if the body applied it when it was due.
    fn index_if_applied(&mut self, input: &Input, tick: u64, steps: &[Step]) -> Option<usize> {
        let due = tick + self.scenario.actuation_delay_ticks;
        let executed = steps.binary_search_by_key(&due, |step| step.tick).is_ok();
        if !executed || !self.is_command_applied(due) {
            return None;
        }
        let index = input.by_tick.get(&tick).copied();
        if index.is_none() {
            self.limit(due, || not_recorded(&input.track.info.service, tick));
        }
        index
    }

    /// Returns the ticks at which an output has a sample, or may have had one that a fault withheld.
    fn output_ticks(&self, output: usize) -> Vec<u64> {
        let Some(output) = self.outputs.get(output) else { return Vec::new() };
        let stamps = (0..output.len()).map(|index| output.stamp(index)).filter(|stamp| self.is_plausible(stamp));
        let mut ticks: Vec<u64> = stamps.map(|stamp| stamp.tick).collect();
        let last = self.scenario.last_tick;
        let faults = self.faults.iter().map(|ticks| &ticks.scripted.fault);
        let faulty =
            faults.flat_map(|fault| fault.from_tick..fault.from_tick.saturating_add(fault.ticks).min(last + 1));
        ticks.extend(faulty.filter(|tick| self.is_disturbed(output, *tick)));
        ticks.sort_unstable();
        ticks.dedup();
        ticks
    }

    /// Returns true if a body applied or rejected the command that was due at a tick.
    ///
    /// Reads the status word of its truth or, if the body died before that, of its measurement.
    fn is_command_applied(&self, tick: u64) -> bool {
        let status = |(output, by_tick): (&Track, &BTreeMap<u64, usize>)| {
            by_tick.get(&tick).and_then(|index| output.unsigned(*index, "status"))
        };
        let word = self.outputs.iter().zip(&self.output_by_tick).rev().find_map(status);
        word.is_none_or(|word| word & status::REJECTED != 0 || word & (status::HOLDING | status::SAFE) == 0)
    }

    /// Returns the least and the largest tick at which an output ends. They differ if the recording ended before its run.
    fn ends(&self) -> (u64, u64) {
        let after = |track: &Track| track.regular().last().map_or(0, |index| track.stamp(index).tick + 1);
        let ends = || self.outputs.iter().map(after);
        (ends().min().unwrap_or(0), ends().max().unwrap_or(0))
    }

    /// Ends the comparable part at the end of the recording, or at the first lost output.
    fn limit_to_recorded(&mut self) {
        let Some(end) = self.recording.info().end.as_ref().filter(|_| self.recording.damage().is_none()) else {
            return self.limit(self.ends().0, || "the file was cut off".to_owned());
        };
        // The writers' counters may be older than the last sample, so they do not show every loss at the end.
        match self.ends() {
            (first, last) if first < last && !end.complete => {
                self.limit(first, || "the recording ended".to_owned());
            }
            _ => {}
        }
        let lost = |service: &str| {
            let signal = end.signals.iter().find(|signal| signal.service == service && signal.lost.unwrap_or(0) > 0)?;
            Some((signal.gaps.first().map_or(0, |gap| gap[0]), signal.lost.unwrap_or(0)))
        };
        let found: Vec<_> = self
            .outputs
            .iter()
            .filter_map(|track| Some((track.info.service.clone(), lost(&track.info.service)?)))
            .collect();
        for (service, (tick, count)) in found {
            self.limit(tick, || format!("{count} samples of {service} are not recorded"));
        }
    }
}

/// Returns true if a generation follows the current one by a plausible step.
fn is_successor(current: u64, generation: u64) -> bool {
    (current + 1..current + GENERATION_STEP_MAX).contains(&generation)
}

fn not_recorded(service: &str, tick: u64) -> String {
    format!("{service} of tick {tick} is not recorded")
}
