//! What a role did in a recorded run, as a script by which it can do it again: its lives, the ticks that it executed, and for
//! each the inputs that it had.
//!
//! A role's inputs are those of a lockstep run: one sample or one void per tick. A recording of lockstep has them as they
//! were. In real time a role that missed a tick, or an input, must miss it again: what it executed is told by what it
//! published, and what a body applied by its status word; everything else becomes a void. Where a fault kept samples back,
//! the role's counters at the end of the recording decide. From where the recording does
//! not tell enough on, nothing is claimed ([`Limit`]). Must not run anything.

use super::RecordError;
use super::reader::{Recording, SignalInfo, Track};
use crate::bus::Port;
use crate::clock::Grid;
use crate::config::{ClockKind, ScriptedFault};
use crate::fault::{Action, Change, ContentFault, FaultSequence, Interruption, Transport};
use crate::runtime::{RoleId, ports};
use crate::sample::{NO_SAMPLE, Stamp, status};
use crate::scenario::Scenario;
use crate::telemetry::Ticks;
use std::collections::{BTreeMap, BTreeSet};

/// A role's successor is not counted further up than this; what says so has a broken stamp.
const LIVES_MAX: u64 = 1000;
/// Words of a stamp, the first of a sample.
const STAMP_WORDS: usize = size_of::<Stamp>() / size_of::<u64>();

/// One executed tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Step {
    /// The tick.
    pub tick: u64,
    /// Which life of the role.
    pub generation: u64,
    /// Whether the role lived to do what a tick leaves to be done.
    pub finished: bool,
}

/// One sample to be fed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Item {
    /// The recorded sample with this index.
    Recorded(usize),
    /// A void of a tick, from a sender in this life.
    Void(u64, u64),
}

/// One input of a role.
#[derive(Debug)]
pub struct InputScript {
    /// What was recorded of it.
    pub track: Track,
    /// What the role gets.
    pub items: Vec<Item>,
    /// Per step: which of the items, first and behind the last, it gets then.
    pub spans: Vec<[usize; 2]>,
}

impl InputScript {
    /// The bytes of an item.
    pub fn write(&self, item: usize, bytes: &mut Vec<u8>) {
        bytes.clear();
        match self.items[item] {
            Item::Recorded(index) => bytes.extend_from_slice(self.track.sample(index)),
            Item::Void(tick, generation) => {
                let stamp = Stamp { tick, generation: generation | NO_SAMPLE, ..Stamp::default() };
                bytes.extend_from_slice(bytemuck::bytes_of(&stamp));
                bytes.resize(self.track.info.layout.size(), 0);
            }
        }
    }
}

/// From which tick on nothing can be said, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Limit {
    /// The first such tick.
    pub tick: u64,
    /// Why.
    pub reason: String,
}

/// What one role did.
#[derive(Debug)]
pub struct Script {
    /// The role.
    pub role: RoleId,
    /// Its name.
    pub name: String,
    /// The ticks that it executed.
    pub steps: Vec<Step>,
    /// What it was given.
    pub inputs: Vec<InputScript>,
    /// What it published.
    pub outputs: Vec<Track>,
    /// How far it can be told.
    pub limit: Option<Limit>,
    /// By how many ticks a fault sends a sample late, at the most.
    pub late_ticks: u64,
    /// The time grid of the run.
    pub grid: Grid,
    /// Whether its links lost what came too late.
    pub realtime: bool,
}

impl Script {
    /// Reads what a role did. `scenario` is that of the recording.
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
            let mut one = |service: &String| {
                let index = tracks.iter().position(|track| track.info.service == *service)?;
                Some(tracks.swap_remove(index))
            };
            services.iter().filter_map(&mut one).collect()
        };
        let (inputs, outputs) = (take(&reads), take(&writes));
        let realtime = recording.info().clock == ClockKind::Realtime.name();
        let grid = Grid { epoch_ns: recording.info().epoch_ns, period_ns: recording.info().period_ns.max(1) };
        let first = |track: &Track| {
            let mut firsts = BTreeMap::new();
            let all = if realtime { track.len() } else { 0 };
            (0..all).for_each(|index| _ = firsts.entry(track.stamp(index).tick).or_insert(index));
            firsts
        };
        let mut reading = Reading {
            recording,
            scenario,
            role,
            grid,
            inputs: inputs.into_iter().map(Source::new).collect(),
            firsts: outputs.iter().map(first).collect(),
            outputs,
            scripted: Acting::of(scenario, role.name(scenario)),
            limit: None,
        };
        if !recording.info().whole {
            reading.limit(0, || {
                "it was begun in the midst of the run, and what the role knew then is not in it".to_owned()
            });
        }
        let steps = if realtime { reading.executed() } else { reading.every_tick() };
        let inputs = if realtime { reading.used(&steps) } else { reading.all(&steps) };
        reading.lost();
        let Reading { outputs, limit, .. } = reading;
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
    /// What is fed for a step, one tick after the other: the tick, and which item of which input. All inputs reach the step's
    /// own tick together, however many come before. A body without inputs has one round with nothing in it.
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
            // What lockstep has beside one sample per tick belongs to the step.
            let before = if realtime { (rounds - 1 - round) as u64 } else { 0 };
            (step.tick.saturating_sub(before), self.inputs.iter().enumerate().filter_map(item).collect())
        })
    }
}

