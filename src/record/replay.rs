//! Recorded inputs through a live, unmodified role, and what it publishes beside what was recorded, bit for bit.
//!
//! Here the role is driven in one thread; [`crate::launch`] does it with a process, by the same script and the same
//! comparison. The time at which a sample was sent is no output and not compared.

use super::RecordError;
use super::reader::{Recording, Track};
use super::script::{Limit, Script, Step};
use crate::bus::memory::MemoryBus;
use crate::bus::{AnyBus, BusError, Reader, WordReader, WordWriter};
use crate::runtime::{NodeError, Poll, ReadyNode, RoleId, RunCondition, depths, ports, private_ledger};
use crate::sample::{FieldKind, NO_SAMPLE, Stamp};
use crate::scenario::Scenario;
use crate::scenario::build;
use crate::telemetry::Ledger;

/// The columns that say by which of a role's processes a sample was sent, and when: no output of the role.
const SENDER: [&str; 2] = ["generation", "sent_ns"];

/// The first thing in which a role's output differs from what was recorded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The tick of the recorded sample, or of the one that is not recorded.
    pub tick: u64,
    /// The signal.
    pub service: String,
    /// Which element of which field; none if one of the two samples does not exist.
    pub field: Option<String>,
    /// What was recorded.
    pub recorded: String,
    /// What the role says now.
    pub replayed: String,
}

/// How one role's replay went.
#[derive(Debug, Clone)]
pub struct RoleReplay {
    /// The role.
    pub role: String,
    /// Ticks that it executed.
    pub ticks: u64,
    /// Lives that it had.
    pub lives: u64,
    /// Samples compared.
    pub samples: u64,
    /// The first difference, if there is any.
    pub difference: Option<Difference>,
    /// From where on nothing can be said.
    pub limit: Option<Limit>,
}

/// Writing ends for a role's inputs.
pub struct Inlets(Vec<WordWriter>);
/// Reading ends for a role's outputs.
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

    /// Sends a sample, given as its bytes, on an input.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn send(&mut self, input: usize, bytes: &[u8]) -> Result<(), BusError> {
        self.0[input].send(bytes)
    }

    /// Lets a reader that has come later know of these ends.
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

/// Compares what a role publishes with what it published.
pub struct Comparer<'a> {
    tracks: &'a [Track],
    /// Per output, the next recorded sample to compare with.
    next: Vec<usize>,
    /// Per output, the tick after the last that has come.
    come: Vec<u64>,
    realtime: bool,
    limit: Option<u64>,
    /// The role may go on beyond its script; that is not looked at.
    end: u64,
    samples: u64,
    difference: Option<Difference>,
}

impl<'a> Comparer<'a> {
    /// A comparison that has not begun.
    pub fn new(script: &'a Script) -> Self {
        Self {
            tracks: &script.outputs,
            next: vec![0; script.outputs.len()],
            come: vec![0; script.outputs.len()],
            end: script.steps.last().map_or(0, |step| step.tick + 1),
            realtime: script.realtime,
            limit: script.limit.as_ref().map(|limit| limit.tick),
            samples: 0,
            difference: None,
        }
    }

