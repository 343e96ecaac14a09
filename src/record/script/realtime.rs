//! The script of a role in real time: its outputs tell which ticks it executed, and which inputs it used.

use super::builder::{Input, ScriptBuilder, is_successor, not_recorded};
use super::step::{InputScript, Item, Step};
use crate::record::track::Track;
use crate::sample::{Stamp, status};
use crate::telemetry::Ticks;
use std::collections::{BTreeMap, BTreeSet};

impl ScriptBuilder<'_> {
    /// Returns true if a stamp is plausible: no sample is sent before its tick is due.
    fn is_plausible(&self, stamp: &Stamp) -> bool {
        stamp.generation != 0 && stamp.tick <= self.scenario.last_tick && stamp.tick <= self.grid.tick_at(stamp.sent_ns)
    }

    /// Returns the executed ticks of a run in real time: those with an output, and those whose output a fault withheld.
    pub(super) fn realtime_steps(&mut self) -> Vec<Step> {
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
    pub(super) fn realtime_inputs(&mut self, steps: &[Step]) -> Vec<InputScript> {
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
}
