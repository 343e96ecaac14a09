//! A benchmark run: its settings, and the services that it offers to its rows.

use super::board::Board;
use super::targets::Target;
use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::config::{ConfigError, SHIPPED};
use crate::launch::{self, Launch, LaunchError, Outcome, Progress};
use crate::runtime::{Privileges, RoleId, release_priority, take_privileges};
use crate::scenario::Scenario;
use rustix::thread::{sched_getaffinity, sched_setaffinity};
use std::io;
use std::sync::atomic::{AtomicUsize, Ordering};

/// A row of a benchmark.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    /// The name of the row.
    pub name: &'static str,
    pub(super) title: &'static str,
    /// The targets of its figures.
    pub targets: &'static [Target],
    pub(super) measure: Measure,
}

/// A function that measures a row and adds its figures to the board.
pub type Measure = fn(&mut Bench<'_>, &mut Board) -> Result<(), BenchError>;

/// Creates a row from its name, title, targets and measuring function.
pub const fn row(name: &'static str, title: &'static str, targets: &'static [Target], measure: Measure) -> Row {
    Row { name, title, targets, measure }
}

/// The settings of a benchmark run.
pub struct Bench<'a> {
    /// The rows, in the order of the table.
    pub rows: Vec<Row>,
    /// True for a smoke run: every row for about a second, with meaningless figures.
    pub quick: bool,
    /// The name and text of each scenario; whole runs use the first.
    pub scenarios: &'a [(&'a str, &'a str)],
    /// The number of the signal that ends the run; 0 without one.
    pub signal: &'a AtomicUsize,
    /// A callback with the current measurement as text.
    pub progress: &'a mut dyn FnMut(&str),
}

/// The reason why a benchmark run failed. All processes that it started have ended.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum BenchError {
    /// A signal ended the run.
    #[error("ended by signal {0} before everything was measured")]
    Interrupted(usize),
    /// The program has no scenario to measure.
    #[error("this program has no scenario of its own to measure; add one with `Program::scenario`")]
    NoScenario,
    /// A row's variant of the scenario is invalid.
    #[error(transparent)]
    #[strum(serialize = "refused-scenario")]
    Scenario(#[from] ConfigError),
    /// A domain could not be created.
    #[error(transparent)]
    #[strum(transparent)]
    Domain(#[from] DomainError),
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// A run of the program failed.
    #[error(transparent)]
    #[strum(transparent)]
    Launch(#[from] LaunchError),
    /// A peer process could not be started, or ended early.
    #[error("the measuring peer failed: {0}; its own error is above")]
    #[strum(serialize = "peer-failed")]
    Peer(String),
    /// The operating system refused something.
    #[error("cannot {what}: {source}")]
    #[strum(serialize = "system-refused")]
    System {
        /// The refused action.
        what: &'static str,
        /// The system's reason.
        source: io::Error,
    },
}

impl BenchError {
    pub(super) fn system(what: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::System { what, source }
    }
}

/// Resolves a scenario with these overrides and without acceptance criteria.
pub(super) fn resolve((name, text): (&str, &str), overrides: &[&str]) -> Result<Scenario, BenchError> {
    let overrides: Vec<String> = overrides.iter().chain(&["accept={}"]).map(|text| (*text).to_owned()).collect();
    Ok(Scenario::parse(text, &format!("{name}.toml"), &overrides)?)
}

impl Bench<'_> {
    /// Returns the measured scenario: without faults and watchdog, and with every role started by the launcher.
    ///
    /// # Errors
    /// [`BenchError::NoScenario`], [`BenchError::Scenario`].
    pub fn scenario(&self, overrides: &[&str]) -> Result<Scenario, BenchError> {
        let first = self.scenarios.first().ok_or(BenchError::NoScenario)?;
        resolve(*first, &[overrides, &["fault=[]", "watchdog={}", "launch.external=[]"]].concat())
    }

    /// Returns true if the scenario is the one to which the targets apply.
    pub(super) fn has_targets(&self) -> bool {
        self.scenarios.first() == SHIPPED.first()
    }

    /// Returns the reasons why no target is judged; empty if all are.
    pub fn unjudged(&self) -> Vec<String> {
        let mut reasons = Vec::new();
        if self.quick {
            reasons.push("a smoke run: everything is exercised, no figure means anything".to_owned());
        }
        if cfg!(debug_assertions) {
            reasons.push("a debug build: its figures are not those of the product; build with --release".to_owned());
        }
        if !self.has_targets() {
            let (judged, own) = (SHIPPED[0].0, self.scenarios.first().map_or("none", |(name, _)| *name));
            reasons.push(format!("the targets are those of corotate's scenario {judged}, and this is {own}"));
        }
        reasons
    }

    /// Runs a scenario with this program, until `signal` is set.
    pub(super) fn launch(
        &self,
        scenario: &Scenario,
        signal: &AtomicUsize,
        progress: &mut dyn FnMut(&Progress<'_>),
    ) -> Result<Outcome, BenchError> {
        let mut launch = Launch::new(signal, progress);
        let outcome = launch::run(scenario, &mut launch)?;
        self.interrupted()?;
        Ok(outcome)
    }

    /// Reports the next measurement.
    ///
    /// # Errors
    /// [`BenchError::Interrupted`] if the run is to end.
    pub fn next(&mut self, what: &str) -> Result<(), BenchError> {
        self.interrupted()?;
        (self.progress)(what);
        Ok(())
    }

    /// Returns an error if the run is to end.
    pub(super) fn interrupted(&self) -> Result<(), BenchError> {
        match self.signal.load(Ordering::Relaxed) {
            0 => Ok(()),
            signal => Err(BenchError::Interrupted(signal)),
        }
    }

    /// Returns the size for a full run, or for a smoke run.
    pub fn size<T>(&self, full: T, quick: T) -> T {
        if self.quick { quick } else { full }
    }

    /// Calls `work` with the leader's privileges, then gives them back.
    ///
    /// # Errors
    /// The error of `work`, and [`BenchError::NoScenario`] or [`BenchError::Scenario`].
    pub fn in_the_leaders_place<T>(
        &self,
        board: &mut Board,
        work: impl FnOnce(&Privileges) -> Result<T, BenchError>,
    ) -> Result<T, BenchError> {
        let cores = sched_getaffinity(None).ok();
        let scenario = self.scenario(&[])?;
        let place = take_privileges(&scenario, RoleId::Plant(0));
        board.granted(place.grants.clone());
        let done = work(&place);
        release_priority();
        // If the cores cannot be restored, the rest of the benchmark stays on the leader's core.
        let _ = cores.map(|cores| sched_setaffinity(None, &cores));
        done
    }
}