    /// Takes whatever has come; true if some has.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn take(&mut self, outlets: &mut Outlets) -> Result<bool, BusError> {
        let mut some = false;
        for (output, outlet) in outlets.0.iter_mut().enumerate() {
            while let Some(words) = outlet.next()? {
                some = true;
                self.compare(output, bytemuck::cast_slice(words));
            }
        }
        Ok(some)
    }

    /// Real time has no voids: in its replay they stand for what was not published.
    fn counts(&self, stamp: &Stamp) -> bool {
        stamp.generation != 0 && !(self.realtime && stamp.generation & NO_SAMPLE != 0)
    }

    fn beyond(&self, tick: u64) -> bool {
        tick >= self.end || self.limit.is_some_and(|limit| tick >= limit)
    }

    /// The tick before which everything has come.
    pub fn next_tick(&self) -> u64 {
        self.come.iter().copied().min().unwrap_or(0)
    }

    fn compare(&mut self, output: usize, bytes: &[u8]) {
        let stamp: Stamp = bytemuck::pod_read_unaligned(&bytes[..size_of::<Stamp>()]);
        if stamp.generation != 0 {
            self.come[output] = self.come[output].max(stamp.tick.saturating_add(1).min(self.end));
        }
        if !self.counts(&stamp) {
            return;
        }
        let (track, index) = (&self.tracks[output], self.next[output]);
        self.next[output] += 1;
        if self.difference.as_ref().is_some_and(|first| first.tick <= stamp.tick) {
            return;
        }
        if index >= track.len() {
            // A recording that was cut off says nothing of what comes after.
            if !self.beyond(stamp.tick) {
                self.differ(stamp.tick, track, None, "nothing".to_owned(), "a sample".to_owned());
            }
            return;
        }
        let recorded = track.stamp(index);
        if self.beyond(recorded.tick.min(stamp.tick)) {
            return;
        }
        self.samples += 1;
        for column in &track.info.layout.columns {
            for element in 0..column.count {
                let at = column.offset + 8 * element;
                let (was, is) = (&track.sample(index)[at..at + 8], &bytes[at..at + 8]);
                if was != is && !SENDER.contains(&column.name.as_str()) {
                    let name = column.elements().nth(element);
                    self.differ(recorded.tick, track, name, words(column.kind, was), words(column.kind, is));
                    return;
                }
            }
        }
    }

    fn differ(&mut self, tick: u64, track: &Track, field: Option<String>, recorded: String, replayed: String) {
        if self.difference.as_ref().is_none_or(|first| tick < first.tick) {
            let service = track.info.service.clone();
            self.difference = Some(Difference { tick, service, field, recorded, replayed });
        }
    }

    /// Closes the comparison of a role up to the step `last`: what is recorded and did not come is a difference too.
    pub fn finish(mut self, script: &Script, steps: &[Step], limit: Option<Limit>) -> RoleReplay {
        let end = limit.as_ref().map_or(u64::MAX, |limit| limit.tick);
        // Behind the last step nothing is sent any more, late or not.
        let sent_before = end.min(steps.last().map_or(0, |step| step.tick + 1));
        for (output, track) in self.tracks.iter().enumerate() {
            if let Some(index) = (self.next[output]..track.len()).find(|index| self.counts(&track.stamp(*index))) {
                let tick = track.stamp(index).tick;
                // One that a fault delayed may have been sent behind the end.
                if tick.saturating_add(script.late_ticks) < sent_before {
                    self.differ(tick, track, None, "a sample".to_owned(), "nothing".to_owned());
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

/// A value for people, with its bits where it is a number.
fn words(kind: FieldKind, bytes: &[u8]) -> String {
    let mut word = [0; 8];
    word.copy_from_slice(bytes);
    match kind {
        FieldKind::U64 => u64::from_le_bytes(word).to_string(),
        FieldKind::F64 => format!("{:?} (0x{:016x})", f64::from_le_bytes(word), u64::from_le_bytes(word)),
    }
}

/// Replays a role of a recording in this thread. `scenario` is the recording's with the clock `lockstep`.
///
/// # Errors
/// [`RecordError`].
pub fn replay_in_process(recording: &Recording, scenario: &Scenario, role: RoleId) -> Result<RoleReplay, RecordError> {
    let script = Script::read(recording, scenario, role)?;
    let bus = MemoryBus::new(depths(scenario));
    let ledger = private_ledger(scenario, role);
    let mut outlets = Outlets::open(scenario, role, &bus)?;
    let mut comparer = Comparer::new(&script);
    let mut stage = Stage {
        script: &script,
        scenario,
        bus: &bus,
        ledger: &ledger,
        inlets: Inlets::open(scenario, role, &bus)?,
        node: None,
        bytes: Vec::new(),
    };
    for number in 0..script.steps.len() {
        if comparer.beyond(script.steps[number].tick) {
            break;
        }
        stage.play(number, &mut || comparer.take(&mut outlets).map(drop))?;
    }
    Ok(comparer.finish(&script, &script.steps, script.limit.clone()))
}

/// A role on its stage.
struct Stage<'a> {
    script: &'a Script,
    scenario: &'a Scenario,
    bus: &'a MemoryBus,
    ledger: &'a Ledger,
    inlets: Inlets,
    node: Option<ReadyNode>,
    bytes: Vec<u8>,
}

impl Stage<'_> {
    /// Plays one step: feeds what the role had, one tick after the other, and lets it execute.
    fn play(&mut self, number: usize, look: &mut dyn FnMut() -> Result<(), BusError>) -> Result<(), NodeError> {
        let step = self.script.steps[number];
        self.enter(step)?;
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
            look()?;
        }
        Ok(())
    }

    /// Builds the role anew for every life that it had.
    fn enter(&mut self, step: Step) -> Result<(), NodeError> {
        while self.node.is_none() || self.ledger.generation() < step.generation {
            if let Some(mut left) = self.node.take() {
                left.finish()?;
            }
            let (script, scenario) = (self.script, self.scenario);
            let mut node = build(scenario, script.role, self.bus, self.ledger)?;
            // Memory of one's own is always open. A life without a tick hands on what it was given.
            if node.restore().is_ok() && self.ledger.generation() >= step.generation {
                // Others than a body pass over what the outage took tick by tick: of a long one the links would not hold all.
                let body = matches!(script.role, RoleId::Plant(_));
                let first_tick = if body && step.generation > 1 { step.tick } else { node.next_tick() };
                node.start(script.grid, first_tick)?;
            }
            self.node = Some(node);
        }
        Ok(())
    }
}
