//! Starts a run, supervises it, ends it, and tells how it went.
//!
//! Never leaves a process or a shared-memory file behind, however it ends. Must not compute what roles compute.

mod change_signal;
mod children;
mod companion;
mod criteria;
mod error;
mod external;
mod foxglove;
mod in_process;
mod incident;
mod janitor;
#[cfg(feature = "hosts")]
mod join;
mod junit;
mod options;
mod outcome;
mod overrun;
mod processes;
mod recorder;
mod relay;
mod remains;
mod replay;
mod results;
mod session;
mod standstill;
mod steps;
mod summary;
mod supervision;
mod table;
mod trace;
mod tracer;

pub use crate::score::{CertificateScore, MetricScore, Score, Scorer};
pub use criteria::{Criterion, Unjudged, tick_words};
pub(crate) use criteria::{exact, short};
pub use error::LaunchError;
pub use incident::{Action, Incident};
pub use janitor::janitor;
#[cfg(feature = "hosts")]
pub use join::{FarOutcome, join};
pub use junit::junit;
pub use options::{Launch, Progress};
pub use outcome::{LinkCounters, Outcome, StageFigures};
pub(crate) use outcome::{State, state_hash};
#[cfg(feature = "hosts")]
pub(crate) use processes::new_domain;
pub use replay::replay_as_process;
pub use results::{Claim, LATEST, RUNS, ResultsError, claim, make_directory, make_latest, new_run};
pub(crate) use results::{GENERATOR, LATE, LATENCY, RECORDING, SCENARIO, SUMMARY};
pub use session::{ScenarioKind, StepSession};
pub use steps::{BodyState, Steps};
pub(crate) use summary::Judged;
pub use summary::{Summary, write_run};
pub use table::{line_words, pace_words, table};
pub(crate) use table::{plain, reasons};

use crate::config::ClockKind;
pub use crate::panics::Panic;
use crate::runtime::unavailable_cores;
use crate::scenario::Scenario;

/// Runs a scenario to its end.
///
/// # Errors
/// [`LaunchError`] if the run could not be started, or a role failed.
pub fn run(scenario: &Scenario, launch: &mut Launch<'_>) -> Result<Outcome, LaunchError> {
    check_cores(scenario)?;
    match scenario.clock {
        ClockKind::InProcess => in_process::run(scenario, launch),
        ClockKind::Realtime | ClockKind::Lockstep => processes::run(scenario, launch),
    }
}

/// Refuses cores that no process of a run in real time can be bound to.
///
/// # Errors
/// [`LaunchError::Cores`].
pub fn check_cores(scenario: &Scenario) -> Result<(), LaunchError> {
    let realtime = scenario.clock == ClockKind::Realtime;
    let cores = if realtime { unavailable_cores(&scenario.realtime) } else { Vec::new() };
    if cores.is_empty() { Ok(()) } else { Err(LaunchError::Cores { cores }) }
}
