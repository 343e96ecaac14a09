//! A script under construction: the tracks and faults of a role, and the end of the part that can be compared.

use super::step::Limit;
use crate::clock::Grid;
use crate::config::ScriptedFault;
use crate::fault::{Action, Change, ContentFault, FaultSequence, Interruption};
use crate::record::reader::Recording;
use crate::record::track::Track;
use crate::runtime::RoleId;
use crate::sample::Stamp;
use crate::scenario::Scenario;
use std::collections::BTreeMap;

/// Largest accepted step from one generation of a role to the next; a larger one is a malformed stamp.
const GENERATION_STEP_MAX: u64 = 1000;

/// Words of a stamp, with which a sample begins.
const STAMP_WORDS: usize = size_of::<Stamp>() / size_of::<u64>();

/// An input of the role.
pub(super) struct Input {
    pub track: Track,
    /// Indexes of the accepted samples; in real time only.
    pub by_tick: BTreeMap<u64, usize>,
}

impl Input {
    pub fn new(track: Track) -> Self {
        Self { track, by_tick: BTreeMap::new() }
    }
}

/// A script under construction.
pub(super) struct ScriptBuilder<'a> {
    pub recording: &'a Recording,
    pub scenario: &'a Scenario,
    pub role: RoleId,
    pub grid: Grid,
    pub inputs: Vec<Input>,
    pub outputs: Vec<Track>,
    /// In real time, per output, the index of the first sample of each tick. A fault may have reordered the samples.
    pub output_by_tick: Vec<BTreeMap<u64, usize>>,
    /// The injected faults of the role.
    pub faults: Vec<FaultTicks<'a>>,
    pub limit: Option<Limit>,
}

/// An injected fault with the ticks at which it acts.
pub(super) struct FaultTicks<'a> {
    pub scripted: &'a ScriptedFault,
    /// One bit per tick, from the fault's first tick on.
    bits: Vec<u64>,
}

impl<'a> FaultTicks<'a> {
    pub fn on_role(scenario: &'a Scenario, role: &str) -> Vec<Self> {
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
    pub(super) fn limit(&mut self, tick: u64, reason: impl FnOnce() -> String) {
        if self.limit.as_ref().is_none_or(|limit| tick < limit.tick) {
            self.limit = Some(Limit { tick, reason: reason() });
        }
    }

    /// Returns true if a fault may change or withhold the sample of an output at a tick.
    pub(super) fn is_disturbed(&self, output: &Track, tick: u64) -> bool {
        self.is_faulty(output, tick, |action| !matches!(action, Action::Role(_)))
    }

    /// Returns true if a fault may change the stamp of an output at a tick.
    pub(super) fn has_uncertain_stamp(&self, output: &Track, tick: u64) -> bool {
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
    pub(super) fn is_missed(&self, tick: u64) -> bool {
        let miss = Action::Role(Interruption::Miss);
        self.faults.iter().any(|ticks| ticks.scripted.fault.action == miss && ticks.contains(tick))
    }

    /// Returns the age in ticks of the input that a step takes: a plant takes the command of the previous tick.
    pub(super) fn input_delay(&self) -> u64 {
        u64::from(matches!(self.role, RoleId::Plant(_)))
    }

    /// Returns the least and the largest tick at which an output ends. They differ if the recording ended before its run.
    fn ends(&self) -> (u64, u64) {
        let after = |track: &Track| track.regular().last().map_or(0, |index| track.stamp(index).tick + 1);
        let ends = || self.outputs.iter().map(after);
        (ends().min().unwrap_or(0), ends().max().unwrap_or(0))
    }

    /// Ends the comparable part at the end of the recording, or at the first lost output.
    pub(super) fn limit_to_recorded(&mut self) {
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
pub(super) fn is_successor(current: u64, generation: u64) -> bool {
    (current + 1..current + GENERATION_STEP_MAX).contains(&generation)
}

pub(super) fn not_recorded(service: &str, tick: u64) -> String {
    format!("{service} of tick {tick} is not recorded")
}
