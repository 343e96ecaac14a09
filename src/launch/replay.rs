//! Replays a recorded role as a process: the program that takes part in runs, in a domain of its own, fed in lockstep.
//!
//! One role at a time. Must not judge: [`crate::record`] selects the role's inputs and compares its outputs.

use super::children::{END_LIMIT, RoleProcess};
use super::error::LaunchError;
use super::janitor::Janitor;
use super::processes::share_changes;
use crate::bus::domain::OwnedDomain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal, Write};
use crate::clock::{monotonic_ns, sleep_until};
use crate::record::{Comparer, Inlets, Limit, Outlets, Recording, RoleReplay, Script};
use crate::runtime::{Backoff, Interruptions, RoleId, depths, shared_memory_bytes, topic, window_ticks};
use crate::sample::{Health, Phase, RoleState, Schedule, Stamp};
use crate::scenario::Scenario;
use crate::seat::{scenario_path, write_whole};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Interval between two looks while nothing comes, ns.
const LULL_NS: u64 = 50_000;
/// The time without progress after which the role counts as hung, ns.
const HUNG_NS: u64 = 30_000_000_000;

/// Replays a role of a recording as a process. `scenario` is the recording's with the clock `lockstep`; `signal` ends it.
///
/// # Errors
/// [`LaunchError`].
pub fn replay_as_process(
    recording: &Recording,
    scenario: &Scenario,
    role: RoleId,
    signal: &AtomicUsize,
) -> Result<RoleReplay, LaunchError> {
    let mut script = Script::read(recording, scenario, role)?;
    cut(&mut script, scenario);
    let owned = OwnedDomain::create(shared_memory_bytes(scenario))?;
    let domain = owned.domain();
    let path = scenario_path(domain);
    write_whole(&path, without_interruptions(scenario).as_bytes())
        .map_err(|source| LaunchError::Write { path, source })?;
    share_changes(scenario, domain)?;
    let _janitor = Janitor::start(domain, Duration::from_secs_f64(scenario.startup_timeout_s))?;
    let bus = IoxBus::enter(domain, "replay", depths(scenario))?;
    let mut prompter = Prompter {
        schedule: bus.writer(&topic(scenario, "run", Signal::Schedule), 1)?,
        health: bus.reader(&topic(scenario, &script.name, Signal::Health), Reader::Role)?,
        word: Schedule { epoch_ns: script.grid.epoch_ns, ..Schedule::default() },
        inlets: Inlets::open(scenario, role, &bus)?,
        outlets: Outlets::open(scenario, role, &bus)?,
        comparer: Comparer::new(&script),
        process: RoleProcess::start(scenario, role, domain)?,
        signal,
        script: &script,
        moved_ns: monotonic_ns(),
        next_word_ns: 0,
        // Less than the links hold, and than the role's window.
        ahead_ticks: window_ticks(scenario) * 3 / 4,
    };
    prompter.lead()?;
    prompter.shut_down();
    Ok(prompter.comparer.finish(&script, &script.steps, script.limit.clone()))
}

/// Removes the steps, with a note, that a single process cannot repeat.
fn cut(script: &mut Script, scenario: &Scenario) {
    let plant = matches!(script.role, RoleId::Plant(_));
    // A scripted miss also happens in the replay.
    let (mut next, mut interruptions) = (0, Interruptions::for_role(scenario, &script.name, 1, 0));
    let broken = script.steps.iter().find_map(|step| {
        let missed = plant && (next..step.tick).any(|tick| !interruptions.misses(tick));
        next = step.tick + 1;
        match (missed, step.generation) {
            (true, _) => Some((step.tick, "in lockstep a body cannot miss a tick; replay it without --processes")),
            (_, 2..) => Some((step.tick, "its process died there; replay its next life without --processes")),
            _ => None,
        }
    });
    let limit = broken.map(|(tick, reason)| Limit { tick, reason: reason.to_owned() });
    let first = [script.limit.take(), limit].into_iter().flatten().min_by_key(|limit| limit.tick);
    if let Some(limit) = &first {
        script.steps.retain(|step| step.tick < limit.tick);
    }
    script.limit = first;
}

