//! A role's seat: its samples to a function, or to a loop that asks for tick after tick.

use crate::run::{failed, scenario};
use corotate::runtime::{RoleFunction, RoleId, TickSamples};
use corotate::sample::Stamp;
use corotate::seat::{RoleAddress, describe_seat, run_function};
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

/// Between two looks for Ctrl-C.
const LOOK: Duration = Duration::from_millis(50);
/// The error of a function whose role has ended.
const LEFT: &str = "this role is not computed any more";

/// Returns the seat of a role of a scenario by name, path or text, as JSON.
#[pyfunction]
pub fn seat(given: &str, kind: &str, role: &str) -> PyResult<String> {
    let scenario = scenario(given, kind, &["clock=lockstep".to_owned()])?;
    let known = scenario.roles().join(", ");
    let id = RoleId::named(&scenario, role)
        .ok_or_else(|| failed(format!("there is no role `{role}`; known here: {known}")))?;
    Ok(describe_seat(&scenario, id, None).to_json())
}

/// The domain of the run that is meant by its domain, or by the directory that its results go to; none if there is no such run.
#[pyfunction]
pub fn domain_of(given: PathBuf) -> PyResult<Option<PathBuf>> {
    use corotate::bus::domain::DomainError;
    match corotate::seat::find_run(Some(&given)) {
        Ok(domain) => Ok(Some(domain).filter(|domain| domain.join("scenario.toml").exists())),
        Err(DomainError::NoRun | DomainError::Over { .. } | DomainError::NotADomain { .. }) => Ok(None),
        Err(error) => Err(failed(error)),
    }
}

/// The samples of a tick as bytes without their stamps.
fn inputs(tick: &TickSamples<'_>) -> Vec<Option<Vec<u8>>> {
    let words = size_of::<Stamp>() / size_of::<u64>();
    let content = |words_of: &&[u64]| words_of[words..].iter().flat_map(|word| word.to_ne_bytes()).collect();
    tick.inputs.iter().map(|input| input.as_ref().map(content)).collect()
}

fn fill(outputs: &mut [Vec<u64>], given: &[Vec<u8>]) {
    for (output, bytes) in outputs.iter_mut().zip(given) {
        for (word, bytes) in output.iter_mut().zip(bytes.chunks_exact(size_of::<u64>())) {
            *word = u64::from_ne_bytes(bytes.try_into().unwrap_or_default());
        }
    }
}

/// Outputs before they are computed, as bytes.
fn blank(outputs: &[Vec<u64>]) -> Vec<Vec<u8>> {
    outputs.iter().map(|words| words.iter().flat_map(|word| word.to_ne_bytes()).collect()).collect()
}

/// Serves a seat to the end of the run with a function of tick, inputs, values and blank outputs, which returns the outputs. Samples are
/// bytes.
/// Raises the function's own exception.
#[pyfunction]
pub fn serve(py: Python<'_>, domain: PathBuf, role: String, function: Py<PyAny>) -> PyResult<()> {
    let raised = Arc::new(Mutex::new(None));
    let function = Function { function, raised: Arc::clone(&raised) };
    let served = py.detach(|| run_function(&RoleAddress { domain, role }, Box::new(function), &AtomicBool::new(false)));
    let raised: Option<PyErr> = raised.lock().map_err(failed)?.take();
    served.map_err(|error| raised.unwrap_or_else(|| failed(error)))
}

struct Function {
    function: Py<PyAny>,
    raised: Arc<Mutex<Option<PyErr>>>,
}

impl RoleFunction for Function {
    fn compute(&mut self, tick: TickSamples<'_>) -> Result<(), String> {
        let computed = Python::attach(|py| {
            let bytes = |bytes: Vec<u8>| PyBytes::new(py, &bytes).unbind();
            let given: Vec<Option<Py<PyBytes>>> = inputs(&tick).into_iter().map(|input| input.map(bytes)).collect();
            let blank: Vec<Py<PyBytes>> = blank(tick.outputs).into_iter().map(bytes).collect();
            self.function.call1(py, (tick.tick, given, tick.values, blank))?.extract::<Vec<Vec<u8>>>(py)
        });
        match computed {
            Ok(outputs) => fill(tick.outputs, &outputs),
            Err(error) => {
                let words = Python::attach(|py| words(py, &error));
                *self.raised.lock().map_err(|error| error.to_string())? = Some(error);
                return Err(words);
            }
        }
        Ok(())
    }
}

