//! Reconstructs what a role did in a recorded run: its generations, the ticks that it executed, and its inputs at each.
//!
//! The script feeds a role as in lockstep: one sample or no-sample marker per tick. A lockstep recording has exactly these.
//! In real time, a role that missed a tick or an input must miss it again: its outputs tell which ticks it executed, a
//! body's status word tells which commands it applied, and everything else becomes a no-sample marker. Where an injected
//! fault withheld samples, the role's final counters decide. From the first tick that the recording leaves open, nothing is
//! claimed ([`Limit`]). Must not run a role.

mod builder;
mod lockstep;
mod realtime;
mod step;

pub use step::{InputScript, Item, Limit, Step};

use super::error::RecordError;
use super::reader::Recording;
use super::track::{SignalInfo, Track};
use crate::bus::Port;
use crate::clock::Grid;
use crate::config::{ClockKind, ScriptedFault};
use crate::fault::{Action, Transport};
use crate::runtime::{RoleId, ports};
use crate::scenario::Scenario;
use builder::{FaultTicks, Input, ScriptBuilder};
use std::collections::BTreeMap;

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
