//! Replays a role: feeds the recorded inputs to the live, unmodified role, and compares its outputs bit for bit.
//!
//! Drives the role in one thread; [`crate::launch`] drives a process with the same script and comparison. Does not compare
//! the time of sending and the generation, which are not outputs of the role.

use super::error::RecordError;
use super::reader::Recording;
use super::script::{Limit, Script, Step};
use super::track::Track;
use crate::bus::memory::MemoryBus;
use crate::bus::{AnyBus, BusError, Reader, WordReader, WordWriter};
use crate::runtime::{NodeError, Poll, ReadyNode, RoleId, RunCondition, depths, ports, private_ledger};
use crate::sample::{FieldKind, NO_SAMPLE, Stamp};
use crate::scenario::Scenario;
use crate::scenario::build;
use crate::telemetry::Ledger;

/// The columns that are not compared: they describe the sending process.
const SENDER: [&str; 2] = ["generation", "sent_ns"];

/// The first difference between a role's output and the recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The tick of the recorded sample, or of a sample that is not recorded.
    pub tick: u64,
    /// The signal.
    pub service: String,
    /// The field and, for arrays, the element; `None` if one of the samples is missing.
    pub field: Option<String>,
    /// The recorded value.
    pub recorded: String,
    /// The replayed value.
    pub replayed: String,
}

/// The result of one role's replay.
#[derive(Debug, Clone)]
pub struct RoleReplay {
    /// The role.
    pub role: String,
    /// Number of executed ticks.
    pub ticks: u64,
    /// Number of generations.
    pub lives: u64,
    /// Number of compared samples.
    pub samples: u64,
    /// The first difference.
    pub difference: Option<Difference>,
    /// The end of the part that can be compared; `None` if all of it can.
    pub limit: Option<Limit>,
}

/// Writers of a role's inputs.
pub struct Inlets(Vec<WordWriter>);
/// Readers of a role's outputs.
pub struct Outlets(Vec<WordReader>);

impl Inlets {
    /// Opens a role's inputs for writing.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open<'a>(scenario: &Scenario, role: RoleId, bus: impl Into<AnyBus<'a>>) -> Result<Self, BusError> {
        let bus = bus.into();
        Ok(Self(ports(scenario, role).reads.iter().map(|port| port.writer(bus)).collect::<Result<_, _>>()?))
    }

    /// Sends the bytes of a sample on an input.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn send(&mut self, input: usize, bytes: &[u8]) -> Result<(), BusError> {
        self.0[input].send(bytes)
    }

    /// Connects to readers that have been opened since.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn refresh(&mut self) -> Result<(), BusError> {
        self.0.iter_mut().try_for_each(|inlet| inlet.refresh())
    }
}

impl Outlets {
    /// Opens a role's outputs for reading.
    ///
    /// # Errors
    /// [`BusError::Open`].
    pub fn open<'a>(scenario: &Scenario, role: RoleId, bus: impl Into<AnyBus<'a>>) -> Result<Self, BusError> {
        let (bus, writes) = (bus.into(), ports(scenario, role).writes);
        Ok(Self(writes.iter().map(|port| port.reader(bus, Reader::Scorer)).collect::<Result<_, _>>()?))
    }
}

/// A comparison of a role's outputs with the recorded ones.
pub struct Comparer<'a> {
    tracks: &'a [Track],
    /// Per output, the index of the next recorded sample to compare.
    next: Vec<usize>,
    /// Per output, the tick after the last received one.
    next_ticks: Vec<u64>,
    realtime: bool,
    limit: Option<u64>,
    /// The tick after the script's last. Later outputs are ignored.
    end: u64,
    samples: u64,
    difference: Option<Difference>,
}

impl<'a> Comparer<'a> {
    /// Creates a comparison with the recorded outputs of a script.
    pub fn new(script: &'a Script) -> Self {
        Self {
            tracks: &script.outputs,
            next: vec![0; script.outputs.len()],
            next_ticks: vec![0; script.outputs.len()],
            end: script.steps.last().map_or(0, |step| step.tick + 1),
            realtime: script.realtime,
            limit: script.limit.as_ref().map(|limit| limit.tick),
            samples: 0,
            difference: None,
        }
    }

