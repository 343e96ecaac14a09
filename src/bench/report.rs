//! The end of a benchmark run: a table for people, JSON for programs, histograms for HdrHistogram's tools.
//!
//! Must not compute a figure: it reports only figures of the board.

use super::board::{Board, Figure};
use super::session::{Bench, Row};
use super::targets::{Target, Verdict};
use crate::files;
use crate::launch::plain;
use crate::system::utc;
use crate::telemetry::MachineInfo;
use crate::telemetry::{Grant, write_hgrm};
use serde::Serialize;
use std::fmt::Write as _;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::time::SystemTime;

/// Layout version of `bench.json`.
const SCHEMA: &str = "corotate/bench/v1";

/// The results of a benchmark run, as written to `bench.json`.
#[derive(Debug, Serialize)]
pub struct Results {
    schema: &'static str,
    version: &'static str,
    revision: &'static str,
    started_utc: String,
    /// True for a smoke run, whose figures are meaningless.
    pub quick: bool,
    host: MachineInfo,
    /// The scenario that was measured.
    pub scenario: String,
    /// The reasons why no target is judged; empty if all are.
    pub not_judged: Vec<String>,
    /// All requested privileges.
    pub privileges: Vec<Grant>,
    /// The measured figures.
    pub figures: Vec<Figure>,
    /// The verdicts on the targets of the measured rows.
    pub targets: Vec<Verdict>,
    /// Notes for the reader.
    pub remarks: Vec<String>,
    #[serde(skip)]
    rows: Vec<Row>,
}

impl Results {
    /// Creates the results of a run that began at `started`.
    pub fn new(bench: &Bench<'_>, mut board: Board, privileges: Vec<Grant>, started: SystemTime) -> Self {
        board.compare();
        let not_judged = bench.unjudged();
        let verdict = |(row, target): (&'static str, &Target)| {
            let verdict = target.judge(row, &board);
            Verdict { met: verdict.met.filter(|_| not_judged.is_empty()), ..verdict }
        };
        let rows = bench.rows.iter().filter(|_| bench.has_targets());
        let targets = rows.flat_map(|row| row.targets.iter().map(|target| (row.name, target)));
        Self {
            schema: SCHEMA,
            version: env!("CARGO_PKG_VERSION"),
            revision: env!("COROTATE_BUILT_REVISION"),
            started_utc: utc(started),
            quick: bench.quick,
            host: MachineInfo::local(),
            privileges,
            scenario: bench.scenarios.first().map_or("", |(name, _)| *name).to_owned(),
            targets: targets.map(verdict).collect(),
            not_judged,
            rows: bench.rows.clone(),
            figures: board.figures().to_vec(),
            remarks: board.remarks().to_vec(),
        }
    }

    /// Returns true if every judged target is met.
    pub fn met(&self) -> bool {
        self.targets.iter().all(|verdict| verdict.met != Some(false))
    }
}

/// Returns the results as text.
pub fn table(results: &Results) -> String {
    let mut text = String::new();
    let host = &results.host;
    let _ = writeln!(
        text,
        "corotate {} ({}), {} cores of {}, Linux {}",
        results.version, results.revision, host.cores, host.cpu, host.kernel
    );
    let _ = writeln!(text, "scenario {}", results.scenario);
    for reason in &results.not_judged {
        let _ = writeln!(text, "no target is judged: {reason}");
    }
    if !results.targets.is_empty() {
        let _ = writeln!(text, "\n{}", targets(&results.targets));
    }
    for Row { name, title, .. } in &results.rows {
        let figures: Vec<_> = results.figures.iter().filter(|figure| figure.row == *name).collect();
        if !figures.is_empty() {
            let _ = writeln!(text, "\n{name}: {title}\n{}", rows(&figures));
        }
    }
    for remark in &results.remarks {
        let _ = writeln!(text, "note: {remark}");
    }
    let (granted, denied): (Vec<_>, Vec<_>) = results.privileges.iter().partition(|grant| grant.granted);
    let names = |grants: &[&Grant]| {
        grants.iter().map(|grant| format!("{} {}", grant.privilege, grant.asked)).collect::<Vec<_>>().join(", ")
    };
    let _ = writeln!(text, "granted: {}", if granted.is_empty() { "nothing".to_owned() } else { names(&granted) });
    for grant in denied {
        let _ = writeln!(text, "not granted: {} {}: {}", grant.privilege, grant.asked, grant.reason);
    }
    text
}

fn rows(figures: &[&Figure]) -> comfy_table::Table {
    let timed = figures.iter().any(|figure| figure.latency.is_some());
    let mut heads = vec!["", "median", "unit", "rounds, least to most"];
    if timed {
        heads.extend(["p50", "p99", "p99.9", "max"]);
    }
    heads.extend(["over", "beside"]);
    let mut table = plain(&heads);
    for figure in figures {
        let (least, most) = figure
            .rounds
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), value| (least.min(*value), most.max(*value)));
        let spread = format!("{} x {} to {}", figure.rounds.len(), number(least), number(most));
        let mut cells = vec![figure.name.clone(), number(figure.median), figure.unit.to_owned(), spread];
        if timed {
            let latency = figure.latency.map(|l| [l.p50_us, l.p99_us, l.p999_us, l.max_us].map(number));
            cells.extend(latency.unwrap_or_default());
        }
        let beside = figure.beside.as_ref();
        cells.extend([beside.map_or(String::new(), |beside| format!("{:.2} x", beside.ratio))]);
        cells.extend([beside.map_or(String::new(), |beside| beside.figure.clone())]);
        table.add_row(cells);
    }
    table
}

fn targets(targets: &[Verdict]) -> comfy_table::Table {
    let mut table = plain(&["target", "", "is", "verdict"]);
    for verdict in targets {
        let met = match (verdict.met, verdict.value) {
            (Some(true), _) => "met",
            (Some(false), _) => "NOT MET",
            (None, Some(_)) => "not judged",
            (None, None) => "not measured",
        };
        let value = verdict.value.map_or("-".to_owned(), number);
        table.add_row([verdict.row.to_owned(), verdict.what.clone(), value, met.to_owned()]);
    }
    table
}

/// Formats a number with three significant digits, or all its digits before the point.
fn number(value: f64) -> String {
    let digits = match value.abs() {
        large if large >= 100.0 => 0,
        large if large >= 10.0 => 1,
        large if large >= 0.1 || large == 0.0 => 2,
        _ => 4,
    };
    format!("{value:.digits$}")
}

/// Writes `bench.json`, `bench.txt` and `latency/<row>.<figure>.hgrm` into `directory`, which exists.
///
/// # Errors
/// [`io::Error`] if a file cannot be written.
pub fn write_results(directory: &Path, results: &Results) -> io::Result<()> {
    files::write(&directory.join("bench.txt"), table(results).as_bytes())?;
    let mut json = BufWriter::new(files::create(&directory.join("bench.json"))?);
    serde_json::to_writer_pretty(&mut json, results)?;
    json.flush()?;
    let latency = directory.join("latency");
    files::create_directories(&latency)?;
    for figure in &results.figures {
        if let Some(pooled) = &figure.pooled {
            let name = figure.name.replace(|letter: char| !letter.is_ascii_alphanumeric(), "-");
            let mut out = BufWriter::new(files::create(&latency.join(format!("{}.{name}.hgrm", figure.row)))?);
            write_hgrm(pooled, None, &mut out)?;
            out.flush()?;
        }
    }
    Ok(())
}
