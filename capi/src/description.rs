//! The description of a seat, as far as a client needs it: the command to start, and the layout of the frames.
//!
//! This file must not know a rig.

use crate::error::SeatError;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The seat as its file describes it, before it is taken.
#[derive(Debug, Deserialize)]
pub struct SeatFile {
    pub role: String,
    /// The command that starts the run's program.
    pub program: Option<Vec<String>>,
    transport: Transport,
}

#[derive(Debug, Deserialize)]
struct Transport {
    domain: Option<PathBuf>,
}

impl SeatFile {
    /// Reads the file of a role from its path, or from the directory of its run.
    pub fn read(path: &Path, role: &str) -> Result<Self, SeatError> {
        let file = if path.is_dir() { path.join(format!("{role}.seat.json")) } else { path.to_owned() };
        let text = std::fs::read_to_string(&file).map_err(|source| SeatError::NoSeat { path: file.clone(), source })?;
        let seat: Self = serde_json::from_str(&text)
            .map_err(|error| SeatError::BadSeat { path: file.clone(), reason: error.to_string() })?;
        if seat.role != role {
            return Err(SeatError::OtherRole { path: file, role: role.to_owned(), found: seat.role });
        }
        Ok(seat)
    }

    /// Returns the directory of the run.
    pub fn domain(&self) -> Option<&Path> {
        self.transport.domain.as_deref()
    }
}

/// The layout of the frames of a seat.
#[derive(Debug, Deserialize)]
pub struct Layout {
    pub period_ns: u64,
    pub last_tick: u64,
    stamp_size: usize,
    valid: u64,
    pub reads: Vec<Signal>,
    pub writes: Vec<Signal>,
    pub values: Vec<Value>,
}

/// A signal that the role reads or writes.
#[derive(Debug, Deserialize)]
pub struct Signal {
    service: String,
    signal: String,
    size: usize,
    fields: Vec<Field>,
}

#[derive(Debug, Deserialize)]
struct Field {
    name: String,
    offset: usize,
}

/// An input of the loop that the role uses.
#[derive(Debug, Deserialize)]
pub struct Value {
    pub key: String,
    pub index: usize,
    pub count: usize,
}

impl Signal {
    /// Returns true if the name is that of the signal, or `body/signal`.
    fn is(&self, name: &str) -> bool {
        name == self.signal
            || self.service.rsplit_once('/').is_some_and(|(before, signal)| {
                let body = before.rsplit('/').next().unwrap_or_default();
                name.strip_prefix(body).and_then(|rest| rest.strip_prefix('/')) == Some(signal)
            })
    }
}

impl Layout {
    /// Returns the length of a signal's content in words.
    pub fn words(&self, signal: &Signal) -> usize {
        signal.size.saturating_sub(self.stamp_size) / size_of::<u64>()
    }

    /// Returns the words of a blank output: zero, except `valid`.
    pub fn blank(&self, signal: &Signal) -> Vec<u64> {
        let mut words = vec![0; self.words(signal)];
        for field in signal.fields.iter().filter(|field| field.name == "valid") {
            if let Some(word) = words.get_mut(field.offset.saturating_sub(self.stamp_size) / size_of::<u64>()) {
                *word = self.valid;
            }
        }
        words
    }

    /// Returns the index of the one signal with a name.
    pub fn find(signals: &[Signal], name: &str) -> Result<usize, SeatError> {
        let mut found = signals.iter().enumerate().filter(|(_, signal)| signal.is(name));
        match (found.next(), found.next()) {
            (Some((index, _)), None) => Ok(index),
            (None, _) => Err(SeatError::NoSignal { name: name.to_owned(), known: names(signals) }),
            (Some(_), Some(_)) => Err(SeatError::Ambiguous { name: name.to_owned(), known: names(signals) }),
        }
    }
}

fn names(signals: &[Signal]) -> String {
    let names = signals.iter().map(|signal| signal.service.rsplitn(3, '/').take(2).collect::<Vec<_>>());
    names
        .map(|mut parts| {
            parts.reverse();
            parts.join("/")
        })
        .collect::<Vec<_>>()
        .join(", ")
}
