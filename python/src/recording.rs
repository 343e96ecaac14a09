//! Recordings as arrays.

use crate::run::failed;
use corotate::record::{Recording as Recorded, Track};
use corotate::sample::FieldKind;
use numpy::{IntoPyArray, PyArray1};
use pyo3::prelude::*;
use std::path::PathBuf;

/// Body, signal, and its fields with kind and count.
type Signal = (String, String, Vec<(String, String, usize)>);

/// A recording of a run.
#[pyclass]
pub struct Recording {
    recorded: Recorded,
}

impl Recording {
    fn track(&self, body: &str, signal: &str) -> PyResult<Track> {
        let mut tracks = self.recorded.tracks(|info| info.body == body && info.signal == signal).map_err(failed)?;
        if tracks.is_empty() {
            return Err(failed(format!("the recording has no signal {body}/{signal}")));
        }
        Ok(tracks.swap_remove(0))
    }
}

#[pymethods]
impl Recording {
    #[new]
    fn new(py: Python<'_>, path: PathBuf, accept_incomplete: bool) -> PyResult<Self> {
        let recorded = py.detach(|| Recorded::open(&path)).map_err(failed)?;
        if !accept_incomplete {
            recorded.require_whole().map_err(failed)?;
        }
        Ok(Self { recorded })
    }

    /// Every signal: body, name, and its fields with kind and count, the stamp's first.
    fn signals(&self) -> Vec<Signal> {
        let kind = |kind| if kind == FieldKind::F64 { "f8" } else { "u8" }.to_owned();
        let of = |info: &corotate::record::SignalInfo| {
            let columns =
                info.layout.columns.iter().map(|column| (column.name.clone(), kind(column.kind), column.count));
            (info.body.clone(), info.signal.clone(), columns.collect())
        };
        self.recorded.signals().iter().map(of).collect()
    }

    /// Scenario, clock, period in ns, and the scenario as TOML.
    fn info(&self) -> PyResult<(String, String, u64, String)> {
        let info = self.recorded.info();
        let scenario = self.recorded.scenario().map_err(failed)?;
        Ok((info.scenario_name.clone(), info.clock.to_string(), info.period_ns, scenario.to_toml()))
    }

    /// All samples of a signal that were sent for a tick, one after the other, as words of eight bytes; and the words of one.
    fn words<'py>(&self, py: Python<'py>, body: &str, signal: &str) -> PyResult<(Bound<'py, PyArray1<u64>>, usize)> {
        let (words, each) = py.detach(|| {
            let track = self.track(body, signal)?;
            let each = track.info.layout.size() / size_of::<u64>();
            let mut words = Vec::with_capacity(track.len() * each);
            for index in track.regular() {
                let sample = track.sample(index).chunks_exact(size_of::<u64>());
                words.extend(sample.map(|bytes| u64::from_ne_bytes(bytes.try_into().unwrap_or_default())));
            }
            Ok::<_, PyErr>((words, each))
        })?;
        Ok((words.into_pyarray(py), each))
    }
}
