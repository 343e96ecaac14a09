//! Runs, and what may be claimed of them.

use corotate::Program;
use corotate::config::{ConfigError, RunId, SHIPPED};
use corotate::late::{LateReport, LateTick};
use corotate::launch::{
    Launch, Outcome, Progress, ScenarioKind, Summary, claim, make_directory, make_latest, new_run, run as launch,
    write_run,
};
use corotate::scenario::Scenario;
use corotate::scenario::shipped as rigs;
use pyo3::create_exception;
use pyo3::exceptions::{PyException, PyValueError};
use pyo3::prelude::*;
use std::fmt::Display;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::SystemTime;

create_exception!(
    _corotate,
    CorotateError,
    PyException,
    "A run, a seat or a recording failed, with the program's own words."
);

/// The number of the signal by which Ctrl-C ends a run in order.
const SIGINT: usize = 2;

pub fn failed(error: impl Display) -> PyErr {
    CorotateError::new_err(error.to_string())
}

/// Returns an exception whose `code` is the stable code of the error.
pub fn coded(error: impl Display, code: &str) -> PyErr {
    with_code(failed(error), Some(code))
}

fn with_code(error: PyErr, code: Option<&str>) -> PyErr {
    Python::attach(|py| error.value(py).setattr("code", code)).map_or_else(|failure| failure, |()| error)
}

pub fn refused(error: impl Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Does what a command line asks for; the first word is the program's name.
#[pyfunction]
pub fn main(py: Python<'_>, words: Vec<String>) -> u8 {
    py.detach(|| {
        let program =
            SHIPPED.iter().fold(Program::new().rigs(rigs()), |program, (name, text)| program.scenario(name, text));
        program.execute(words.into_iter().map(Into::into).collect())
    })
}

/// Says how the roles of a run are started.
#[pyfunction]
pub fn started_by(file: PathBuf, arguments: Vec<String>) {
    corotate::system::started_by(file, arguments.into_iter().map(Into::into).collect());
}

/// The scenarios that ship, by name.
#[pyfunction]
pub fn shipped() -> Vec<(&'static str, &'static str)> {
    SHIPPED.to_vec()
}

/// Reads a scenario by its path, by the name of one that ships, or from its text.
pub fn load(given: &str, kind: ScenarioKind, overrides: &[String]) -> Result<Scenario, ConfigError> {
    match kind {
        ScenarioKind::Text => Scenario::parse(given, "the scenario given", overrides),
        ScenarioKind::Name => {
            let named = SHIPPED.iter().find(|(name, _)| *name == given);
            let names = || SHIPPED.map(|(name, _)| name).join(", ");
            let unknown = || ConfigError::Unknown {
                code: "unknown-scenario",
                text: format!("there is no scenario `{given}`; known here: {}. A file is given by its path", names()),
            };
            Scenario::parse(named.ok_or_else(unknown)?.1, given, overrides)
        }
        ScenarioKind::Path => Scenario::load(Path::new(given), overrides),
    }
}

/// The same, for callers in Python.
pub fn scenario(given: &str, kind: &str, overrides: &[String]) -> PyResult<Scenario> {
    let kind = match kind {
        "name" => ScenarioKind::Name,
        "text" => ScenarioKind::Text,
        _ => ScenarioKind::Path,
    };
    load(given, kind, overrides).map_err(|error| {
        let code = error.mistakes().first().map(|(_, code)| *code);
        with_code(refused(error), code)
    })
}

/// Runs a scenario; gives its summary as JSON and its directory. `tell` gets `("waiting", domain)` and `("running", tick)` now and
/// then; what it raises ends the run in order, and is raised then.
#[pyfunction]
#[pyo3(signature = (given, kind, overrides, external, record, out, overwrite, require_realtime, tell))]
#[allow(clippy::too_many_arguments, reason = "one call from one place")]
pub fn run(
    py: Python<'_>,
    given: &str,
    kind: &str,
    overrides: Vec<String>,
    external: Vec<String>,
    record: bool,
    out: Option<PathBuf>,
    overwrite: bool,
    require_realtime: bool,
    tell: Option<Py<PyAny>>,
) -> PyResult<(String, PathBuf)> {
    let id: RunId = new_run().map_err(|error| coded(error, "no-random-numbers"))?;
    let mut scenario = scenario(given, kind, &overrides)?;
    scenario.run = Some(id);
    external
        .iter()
        .try_for_each(|role| scenario.check_external(role).map_err(|reason| refused(format!("{role}: {reason}"))))?;
    let started = SystemTime::now();
    let directory = make_directory(out.as_deref(), &scenario.name, started)
        .map_err(|error| coded(error, "cannot-use-directory"))?;
    let _claim = claim(&directory, id, overwrite).map_err(|error| coded(&error, (&error).into()))?;
    let signal = AtomicUsize::new(0);
    let mut raised: Option<PyErr> = None;
    let ended: Result<String, PyErr> = py.detach(|| {
        let mut progress = |progress: &Progress<'_>| {
            let called = Python::attach(|py| {
                py.check_signals()?;
                let Some(tell) = &tell else { return Ok(()) };
                match progress {
                    Progress::Waiting { domain, .. } => tell.call1(py, ("waiting", domain.display().to_string())),
                    Progress::Running { tick, .. } => tell.call1(py, ("running", *tick)),
                    Progress::External(words) => tell.call1(py, ("external", *words)),
                }
                .map(drop)
            });
            if let Err(error) = called {
                signal.store(SIGINT, Ordering::Relaxed);
                raised.get_or_insert(error);
            }
        };
        let launched = &mut Launch {
            external,
            record: (record || scenario.record).then(|| directory.join("run.mcap")),
            results: std::fs::canonicalize(&directory).ok(),
            require_realtime,
            ..Launch::new(&signal, &mut progress)
        };
        // Results are written before what is left of the run is put away.
        let outcome: Outcome = launch(&scenario, launched).map_err(|error| coded(&error, (&error).into()))?;
        let summary = Summary::new(&scenario, &outcome, started);
        write_run(&directory, &scenario, &summary, outcome.late.as_ref()).map_err(failed)?;
        let _ = make_latest(&directory);
        serde_json::to_string(&summary).map_err(failed)
    });
    // The exception of the progress function comes before the failures that follow from it.
    raised.map_or(ended, Err).map(|summary| (summary, directory))
}

