//! Loops in this process that are stepped by requests.

use crate::run::{failed, load};
use corotate::launch::StepSession;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use std::sync::Mutex;

/// A session with all of its shared parts.
struct Owned(StepSession<'static>);

// SAFETY: its parts share counted references with each other only, none leaves it, and it uses nothing that belongs to a thread. The lock
// of `Session` lets one thread use or drop it at a time.
#[allow(unsafe_code)]
unsafe impl Send for Owned {}

/// A session that steps runs of this package, as the process of another program does. Any thread may use or drop it.
#[pyclass(frozen)]
pub struct Session {
    session: Mutex<Owned>,
}

impl Session {
    fn opened() -> Owned {
        Owned(StepSession::new(load))
    }
}

#[pymethods]
impl Session {
    #[new]
    fn new() -> Self {
        Self { session: Mutex::new(Self::opened()) }
    }

    /// Returns the answer to a request.
    fn request<'py>(&self, py: Python<'py>, message: &[u8]) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &self.session.lock().map_err(failed)?.0.answer(message)))
    }

    /// Ends the session.
    fn close(&self) -> PyResult<()> {
        *self.session.lock().map_err(failed)? = Self::opened();
        Ok(())
    }
}
