//! Changes of inputs of a running loop.

use crate::run::coded;
use corotate::inputs::{Answer, InputError, WantedChange, change, current};
use corotate::seat::find_run;
use pyo3::prelude::*;
use std::path::PathBuf;
use toml::{Table, Value};

/// Reads the TOML of a value.
pub fn value(text: &str) -> PyResult<Value> {
    let table: Result<Table, _> = toml::from_str(&format!("value = {text}"));
    let value = table.ok().and_then(|mut table| table.remove("value"));
    value.ok_or_else(|| {
        coded(format!("{text} is not a value; give a number, a list of numbers, or true or false"), "no-value")
    })
}

pub fn refused(error: InputError) -> PyErr {
    coded(&error, error.code())
}

/// Returns the domain of a run: the given one, or that of the newest running run.
fn domain(run: Option<PathBuf>) -> PyResult<PathBuf> {
    find_run(run.as_deref()).map_err(|error| coded(&error, (&error).into()))
}

/// Changes inputs of a running run, all at the same tick: keys with values in TOML. Returns the tick, its time, s, and the time until
/// it, ms, in real time.
#[pyfunction]
#[pyo3(signature = (run, values, at_tick, ramp_s, force))]
pub fn set_inputs(
    py: Python<'_>,
    run: Option<PathBuf>,
    values: Vec<(String, String)>,
    at_tick: Option<u64>,
    ramp_s: f64,
    force: bool,
) -> PyResult<(u64, f64, Option<f64>)> {
    let wanted = |(key, text): (String, String)| Ok(WantedChange { key, value: value(&text)?, ramp_s });
    let changes = values.into_iter().map(wanted).collect::<PyResult<Vec<_>>>()?;
    let root = domain(run)?;
    match py.detach(|| change(&root, changes, at_tick, force)).map_err(refused)? {
        Answer::Accepted { tick, time_s, delay_ms } => Ok((tick, time_s, delay_ms)),
        answer => Err(refused(answer.into())),
    }
}

/// Returns the values of all inputs of a running run by key, as JSON.
#[pyfunction]
#[pyo3(signature = (run))]
pub fn get_inputs(py: Python<'_>, run: Option<PathBuf>) -> PyResult<String> {
    let root = domain(run)?;
    let (_, values) = py.detach(|| current(&root)).map_err(refused)?;
    serde_json::to_string(&values).map_err(crate::run::failed)
}