    /// Compares the outputs that have arrived. Returns true if there were any.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn take(&mut self, outlets: &mut Outlets) -> Result<bool, BusError> {
        let mut any = false;
        for (output, outlet) in outlets.0.iter_mut().enumerate() {
            while let Some(words) = outlet.next()? {
                any = true;
                self.compare(output, bytemuck::cast_slice(words));
            }
        }
        Ok(any)
    }

    /// Returns true if a sample is to be compared: not warm-up and, in real time, not a no-sample marker. Only the lockstep
    /// replay publishes markers, where the run in real time published nothing.
    fn is_compared(&self, stamp: &Stamp) -> bool {
        stamp.generation != 0 && !(self.realtime && stamp.generation & NO_SAMPLE != 0)
    }

    /// Returns true if a tick is after the part that can be compared.
    fn is_beyond(&self, tick: u64) -> bool {
        tick >= self.end || self.limit.is_some_and(|limit| tick >= limit)
    }

    /// Returns the first tick that some output still lacks.
    pub fn next_tick(&self) -> u64 {
        self.next_ticks.iter().copied().min().unwrap_or(0)
    }

    fn compare(&mut self, output: usize, bytes: &[u8]) {
        let stamp: Stamp = bytemuck::pod_read_unaligned(&bytes[..size_of::<Stamp>()]);
        if stamp.generation != 0 {
            self.next_ticks[output] = self.next_ticks[output].max(stamp.tick.saturating_add(1).min(self.end));
        }
        if !self.is_compared(&stamp) {
            return;
        }
        let track = &self.tracks[output];
        let index = (self.next[output]..).find(|index| !is_sent_again(track, *index)).unwrap_or(track.len());
        self.next[output] = index + 1;
        if self.difference.as_ref().is_some_and(|first| first.tick <= stamp.tick) {
            return;
        }
        if index >= track.len() {
            // After the end of a truncated recording a sample is not a difference.
            if !self.is_beyond(stamp.tick) {
                self.add_difference(stamp.tick, track, None, "nothing".to_owned(), "a sample".to_owned());
            }
            return;
        }
        let recorded = track.stamp(index);
        if self.is_beyond(recorded.tick.min(stamp.tick)) {
            return;
        }
        self.samples += 1;
        for column in &track.info.layout.columns {
            for element in 0..column.count {
                let at = column.offset + 8 * element;
                let (old, new) = (&track.sample(index)[at..at + 8], &bytes[at..at + 8]);
                if old != new && !SENDER.contains(&column.name.as_str()) {
                    let name = column.elements().nth(element);
                    self.add_difference(recorded.tick, track, name, text(column.kind, old), text(column.kind, new));
                    return;
                }
            }
        }
    }

    /// Keeps a difference if it is the earliest.
    fn add_difference(&mut self, tick: u64, track: &Track, field: Option<String>, recorded: String, replayed: String) {
        if self.difference.as_ref().is_none_or(|first| tick < first.tick) {
            let service = track.info.service.clone();
            self.difference = Some(Difference { tick, service, field, recorded, replayed });
        }
    }

    /// Ends the comparison after the executed `steps`. A recorded sample that was not replayed is a difference too.
    pub fn finish(mut self, script: &Script, steps: &[Step], limit: Option<Limit>) -> RoleReplay {
        let end = limit.as_ref().map_or(u64::MAX, |limit| limit.tick);
        // After the last step nothing is sent, not even late samples.
        let sent_before = end.min(steps.last().map_or(0, |step| step.tick + 1));
        for (output, track) in self.tracks.iter().enumerate() {
            let is_compared = |index: &usize| self.is_compared(&track.stamp(*index)) && !is_sent_again(track, *index);
            if let Some(index) = (self.next[output]..track.len()).find(is_compared) {
                let tick = track.stamp(index).tick;
                // An injected delay may have moved the sample past the end.
                if tick.saturating_add(script.late_ticks) < sent_before {
                    self.add_difference(tick, track, None, "a sample".to_owned(), "nothing".to_owned());
                }
            }
        }
        RoleReplay {
            role: script.name.clone(),
            ticks: steps.iter().filter(|step| step.tick < end).count() as u64,
            lives: steps.last().map_or(0, |step| step.generation),
            samples: self.samples,
            difference: self.difference,
            limit,
        }
    }
}

