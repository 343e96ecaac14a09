//! Collects all measurements: one value per round, and the distribution of all values.
//!
//! Must not drop or round a value.

use crate::telemetry::{Grant, Latency, Percentiles, quantile, sorted};

/// The comparison of a figure with another one.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Beside {
    /// The other figure, of the same row.
    pub figure: String,
    /// The figure divided by the other one.
    pub ratio: f64,
}

/// One measured quantity.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Figure {
    /// The row of the figure.
    pub row: &'static str,
    /// The name of the figure, unique in its row.
    pub name: String,
    /// The unit of `rounds`; latencies are in µs.
    pub unit: &'static str,
    /// The median over the rounds.
    pub median: f64,
    /// One value per round; for a latency, the round's median.
    pub rounds: Vec<f64>,
    /// The percentiles over all rounds, if it is a latency.
    pub latency: Option<Percentiles>,
    /// The comparison with its lower bound, if it has one.
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

/// All measurements of a benchmark run.
#[derive(Debug, Default)]
pub struct Board {
    /// The current row.
    row: &'static str,
    figures: Vec<Figure>,
    remarks: Vec<String>,
    pub(super) grants: Vec<Grant>,
}

/// Returns the median.
fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    quantile(&sorted(values), 0.5).unwrap_or(f64::NAN)
}

impl Board {
    /// Begins a row, to which all later figures belong.
    pub fn begin(&mut self, row: &'static str) {
        self.row = row;
    }

    /// Adds a round's value to a figure. `floor` names the figure of the same row with which it is compared.
    pub fn add(&mut self, name: &str, unit: &'static str, floor: Option<&str>, value: f64) {
        self.figure(name, unit, floor).push(value);
    }

    /// Adds a round's latencies to a figure. A round without latencies does not count.
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

    /// Adds a note for the reader.
    pub fn remark(&mut self, remark: String) {
        if !self.remarks.contains(&remark) {
            self.remarks.push(remark);
        }
    }

    /// Adds the privileges that a measuring process requested.
    pub(super) fn granted(&mut self, grants: Vec<Grant>) {
        for grant in grants {
            if !self.grants.contains(&grant) {
                self.grants.push(grant);
            }
        }
    }

    /// Returns the figures, in the order of their first values.
    pub fn figures(&self) -> &[Figure] {
        &self.figures
    }

    /// Returns the notes for the reader.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// Returns the figure of this name.
    pub fn find(&self, row: &str, name: &str) -> Option<&Figure> {
        self.figures.iter().find(|figure| figure.row == row && figure.name == name)
    }

    /// Returns the ratio of two figures. For values per round it is the median of the ratios of neighbouring rounds, because these
    /// found the machine in the same state.
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

    /// Compares every figure with its lower bound, once all figures are complete.
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
    fn a_ratio_compares_neighbouring_rounds() {
        let mut board = Board::default();
        board.begin("step");
        // The machine slows down tenfold halfway, so the ratio of the medians alone would be meaningless.
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