/// Returns the scenario without stalls and kills, whose effect is in the recording already. Every role has a process of its own
/// here.
fn without_interruptions(scenario: &Scenario) -> String {
    let mut table = scenario.resolved.clone();
    if let Some(launch) = table.get_mut("launch").and_then(toml::Value::as_table_mut) {
        launch.remove("processes");
    }
    if let Some(faults) = table.get_mut("fault").and_then(toml::Value::as_array_mut) {
        let interrupts = |fault: &toml::Value| {
            fault.get("kind").and_then(toml::Value::as_str).is_some_and(|kind| ["stall", "kill"].contains(&kind))
        };
        faults.retain(|fault| !interrupts(fault));
    }
    toml::to_string(&table).expect("a scenario of plain values is TOML")
}

/// Runs the phases of a run with the process, and feeds it its recorded inputs.
struct Prompter<'a> {
    schedule: <IoxBus as Bus>::Writer<Schedule>,
    health: <IoxBus as Bus>::Reader<Health>,
    word: Schedule,
    inlets: Inlets,
    outlets: Outlets,
    comparer: Comparer<'a>,
    process: RoleProcess,
    signal: &'a AtomicUsize,
    script: &'a Script,
    moved_ns: u64,
    next_word_ns: u64,
    /// The lead of the inputs over the outputs.
    ahead_ticks: u64,
}

impl Prompter<'_> {
    fn lead(&mut self) -> Result<(), LaunchError> {
        for (phase, state) in [(Phase::Gather, RoleState::Open), (Phase::WarmUp, RoleState::Ready)] {
            self.word.phase = phase as u64;
            let mut reached = RoleState::Absent;
            while reached < state && self.goes_on()? {
                self.announce()?;
                self.inlets.refresh()?;
                self.comparer.take(&mut self.outlets)?;
                std::thread::sleep(Duration::from_millis(1));
                while self.health.advance()? {}
                reached = self.health.current().map_or(reached, |health| RoleState::from_number(health.state));
            }
        }
        self.word.phase = Phase::Run as u64;
        self.announce()?;
        let mut bytes = Vec::new();
        for number in 0..self.script.steps.len() {
            for (tick, round) in self.script.rounds(number) {
                self.await_tick(tick.saturating_sub(self.ahead_ticks))?;
                for (input, item) in round {
                    self.script.inputs[input].write(item, &mut bytes);
                    self.inlets.send(input, &bytes)?;
                }
            }
        }
        self.await_tick(self.script.steps.last().map_or(0, |step| step.tick + 1))
    }

    /// Waits until all outputs before a tick have come.
    fn await_tick(&mut self, tick: u64) -> Result<(), LaunchError> {
        let mut backoff = Backoff::default();
        loop {
            let some = self.comparer.take(&mut self.outlets)?;
            let next = self.comparer.next_tick();
            if some {
                (self.moved_ns, backoff) = (monotonic_ns(), Backoff::default());
            }
            if next >= self.word.credit_tick + self.ahead_ticks / 2 || monotonic_ns() >= self.next_word_ns {
                self.word.credit_tick = next;
                self.announce()?;
                self.next_word_ns = monotonic_ns() + 1_000_000;
            }
            if next >= tick || !self.goes_on()? {
                return Ok(());
            }
            if !backoff.brief() {
                sleep_until(monotonic_ns() + LULL_NS);
            }
        }
    }

    /// Returns false if a signal ended the replay.
    fn goes_on(&mut self) -> Result<bool, LaunchError> {
        if let Some(status) = self.process.ended() {
            let failure = self.process.failure(status);
            let (cause, last_words) = (failure.cause, failure.last_words);
            return Err(LaunchError::Died { role: self.script.name.clone(), cause, last_words });
        }
        if monotonic_ns() > self.moved_ns + HUNG_NS {
            let limit_s = HUNG_NS as f64 / 1e9;
            return Err(LaunchError::Hung { limit_s, roles: self.script.name.clone() });
        }
        Ok(self.signal.load(Ordering::Relaxed) == 0)
    }

    fn announce(&mut self) -> Result<(), BusError> {
        let tick = self.word.stamp.tick + 1;
        self.word.stamp = Stamp { tick, generation: 1, origin_ns: 0, sent_ns: monotonic_ns() };
        let word = self.word;
        self.schedule.send(|sample| *sample = word)
    }

    fn shut_down(&mut self) {
        self.word.phase = Phase::Stop as u64;
        let limit_ns = monotonic_ns() + END_LIMIT.as_nanos() as u64;
        while self.process.ended().is_none() && monotonic_ns() < limit_ns {
            // A link that fails now changes nothing: the process is killed.
            let _ = self.announce();
            std::thread::sleep(Duration::from_millis(1));
        }
        self.process.kill();
    }
}
