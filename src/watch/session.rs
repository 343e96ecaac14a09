//! A run that is watched: found, joined, and left as soon as it ends.
//!
//! Must not outstay the run in its domain: whoever owns that removes it, and expects it to stay removed.

use super::WatchError;
use super::feed::{Feed, LOOK_NS};
use super::model::Model;
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal};
use crate::clock::{Grid, monotonic_ns, sleep_until};
use crate::runtime::{depths, join_at_low_priority, topic, with_realtime_priority};
use crate::sample::{Phase, Schedule};
use crate::scenario::Scenario;
use crate::seat::{RoleError, find_run, join_complete};
use std::path::Path;

/// How much a watcher gives way to everybody.
const NICENESS: i32 = 10;
/// For so long a run may still be opening its signals, ns.
const JOIN_NS: u64 = 10_000_000_000;

/// A run that is watched.
pub struct Session {
    domain: Domain,
    scenario: Scenario,
    joined: Option<Joined>,
    /// What there is to see.
    pub model: Model,
}

/// The links go before the node that they belong to.
struct Joined {
    feed: Feed,
    schedule: <IoxBus as Bus>::Reader<Schedule>,
    _bus: IoxBus,
}

impl Joined {
    fn open(
        domain: &Domain,
        scenario: &Scenario,
        patient: impl Fn() -> bool,
        model: &mut Model,
    ) -> Result<Self, BusError> {
        let bus = insist(&patient, || IoxBus::join(domain, "watch", depths(scenario)))?;
        let feed = insist(&patient, || Feed::open(scenario, &bus, model))?;
        let schedule = bus.reader(&topic(scenario, "run", Signal::Schedule), Reader::Role)?;
        Ok(Self { feed, schedule, _bus: bus })
    }
}

impl Session {
    /// Joins the run in that domain, or with its results in that directory, or the newest of this user. Waits for one that is
    /// only just being started, until `stop` says so.
    ///
    /// # Errors
    /// [`WatchError`].
    pub fn open(directory: Option<&Path>, stop: impl Fn() -> bool) -> Result<Self, WatchError> {
        let root = find_run(directory)?;
        let end_ns = monotonic_ns() + JOIN_NS;
        let patient = || monotonic_ns() < end_ns && !stop();
        let (domain, scenario) = insist(patient, || join_complete(&root))?;
        let mut model = Model {
            scenario: scenario.name.clone(),
            clock: scenario.clock.name(),
            domain: root.display().to_string(),
            last_tick: scenario.last_tick,
            tick_s: scenario.tick_s(),
            ..Model::default()
        };
        let joined =
            join_at_low_priority(&scenario, NICENESS, || Joined::open(&domain, &scenario, patient, &mut model));
        Ok(Self { joined: Some(joined.map_err(|source| WatchError::Join { source })?), domain, scenario, model })
    }

    /// Takes what has come. To be called every 0.1 s or so; the model tells when the run has ended.
    ///
    /// # Errors
    /// [`WatchError::Bus`].
    pub fn look(&mut self) -> Result<(), WatchError> {
        let Some(Joined { feed, schedule, .. }) = &mut self.joined else { return Ok(()) };
        while schedule.advance()? {}
        let word = schedule.current().copied().unwrap_or_default();
        let phase = Phase::from_number(word.phase);
        let grid = Grid { epoch_ns: word.epoch_ns, period_ns: self.scenario.period_ns };
        feed.look((phase >= Phase::Run).then_some(grid), &mut self.model)?;
        if phase == Phase::Stop || !self.domain.exists() {
            self.leave();
        }
        Ok(())
    }

    /// Brings what is only for the eye up to date.
    pub fn refresh(&mut self) {
        if let Some(Joined { feed, .. }) = &self.joined {
            feed.tell(&mut self.model);
        }
    }

    /// Watches without a screen for so long, ns, or until the run ends, or `stop` says so.
    ///
    /// # Errors
    /// [`WatchError::Bus`].
    pub fn follow(&mut self, ns: u64, stop: impl Fn() -> bool) -> Result<(), WatchError> {
        let end_ns = monotonic_ns().saturating_add(ns);
        while !self.model.ended && !stop() && monotonic_ns() < end_ns {
            self.look()?;
            sleep_until(monotonic_ns() + LOOK_NS);
        }
        self.refresh();
        Ok(())
    }

    fn leave(&mut self) {
        self.refresh();
        if let Some(joined) = self.joined.take() {
            with_realtime_priority(|| drop(joined));
            self.model.ended = true;
            self.domain.remove_if_over();
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        self.leave();
    }
}

/// Tries again and again: a run that was just started makes one thing after another.
fn insist<T, E>(patient: impl Fn() -> bool, mut attempt: impl FnMut() -> Result<T, E>) -> Result<T, E>
where
    E: Retry,
{
    loop {
        match attempt() {
            Err(error) if error.may_pass() && patient() => sleep_until(monotonic_ns() + LOOK_NS),
            other => return other,
        }
    }
}

/// Whether an error may be one of a run that is only just being started.
trait Retry {
    fn may_pass(&self) -> bool;
}

impl Retry for RoleError {
    /// A directory without a lock is no domain and will be none; one without a scenario is about to have it.
    fn may_pass(&self) -> bool {
        matches!(self, Self::Config(crate::config::ConfigError::Read { .. }))
    }
}

impl Retry for BusError {
    fn may_pass(&self) -> bool {
        true
    }
}