/// An exception with its traceback, as one text.
fn words(py: Python<'_>, error: &PyErr) -> String {
    let format = |error: &PyErr| -> PyResult<String> {
        let lines = py
            .import("traceback")?
            .call_method1("format_exception", (error.clone_ref(py).into_value(py),))?
            .extract::<Vec<String>>()?;
        Ok(lines.concat())
    };
    format(error).unwrap_or_else(|_| error.to_string()).trim_end().to_owned()
}

/// One tick on its way to a loop: inputs, values, blank outputs.
type Asked = (u64, Vec<Option<Vec<u8>>>, Vec<f64>, Vec<Vec<u8>>);

struct Handed {
    asked: SyncSender<Asked>,
    answers: Receiver<Vec<Vec<u8>>>,
}

impl RoleFunction for Handed {
    fn compute(&mut self, tick: TickSamples<'_>) -> Result<(), String> {
        let asked = (tick.tick, inputs(&tick), tick.values.to_vec(), blank(tick.outputs));
        self.asked.send(asked).map_err(|_| LEFT.to_owned())?;
        fill(tick.outputs, &self.answers.recv().map_err(|_| LEFT.to_owned())?);
        Ok(())
    }
}

/// The source of ticks and the destination of their outputs.
type Line = (Receiver<Asked>, SyncSender<Vec<Vec<u8>>>);

/// A seat that is asked for tick after tick. A thread serves it meanwhile.
#[pyclass]
pub struct Ticks {
    /// Behind a lock, for a class of Python may be used by any thread.
    line: Mutex<Option<Line>>,
    served: Option<JoinHandle<Result<(), String>>>,
    leaves: Arc<AtomicBool>,
}

#[pymethods]
impl Ticks {
    #[new]
    fn new(domain: PathBuf, role: String) -> Self {
        let ((asked, ticks), (give, answers)) = (sync_channel(0), sync_channel(0));
        let leaves = Arc::new(AtomicBool::new(false));
        let terminated = Arc::clone(&leaves);
        let served = std::thread::spawn(move || {
            let handed = Box::new(Handed { asked, answers });
            run_function(&RoleAddress { domain, role }, handed, &terminated).map_err(|error| error.to_string())
        });
        Self { line: Mutex::new(Some((ticks, give))), served: Some(served), leaves }
    }

    /// Gives the outputs of the tick before, if there was one, and waits for the next: its number, inputs, values, and blank outputs. None
    /// at the end of the run.
    #[pyo3(signature = (outputs))]
    fn next(&mut self, py: Python<'_>, outputs: Option<Vec<Vec<u8>>>) -> PyResult<Option<Asked>> {
        let mut line = self.line.lock().map_err(failed)?;
        let Some((ticks, give)) = &mut *line else { return Ok(None) };
        // A seat that has ended takes nothing more; that is reported below.
        let _ = outputs.map(|outputs| give.send(outputs));
        loop {
            let ticks = &mut *ticks;
            match py.detach(move || ticks.recv_timeout(LOOK)) {
                Ok(asked) => return Ok(Some(asked)),
                Err(RecvTimeoutError::Timeout) => py.check_signals()?,
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        drop(line);
        self.close(py).map(|()| None)
    }

    /// Leaves the seat; raises what it ended with.
    fn close(&mut self, py: Python<'_>) -> PyResult<()> {
        self.leaves.store(true, Ordering::Relaxed);
        *self.line.lock().map_err(failed)? = None;
        let Some(served) = self.served.take() else { return Ok(()) };
        match py.detach(|| served.join()) {
            Ok(Err(reason)) if reason != LEFT => Err(failed(reason)),
            Ok(_) => Ok(()),
            Err(_) => Err(failed("the seat's thread panicked")),
        }
    }
}
