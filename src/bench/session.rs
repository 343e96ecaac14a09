//! A benchmark run: what it is to do, and what its rows ask of it.

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
    /// Its name.
    pub name: &'static str,
    pub(super) title: &'static str,
    /// What its figures are held against.
    pub targets: &'static [Target],
    pub(super) measure: Measure,
}

/// Measures a row and puts its figures on the board.
pub type Measure = fn(&mut Bench<'_>, &mut Board) -> Result<(), BenchError>;

/// A row by its name, what it is in words, what its figures are held against, and what measures it.
pub const fn row(name: &'static str, title: &'static str, targets: &'static [Target], measure: Measure) -> Row {
    Row { name, title, targets, measure }
}

/// What a benchmark run is to do.
pub struct Bench<'a> {
    /// The rows, in the order of the table.
    pub rows: Vec<Row>,
    /// A smoke run: every row, a second each, figures that mean nothing.
    pub quick: bool,
    /// Its scenarios, name and text; whole runs are of the first.
    pub scenarios: &'a [(&'a str, &'a str)],
    /// The signal that asked the run to end; 0 while none has.
    pub signal: &'a AtomicUsize,
    /// Told what is being measured.
    pub progress: &'a mut dyn FnMut(&str),
}

/// Why a benchmark run failed. Whatever had been started is gone.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum BenchError {
    /// A signal asked for the end.
    #[error("ended by signal {0} before everything was measured")]
    Interrupted(usize),
    /// There is nothing to measure.
    #[error("this program has no scenario of its own to measure; add one with `Program::scenario`")]
    NoScenario,
    /// A scenario cannot be run as a row has to run it.
    #[error(transparent)]
    #[strum(serialize = "refused-scenario")]
    Scenario(#[from] ConfigError),
    /// A domain could not be made.
    #[error(transparent)]
    #[strum(transparent)]
    Domain(#[from] DomainError),
    /// A link failed.
    #[error(transparent)]
    #[strum(transparent)]
    Bus(#[from] BusError),
    /// A run of the product failed.
    #[error(transparent)]
    #[strum(transparent)]
    Launch(#[from] LaunchError),
    /// A peer process could not be started, or left.
    #[error("the measuring peer failed: {0}; its own error is above")]
    #[strum(serialize = "peer-failed")]
    Peer(String),
    /// The operating system refused something.
    #[error("cannot {what}: {source}")]
    #[strum(serialize = "system-refused")]
    System {
        /// What was asked for.
        what: &'static str,
        /// Its reason.
        source: io::Error,
    },
}

impl BenchError {
    pub(super) fn system(what: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::System { what, source }
    }
}

/// A scenario with these overrides, whatever its run is judged by.
pub(super) fn resolve((name, text): (&str, &str), overrides: &[&str]) -> Result<Scenario, BenchError> {
    let overrides: Vec<String> = overrides.iter().chain(&["accept={}"]).map(|text| (*text).to_owned()).collect();
    Ok(Scenario::parse(text, &format!("{name}.toml"), &overrides)?)
}

impl Bench<'_> {
    /// The scenario that is measured: without faults, unwatched, and with every role started by the launcher.
    ///
    /// # Errors
    /// [`BenchError::NoScenario`], [`BenchError::Scenario`].
    pub fn scenario(&self, overrides: &[&str]) -> Result<Scenario, BenchError> {
        let first = self.scenarios.first().ok_or(BenchError::NoScenario)?;
        resolve(*first, &[overrides, &["fault=[]", "watchdog={}", "launch.external=[]"]].concat())
    }

    /// Whether the scenario is the one whose figures have targets.
    pub(super) fn has_targets(&self) -> bool {
        self.scenarios.first() == SHIPPED.first()
    }

    /// Why no target is judged; nothing if all are.
    pub fn unjudged(&self) -> Vec<String> {
        let mut reasons = Vec::new();
        if self.quick {
            reasons.push("a smoke run: everything is exercised, no figure means anything".to_owned());
        }
        if cfg!(debug_assertions) {
            reasons.push("a debug build: its figures are not those of the product; build with --release".to_owned());
        }
        if !self.has_targets() {
            let (of, this) = (SHIPPED[0].0, self.scenarios.first().map_or("none", |(name, _)| *name));
            reasons.push(format!("the targets are those of corotate's scenario {of}, and this is {this}"));
        }
        reasons
    }

    /// Runs a scenario by this program, until `signal` is one.
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

    /// Says what comes next.
    ///
    /// # Errors
    /// [`BenchError::Interrupted`] if the run is to end.
    pub fn next(&mut self, what: &str) -> Result<(), BenchError> {
        self.interrupted()?;
        (self.progress)(what);
        Ok(())
    }

    /// An error if the run is to end.
    pub(super) fn interrupted(&self) -> Result<(), BenchError> {
        match self.signal.load(Ordering::Relaxed) {
            0 => Ok(()),
            signal => Err(BenchError::Interrupted(signal)),
        }
    }

    /// One of two sizes: of a run that counts, and of a smoke run.
    pub fn size<T>(&self, full: T, quick: T) -> T {
        if self.quick { quick } else { full }
    }

    /// Does something with what the leader asks for, and gives it back; told what was granted.
    ///
    /// # Errors
    /// Those of the work, and [`BenchError`] if there is no scenario.
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
        // Where it cannot be had back the rest of the suite stays on the leader's core.
        let _ = cores.map(|cores| sched_setaffinity(None, &cores));
        done
    }
}
