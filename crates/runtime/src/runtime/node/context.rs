//! The context of a node: bus, settings, role, ledger and clock, and the links that follow from these.

use super::ports::{ports, topic};
use crate::bus::{Bus, BusError, Carried, Port, Reader, Signal, Topic};
use crate::clock::{Clock, Grid};
use crate::config::{BodyInfo, ClockKind, InputUser, Settings};
use crate::role::Guard;
use crate::runtime::disturb::{Disturbance, Interruptions, LateSamples, extra_samples, late_samples};
use crate::runtime::link::{AcceptedTicks, Extent, Input, Output, RetainedSamples};
use crate::runtime::role_id::RoleId;
use crate::runtime::role_inputs::RoleInputs;
use crate::runtime::window_ticks;
use crate::state::{Persist, StoredWords};
use crate::telemetry::{LateLog, Ledger, TickCounters};

/// Pause between two polls of a device's line, ns.
pub(super) const LOOK_NS: u64 = 50_000;

/// The context from which a node opens its links.
pub struct NodeContext<'a, B> {
    pub(super) bus: &'a B,
    pub(super) scenario: &'a Settings,
    pub(super) role: RoleId,
    pub(super) generation: u64,
    pub(super) ledger: Ledger,
    pub(super) clock: Clock,
}

impl<B: Bus> NodeContext<'_, B> {
    pub(super) fn input<S, G: Guard<S>>(
        &self,
        body: &BodyInfo,
        signal: Signal,
        guard: G,
    ) -> Result<Input<B, S, G>, BusError>
    where
        S: Carried + ?Sized,
    {
        // If inputs of one tick may arrive ticks apart, the newest sample of each is not enough.
        let lags = self.scenario.lag_ticks(self.role.name(self.scenario)) > 1;
        self.input_of(body, signal, guard, if lags { Reader::Scorer } else { Reader::Role })
    }

    pub(super) fn input_of<S, G: Guard<S>>(
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
        let mut input = Input::open_many(self.bus, &topic, body.bodies(), reader)?
            .with_recovery(self.retained(&topic), body.bodies(), self.generation > 1)
            .with_late(LateSamples::for_signal(self.scenario, signal, &body.name))
            .with_guard(guard);
        input.expect(accepted_ticks(self.scenario, None));
        Ok(input)
    }

    /// Returns the retained samples of a signal's writer.
    fn retained(&self, topic: &Topic) -> Option<RetainedSamples> {
        retained_samples(self.scenario, topic, |writer| {
            let path = self.ledger.path()?.with_file_name(ledger_file(self.scenario, writer));
            Ledger::shared(&path, ledger_words(self.scenario, writer)).ok()
        })
    }

    pub(super) fn output<S: Carried + ?Sized>(
        &self,
        body: &BodyInfo,
        signal: Signal,
    ) -> Result<Output<B, S>, BusError> {
        let topic = topic(self.scenario, &body.name, signal);
        let (bodies, extent) = (body.bodies(), extent(self.scenario));
        let output = Output::open(self.bus, &topic, bodies, self.generation, &self.ledger, extent)?;
        // No role reads the truth, and the score must be based on the real state.
        let disturbance = match signal {
            Signal::Truth => None,
            _ => {
                let role = self.role.name(self.scenario);
                Disturbance::for_signal(self.scenario, role, &body.name, bodies, next_tick(&self.ledger))
            }
        };
        // In a shared process, readers of the latest value come first; all other readers follow once the tick is done.
        let alone = self.role.process_role(self.scenario).process_members(self.scenario).len() == 1;
        let output = if alone { output } else { output.latest_first() };
        Ok(output.with_markers(self.scenario.clock != ClockKind::Realtime).disturbed(disturbance))
    }

    /// Returns the inputs of the users for which `uses` returns true.
    pub(super) fn inputs(&self, uses: impl Fn(InputUser) -> bool) -> RoleInputs {
        RoleInputs::new(&self.scenario.inputs, uses)
    }

    pub(super) fn interruptions(&self) -> Interruptions {
        let role = self.role.name(self.scenario);
        Interruptions::for_role(self.scenario, role, self.generation, next_tick(&self.ledger))
    }
}

/// Returns the retained samples of a signal, which lie in the ledger of its writer; `open` opens that ledger.
pub fn retained_samples(
    scenario: &Settings,
    topic: &Topic,
    open: impl Fn(RoleId) -> Option<Ledger>,
) -> Option<RetainedSamples> {
    let extent = extent(scenario);
    let writers = if extent.retained_samples == 0 { Vec::new() } else { RoleId::all(scenario) };
    writers.into_iter().find_map(|writer| {
        let written = ports(scenario, writer).writes;
        let index = written.iter().position(|port| port.topic == *topic)?;
        let (ledger, length) = (open(writer)?, words(&written[index]));
        ledger.take(words_of(&written[..=index], extent) - RetainedSamples::words(extent.retained_samples, length));
        RetainedSamples::open(&ledger, extent.retained_samples, length)
    })
}

/// Returns the ticks that samples may have; in real time this needs the grid.
pub fn accepted_ticks(scenario: &Settings, grid: Option<Grid>) -> AcceptedTicks {
    match (scenario.clock, grid) {
        (ClockKind::Realtime, None) => AcceptedTicks::Unknown,
        (ClockKind::Realtime, Some(grid)) => AcceptedTicks::Due(grid),
        (ClockKind::Lockstep | ClockKind::InProcess, _) => AcceptedTicks::Next,
    }
}

/// Returns the number of words in a role's ledger besides its record.
pub fn ledger_words(scenario: &Settings, role: RoleId) -> usize {
    let late = if scenario.keeps_late_ticks() { LateLog::words(scenario.roles().len()) } else { 0 };
    words_of(&ports(scenario, role).writes, extent(scenario)) + late
}

/// Returns the records of a role's late ticks, if the scenario asks for them.
pub fn late_log(scenario: &Settings, role: RoleId, ledger: &Ledger) -> Option<LateLog> {
    let ledger = ledger.reopened();
    ledger.take(words_of(&ports(scenario, role).writes, extent(scenario)));
    scenario.keeps_late_ticks().then(|| LateLog::open(&ledger, scenario.roles().len()))
}

pub(super) fn words_of(written: &[Port], extent: Extent) -> usize {
    written.iter().map(|port| extent.words(words(port))).sum()
}

/// Returns the length of a sample, words.
pub(super) fn words(port: &Port) -> usize {
    port.size / size_of::<u64>()
}

/// Returns the file name of a role's ledger.
pub fn ledger_file(scenario: &Settings, role: RoleId) -> String {
    format!("{}.books", role.name(scenario))
}

/// Returns the size of the ledger's part for writing ends. In lockstep a sample may be in flight for the window and a
/// little longer, because a tick is scored before its command is used; like links, this is twice the window.
pub(super) fn extent(scenario: &Settings) -> Extent {
    let lockstep = scenario.clock == ClockKind::Lockstep;
    let retained_samples = if lockstep {
        2 * window_ticks(scenario) * (1 + extra_samples(scenario) as u64) + late_samples(scenario) as u64
    } else {
        0
    };
    Extent { last_tick: scenario.last_tick, retained_samples }
}

/// Returns the next tick of a role according to its ledger.
pub fn next_tick(ledger: &Ledger) -> u64 {
    let mut ticks = TickCounters::default();
    ticks.persist(&mut StoredWords(&ledger.record().unwrap_or_default()));
    ticks.next()
}
