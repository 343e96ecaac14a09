//! The rates of the roles: a controller and an observer may compute at every n-th tick only, and bodies may be integrated in smaller
//! steps than a tick.
//!
//! The tables `controller` and `observer` also hold the keys of a rig. This file must not know these.

use super::checks::Checks;
use super::document::Document;
use super::error::ConfigError;
use super::sensor::{EVERY_MAX, common_multiple};
use serde::Deserialize;
use toml::Table;

/// The most steps of a tick.
const SUBSTEPS_MAX: u64 = 10_000;

/// The rates of the roles. Bodies move at every tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rates {
    /// The controller computes at every n-th tick, from tick 0 on; in between it sends the last commands again.
    pub controller_ticks: u64,
    /// The same for the observer and its estimate.
    pub observer_ticks: u64,
    /// The ticks after which the pattern of all sensors repeats; 1 if all measure at every tick.
    pub sensor_ticks: u64,
    /// The number of equal steps in which a body moves over a tick.
    pub substeps: u64,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawRole {
    #[serde(default = "every_tick")]
    every_ticks: u64,
}

impl Default for RawRole {
    fn default() -> Self {
        Self { every_ticks: every_tick() }
    }
}

#[derive(Debug, Default, Deserialize)]
struct RawRoles {
    #[serde(default)]
    controller: RawRole,
    #[serde(default)]
    observer: RawRole,
}

fn every_tick() -> u64 {
    1
}

impl Rates {
    /// Every role computes at every tick.
    pub const ALL: Self = Self { controller_ticks: 1, observer_ticks: 1, sensor_ticks: 1, substeps: 1 };

    /// Moves the keys of the rates out of a scenario. `rig_tables` are the tables whose other keys belong to a rig.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub(crate) fn split_off(document: &mut Document, rig_tables: &[&str]) -> Result<Self, ConfigError> {
        let mut every = |table: &str| {
            let of_rig = rig_tables.contains(&table);
            let split = document.split_off_within(table, |key| key == "every_ticks" || !of_rig);
            if !of_rig {
                document.split_off(&[table]);
            }
            split.read_into::<RawRoles>()
        };
        let (controller, observer) = (every("controller")?, every("observer")?);
        let (controller_ticks, observer_ticks) = (controller.controller.every_ticks, observer.observer.every_ticks);
        Ok(Self { controller_ticks, observer_ticks, ..Self::ALL })
    }

    /// Checks the rates. `timeout_ticks` is the command timeout of the actuators.
    pub(crate) fn check(self, timeout_ticks: u64, last_tick: u64, checks: &mut Checks<'_>) {
        for (key, ticks, most) in [
            ("controller.every_ticks", self.controller_ticks, EVERY_MAX),
            ("observer.every_ticks", self.observer_ticks, EVERY_MAX),
            ("substeps", self.substeps, SUBSTEPS_MAX),
        ] {
            checks.require((1..=most).contains(&ticks), key, "out-of-range", || {
                format!("{ticks} is out of range; give a number from 1 to {most}")
            });
            if key != "substeps" && ticks > last_tick.max(1) {
                checks.warn(key, format!("the run ends at tick {last_tick}: the role computes at tick 0 only"));
            }
        }
        if self.controller_ticks > timeout_ticks {
            checks.warn(
                "actuator.command_timeout_ticks",
                format!(
                    "{timeout_ticks} is less than controller.every_ticks = {}: one missing command leads to the safe \
                     command; raise it",
                    self.controller_ticks
                ),
            );
        }
    }

    /// Writes the rates that differ from 1 into a resolved scenario.
    pub(crate) fn write(self, resolved: &mut Table) {
        let roles = [("controller", self.controller_ticks), ("observer", self.observer_ticks)];
        for (table, ticks) in roles.into_iter().filter(|(_, ticks)| *ticks != 1) {
            let table = resolved.entry(table).or_insert_with(|| Table::new().into());
            table.as_table_mut().map(|table| table.insert("every_ticks".to_owned(), (ticks as i64).into()));
        }
    }

    /// Returns the ticks after which the pattern of roles and sensors repeats.
    pub fn pattern_ticks(self) -> u64 {
        common_multiple(self.controller_ticks, self.update_ticks())
    }

    /// Returns a bound on the ticks between two corrections of the estimate, if every one of them needs all sensors.
    pub fn update_ticks(self) -> u64 {
        common_multiple(self.observer_ticks, self.sensor_ticks)
    }

    /// Returns a sentence about each role that does not compute at every tick.
    pub fn notes(self, tick_hz: f64) -> Vec<String> {
        let roles = [("controller", self.controller_ticks), ("observer", self.observer_ticks)];
        let slower = roles.into_iter().filter(|(_, ticks)| *ticks != 1);
        slower
            .map(|(role, ticks)| {
                format!(
                    "the {role} computes at every {ticks} ticks, at {} Hz; in between its last sample holds",
                    tick_hz / ticks as f64
                )
            })
            .collect()
    }
}
