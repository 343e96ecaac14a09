//! Loops in this process that are stepped by requests.

use crate::run::load;
use corotate::launch::StepSession;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

/// A session that steps runs of this package, as the process of another program does.
#[pyclass(unsendable)]
pub struct Session {
    session: StepSession<'static>,
}

#[pymethods]
impl Session {
    #[new]
    fn new() -> Self {
        Self { session: StepSession::new(load) }
    }

    /// Returns the answer to a request.
    fn request<'py>(&mut self, py: Python<'py>, message: &[u8]) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.session.answer(message))
    }

    /// Ends the session.
    fn close(&mut self) {
        self.session = StepSession::new(load);
    }
}
