//! A resolved scenario: every value checked, every default filled in, its rig created; ready to run.
//!
//! | file | duty |
//! |---|---|
//! | `any` | the rig behind a table of functions: the generic code of the modules below, for code that does not know its type |
//! | `registry` | the rigs that scenarios of this program may name |
//! | `resolve` | reads the tables, creates the rig and checks every value |
//! | `schema` | a JSON Schema of scenarios |
//!
//! Modules below know a scenario as its [`Settings`](crate::config::Settings), and the rig as a type parameter. This module reads the scenario file and
//! nothing else of the machine.

mod any;
mod registry;
mod resolve;
mod schema;

pub use any::AnyRig;
pub use registry::{RigKind, register, shipped};
pub use resolve::Scenario;
pub use schema::schema;

use crate::analysis::Claim;
use crate::bus::{AnyBus, BusError};
use crate::config::{ConfigError, Document, sensor};
use crate::runtime::{ReadyNode, RoleImpl};
use crate::score::Scorer;
use crate::telemetry::Ledger;
use std::path::Path;

impl Scenario {
    /// Reads a scenario file, applies overrides and checks everything.
    ///
    /// # Errors
    /// [`ConfigError`], with place, reason and remedy.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        Self::changed(Document::read(path)?, overrides)
    }

    /// Does the same for a text; `origin` stands for the file in error messages.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn parse(text: &str, origin: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        Self::changed(Document::parse(text, origin)?, overrides)
    }

    fn changed(mut document: Document, overrides: &[String]) -> Result<Self, ConfigError> {
        overrides.iter().try_for_each(|argument| document.set(argument))?;
        Self::resolve(document)
    }

    /// Returns notes for readers of the results: on a rounded period, and those of the rig.
    pub fn notes(&self) -> Vec<String> {
        let real_hz = 1e9 / self.period_ns as f64;
        let part = real_hz / self.tick_hz - 1.0;
        let rounded = (part.abs() > 1e-12).then(|| {
            let period_ns = self.period_ns;
            format!("tick_hz {}: a period is a whole number of ns, {period_ns}, so the rate is {real_hz:.9} Hz ({:+.2e} of it)", self.tick_hz, part)
        });
        rounded
            .into_iter()
            .chain(self.rates.notes(self.tick_hz))
            .chain(sensor::notes(&self.sensors, self.tick_hz))
            .chain(self.rig.notes())
            .collect()
    }

    /// Returns the text of the scenario file of its run; the first line names the run.
    pub fn to_file(&self) -> String {
        self.run.map_or(String::new(), |run| format!("# {}\n", run.comment())) + &self.to_toml()
    }

    /// Returns the scenario as the text of a file.
    pub fn to_toml(&self) -> String {
        toml::to_string(&self.resolved).expect("a scenario of plain values is TOML")
    }
}

/// Returns the claims about every driven body's loop.
pub fn claims(scenario: &Scenario) -> Vec<Claim> {
    scenario.rig.claims(scenario)
}

/// Opens a role's links and builds its node. Its counters are in the ledger, which may hold those of a predecessor.
///
/// # Errors
/// [`BusError::Open`].
pub fn build<'a>(
    scenario: &Scenario,
    role_impl: impl Into<RoleImpl>,
    bus: impl Into<AnyBus<'a>>,
    ledger: &Ledger,
) -> Result<ReadyNode, BusError> {
    scenario.rig.node(scenario, role_impl.into(), bus.into(), ledger)
}

/// Opens a scorer on the run's bus.
///
/// # Errors
/// [`BusError::Open`].
pub fn scorer<'a>(scenario: &Scenario, bus: impl Into<AnyBus<'a>>) -> Result<Box<dyn Scorer>, BusError> {
    scenario.rig.scorer(scenario, bus.into())
}
