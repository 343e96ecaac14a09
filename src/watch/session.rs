//! A session with a run: finds it, joins it, and leaves as soon as it ends.
//!
//! Must not stay in the domain after the run has ended, since its owner removes the domain.

use super::error::WatchError;
use super::feed::{Feed, POLL_NS};
use super::model::Model;
use super::tune::Tune;
use crate::bus::domain::Domain;
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal};
use crate::clock::{Grid, monotonic_ns, sleep_until};
use crate::late::LateFollower;
use crate::runtime::{PaceBoard, depths, join_at_low_priority, topic, with_realtime_priority};
use crate::sample::{Phase, Schedule};
use crate::scenario::Scenario;
use crate::seat::{RoleError, find_run, join_complete};
use std::path::Path;

/// The nice value of the watcher.
const NICENESS: i32 = 10;
/// The time that a run may take to open its signals, ns.
const JOIN_NS: u64 = 10_000_000_000;

/// A watched run.
pub struct Session {
    domain: Domain,
    scenario: Scenario,
    joined: Option<Joined>,
    /// The content of the screen.
    pub model: Model,
}

/// The open links; they are dropped before the bus, in the order of the fields.
struct Joined {
    feed: Feed,
    schedule: <IoxBus as Bus>::Reader<Schedule>,
    late: Option<LateFollower>,
    pace: Option<PaceBoard>,
    _bus: IoxBus,
}

impl Joined {
    fn open(
        domain: &Domain,
        scenario: &Scenario,
        may_wait: impl Fn() -> bool,
        model: &mut Model,
    ) -> Result<Self, BusError> {
        let bus = retry(&may_wait, || IoxBus::join(domain, "watch", depths(scenario)))?;
        let feed = retry(&may_wait, || Feed::open(scenario, &bus, model))?;
        let schedule = bus.reader(&topic(scenario, "run", Signal::Schedule), Reader::Role)?;
        // A watcher of a run without such a device shows nothing.
        let pace = PaceBoard::existing(domain).unwrap_or_default();
        Ok(Self { feed, schedule, late: LateFollower::open(domain, scenario), pace, _bus: bus })
    }
}

impl Session {
    /// Joins the run with the given domain or output directory, or the newest run of this user. Waits for a run that is
    /// starting, until `stop` returns true.
    ///
    /// # Errors
    /// [`WatchError`].
    pub fn open(directory: Option<&Path>, stop: impl Fn() -> bool) -> Result<Self, WatchError> {
        let root = find_run(directory)?;
        let end_ns = monotonic_ns() + JOIN_NS;
        let may_wait = || monotonic_ns() < end_ns && !stop();
        let (domain, scenario) = retry(may_wait, || join_complete(&root))?;
        let mut model = Model {
            scenario: scenario.name.clone(),
            clock: scenario.clock.name(),
            domain: root.display().to_string(),
            last_tick: scenario.last_tick,
            tick_s: scenario.tick_s(),
            ..Model::default()
        };
        let joined =
            join_at_low_priority(&scenario, NICENESS, || Joined::open(&domain, &scenario, may_wait, &mut model));
        Ok(Self { joined: Some(joined.map_err(|source| WatchError::Join { source })?), domain, scenario, model })
    }

    /// Reads the new samples, and sets `model.ended` when the run has ended. Must be called about every 0.1 s.
    ///
    /// # Errors
    /// [`WatchError::Bus`].
    pub fn poll(&mut self) -> Result<(), WatchError> {
        let Some(Joined { feed, schedule, late, pace, .. }) = &mut self.joined else { return Ok(()) };
        while schedule.advance()? {}
        let current = schedule.current().copied().unwrap_or_default();
        let phase = Phase::from_number(current.phase);
        let grid = Grid { epoch_ns: current.epoch_ns, period_ns: self.scenario.period_ns };
        feed.poll((phase >= Phase::Run).then_some(grid), &mut self.model)?;
        self.model.late = late.as_mut().map(|late| late.poll(&self.scenario).clone());
        self.model.pace = pace.as_ref().and_then(PaceBoard::status);
        if phase == Phase::Stop || !self.domain.exists() {
            self.leave();
        }
        Ok(())
    }

    /// Starts to tune the run; `None` if that is not possible.
    pub(super) fn tune(&self) -> Option<Tune> {
        Tune::start(self.domain.root())
    }

    /// Updates the parts of the model that only a screen needs.
    pub fn refresh(&mut self) {
        if let Some(Joined { feed, .. }) = &self.joined {
            feed.refresh(&mut self.model);
        }
    }

    /// Watches without a screen for the given time, ns, or until the run ends or `stop` returns true.
    ///
    /// # Errors
    /// [`WatchError::Bus`].
    pub fn follow(&mut self, ns: u64, stop: impl Fn() -> bool) -> Result<(), WatchError> {
        let end_ns = monotonic_ns().saturating_add(ns);
        while !self.model.ended && !stop() && monotonic_ns() < end_ns {
            self.poll()?;
            sleep_until(monotonic_ns() + POLL_NS);
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

/// Repeats an attempt while its error may be temporary: a starting run creates its parts one after another.
fn retry<T, E>(may_wait: impl Fn() -> bool, mut attempt: impl FnMut() -> Result<T, E>) -> Result<T, E>
where
    E: Retry,
{
    loop {
        match attempt() {
            Err(error) if error.is_temporary() && may_wait() => sleep_until(monotonic_ns() + POLL_NS),
            result => return result,
        }
    }
}

/// An error that a starting run may cause.
trait Retry {
    /// Returns true if a later attempt may succeed.
    fn is_temporary(&self) -> bool;
}

impl Retry for RoleError {
    /// A domain without a scenario is about to get one. A directory without a lock never becomes a domain.
    fn is_temporary(&self) -> bool {
        matches!(self, Self::Config(crate::config::ConfigError::Read { .. }))
    }
}

impl Retry for BusError {
    fn is_temporary(&self) -> bool {
        true
    }
}