/// Returns true if a successor sent a recorded sample again, because its predecessor was killed after it had sent the sample and
/// before it had noted that. In a replay no role is killed there.
fn is_sent_again(track: &Track, index: usize) -> bool {
    let Some(before) = index.checked_sub(1).filter(|_| index < track.len()) else { return false };
    let (before, again) = (track.stamp(before), track.stamp(index));
    again.tick == before.tick && again.generation & !NO_SAMPLE > before.generation & !NO_SAMPLE
}

/// Formats a value; a floating-point number with its bits.
fn text(kind: FieldKind, bytes: &[u8]) -> String {
    let mut word = [0; 8];
    word.copy_from_slice(bytes);
    match kind {
        FieldKind::U64 => u64::from_le_bytes(word).to_string(),
        FieldKind::F64 => format!("{:?} (0x{:016x})", f64::from_le_bytes(word), u64::from_le_bytes(word)),
    }
}

/// Replays a role in this thread. `scenario` is that of [`Recording::scenario_for_replay`].
///
/// # Errors
/// [`RecordError`].
pub fn replay_in_process(recording: &Recording, scenario: &Scenario, role: RoleId) -> Result<RoleReplay, RecordError> {
    let script = Script::read(recording, scenario, role)?;
    let bus = MemoryBus::new(depths(scenario));
    let ledger = private_ledger(scenario, role);
    let mut outlets = Outlets::open(scenario, role, &bus)?;
    let mut comparer = Comparer::new(&script);
    let mut replayed = ReplayedRole {
        script: &script,
        scenario,
        bus: &bus,
        ledger: &ledger,
        inlets: Inlets::open(scenario, role, &bus)?,
        node: None,
        bytes: Vec::new(),
    };
    for number in 0..script.steps.len() {
        if comparer.is_beyond(script.steps[number].tick) {
            break;
        }
        replayed.execute_step(number, &mut || comparer.take(&mut outlets).map(drop))?;
    }
    Ok(comparer.finish(&script, &script.steps, script.limit.clone()))
}

/// A role that is driven by its script.
struct ReplayedRole<'a> {
    script: &'a Script,
    scenario: &'a Scenario,
    bus: &'a MemoryBus,
    ledger: &'a Ledger,
    inlets: Inlets,
    node: Option<ReadyNode>,
    bytes: Vec<u8>,
}

impl ReplayedRole<'_> {
    /// Executes one step: feeds the recorded inputs tick by tick, and calls `compare` after each.
    fn execute_step(
        &mut self,
        number: usize,
        compare: &mut dyn FnMut() -> Result<(), BusError>,
    ) -> Result<(), NodeError> {
        let step = self.script.steps[number];
        self.restart_until(step)?;
        let Some(node) = &mut self.node else { return Ok(()) };
        let plant = matches!(self.script.role, RoleId::Plant(_));
        if plant {
            node.skip_to(step.tick);
        }
        let mut executed = false;
        for (_, round) in self.script.rounds(number) {
            for (input, item) in round {
                self.script.inputs[input].write(item, &mut self.bytes);
                self.inlets.send(input, &self.bytes)?;
            }
            if !executed && node.poll(RunCondition::Inputs { up_to: step.tick })? == Poll::Executed {
                executed = true;
                if step.finished {
                    node.finish_tick()?;
                }
            }
            compare()?;
        }
        Ok(())
    }

    /// Starts the role, and restarts it until it has the generation of the step.
    fn restart_until(&mut self, step: Step) -> Result<(), NodeError> {
        while self.node.is_none() || self.ledger.generation() < step.generation {
            if let Some(mut predecessor) = self.node.take() {
                predecessor.finish()?;
            }
            let (script, scenario) = (self.script, self.scenario);
            let mut node = build(scenario, script.role, self.bus, self.ledger)?;
            // The state is in private memory, so restoring it does not fail. A generation that executed no tick passes it on.
            if node.restore().is_ok() && self.ledger.generation() >= step.generation {
                // A body skips an outage at once. Other roles pass it tick by tick, because links hold few samples.
                let body = matches!(script.role, RoleId::Plant(_));
                let first_tick = if body && step.generation > 1 { step.tick } else { node.next_tick() };
                node.start(script.grid, first_tick)?;
            }
            self.node = Some(node);
        }
        Ok(())
    }
}
