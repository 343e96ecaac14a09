//! One work item of a campaign: a case to run, or a point of a margin to search. Any process may do any item.
//!
//! Must not fail: a case that cannot run becomes a row with the reason.

use super::file::{Campaign, Case, resolved};
use super::journal::Entry;
use super::margin::Searched;
use super::table::{End, MarginPoint, Metric, Row, Statistic};
use crate::config::{ClockKind, ConfigError, Document};
use crate::launch::{self, Action, Judged, Launch, MetricScore, Outcome, state_hash};
use crate::scenario::Scenario;
use crate::scenario::claims;
use std::sync::atomic::AtomicUsize;
use toml::Value;

/// The result of running a scenario.
pub(super) enum Ran {
    /// The run ended.
    Ended(Box<(Scenario, Outcome)>),
    /// The scenario is invalid.
    Invalid(ConfigError),
    /// The run could not start.
    Failed(launch::LaunchError),
}

impl Campaign {
    /// Runs a case; `None` if the number is out of range, or if `signal` interrupted it. The row is the same under every clock
    /// that loses no sample.
    pub fn run(&self, number: u64, clock: ClockKind, signal: &AtomicUsize) -> Option<Row> {
        let case = self.case(number)?;
        let ran = run(self.document(&case), clock, signal)?;
        Some(self.row(&case, &ran))
    }

    /// Returns the number of work items: all cases, then all points of all margins.
    pub fn pieces(&self) -> u64 {
        self.cases() + self.margins().iter().map(|searched| self.points(searched)).sum::<u64>()
    }

    /// Does a work item; [`collect`](Self::collect) takes its result. `None` if the number is out of range, or if `signal`
    /// interrupted it.
    pub fn work(&self, piece: u64, clock: ClockKind, signal: &AtomicUsize) -> Option<Entry> {
        let Some(mut point) = piece.checked_sub(self.cases()) else {
            return self.run(piece, clock, signal).map(Entry::Row);
        };
        for (margin, searched) in self.margins().iter().enumerate() {
            let points = self.points(searched);
            if point < points {
                let point = self.search(searched, &self.case_at(searched, point)?, clock, signal)?;
                return Some(Entry::Margin { margin, point });
            }
            point -= points;
        }
        None
    }

    /// Returns the work item of an entry, if it belongs to this campaign.
    pub(super) fn piece(&self, entry: &Entry) -> Option<u64> {
        match entry {
            Entry::Row(row) => Some(row.case).filter(|case| *case < self.cases()),
            Entry::Margin { margin, point } => {
                let before: u64 = self.margins().get(..*margin)?.iter().map(|searched| self.points(searched)).sum();
                let point = self.point(self.margins().get(*margin)?, point.case)?;
                Some(self.cases() + before + point)
            }
        }
    }

    fn search(&self, searched: &Searched, case: &Case, clock: ClockKind, signal: &AtomicUsize) -> Option<MarginPoint> {
        let holds = |value: Value| {
            let ran = run(self.document_with(case, Some((searched, &value))), clock, signal)?;
            Some(searched.such_that.holds(&self.row(case, &ran)))
        };
        let found = searched.search(holds)?;
        Some(MarginPoint {
            case: case.number,
            parameters: searched.parameters(case),
            value: found.value,
            bracket: found.bracket,
            runs: found.runs,
        })
    }

    fn row(&self, case: &Case, ran: &Ran) -> Row {
        let row = Row {
            case: case.number,
            seed: case.seed,
            parameters: case.parameters.clone(),
            verdict: "not judged: it did not run".to_owned(),
            metrics: vec![None; self.metrics().len()],
            ..Row::default()
        };
        match ran {
            Ran::Invalid(error) => Row { reason: Some(error.to_string()), ..row },
            Ran::Failed(error) => Row { exit: End::Failed, reason: Some(error.to_string()), ..row },
            Ran::Ended(ended) => self.ended(row, &ended.0, &ended.1),
        }
    }

    fn ended(&self, row: Row, scenario: &Scenario, outcome: &Outcome) -> Row {
        let Judged { books, accepted, verdict, .. } = Judged::new(scenario, outcome);
        let score = &outcome.score;
        let stopped = outcome.incidents.iter().find(|incident| incident.action == Action::Stopped);
        let (exit, reason) = match stopped {
            Some(incident) => (End::Stopped, Some(incident.to_string())),
            None if !books.balanced => (End::Failed, Some(books.problems.join("; "))),
            None if score.faulted_ticks > 0 => {
                (End::Lost, Some(format!("a body left the range of its model: lost at {} ticks", score.faulted_ticks)))
            }
            None => (End::Completed, None),
        };
        let ticks = |count: fn(&crate::telemetry::Ticks) -> u64| books.roles.values().map(count).sum();
        Row {
            accepted,
            verdict,
            exit,
            reason,
            settled_at_s: settled_at_s(scenario, &score.metrics),
            metrics: self.metrics().iter().map(|metric| value(metric, &score.metrics)).collect(),
            executed: ticks(|ticks| ticks.executed),
            missed: ticks(|ticks| ticks.missed),
            starved: ticks(|ticks| ticks.starved),
            safe: ticks(|ticks| ticks.safe),
            lost: score.faulted_ticks,
            injected: books.injected_faults,
            hash: state_hash(&outcome.reports),
            predicted_rate_per_s: self.rate().then(|| predicted_rate_per_s(scenario)).flatten(),
            ..row
        }
    }
}

/// Runs the scenario of a case; `None` if `signal` interrupted it.
fn run(document: Result<Document, ConfigError>, clock: ClockKind, signal: &AtomicUsize) -> Option<Ran> {
    let scenario = match document.and_then(|document| resolved(document, clock)) {
        Ok(scenario) => scenario,
        Err(error) => return Some(Ran::Invalid(error)),
    };
    let mut silent = |_: &launch::Progress<'_>| {};
    let mut launch = Launch { checkpoints: false, ..Launch::new(signal, &mut silent) };
    match launch::run(&scenario, &mut launch) {
        Ok(outcome) if outcome.signal != 0 => None,
        Ok(outcome) => Some(Ran::Ended(Box::new((scenario, outcome)))),
        Err(error) => Some(Ran::Failed(error)),
    }
}

/// Returns the time at which the last metric with a limit settled; `None` if one did not settle, or if no metric has a limit.
fn settled_at_s(scenario: &Scenario, metrics: &[MetricScore]) -> Option<f64> {
    let limited = metrics.iter().filter(|metric| scenario.accept.metric_max.contains_key(&metric.name));
    let times: Option<Vec<f64>> = limited.map(|metric| metric.settled_at_s).collect();
    times?.into_iter().reduce(f64::max)
}

fn value(metric: &Metric, scores: &[MetricScore]) -> Option<f64> {
    let score = scores.iter().find(|score| score.name == metric.metric)?;
    let value = match metric.statistic {
        Statistic::Last => Some(score.last),
        Statistic::SettledMax => score.settled_max,
        Statistic::Peak => score.peak,
        Statistic::Ise => Some(score.ise),
    };
    value.filter(|value| value.is_finite())
}

/// Returns the slowest proven rate of the loop; `None` if it is not proven for some body.
fn predicted_rate_per_s(scenario: &Scenario) -> Option<f64> {
    let rates: Option<Vec<f64>> = claims(scenario).iter().map(|claim| claim.loop_rate_per_s).collect();
    rates?.into_iter().reduce(f64::min)
}
