//! What the suite's figures are held against: the one place where a target stands.
//!
//! Must not measure anything. A target that could not be measured is neither met nor missed, and says so.

use super::{Board, Row};
use crate::telemetry::Percentiles;

/// Which number of a figure counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Of {
    /// The median of the rounds.
    Median,
    /// All latencies: half of them are at most this.
    P50,
    /// 99 %.
    P99,
    /// 99.9 %.
    P999,
}

/// How a figure is to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// At most.
    AtMost(f64),
    /// At least.
    AtLeast(f64),
}

/// What a figure, or its ratio to another one, is to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// The row of both figures.
    pub row: Row,
    /// The figure.
    pub figure: &'static str,
    /// What it is divided by.
    pub over: Option<&'static str>,
    /// Which number of both.
    pub of: Of,
    /// The target.
    pub bound: Bound,
}

const fn target(row: Row, figure: &'static str, over: Option<&'static str>, of: Of, bound: Bound) -> Target {
    Target { row, figure, over, of, bound }
}

use Bound::{AtLeast, AtMost};
use Of::{Median, P50, P99, P999};

/// Every target.
pub const TARGETS: &[Target] = &[
    target(Row::Step, "first order", Some("first order in C"), Median, AtMost(1.05)),
    target(Row::Step, "first order", None, Median, AtMost(15.0)),
    target(Row::Step, "first order by an EKF", Some("first order"), Median, AtLeast(3.0)),
    target(Row::Step, "second order", Some("first order"), Median, AtMost(1.3)),
    target(Row::Fleet, "law, N = 1000", Some("copy, N = 1000"), Median, AtMost(1.3)),
    target(Row::Fleet, "law, N = 1000", None, Median, AtMost(0.7)),
    target(Row::Hop, "ours, spin, 64 B", Some("iceoryx2, spin, 64 B"), P50, AtMost(1.1)),
    target(Row::Hop, "ours, spin, 128 B", Some("iceoryx2, spin, 128 B"), P50, AtMost(1.1)),
    target(Row::Hop, "ours, spin, 256 B", Some("iceoryx2, spin, 256 B"), P50, AtMost(1.1)),
    target(Row::Hop, "ours, event, 64 B", Some("iceoryx2, event, 64 B"), P50, AtMost(1.1)),
    target(Row::Hop, "ours, hybrid, 64 B", Some("iceoryx2, hybrid, 64 B"), P50, AtMost(1.1)),
    target(Row::Chain, "ours, 1000 Hz", Some("raw hops, 1000 Hz"), P50, AtMost(1.15)),
    target(Row::Chain, "ours, 1000 Hz", Some("raw hops, 1000 Hz"), P99, AtMost(1.15)),
    target(Row::Tick, "ours, in a run", Some("cyclictest"), P50, AtMost(1.1)),
    target(Row::Tick, "ours, in a run", Some("cyclictest"), P99, AtMost(1.1)),
    target(Row::Tick, "ours, in a run", Some("cyclictest"), P999, AtMost(1.1)),
    target(Row::Tick, "rate error of a run", None, Median, AtMost(0.01)),
    target(Row::Lockstep, "lockstep", None, Median, AtLeast(100_000.0)),
    target(Row::Lockstep, "in one thread, rigid-pair", None, Median, AtLeast(8_000_000.0)),
    target(Row::Run, "start to first tick", None, Median, AtMost(150.0)),
    target(Row::Run, "memory of the largest role", None, Median, AtMost(12.0)),
    target(Row::Run, "shared memory", None, Median, AtMost(4.0)),
    target(Row::Toll, "system calls beyond its waits, worst role", None, Median, AtMost(0.01)),
    target(Row::Toll, "page faults, worst role", None, Median, AtMost(0.0)),
    target(Row::Toll, "allocations beyond iceoryx2's one per sample, worst role", None, Median, AtMost(0.01)),
];

/// A target with what was measured.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Verdict {
    /// The row.
    pub row: Row,
    /// What is to be how, in words.
    pub what: String,
    /// What it is; none if it was not measured.
    pub value: Option<f64>,
    /// The limit.
    pub limit: f64,
    /// Whether the target is met; none if it was not measured.
    pub met: Option<bool>,
}

impl Target {
    /// The target's verdict on what a board has; none if its row was not asked for.
    pub fn judge(&self, board: &Board) -> Option<Verdict> {
        board.figures().iter().find(|figure| figure.row == self.row)?;
        let value = self.value(board);
        let (sign, limit, met) = match self.bound {
            AtMost(limit) => ("at most", limit, value.map(|value| value <= limit)),
            AtLeast(limit) => ("at least", limit, value.map(|value| value >= limit)),
        };
        let of = match self.of {
            Median => "",
            P50 => ", p50",
            P99 => ", p99",
            P999 => ", p99.9",
        };
        let over = self.over.map_or(String::new(), |over| format!(" / {over}"));
        let unit = board.find(self.row, self.figure).filter(|_| self.over.is_none()).map_or("", |figure| figure.unit);
        let what = format!("{}{over}{of}: {sign} {limit} {unit}", self.figure).trim_end().to_owned();
        Some(Verdict { row: self.row, what, value, limit, met })
    }

    fn value(&self, board: &Board) -> Option<f64> {
        let value = match (self.of, self.over) {
            (Median, None) => board.find(self.row, self.figure)?.median,
            (Median, Some(over)) => board.ratio(self.row, self.figure, over)?,
            (of, None) => of.pick(&board.find(self.row, self.figure)?.latency?),
            (of, Some(over)) => {
                let of_figure = |name| Some(of.pick(&board.find(self.row, name)?.latency?));
                of_figure(self.figure)? / of_figure(over)?
            }
        };
        value.is_finite().then_some(value)
    }
}

impl Of {
    fn pick(self, latency: &Percentiles) -> f64 {
        match self {
            Median | P50 => latency.p50_us,
            P99 => latency.p99_us,
            P999 => latency.p999_us,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_target_is_met_missed_or_not_measured() {
        let mut board = Board::default();
        let first = TARGETS.iter().find(|target| target.figure == "first order" && target.over.is_some()).unwrap();
        assert!(first.judge(&board).is_none(), "the row was not asked for");
        board.add(Row::Step, "first order", "ns", None, 10.0);
        assert_eq!(first.judge(&board).unwrap().met, None);
        board.add(Row::Step, "first order in C", "ns", None, 9.0);
        let verdict = first.judge(&board).unwrap();
        assert_eq!(verdict.met, Some(false));
        assert!(verdict.what.starts_with("first order / first order in C: at most 1.05"), "{}", verdict.what);
        let absolute = Target { over: None, bound: AtMost(10.0), ..*first }.judge(&board).unwrap();
        assert_eq!((absolute.met, absolute.value), (Some(true), Some(10.0)));
    }
}
