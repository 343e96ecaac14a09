//! The product compared with other implementations: its step with straight-line C, an extended Kalman filter and the
//! bare copy of the samples; the law of its fleets with a copy of the same bytes.
//!
//! Run `cargo bench --bench contest [-- OPTIONS]`, with the options of `corotate bench`, which measures everything
//! else. C code is compiled at run time. This benchmark must not be part of the library, nor contain code that the
//! library needs.

pub mod compiled;
pub mod ekf;
mod fleet;
mod product;
pub mod recording;
pub mod step;

use corotate::Program;
use corotate::bench::Bound::{AtLeast, AtMost};
use corotate::bench::Of::Median;
use corotate::bench::{Row, Target, row, target};
use corotate::config::SHIPPED;
use std::process::ExitCode;

/// The targets of the step.
const STEP: &[Target] = &[
    target("first order", Some("first order in C"), Median, AtMost(1.05)),
    target("first order", None, Median, AtMost(15.0)),
    target("first order by an EKF", Some("first order"), Median, AtLeast(3.0)),
    target("second order", Some("first order"), Median, AtMost(1.3)),
];
/// The targets of the law of a fleet.
const FLEET: &[Target] = &[
    target("law, N = 1000", Some("copy, N = 1000"), Median, AtMost(1.3)),
    target("law, N = 1000", None, Median, AtMost(0.7)),
];

/// All rows.
pub const ROWS: &[Row] = &[
    row("step", "estimate-and-control step: samples in, command out", STEP, step::measure),
    row("fleet", "the law of N followers in one controller's step, per follower", FLEET, fleet::measure),
];

fn main() -> ExitCode {
    let (name, text) = SHIPPED[0];
    Program::new().rigs(corotate::scenario::shipped()).scenario(name, text).bench(ROWS)
}
