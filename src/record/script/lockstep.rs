//! The script of a role in lockstep: its recording has every sample and marker.

use super::builder::{Input, ScriptBuilder, is_successor, not_recorded};
use super::step::{InputScript, Item, Step};
use crate::sample::NO_SAMPLE;

impl ScriptBuilder<'_> {
    /// Returns every tick of a lockstep run, with the generations that the outputs show.
    pub(super) fn lockstep_steps(&mut self) -> Vec<Step> {
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
    pub(super) fn lockstep_inputs(&mut self, steps: &[Step]) -> Vec<InputScript> {
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
}