/// One input that is read.
struct Source {
    track: Track,
    by_tick: BTreeMap<u64, usize>,
}

impl Source {
    fn new(track: Track) -> Self {
        Self { track, by_tick: BTreeMap::new() }
    }
}

/// A script in the making.
struct Reading<'a> {
    recording: &'a Recording,
    scenario: &'a Scenario,
    role: RoleId,
    grid: Grid,
    inputs: Vec<Source>,
    outputs: Vec<Track>,
    /// In real time, per output, the first sample of each tick: a fault may have put them into another order.
    firsts: Vec<BTreeMap<u64, usize>>,
    /// What the scenario does to the role, and when.
    scripted: Vec<Acting<'a>>,
    limit: Option<Limit>,
}

/// A scripted fault, and the ticks up to the last at which it acts, by bits from its first on.
struct Acting<'a> {
    scripted: &'a ScriptedFault,
    bits: Vec<u64>,
}

impl<'a> Acting<'a> {
    fn of(scenario: &'a Scenario, role: &str) -> Vec<Self> {
        let acting = |scripted: &'a ScriptedFault| {
            let (mut course, from) = (FaultSequence::new(scripted.fault.clone()), scripted.fault.from_tick);
            let ticks = scripted.fault.ticks.min((scenario.last_tick + 1).saturating_sub(from));
            let mut bits = vec![0; ticks.div_ceil(64) as usize];
            (0..ticks).filter(|at| course.acts(from + at)).for_each(|at| bits[(at / 64) as usize] |= 1 << (at % 64));
            Self { scripted, bits }
        };
        scenario.faults.iter().filter(|scripted| scripted.role == role).map(acting).collect()
    }

    fn at(&self, tick: u64) -> bool {
        let at = tick.checked_sub(self.scripted.fault.from_tick);
        at.is_some_and(|at| self.bits.get((at / 64) as usize).is_some_and(|word| word >> (at % 64) & 1 == 1))
    }
}

