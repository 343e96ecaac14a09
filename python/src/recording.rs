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

/// The samples of a signal that were sent for a tick, one after the other, as words.
fn words(track: &Track) -> (Vec<u64>, usize) {
    let each = track.info.layout.size() / size_of::<u64>();
    let regular: Vec<usize> = track.regular().collect();
    let mut words = vec![0; regular.len() * each];
    for (place, index) in words.chunks_exact_mut(each).zip(regular) {
        bytemuck::cast_slice_mut(place).copy_from_slice(track.sample(index));
    }
    (words, each)
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
        let signal = |info: &corotate::record::SignalInfo| {
            let columns =
                info.layout.columns.iter().map(|column| (column.name.clone(), kind(column.kind), column.count));
            (info.body.clone(), info.signal.clone(), columns.collect())
        };
        self.recorded.signals().iter().map(signal).collect()
    }

    /// Scenario, clock, period in ns, and the scenario as TOML, which may have a rig that this package does not know.
    fn info(&self) -> (String, String, u64, String) {
        let info = self.recorded.info();
        (info.scenario_name.clone(), info.clock.clone(), info.period_ns, info.scenario.clone())
    }

    /// All samples of each of these signals that were sent for a tick, one after the other, as words of eight bytes; and the words of
    /// one. The file is read once.
    fn words<'py>(
        &self,
        py: Python<'py>,
        names: Vec<(String, String)>,
    ) -> PyResult<Vec<(Bound<'py, PyArray1<u64>>, usize)>> {
        let read = py.detach(|| {
            let wanted = |info: &corotate::record::SignalInfo| {
                names.iter().any(|(body, name)| (body, name) == (&info.body, &info.signal))
            };
            let tracks = self.recorded.tracks(wanted).map_err(failed)?;
            let values = |(body, name): &(String, String)| {
                let track = tracks.iter().find(|track| (&track.info.body, &track.info.signal) == (body, name));
                track.map(words).ok_or_else(|| failed(format!("the recording has no signal {body}/{name}")))
            };
            names.iter().map(values).collect::<PyResult<Vec<_>>>()
        })?;
        Ok(read.into_iter().map(|(words, each)| (words.into_pyarray(py), each)).collect())
    }
}
