//! Where everything that was measured is collected: one value per round, and the distribution of all values.
//!
//! Must not drop a value, nor round one.

use crate::telemetry::{Grant, Latency, Percentiles};

/// A row of the suite.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Row {
    /// The estimate-and-control step.
    Step,
    /// The control law of many followers at once.
    Fleet,
    /// One hop between two processes.
    Hop,
    /// Leader, observer, controller: from the tick to the command.
    Chain,
    /// How late a tick begins.
    Tick,
    /// Ticks per second where nobody waits for the time.
    Lockstep,
    /// A whole run: start, stop, memory.
    Run,
    /// What a tick takes of the system: calls, faults, switches, allocations.
    Toll,
    /// What a tick takes of the processor, by how roles wait.
    Processor,
}

impl Row {
    /// Every row with its name and what it is.
    pub const ALL: [(Self, &str, &str); 9] = [
        (Self::Step, "step", "estimate-and-control step: samples in, command out"),
        (Self::Fleet, "fleet", "the law of N followers in one controller's step, per follower"),
        (Self::Hop, "hop", "one hop between two processes on two cores"),
        (Self::Chain, "chain", "leader -> observer -> controller: from the leader's tick until the command is sent"),
        (Self::Tick, "tick", "how late a tick begins"),
        (Self::Lockstep, "lockstep", "ticks per second where nobody waits for the time"),
        (Self::Run, "run", "a whole `corotate run`: start, stop, memory"),
        (Self::Toll, "toll", "system calls, faults, context switches and allocations per tick"),
        (Self::Processor, "processor", "processor time per tick of every role, by how roles wait"),
    ];

    /// The row of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|(_, known, _)| *known == name).map(|(row, ..)| row)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        self.entry().1
    }

    /// What it is, in words.
    pub fn title(self) -> &'static str {
        self.entry().2
    }

    fn entry(self) -> (Self, &'static str, &'static str) {
        let entry = Self::ALL.into_iter().find(|(row, ..)| *row == self);
        entry.expect("the table of rows has every row")
    }
}

/// What a figure is held against.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Beside {
    /// The other figure, of the same row.
    pub figure: String,
    /// This one over that one.
    pub ratio: f64,
}

/// One thing that was measured.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Figure {
    /// Its row.
    pub row: Row,
    /// What it is; unique in its row.
    pub name: String,
    /// The unit of `rounds`; latencies are in µs.
    pub unit: &'static str,
    /// The median over the rounds.
    pub median: f64,
    /// One value per round: of a latency, the round's median.
    pub rounds: Vec<f64>,
    /// All values of all rounds, if it is a latency.
    pub latency: Option<Percentiles>,
    /// The floor that it stands beside, if there is one.
    pub beside: Option<Beside>,
    #[serde(skip)]
    pub(super) pooled: Option<Latency>,
    #[serde(skip)]
    floor: Option<String>,
}

/// Everything that was measured.
#[derive(Debug, Default)]
pub struct Board {
    figures: Vec<Figure>,
    remarks: Vec<String>,
    grants: Vec<Grant>,
}

/// The median of some values; the mean of the middle two of an even number.
pub(super) fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        count if count % 2 == 1 => sorted[count / 2],
        count => 0.5 * (sorted[count / 2 - 1] + sorted[count / 2]),
    }
}

impl Board {
    /// Adds a round's value to a figure. `floor` names the figure of the same row that it stands beside.
    pub fn add(&mut self, row: Row, name: &str, unit: &'static str, floor: Option<&str>, value: f64) {
        self.figure(row, name, unit, floor).rounds.push(value);
        self.settle(row, name);
    }

    /// Adds a round's latencies to a figure. A round without any is none.
    pub fn record(&mut self, row: Row, name: &str, floor: Option<&str>, latency: &Latency) {
        if latency.is_empty() {
            return;
        }
        let figure = self.figure(row, name, "us", floor);
        figure.rounds.push(latency.percentiles().p50_us);
        let pooled = figure.pooled.get_or_insert_default();
        pooled.absorb(latency);
        figure.latency = Some(pooled.percentiles());
        self.settle(row, name);
    }

    /// Adds something that a reader must know.
    pub fn remark(&mut self, remark: String) {
        if !self.remarks.contains(&remark) {
            self.remarks.push(remark);
        }
    }

