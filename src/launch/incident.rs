//! An incident: a role that failed while the ticks ran, and what the launcher did. Must not decide what is done.

use crate::panics::Panic;
use crate::telemetry::{Ledger, Outage};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// A role that failed while the ticks ran, and what was done.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Incident {
    /// The number within the run, from 1; recoveries refer to it.
    #[serde(default)]
    pub id: u64,
    /// The role.
    pub role: String,
    /// True if the role is another program, whose death cannot be seen.
    pub external: bool,
    /// Other roles in the same process, which failed with it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub with: Vec<String>,
    /// The role's generation.
    pub generation: u64,
    /// The tick that it had not finished.
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
    /// The panic that ended its process, if one did: its message as it was written, and its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub panic: Option<Panic>,
    /// True if it panicked as before, so that another start would not help.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub repeated: bool,
    /// True if its successor begins with its counters alone: the inherited state may be what it died of.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub begins_anew: bool,
    /// The program that took its seat, if one did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replaced_by: Option<Replacement>,
    /// The launcher's action.
    pub action: Action,
    /// The time from when it was noticed until its successor ran, s.
    pub outage_s: Option<f64>,
    /// The time from `tick` on until every metric with a limit was within it and stayed there, s. None if that did not happen,
    /// or if there is no limit.
    pub recovery_s: Option<f64>,
}

/// A program that took the seat of another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Replacement {
    /// Its process, by the number that it knows itself by.
    pub pid: u32,
    /// The tick of its first sample.
    pub tick: u64,
}

/// What is done about a role that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Action {
    /// It was started anew.
    Restarted,
    /// The run was ended in order.
    Stopped,
    /// Nothing: it died after its last tick, and its results are complete.
    Noted,
    /// Nothing: the run went on without it, and with it again once it was back.
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
            write!(f, "; it said: {}", self.last_words)?;
        }
        let end = match self.action {
            Action::Restarted if self.begins_anew => "; it is started anew, without the state that it had inherited",
            Action::Restarted => "; it is started anew",
            Action::Stopped if self.repeated => "; as before, so it is not started anew; the run ends",
            Action::Stopped => "; the run ends",
            Action::Noted => " after its last tick; its results are complete",
            Action::Continued => "; the run goes on",
        };
        write!(f, "{end} [{}]", self.code)
    }
}

impl Incident {
    /// An incident of a role of the first generation with a process of its own.
    pub(super) fn new(role: String, tick: u64, failure: Failure, action: Action) -> Self {
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

    /// An absence of the device in a role's seat.
    pub(super) fn of_device(role: &str, outage: &Outage) -> Self {
        let failure = Failure::new(outage.code.clone(), outage.cause.clone(), String::new());
        Self {
            external: true,
            outage_s: outage.back_at_tick.map(|_| outage.seconds),
            ..Self::new(role.to_owned(), outage.tick, failure, Action::Continued)
        }
    }

    /// The end of a role that has no process of its own: after a scripted one its successor is there at once.
    pub(super) fn without_process(role: &str, ledger: &Ledger, failure: Failure, action: Action) -> Self {
        let tick = crate::runtime::next_tick(ledger);
        Self { generation: ledger.generation(), ..Self::new(role.to_owned(), tick, failure, action) }
    }
}

/// The incidents of a run, numbered from 1 in the order in which they became known.
#[derive(Default)]
pub(super) struct Incidents(Vec<Incident>);

impl Incidents {
    /// Keeps an incident, and passes its number and its tick on.
    pub fn add(&mut self, incident: Incident, note: &mut dyn FnMut(u64, u64)) -> &Incident {
        let id = self.0.len() as u64 + 1;
        note(id, incident.tick);
        self.0.push(Incident { id, ..incident });
        &self.0[self.0.len() - 1]
    }

    /// Returns true if an incident is known, whatever its number.
    pub fn contains(&self, incident: &Incident) -> bool {
        self.0.iter().any(|known| *known == Incident { id: known.id, ..incident.clone() })
    }

    /// Ends the outage of a role after so long, s.
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
pub(super) struct Failure {
    /// The stable name of the cause.
    pub code: String,
    pub cause: String,
    pub last_words: String,
    /// The panic that ended its process, if one did.
    pub panic: Option<Panic>,
}

impl Failure {
    /// A failure of a process that did not panic.
    pub fn new(code: impl Into<String>, cause: String, last_words: String) -> Self {
        Self { code: code.into(), cause, last_words, panic: None }
    }

    /// A panic. Of the error output, which ends with a backtrace, it keeps the message alone.
    pub fn of(panic: Panic) -> Self {
        Self { panic: Some(panic.clone()), ..Self::new("panicked", panic.to_string(), String::new()) }
    }
}
