//! The benchmark suite: what the product costs beside its floors, everything in one run on one machine.
//!
//! Contestants that are compared take turns in short rounds (A B A B …), so that whatever disturbs the machine disturbs all
//! of them. Nothing is removed: medians are those of all rounds, percentiles those of all values. A latency is measured from
//! when the sample was due, at a paced, open-loop tick; back-to-back exchange is an extra figure. Must not know what a good
//! result is (`targets.rs` does), and must not judge by anything that this run has not measured.

mod board;
mod chain;
mod compiled;
pub mod ekf;
mod exchange;
mod fleet;
mod hop;
mod lockstep;

mod page;
mod peer;
mod processor;
pub mod recording;
mod report;
mod run;
mod step;
mod targets;
mod tick;
mod toll;
mod watch;

pub use board::{Beside, Board, Figure, Row};
pub use compiled::Compiled;
pub use peer::{PeerSeat, serve_peer};
pub use report::{Results, table, write_results};
pub use step::{Agreement, STEP_KINDS, agreements, repeat_step};
pub use targets::{TARGETS, Target, Verdict};

use crate::bus::BusError;
use crate::bus::domain::DomainError;
use crate::config::Realtime;
use crate::launch::LaunchError;
use crate::telemetry::Grant;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

/// What a benchmark run is to do.
pub struct Bench<'a> {
    /// The rows, in the order of the table.
    pub rows: Vec<Row>,
    /// A smoke run: every row, a second each, figures that mean nothing.
    pub quick: bool,
    /// The program whose subcommands are the roles and the peers: this one.
    pub program: PathBuf,
    /// The signal that asked the run to end; 0 while none has.
    pub signal: &'a AtomicUsize,
    /// Told what is being measured.
    pub progress: &'a mut dyn FnMut(&str),
}

/// Why a benchmark run failed. Whatever had been started is gone.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// A signal asked for the end.
    #[error("ended by signal {0} before everything was measured")]
    Interrupted(usize),
    /// A domain could not be made.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// A link failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A run of the product failed.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// A peer process could not be started, or left.
    #[error("the measuring peer failed: {0}; its own error is above")]
    Peer(String),
    /// The operating system refused something.
    #[error("cannot {what}: {source}")]
    System {
        /// What was asked for.
        what: &'static str,
        /// Its reason.
        source: io::Error,
    },
}

impl BenchError {
    fn system(what: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::System { what, source }
    }
}

/// Measures the rows.
///
/// # Errors
/// [`BenchError`].
pub fn run(bench: &mut Bench<'_>) -> Result<(Board, Vec<Grant>), BenchError> {
    let (_low_latency, grants) = crate::runtime::hold_low_latency_idle(&Realtime::default());
    let mut board = Board::default();
    for row in bench.rows.clone() {
        match row {
            Row::Step => step::measure(bench, &mut board)?,
            Row::Fleet => fleet::measure(bench, &mut board)?,
            Row::Hop => hop::measure(bench, &mut board)?,
            Row::Chain => chain::measure(bench, &mut board)?,
            Row::Tick => tick::measure(bench, &mut board)?,
            Row::Lockstep => lockstep::measure(bench, &mut board)?,
            Row::Run => run::measure(bench, &mut board)?,
            Row::Toll => toll::measure(bench, &mut board)?,
            Row::Processor => processor::measure(bench, &mut board)?,
        }
    }
    let taken = board.take_grants();
    Ok((board, [grants, taken].concat()))
}

impl Bench<'_> {
    /// Says what comes next; an error if the run is to end.
    fn next(&mut self, what: &str) -> Result<(), BenchError> {
        self.interrupted()?;
        (self.progress)(what);
        Ok(())
    }

    /// An error if the run is to end.
    fn interrupted(&self) -> Result<(), BenchError> {
        match self.signal.load(Ordering::Relaxed) {
            0 => Ok(()),
            signal => Err(BenchError::Interrupted(signal)),
        }
    }

    /// One of two sizes: of a run that counts, and of a smoke run.
    fn size<T>(&self, full: T, quick: T) -> T {
        if self.quick { quick } else { full }
    }
}
