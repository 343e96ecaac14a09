//! The targets for the figures of all rows.
//!
//! Must not measure anything. A target without a measurement is neither met nor missed.

use super::board::Board;
use crate::telemetry::Percentiles;

/// The statistic of a figure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Of {
    /// The median of the rounds.
    Median,
    /// The 50th percentile of all latencies.
    P50,
    /// The 99th percentile.
    P99,
    /// The 99.9th percentile.
    P999,
}

/// The bound on a figure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// An upper bound.
    AtMost(f64),
    /// A lower bound.
    AtLeast(f64),
}

/// A target for a figure, or for its ratio to another figure of its row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    figure: &'static str,
    over: Option<&'static str>,
    statistic: Of,
    bound: Bound,
}

/// Creates the target of a figure, or of its ratio to the figure `over`.
pub const fn target(figure: &'static str, over: Option<&'static str>, statistic: Of, bound: Bound) -> Target {
    Target { figure, over, statistic, bound }
}

use Bound::{AtLeast, AtMost};
use Of::{Median, P50, P99, P999};

pub(super) const HOP: &[Target] = &[
    target("ours, spin, 64 B", Some("iceoryx2, spin, 64 B"), P50, AtMost(1.1)),
    target("ours, spin, 128 B", Some("iceoryx2, spin, 128 B"), P50, AtMost(1.1)),
    target("ours, spin, 256 B", Some("iceoryx2, spin, 256 B"), P50, AtMost(1.1)),
    target("ours, event, 64 B", Some("iceoryx2, event, 64 B"), P50, AtMost(1.1)),
    target("ours, hybrid, 64 B", Some("iceoryx2, hybrid, 64 B"), P50, AtMost(1.1)),
];
pub(super) const CHAIN: &[Target] = &[
    target("ours, 1000 Hz", Some("raw hops, 1000 Hz"), P50, AtMost(1.15)),
    target("ours, 1000 Hz", Some("raw hops, 1000 Hz"), P99, AtMost(1.15)),
];
pub(super) const TICK: &[Target] = &[
    target("ours, in a run", Some("cyclictest"), P50, AtMost(1.1)),
    target("ours, in a run", Some("cyclictest"), P99, AtMost(1.1)),
    target("ours, in a run", Some("cyclictest"), P999, AtMost(1.1)),
    target("rate error of a run", None, Median, AtMost(0.01)),
];
pub(super) const LOCKSTEP: &[Target] = &[
    target("lockstep", None, Median, AtLeast(100_000.0)),
    target("in one thread, rigid-pair", None, Median, AtLeast(8_000_000.0)),
];
pub(super) const RUN: &[Target] = &[
    target("start to first tick", None, Median, AtMost(150.0)),
    target("memory of the largest role", None, Median, AtMost(12.0)),
    target("shared memory", None, Median, AtMost(4.0)),
];
pub(super) const OVERHEAD: &[Target] = &[
    target("system calls beyond its waits, worst role", None, Median, AtMost(0.01)),
    target("page faults, worst role", None, Median, AtMost(0.0)),
    target("allocations beyond iceoryx2's one per sample, worst role", None, Median, AtMost(0.01)),
];

/// A target with its measured value.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Verdict {
    /// The row.
    pub row: &'static str,
    /// The target in words.
    pub what: String,
    /// The measured value; `None` without a measurement.
    pub value: Option<f64>,
    /// The limit.
    pub limit: f64,
    /// True if the target is met; `None` if it was not measured or is not judged.
    pub met: Option<bool>,
}

impl Target {
    /// Judges the figures of a row on the board.
    pub fn judge(&self, row: &'static str, board: &Board) -> Verdict {
        let value = self.value(row, board);
        let (sign, limit, met) = match self.bound {
            AtMost(limit) => ("at most", limit, value.map(|value| value <= limit)),
            AtLeast(limit) => ("at least", limit, value.map(|value| value >= limit)),
        };
        let statistic = match self.statistic {
            Median => "",
            P50 => ", p50",
            P99 => ", p99",
            P999 => ", p99.9",
        };
        let over = self.over.map_or(String::new(), |over| format!(" / {over}"));
        let unit = board.find(row, self.figure).filter(|_| self.over.is_none()).map_or("", |figure| figure.unit);
        let what = format!("{}{over}{statistic}: {sign} {limit} {unit}", self.figure).trim_end().to_owned();
        Verdict { row, what, value, limit, met }
    }

    fn value(&self, row: &str, board: &Board) -> Option<f64> {
        let value = match (self.statistic, self.over) {
            (Median, None) => board.find(row, self.figure)?.median,
            (Median, Some(over)) => board.ratio(row, self.figure, over)?,
            (statistic, None) => statistic.pick(&board.find(row, self.figure)?.latency?),
            (statistic, Some(over)) => {
                let of_figure = |name| Some(statistic.pick(&board.find(row, name)?.latency?));
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
        board.begin("step");
        let ratio = target("ours", Some("floor"), Median, AtMost(1.05));
        board.add("ours", "ns", None, 10.0);
        assert_eq!(ratio.judge("step", &board).met, None);
        board.add("floor", "ns", None, 9.0);
        let verdict = ratio.judge("step", &board);
        assert_eq!(verdict.met, Some(false));
        assert!(verdict.what.starts_with("ours / floor: at most 1.05"), "{}", verdict.what);
        assert_eq!(ratio.judge("hop", &board).met, None, "the row is another");
        let absolute = target("ours", None, Median, AtMost(10.0)).judge("step", &board);
        assert_eq!((absolute.met, absolute.value), (Some(true), Some(10.0)));
    }
}