/// Returns the late ticks of the run in a directory as a list in JSON, each cause with its `words`; `None` without a `late.json`.
#[pyfunction]
pub fn late_ticks(py: Python<'_>, directory: PathBuf) -> PyResult<Option<String>> {
    py.detach(|| {
        let path = directory.join("late.json");
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(failed(format!("cannot read {}: {error}", path.display()))),
        };
        let report = LateReport::parse(&bytes);
        let report = report.map_err(|reason| failed(format!("cannot read {}: {reason}", path.display())))?;
        let ticks = report.ticks.iter().map(tick_with_words).collect::<Result<Vec<_>, _>>().map_err(failed)?;
        serde_json::to_string(&ticks).map(Some).map_err(failed)
    })
}

/// Returns a late tick whose causes are also in words.
fn tick_with_words(late: &LateTick) -> serde_json::Result<serde_json::Value> {
    let mut tick = serde_json::to_value(late)?;
    for (cause, known) in tick["causes"].as_array_mut().into_iter().flatten().zip(&late.causes) {
        cause["words"] = known.to_string().into();
    }
    Ok(tick)
}

/// Returns the convergence claims of a scenario's loop as JSON: one entry per driven body.
#[pyfunction]
pub fn certificate(py: Python<'_>, given: &str, kind: &str, overrides: Vec<String>) -> PyResult<String> {
    let scenario = scenario(given, kind, &overrides)?;
    py.detach(|| serde_json::to_string(&corotate::scenario::claims(&scenario)).map_err(failed))
}