    /// Adds what was asked of the machine by a measuring process.
    pub(super) fn granted(&mut self, grants: Vec<Grant>) {
        for grant in grants {
            if !self.grants.contains(&grant) {
                self.grants.push(grant);
            }
        }
    }

    pub(super) fn take_grants(&mut self) -> Vec<Grant> {
        std::mem::take(&mut self.grants)
    }

    /// What was measured, in the order in which it was begun.
    pub fn figures(&self) -> &[Figure] {
        &self.figures
    }

    /// What a reader must know.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// The figure of this name.
    pub fn find(&self, row: Row, name: &str) -> Option<&Figure> {
        self.figures.iter().find(|figure| figure.row == row && figure.name == name)
    }

    /// One figure over another. Of the medians of rounds: the median of the quotients of neighbouring rounds, since these
    /// had the machine in the same state.
    pub fn ratio(&self, row: Row, over: &str, under: &str) -> Option<f64> {
        let (over, under) = (self.find(row, over)?, self.find(row, under)?);
        let ratio = match (&over.latency, &under.latency) {
            (Some(over), Some(under)) => over.p50_us / under.p50_us,
            _ if over.rounds.len() == under.rounds.len() => {
                median(&over.rounds.iter().zip(&under.rounds).map(|(over, under)| over / under).collect::<Vec<_>>())
            }
            _ => over.median / under.median,
        };
        ratio.is_finite().then_some(ratio)
    }

    fn figure(&mut self, row: Row, name: &str, unit: &'static str, floor: Option<&str>) -> &mut Figure {
        let index = self.figures.iter().position(|figure| figure.row == row && figure.name == name);
        let index = index.unwrap_or_else(|| {
            self.figures.push(Figure {
                row,
                name: name.to_owned(),
                unit,
                median: f64::NAN,
                rounds: Vec::new(),
                latency: None,
                beside: None,
                pooled: None,
                floor: floor.map(str::to_owned),
            });
            self.figures.len() - 1
        });
        &mut self.figures[index]
    }

    fn settle(&mut self, row: Row, name: &str) {
        if let Some(figure) = self.figures.iter_mut().find(|figure| figure.row == row && figure.name == name) {
            figure.median = median(&figure.rounds);
        }
    }

    /// Computes what every figure is to the one that it stands beside, once all are there.
    pub(super) fn compare(&mut self) {
        for index in 0..self.figures.len() {
            let figure = &self.figures[index];
            let beside = figure.floor.clone().and_then(|floor| {
                let ratio = self.ratio(figure.row, &figure.name, &floor)?;
                Some(Beside { figure: floor, ratio })
            });
            self.figures[index].beside = beside;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ratio_of_rounds_is_that_of_neighbours() {
        let mut board = Board::default();
        // The machine slows down by ten in the midst: the medians alone would say anything.
        for (ours, floor) in [(2.0, 1.0), (2.0, 1.0), (20.0, 10.0)] {
            board.add(Row::Step, "ours", "ns", Some("floor"), ours);
            board.add(Row::Step, "floor", "ns", None, floor);
        }
        board.compare();
        assert_eq!(board.find(Row::Step, "ours").unwrap().beside, Some(Beside { figure: "floor".into(), ratio: 2.0 }));
        assert_eq!(board.find(Row::Step, "floor").unwrap().beside, None);
        assert!(board.ratio(Row::Hop, "ours", "floor").is_none());
    }

    #[test]
    fn latencies_are_pooled_and_nothing_is_removed() {
        let mut board = Board::default();
        for round in 1..=3_u64 {
            let mut latency = Latency::default();
            (0..100).for_each(|_| latency.record(0, round * 1000));
            latency.record(0, 1_000_000_000);
            board.record(Row::Hop, "hop", None, &latency);
        }
        let figure = board.find(Row::Hop, "hop").unwrap();
        let pooled = figure.latency.unwrap();
        assert_eq!((pooled.count, figure.rounds.len()), (303, 3));
        assert!(pooled.max_us > 0.99e6 && (figure.median - 2.0).abs() < 0.01, "{figure:?}");
    }

    #[test]
    fn every_row_has_a_name_of_its_own() {
        for (row, name, _) in Row::ALL {
            assert_eq!((Row::named(name), row.name()), (Some(row), name));
        }
        assert_eq!(median(&[4.0, 1.0, 3.0, 2.0]), 2.5);
    }
}
