//! The benchmark of a program with rigs: its costs on this machine, compared with their lower bounds in the same run.
//!
//! Compared candidates take turns in short rounds (A B A B …), so that a disturbance of the machine affects all of them. No value
//! is removed: medians cover all rounds, percentiles all values. A latency is measured from the time at which the sample was
//! due, at a paced, open-loop tick; back-to-back exchange is an extra figure. Must not contain targets (`targets.rs` does), and
//! must not judge by anything that this run has not measured.

mod board;
mod chain;
mod exchange;
mod hop;
mod lockstep;
mod overhead;
mod page;
mod peer;
mod processor;
mod report;
mod run;
mod session;
mod targets;
mod tick;
mod watch;

pub use board::{Beside, Board, Figure};
pub use peer::serve_peer;
pub use report::{Results, table, write_results};
pub use session::{Bench, BenchError, Measure, Row, row};
pub use targets::{Bound, Of, Target, Verdict, target};

use crate::telemetry::Grant;

/// The rows of the benchmark.
pub const ROWS: &[Row] = &[
    row("hop", "one hop between two processes on two cores", targets::HOP, hop::measure),
    row("chain", "leader -> observer -> controller: from tick to command sent", targets::CHAIN, chain::measure),
    row("tick", "how late a tick begins", targets::TICK, tick::measure),
    row("lockstep", "ticks per second without waiting for real time", targets::LOCKSTEP, lockstep::measure),
    row("run", "a whole run: start, stop, memory", targets::RUN, run::measure),
    row(
        "overhead",
        "system calls, faults, context switches and allocations per tick",
        targets::OVERHEAD,
        overhead::measure,
    ),
    row("processor", "processor time per tick of every role, by how roles wait", &[], processor::measure),
];

/// Measures the rows. A row that this program's scenario does not support becomes a remark on the board.
///
/// # Errors
/// [`BenchError`].
pub fn run(bench: &mut Bench<'_>) -> Result<(Board, Vec<Grant>), BenchError> {
    let (_low_latency, grants) = crate::runtime::hold_low_latency_idle(&bench.scenario(&[])?.realtime);
    let mut board = Board::default();
    for row in bench.rows.clone() {
        board.begin(row.name);
        match (row.measure)(bench, &mut board) {
            Err(BenchError::Scenario(reason)) => board.remark(format!("{} is not measured: {reason}", row.name)),
            measured => measured?,
        }
    }
    let peer_grants = std::mem::take(&mut board.grants);
    Ok((board, [grants, peer_grants].concat()))
}

#[cfg(test)]
mod tests {
    use super::session::resolve;
    use super::*;
    use crate::config::SHIPPED;
    use std::sync::atomic::AtomicUsize;

    fn with<T>(name: &str, scenarios: &[(&str, &str)], act: impl FnOnce(&mut Bench<'_>) -> T) -> T {
        act(&mut Bench {
            rows: ROWS.iter().filter(|row| row.name == name).copied().collect(),
            quick: true,
            scenarios,
            signal: &AtomicUsize::new(0),
            progress: &mut |_| {},
        })
    }

    #[test]
    fn an_unsupported_row_is_a_remark_and_is_not_measured() {
        let (_, text) = SHIPPED.iter().find(|(name, _)| *name == "orbit-rendezvous").unwrap();
        let mut free: toml::Table = text.parse().unwrap();
        free.retain(|key, _| !["controller", "follower"].contains(&key));
        let (board, _) = with("chain", &[("free", &free.to_string())], run).unwrap();
        assert!(board.figures().is_empty() && board.remarks()[0].contains("no body of this"), "{:?}", board.remarks());
        let scenarios = [SHIPPED[0], ("wrong", "tick_hz = 0")];
        let (board, _) = with("lockstep", &scenarios, run).unwrap();
        assert!(board.figures().is_empty() && board.remarks()[0].contains("wrong.toml"), "{:?}", board.remarks());
        assert!(matches!(with("lockstep", &scenarios[1..], run), Err(BenchError::Scenario(_))));
        assert!(matches!(with("lockstep", &[], run), Err(BenchError::NoScenario)));
    }

    #[test]
    fn faults_and_external_roles_are_removed_from_the_scenario() {
        let (_, text) = SHIPPED.iter().find(|(name, _)| *name == "faults").unwrap();
        let text = text.replace("\n[watchdog]", "\n[launch]\nexternal = [\"follower\"]\n[watchdog]");
        assert!(resolve(("disturbed", &text), &[]).is_ok_and(|whole| !whole.faults.is_empty()));
        let short = with("", &[("disturbed", &text)], |bench| bench.scenario(&["duration_s=0.1"])).unwrap();
        assert!(short.faults.is_empty() && short.external.is_empty(), "{short:?}");
    }
}
