//! An incident: a role that failed while the ticks ran, and the launcher's reaction. Must not decide about the reaction.

use crate::panics::Panic;
use crate::telemetry::{Ledger, Outage};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// A role that failed while the ticks ran, and the reaction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Incident {
    /// The number within the run, from 1; recoveries refer to it.
    #[serde(default)]
    pub id: u64,
    /// The role.
    pub role: String,
    /// True if the role is another program, whose end the launcher cannot see.
    pub external: bool,
    /// Other roles in the same process, which failed with it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub with: Vec<String>,
    /// The role's generation.
    pub generation: u64,
    /// The first tick that it did not finish.
    pub tick: u64,
    /// The time of that tick, s from the first one.
    #[serde(default)]
    pub time_s: f64,
    /// The stable name of the cause.
    #[serde(default)]
    pub code: String,
    /// The cause.
    pub cause: String,
    /// The end of its error output.
    pub last_words: String,
    /// The panic that ended its process, if one did: its message and its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub panic: Option<Panic>,
    /// True if it panicked as before, so that a restart would not help.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub repeated: bool,
    /// True if its successor inherits the counters only: the inherited state may have caused the failure.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub begins_anew: bool,
    /// The program that replaced it, if one did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replaced_by: Option<Replacement>,
    /// The launcher's action.
    pub action: Action,
    /// The time from the noticed failure until the successor ran, s.
    pub outage_s: Option<f64>,
    /// The time from `tick` on until every metric with a limit was within it and stayed there, s. `None` if that did not happen,
    /// or if there is no limit.
    pub recovery_s: Option<f64>,
}

/// A program that replaced another one in an external role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Replacement {
    /// Its process identifier, as the program itself sees it.
    pub pid: u32,
    /// The tick of its first sample.
    pub tick: u64,
}

/// The reaction to a failed role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Action {
    /// The role was restarted.
    Restarted,
    /// The run was ended in order.
    Stopped,
    /// None: it died after its last tick, and its results are complete.
    Noted,
    /// None: the run went on while the role was absent.
    Continued,
}

impl Action {
    /// Returns the name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Restarted => "restarted",
            Self::Stopped => "stopped",
            Self::Noted => "noted",
            Self::Continued => "continued",
        }
    }
}

impl fmt::Display for Incident {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let with: String = self.with.iter().map(|role| format!(", and {role} with it,")).collect();
        let failed = match (self.action, self.external) {
            (Action::Continued, _) => "was absent",
            (_, true) => "failed",
            (_, false) => "died",
        };
        write!(f, "{}{with} {failed} at tick {}: {}", self.role, self.tick, self.cause)?;
        if !self.last_words.is_empty() {
            write!(f, "; its output ended with: {}", self.last_words)?;
        }
        let end = match self.action {
            Action::Restarted if self.begins_anew => "; it is restarted without the inherited state",
            Action::Restarted => "; it is restarted",
            Action::Stopped if self.repeated => "; a restart would fail in the same way; the run ends",
            Action::Stopped => "; the run ends",
            Action::Noted => " after its last tick; its results are complete",
            Action::Continued => "; the run goes on",
        };
        write!(f, "{end} [{}]", self.code)
    }
}

impl Incident {
    /// Creates an incident of a role of the first generation with a process of its own.
    pub(super) fn new(role: String, tick: u64, failure: RoleFailure, action: Action) -> Self {
        Self {
            id: 0,
            role,
            external: false,
            with: Vec::new(),
            generation: 1,
            tick,
            time_s: 0.0,
            code: failure.code,
            cause: failure.cause,
            last_words: failure.last_words,
            panic: failure.panic,
            repeated: false,
            begins_anew: false,
            replaced_by: None,
            action,
            outage_s: None,
            recovery_s: None,
        }
    }

    /// Creates an incident of a device that was absent.
    pub(super) fn from_outage(role: &str, outage: &Outage) -> Self {
        let failure = RoleFailure::new(outage.code.clone(), outage.cause.clone(), String::new());
        Self {
            external: true,
            outage_s: outage.back_at_tick.map(|_| outage.seconds),
            ..Self::new(role.to_owned(), outage.tick, failure, Action::Continued)
        }
    }

    /// Creates an incident of a role without a process of its own. After a scripted end its successor starts at once.
    pub(super) fn without_process(role: &str, ledger: &Ledger, failure: RoleFailure, action: Action) -> Self {
        let tick = crate::runtime::next_tick(ledger);
        Self { generation: ledger.generation(), ..Self::new(role.to_owned(), tick, failure, action) }
    }
}

/// The incidents of a run, numbered from 1 in the order in which they became known.
#[derive(Default)]
pub(super) struct Incidents(Vec<Incident>);

impl Incidents {
    /// Adds an incident, and passes its number and its tick to `note`.
    pub fn add(&mut self, incident: Incident, note: &mut dyn FnMut(u64, u64)) -> &Incident {
        let id = self.0.len() as u64 + 1;
        note(id, incident.tick);
        self.0.push(Incident { id, ..incident });
        &self.0[self.0.len() - 1]
    }

    /// Returns true if an equal incident is known, apart from its number.
    pub fn contains(&self, incident: &Incident) -> bool {
        self.0.iter().any(|known| *known == Incident { id: known.id, ..incident.clone() })
    }

    /// Sets the outage of a role, s.
    pub fn end_outage(&mut self, role: &str, outage_s: f64) {
        let last = self.0.iter_mut().rev().find(|incident| incident.role == role);
        last.into_iter().for_each(|incident| incident.outage_s = Some(outage_s));
    }

    /// Returns the incidents, with the times of recovery by number.
    pub fn finish(self, recoveries_s: &BTreeMap<u64, f64>) -> Vec<Incident> {
        let recovered =
            |incident: Incident| Incident { recovery_s: recoveries_s.get(&incident.id).copied(), ..incident };
        self.0.into_iter().map(recovered).collect()
    }
}

/// The failure of a role.
pub(super) struct RoleFailure {
    /// The stable name of the cause.
    pub code: String,
    pub cause: String,
    pub last_words: String,
    /// The panic that ended its process, if one did.
    pub panic: Option<Panic>,
}

impl RoleFailure {
    /// Creates the failure of a process that did not panic.
    pub fn new(code: impl Into<String>, cause: String, last_words: String) -> Self {
        Self { code: code.into(), cause, last_words, panic: None }
    }

    /// Creates a failure by a panic. The error output, which ends with a backtrace, is left out.
    pub fn from_panic(panic: Panic) -> Self {
        Self { panic: Some(panic.clone()), ..Self::new("panicked", panic.to_string(), String::new()) }
    }
}
