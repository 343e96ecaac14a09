//! Where everything that was measured is collected: one value per round, and the distribution of all values.
//!
//! Must not drop a value, nor round one.

use crate::telemetry::{Grant, Latency, Percentiles, quantile, sorted};

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
    pub row: &'static str,
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

impl Figure {
    fn push(&mut self, round: f64) {
        self.rounds.push(round);
        self.median = median(self.rounds.iter().copied());
    }
}

/// Everything that was measured.
#[derive(Debug, Default)]
pub struct Board {
    /// The row that is being measured.
    row: &'static str,
    figures: Vec<Figure>,
    remarks: Vec<String>,
    pub(super) grants: Vec<Grant>,
}

/// The median of some values.
fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    quantile(&sorted(values), 0.5).unwrap_or(f64::NAN)
}

impl Board {
    /// Begins a row: what is added from here on is its.
    pub fn begin(&mut self, row: &'static str) {
        self.row = row;
    }

    /// Adds a round's value to a figure. `floor` names the figure of the same row that it stands beside.
    pub fn add(&mut self, name: &str, unit: &'static str, floor: Option<&str>, value: f64) {
        self.figure(name, unit, floor).push(value);
    }

    /// Adds a round's latencies to a figure. A round without any is none.
    pub fn record(&mut self, name: &str, floor: Option<&str>, latency: &Latency) {
        if latency.is_empty() {
            return;
        }
        let figure = self.figure(name, "us", floor);
        figure.push(latency.percentiles().p50_us);
        let pooled = figure.pooled.get_or_insert_default();
        pooled.absorb(latency);
        figure.latency = Some(pooled.percentiles());
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

    /// What was measured, in the order in which it was begun.
    pub fn figures(&self) -> &[Figure] {
        &self.figures
    }

    /// What a reader must know.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// The figure of this name.
    pub fn find(&self, row: &str, name: &str) -> Option<&Figure> {
        self.figures.iter().find(|figure| figure.row == row && figure.name == name)
    }

    /// One figure over another. Of the medians of rounds: the median of the quotients of neighbouring rounds, since these
    /// had the machine in the same state.
    pub fn ratio(&self, row: &str, over: &str, under: &str) -> Option<f64> {
        let (over, under) = (self.find(row, over)?, self.find(row, under)?);
        let ratio = match (&over.latency, &under.latency) {
            (Some(over), Some(under)) => over.p50_us / under.p50_us,
            _ if over.rounds.len() == under.rounds.len() => {
                median(over.rounds.iter().zip(&under.rounds).map(|(over, under)| over / under))
            }
            _ => over.median / under.median,
        };
        ratio.is_finite().then_some(ratio)
    }

    fn figure(&mut self, name: &str, unit: &'static str, floor: Option<&str>) -> &mut Figure {
        let row = self.row;
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
        board.begin("step");
        // The machine slows down by ten in the midst: the medians alone would say anything.
        for (ours, floor) in [(2.0, 1.0), (2.0, 1.0), (20.0, 10.0)] {
            board.add("ours", "ns", Some("floor"), ours);
            board.add("floor", "ns", None, floor);
        }
        board.compare();
        assert_eq!(board.find("step", "ours").unwrap().beside, Some(Beside { figure: "floor".into(), ratio: 2.0 }));
        assert_eq!(board.find("step", "floor").unwrap().beside, None);
        assert!(board.ratio("hop", "ours", "floor").is_none());
    }

    #[test]
    fn latencies_are_pooled_and_nothing_is_removed() {
        let mut board = Board::default();
        board.begin("hop");
        for round in 1..=3_u64 {
            let mut latency = Latency::default();
            (0..100).for_each(|_| latency.record(0, round * 1000));
            latency.record(0, 1_000_000_000);
            board.record("hop", None, &latency);
        }
        let figure = board.find("hop", "hop").unwrap();
        let pooled = figure.latency.unwrap();
        assert_eq!((pooled.count, figure.rounds.len()), (303, 3));
        assert!(pooled.max_us > 0.99e6 && (figure.median - 2.0).abs() < 0.01, "{figure:?}");
    }
}
