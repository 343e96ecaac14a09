//! Campaigns: run here, or piece by piece by other workers.

use crate::run::{failed, refused, shipped};
use corotate::campaign::{Campaign, Collection, SHIPPED, Sweep, Swept};
use corotate::config::{ClockKind, ConfigError};
use corotate::launch::make_directory;
use pyo3::prelude::*;
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::SystemTime;

/// The number of the signal by which Ctrl-C ends a sweep in order.
const SIGINT: usize = 2;

/// A campaign by its path, by the name of one that ships, or as text.
fn load(given: &str, kind: &str, overrides: &[String]) -> PyResult<Campaign> {
    let base = |name: &str| {
        let found = shipped().into_iter().find(|(known, _)| *known == name);
        found.map(|(_, text)| Cow::Borrowed(text)).ok_or_else(|| ConfigError::Unknown {
            code: "unknown-scenario",
            text: format!("there is no scenario `{name}`"),
        })
    };
    match kind {
        "text" => Campaign::parse(given, "the campaign given", overrides, &base),
        "name" => {
            let named = SHIPPED.iter().find(|(name, _)| *name == given);
            let names = || SHIPPED.map(|(name, _)| name).join(", ");
            let known = || {
                refused(format!("there is no campaign `{given}`; known here: {}. A file is given by its path", names()))
            };
            Campaign::parse(named.ok_or_else(known)?.1, given, overrides, &base)
        }
        _ => Campaign::load(Path::new(given), overrides, &base),
    }
    .map_err(refused)
}

/// A campaign with its cases.
#[pyclass(frozen, name = "Campaign")]
pub struct Cases {
    campaign: Campaign,
}

#[pymethods]
impl Cases {
    #[new]
    fn new(given: &str, kind: &str, overrides: Vec<String>) -> PyResult<Self> {
        Ok(Self { campaign: load(given, kind, &overrides)? })
    }

    /// A text that is read as the same campaign without any other file.
    fn text(&self) -> &str {
        self.campaign.to_toml()
    }

    /// The hash of everything that determines the cases.
    fn identity(&self) -> String {
        self.campaign.identity()
    }

    /// Returns the directory of the results.
    fn directory(&self, out: Option<PathBuf>) -> PyResult<PathBuf> {
        match out {
            Some(out) => Ok(out),
            None => make_directory(None, self.campaign.name(), SystemTime::now()).map_err(failed),
        }
    }

    /// The number of pieces of work.
    fn pieces(&self) -> u64 {
        self.campaign.pieces()
    }

    /// Runs these pieces of work; returns the result of each as JSON.
    fn work(&self, py: Python<'_>, pieces: Vec<u64>) -> PyResult<Vec<String>> {
        let never = AtomicUsize::new(0);
        let done = |piece| self.campaign.work(piece, ClockKind::InProcess, &never);
        py.detach(|| {
            pieces.into_iter().filter_map(done).map(|entry| serde_json::to_string(&entry)).collect::<Result<_, _>>()
        })
        .map_err(failed)
    }

    /// Runs what is left of it in this process; whether that was all. `tell` gets how many pieces of work are done, of how many,
    /// now and then; what it raises ends the sweep in order, and is raised then.
    fn sweep(&self, py: Python<'_>, directory: PathBuf, threads: usize, tell: Option<Py<PyAny>>) -> PyResult<bool> {
        let signal = AtomicUsize::new(0);
        let mut raised: Option<PyErr> = None;
        let swept: PyResult<Swept> = py.detach(|| {
            let mut progress = |done: u64, all: u64| {
                let called = Python::attach(|py| {
                    py.check_signals()?;
                    tell.as_ref().map_or(Ok(()), |tell| tell.call1(py, (done, all)).map(drop))
                });
                if let Err(error) = called {
                    signal.store(SIGINT, Ordering::Relaxed);
                    raised.get_or_insert(error);
                }
            };
            let clock = ClockKind::InProcess;
            let sweep = &mut Sweep { threads, shard: None, clock, signal: &signal, progress: &mut progress };
            self.campaign.sweep(&directory, sweep).map_err(failed)
        });
        raised.map_or(swept, Err).map(|swept| swept.counts.is_some())
    }

    /// Opens a directory for results that come from elsewhere.
    fn collect(&self, directory: PathBuf) -> PyResult<Results> {
        Ok(Results { collection: Some(self.campaign.clone().collect(&directory).map_err(failed)?) })
    }
}

/// Results as they come in.
#[pyclass]
pub struct Results {
    collection: Option<Collection>,
}

impl Results {
    fn collection(&mut self) -> PyResult<&mut Collection> {
        self.collection.as_mut().ok_or_else(|| failed("the results are closed"))
    }
}

#[pymethods]
impl Results {
    /// The pieces of work that are not done.
    fn left(&mut self) -> PyResult<Vec<u64>> {
        Ok(self.collection()?.left())
    }

    /// Adds the result of a piece of work.
    fn add(&mut self, entry: &str) -> PyResult<()> {
        let entry = serde_json::from_str(entry).map_err(failed)?;
        self.collection()?.add(&entry).map_err(failed)
    }

    /// Writes the tables.
    fn finish(&mut self, py: Python<'_>) -> PyResult<()> {
        let collection = self.collection()?;
        py.detach(|| collection.finish()).map(drop).map_err(failed)
    }

    /// Lets others write to the directory.
    fn close(&mut self) {
        self.collection = None;
    }
}
