//! The library as a Python extension: what needs its types. How it looks to a user is in `corotate/*.py`.
//!
//! Must not decide anything that the library decides.

mod inputs;
mod logs;
mod recording;
mod run;
mod seat;
mod session;
mod sweep;

use pyo3::prelude::*;

/// The extension module of the package.
#[pymodule]
fn _corotate(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(run::main, module)?)?;
    module.add_function(wrap_pyfunction!(run::started_by, module)?)?;
    module.add_function(wrap_pyfunction!(run::run, module)?)?;
    module.add_function(wrap_pyfunction!(run::late_ticks, module)?)?;
    module.add_function(wrap_pyfunction!(run::certificate, module)?)?;
    module.add_function(wrap_pyfunction!(run::shipped, module)?)?;
    module.add_function(wrap_pyfunction!(seat::seat, module)?)?;
    module.add_function(wrap_pyfunction!(seat::serve, module)?)?;
    module.add_function(wrap_pyfunction!(seat::domain_of, module)?)?;
    module.add_function(wrap_pyfunction!(logs::identify, module)?)?;
    module.add_function(wrap_pyfunction!(logs::reconstruct, module)?)?;
    module.add_function(wrap_pyfunction!(logs::command, module)?)?;
    module.add_function(wrap_pyfunction!(logs::thrust, module)?)?;
    module.add_function(wrap_pyfunction!(inputs::set_inputs, module)?)?;
    module.add_function(wrap_pyfunction!(inputs::get_inputs, module)?)?;
    module.add_class::<seat::Ticks>()?;
    module.add_class::<session::Session>()?;
    module.add_class::<sweep::Cases>()?;
    module.add_class::<sweep::Results>()?;
    module.add_class::<recording::Recording>()?;
    let error = module.py().get_type::<run::CorotateError>();
    error.setattr("code", module.py().None())?;
    module.add("CorotateError", error)?;
    module.add("build", corotate::campaign::BUILD)?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))
}
