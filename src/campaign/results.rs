//! The tables of a campaign that is done: CSV, Parquet with the feature, and a summary. The bytes do not depend on which process did
//! the work.
//!
//! Must not hold the rows: they pass from the journal to the files.

use super::error::SweepError;
use super::file::Campaign;
use super::journal::{Entry, Journal};
use super::table::{End, Kind, Parameter, Row, Table, columns};
use crate::files;
use serde::Serialize;
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// The campaign as a file that needs no other.
pub(crate) const CAMPAIGN: &str = "campaign.toml";
/// The rows.
const CASES: &str = "cases.csv";
#[cfg(feature = "parquet")]
const CASES_PARQUET: &str = "cases.parquet";
/// The counts and the margins.
const SUMMARY: &str = "summary.json";
/// Layout version of the summary.
const SCHEMA: &str = "corotate/sweep/v1";
/// The counts of the rows.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct Counts {
    /// Rows.
    pub rows: u64,
    /// Cases whose criteria hold.
    pub accepted: u64,
    /// Cases with a criterion that does not hold.
    pub not_accepted: u64,
    /// Cases that could not be judged.
    pub not_judged: u64,
    /// The number of cases by how they ended; zero counts are left out.
    pub exits: BTreeMap<&'static str, u64>,
    /// The cases of each verdict (accepted, not accepted, not judged) that did not run to their last tick, by how they ended.
    #[serde(skip)]
    pub otherwise: [BTreeMap<&'static str, u64>; 3],
    /// Points of margins.
    pub margin_points: u64,
}

impl Counts {
    fn take(&mut self, row: &Row) {
        self.rows += 1;
        let [accepted, refused, unjudged] = &mut self.otherwise;
        let (count, otherwise) = match row.accepted {
            Some(true) => (&mut self.accepted, accepted),
            Some(false) => (&mut self.not_accepted, refused),
            None => (&mut self.not_judged, unjudged),
        };
        *count += 1;
        if row.exit != End::Completed {
            *otherwise.entry(row.exit.name()).or_default() += 1;
        }
        *self.exits.entry(row.exit.name()).or_default() += 1;
    }
}

#[derive(Serialize)]
struct Summary<'a> {
    schema: &'static str,
    version: &'static str,
    revision: &'static str,
    identity: String,
    shard: Option<[u64; 2]>,
    counts: &'a Counts,
    #[serde(flatten)]
    table: &'a Table,
}

/// Writes the tables of a campaign whose journal is complete.
pub(super) fn write(
    directory: &Path,
    campaign: &Campaign,
    shard: Option<[u64; 2]>,
    journal: &Journal,
) -> Result<Counts, SweepError> {
    let (mut table, mut counts) = (campaign.table(), Counts::default());
    let mut kinds = vec![None; table.axes.len()];
    let columns = columns(&table);
    let mut failure = None;
    write_file(&directory.join(CASES), |out| {
        let mut csv = csv::Writer::from_writer(out);
        csv.write_record(&columns)?;
        for entry in journal.entries().map_err(io::Error::other)? {
            match entry {
                Ok(Entry::Row(row)) => {
                    counts.take(&row);
                    kinds
                        .iter_mut()
                        .zip(&row.parameters)
                        .for_each(|(kind, parameter)| *kind = Some(Kind::from_parameter(parameter).with(*kind)));
                    csv.write_record(record(&row))?;
                }
                Ok(Entry::Margin { margin, point }) => {
                    counts.margin_points += 1;
                    table.margins[margin].points.push(point);
                }
                Err(error) => {
                    failure = Some(error);
                    break;
                }
            }
        }
        csv.flush()
    })?;
    if let Some(error) = failure {
        return Err(error.into());
    }
    #[cfg(feature = "parquet")]
    {
        let kinds: Vec<_> = kinds.into_iter().map(|kind| kind.unwrap_or(Kind::Word)).collect();
        let rows = journal.entries()?.filter_map(|entry| match entry {
            Ok(Entry::Row(row)) => Some(Ok(row)),
            Ok(Entry::Margin { .. }) => None,
            Err(error) => Some(Err(io::Error::other(error))),
        });
        write_file(&directory.join(CASES_PARQUET), |out| super::parquet::write(out, &table, &kinds, rows))?;
    }
    let summary = Summary {
        schema: SCHEMA,
        version: env!("CARGO_PKG_VERSION"),
        revision: env!("COROTATE_BUILT_REVISION"),
        identity: campaign.identity(),
        shard,
        counts: &counts,
        table: &table,
    };
    write_file(&directory.join(SUMMARY), |out| {
        serde_json::to_writer_pretty(&mut *out, &summary)?;
        writeln!(out)
    })?;
    Ok(counts)
}

/// Writes a file under another name and renames it when it is complete.
pub(super) fn write_file(
    path: &Path,
    content: impl FnOnce(&mut BufWriter<files::Created>) -> io::Result<()>,
) -> Result<(), SweepError> {
    let part = path.with_extension("part");
    let attempt = || {
        let mut out = BufWriter::new(files::create(&part)?);
        content(&mut out)?;
        out.flush()?;
        drop(out);
        fs::rename(&part, path)
    };
    attempt().map_err(|source| SweepError::Write { path: path.to_owned(), source })
}

fn record(row: &Row) -> Vec<String> {
    let number = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    let mut record = vec![row.case.to_string(), row.seed.to_string()];
    record.extend(row.parameters.iter().map(Parameter::to_string));
    record.push(row.accepted.map_or(String::new(), |accepted| accepted.to_string()));
    record.extend([row.verdict.clone(), row.exit.name().to_owned(), row.reason.clone().unwrap_or_default()]);
    record.push(number(row.settled_at_s));
    record.extend(row.metrics.iter().map(|value| number(*value)));
    record.extend(
        [row.executed, row.missed, row.starved, row.safe, row.lost, row.injected].map(|count| count.to_string()),
    );
    record.extend([row.hash.clone(), number(row.predicted_rate_per_s)]);
    record
}

/// Returns the worst cases that ran, the worst first: lost or stopped, then not accepted, then by the largest first metric.
pub fn worst(table: &Table, count: usize) -> Vec<u64> {
    let first = table.metrics.iter().position(|metric| metric.statistic == super::table::Statistic::SettledMax);
    let badness = |row: &&Row| {
        let ended = row.exit != End::Completed;
        let size = first.and_then(|first| row.metrics[first]).unwrap_or(f64::INFINITY);
        // Of numbers not below zero the order is that of their bits.
        (Reverse((ended, row.accepted == Some(false), size.to_bits())), row.case)
    };
    let mut rows: Vec<&Row> =
        table.rows.iter().filter(|row| row.exit != End::Invalid && row.exit != End::Failed).collect();
    rows.sort_by_key(badness);
    rows.iter().take(count).map(|row| row.case).collect()
}