impl Reading<'_> {
    /// Nothing can be said from a tick on.
    fn limit(&mut self, tick: u64, reason: impl FnOnce() -> String) {
        if self.limit.as_ref().is_none_or(|limit| tick < limit.tick) {
            self.limit = Some(Limit { tick, reason: reason() });
        }
    }

    /// Whether a scripted fault touches what the role publishes of a body at a tick.
    fn disturbed(&self, output: &Track, tick: u64) -> bool {
        self.touched(output, tick, |action| !matches!(action, Action::Role(_)))
    }

    /// Whether one may have changed the stamp.
    fn forged(&self, output: &Track, tick: u64) -> bool {
        let flips =
            |tamper: &ContentFault| matches!(tamper.change, Change::Flip(_)) && tamper.words.first < STAMP_WORDS;
        self.touched(output, tick, |action| matches!(action, Action::Content(tamper) if flips(tamper)))
    }

    fn touched(&self, output: &Track, tick: u64, by: impl Fn(&Action) -> bool) -> bool {
        let here = |body: &Option<String>| body.as_ref() == Some(&output.info.body);
        output.info.signal != "truth"
            && self.scripted.iter().any(|acting| {
                let ScriptedFault { body, fault, .. } = acting.scripted;
                here(body) && by(&fault.action) && acting.at(tick)
            })
    }

    /// Whether a scripted fault has taken the tick from the role.
    fn taken(&self, tick: u64) -> bool {
        let miss = Action::Role(Interruption::Miss);
        self.scripted.iter().any(|acting| acting.scripted.fault.action == miss && acting.at(tick))
    }

    /// Lockstep: every tick, in as many lives as the generations tell.
    fn every_tick(&mut self) -> Vec<Step> {
        let (mut steps, mut next, mut life) = (Vec::<Step>::new(), 0, 1);
        let mut gap = None;
        if let Some(output) = self.outputs.first() {
            for index in 0..output.len() {
                let stamp = output.stamp(index);
                let generation = stamp.generation & !NO_SAMPLE;
                let disturbed = self.disturbed(output, next) || self.disturbed(output, stamp.tick);
                if !disturbed && stamp.tick <= next && (life + 1..life + LIVES_MAX).contains(&generation) {
                    // The successor does again what was not finished.
                    while steps.last().is_some_and(|step| step.tick > stamp.tick) {
                        steps.pop();
                    }
                    if let Some(last) = steps.last_mut().filter(|last| last.tick == stamp.tick) {
                        last.finished = false;
                    }
                    (next, life) = (stamp.tick, generation);
                }
                if stamp.tick == next {
                    steps.push(Step { tick: next, generation: life, finished: true });
                    next += 1;
                } else if stamp.tick > next && !disturbed {
                    gap = Some(next);
                    break;
                }
            }
        }
        if let Some(tick) = gap {
            self.limit(tick, || format!("the recording lacks tick {tick}"));
        }
        steps
    }

    /// Lockstep: everything that came, up to the sample that the step needs.
    fn all(&mut self, steps: &[Step]) -> Vec<InputScript> {
        let delay = self.delay();
        let mut scripts = Vec::new();
        for Source { track, .. } in std::mem::take(&mut self.inputs) {
            let (mut spans, mut at, mut life, mut lacking) = (Vec::new(), 0, 1, None);
            for step in steps {
                let Some(needed) = step.tick.checked_sub(delay) else {
                    spans.push([at, at]);
                    continue;
                };
                if step.generation != life {
                    // A successor is sent again what its predecessor had.
                    life = step.generation;
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
                self.limit(tick, || format!("the recording lacks {service} of tick {}", tick - delay));
            }
            let items = (0..track.len()).map(Item::Recorded).collect();
            scripts.push(InputScript { track, items, spans });
        }
        scripts
    }

    /// By how many ticks an input is older than the step that takes it: a command is taken one tick later.
    fn delay(&self) -> u64 {
        u64::from(matches!(self.role, RoleId::Plant(_)))
    }

    /// Whether a stamp can be of its tick: nobody knows a sample of a tick that is not due.
    fn possible(&self, stamp: &Stamp) -> bool {
        stamp.generation != 0 && stamp.tick <= self.scenario.last_tick && stamp.tick <= self.grid.tick_at(stamp.sent_ns)
    }

    /// Real time: the ticks of which the role published something.
    fn executed(&mut self) -> Vec<Step> {
        for index in 0..self.inputs.len() {
            let mut by_tick = BTreeMap::new();
            let (track, mut next) = (&self.inputs[index].track, 0);
            for sample in 0..track.len() {
                let stamp = track.stamp(sample);
                if stamp.tick >= next && self.possible(&stamp) {
                    by_tick.insert(stamp.tick, sample);
                    next = stamp.tick + 1;
                }
            }
            self.inputs[index].by_tick = by_tick;
        }
        let mut ticks = BTreeMap::new();
        let mut withheld = BTreeSet::new();
        // A plant's truth is what really happened; it is written after the measurement.
        let telling = if self.delay() == 1 { 1..2 } else { 0..self.outputs.len() };
        for output in &self.outputs[telling] {
            for index in 0..output.len() {
                let stamp = output.stamp(index);
                if self.possible(&stamp) {
                    let generation = if self.forged(output, stamp.tick) { 0 } else { stamp.generation };
                    ticks.entry(stamp.tick).or_insert((generation, true));
                }
            }
            if let Some(first) = self.inputs.first() {
                withheld.extend(first.by_tick.keys().filter(|tick| self.disturbed(output, **tick)));
            }
        }
        withheld.retain(|tick| !ticks.contains_key(tick) && !self.taken(*tick));
        self.unfinished(&mut ticks);
        if let Some(first) = withheld.first().filter(|_| !self.executed_all(&ticks, withheld.len() as u64)) {
            let first = *first;
            self.limit(first, || {
                "a fault kept samples back, and the outputs do not tell which of them were made".to_owned()
            });
        } else {
            ticks.extend(withheld.into_iter().map(|tick| (tick, (0, true))));
        }
        let mut life = 1;
        let step = |(tick, (generation, finished)): (u64, (u64, bool))| {
            if (life + 1..life + LIVES_MAX).contains(&generation) {
                life = generation;
            }
            Step { tick, generation: life, finished }
        };
        let steps: Vec<Step> = ticks.into_iter().map(step).collect();
        self.anew(&steps);
        steps
    }

    /// What the role counted, if it came to its end.
    fn counted(&self) -> Option<Ticks> {
        let ticks = self.recording.info().end.as_ref()?.ticks.get(self.role.name(self.scenario))?;
        Some(*ticks).filter(|ticks| ticks.elapsed > self.scenario.last_tick)
    }

    /// Whether a role executed, beside the ticks of which there is a sample, so many others, by its own counters. What a
    /// missing input did to these is not known.
    fn executed_all(&self, told: &BTreeMap<u64, (u64, bool)>, others: u64) -> bool {
        self.counted().is_some_and(|ticks| ticks.starved == 0 && ticks.executed == told.len() as u64 + others)
    }

    /// A life that began without its predecessor's state began somewhere else; which of several did is not told.
    fn anew(&mut self, steps: &[Step]) {
        let successor = steps.iter().find(|step| step.generation > 1).map(|step| step.tick);
        let ticks = self.recording.info().end.as_ref().and_then(|end| end.ticks.get(self.role.name(self.scenario)));
        if let Some(tick) = successor.filter(|_| ticks.is_some_and(|ticks| ticks.anew > 0)) {
            self.limit(tick, || "a successor began there without the state of its predecessor".to_owned());
        }
    }

    /// A plant that died between its measurement and its truth had moved nothing.
    fn unfinished(&mut self, ticks: &mut BTreeMap<u64, (u64, bool)>) {
        let mut untold = None;
        if let Some(output) = self.outputs.first().filter(|_| self.delay() == 1) {
            for index in 0..output.len() {
                let stamp = output.stamp(index);
                if !self.possible(&stamp) || ticks.contains_key(&stamp.tick) {
                    continue;
                }
                if self.forged(output, stamp.tick) {
                    untold.get_or_insert(stamp.tick);
                } else {
                    ticks.insert(stamp.tick, (stamp.generation, false));
                }
            }
        }
        if let Some(tick) = untold {
            self.limit(tick, || "a fault changed stamps, and nothing tells whether that tick was executed".to_owned());
        }
    }

    /// Real time: the inputs that the role used, by what it made of them.
    fn used(&mut self, steps: &[Step]) -> Vec<InputScript> {
        let delay = self.delay();
        let starves = self.counted().is_none_or(|ticks| ticks.starved > 0);
        let mut scripts = Vec::new();
        let sources = std::mem::take(&mut self.inputs);
        for (input, source) in sources.into_iter().enumerate() {
            // Every input but a controller's estimate belongs to one output.
            let told_by = if delay == 1 { None } else { input.checked_sub(1) };
            let said: Option<Vec<u64>> = told_by.map(|output| self.said(output));
            let (mut items, mut spans, mut at_tick, mut generation) = (Vec::new(), Vec::new(), 0, 1);
            let mut life = 1;
            for step in steps {
                let begin = items.len();
                let Some(needed) = step.tick.checked_sub(delay) else {
                    spans.push([begin, begin]);
                    continue;
                };
                if step.generation != life {
                    (life, at_tick) = (step.generation, at_tick.min(needed));
                }
                let waits = delay == 1 && self.scenario.actuation_delay_ticks > 1;
                if waits {
                    // What a body takes now it uses later, or never.
                    for tick in at_tick..=needed {
                        let (index, item) = self.applied_later(&source, tick, steps);
                        generation = index.map_or(generation, |index| source.track.stamp(index).generation);
                        items.push(item.unwrap_or(Item::Void(tick, generation)));
                    }
                    at_tick = needed + 1;
                    spans.push([begin, items.len()]);
                    continue;
                }
                items.extend((at_tick..needed).map(|tick| Item::Void(tick, generation)));
                at_tick = needed + 1;
                let used = match (&said, delay) {
                    (None, 1) => self.applied(step.tick),
                    (None, _) => true,
                    (Some(ticks), _) => ticks.binary_search(&step.tick).is_ok(),
                };
                let withheld =
                    |output: usize| self.firsts.get(output).is_some_and(|firsts| !firsts.contains_key(&step.tick));
                if used && starves && told_by.is_some_and(withheld) {
                    self.limit(step.tick, || {
                        "a fault kept a sample back, and nothing tells whether its input was there".to_owned()
                    });
                }
                match source.by_tick.get(&needed).filter(|_| used) {
                    Some(index) => {
                        generation = source.track.stamp(*index).generation;
                        items.push(Item::Recorded(*index));
                    }
                    None => {
                        items.push(Item::Void(needed, generation));
                        if used {
                            let service = source.track.info.service.clone();
                            self.limit(step.tick, || format!("the recording lacks {service} of tick {needed}"));
                        }
                    }
                }
                spans.push([begin, items.len()]);
            }
            scripts.push(InputScript { track: source.track, items, spans });
        }
        scripts
    }

    /// The command of a tick, if the body applied it when it was due: its sample's index, and that as an item.
    fn applied_later(&mut self, source: &Source, tick: u64, steps: &[Step]) -> (Option<usize>, Option<Item>) {
        let due = tick + self.scenario.actuation_delay_ticks;
        let executed = steps.binary_search_by_key(&due, |step| step.tick).is_ok();
        if !executed || !self.applied(due) {
            return (None, None);
        }
        let index = source.by_tick.get(&tick).copied();
        if index.is_none() {
            let service = source.track.info.service.clone();
            self.limit(due, || format!("the recording lacks {service} of tick {tick}"));
        }
        (index, index.map(Item::Recorded))
    }

    /// The ticks of which an output has a sample, or would have but for a scripted fault.
    fn said(&self, output: usize) -> Vec<u64> {
        let Some(output) = self.outputs.get(output) else { return Vec::new() };
        let stamps = (0..output.len()).map(|index| output.stamp(index)).filter(|stamp| self.possible(stamp));
        let mut ticks: Vec<u64> = stamps.map(|stamp| stamp.tick).collect();
        let last = self.scenario.last_tick;
        let faults = self.scripted.iter().map(|acting| &acting.scripted.fault);
        let touched =
            faults.flat_map(|fault| fault.from_tick..fault.from_tick.saturating_add(fault.ticks).min(last + 1));
        ticks.extend(touched.filter(|tick| self.disturbed(output, *tick)));
        ticks.sort_unstable();
        ticks.dedup();
        ticks
    }

    /// Whether a body applied the command that was due at a tick, or had one that it did not believe. Its truth says so, or,
    /// where it died before that, its measurement.
    fn applied(&self, tick: u64) -> bool {
        let status = |(output, firsts): (&Track, &BTreeMap<u64, usize>)| {
            firsts.get(&tick).and_then(|index| output.unsigned(*index, "status"))
        };
        let word = self.outputs.iter().zip(&self.firsts).rev().find_map(status);
        word.is_none_or(|word| word & status::REJECTED != 0 || word & (status::HOLDING | status::SAFE) == 0)
    }

    /// The tick behind the last of each output, the least and the largest. A recording that ended before its run ends with each
    /// signal at a tick of its own.
    fn ends(&self) -> (u64, u64) {
        let after = |track: &Track| track.regular().last().map_or(0, |index| track.stamp(index).tick + 1);
        let ends = || self.outputs.iter().map(after);
        (ends().min().unwrap_or(0), ends().max().unwrap_or(0))
    }

    /// What was published and is not in the recording may have been anything.
    fn lost(&mut self) {
        let Some(end) = self.recording.info().end.as_ref().filter(|_| self.recording.damage().is_none()) else {
            return self.limit(self.ends().0, || "the file was cut off there".to_owned());
        };
        // What the counters say was published may be of a moment before the last sample.
        match self.ends() {
            (first, last) if first < last && !end.complete => {
                self.limit(first, || "the recording ended there".to_owned());
            }
            _ => {}
        }
        let lost = |service: &str| {
            let books = end.signals.iter().find(|books| books.service == service && books.lost.unwrap_or(0) > 0)?;
            Some((books.gaps.first().map_or(0, |gap| gap[0]), books.lost.unwrap_or(0)))
        };
        let found: Vec<_> = self
            .outputs
            .iter()
            .filter_map(|track| Some((track.info.service.clone(), lost(&track.info.service)?)))
            .collect();
        for (service, (tick, count)) in found {
            self.limit(tick, || format!("{count} samples of {service} are not in the recording"));
        }
    }
}
