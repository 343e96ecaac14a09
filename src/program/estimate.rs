//! `corotate estimate`: the rate about one axis of a body from a log of the other two.

use super::data::{AXES, LogArguments, axis, exit_of, log_json, numbers, tell_log};
use super::output::{Ended, Exit, Failure, fail, harmless, say};
use crate::data::{EstimateError, Estimated, Estimation, FilterOrder, Request, estimate_log};
use crate::estimate::{FilterKind, SegmentScore};
use crate::files;
use crate::model::Inertia;
#[cfg(feature = "parquet")]
use crate::record::{Cell, ColumnKind, RowGroups};
use crate::report::{HiddenFacts, HiddenPage};
use crate::sample::FieldKind;
use crate::system::remedy;
use nalgebra::{Matrix3, Vector3};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// So many rows of a Parquet table wait for their group.
#[cfg(feature = "parquet")]
const ROWS_PER_GROUP: usize = 1 << 17;
/// So many segments are listed one by one.
const LISTED: usize = 12;

/// Options of `corotate estimate`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The log: CSV, MCAP or Parquet; - is CSV from the standard input
    data: PathBuf,
    #[command(flatten)]
    log: LogArguments,
    /// The axis whose rate is not to be read: x, y or z. Where the log has it, it is used for the score alone
    #[arg(long, value_name = "AXIS", value_parser = axis)]
    hidden: usize,
    /// The body: what `corotate identify --json` printed
    #[arg(long, value_name = "FILE", conflicts_with = "inertia", required_unless_present = "inertia")]
    body: Option<PathBuf>,
    /// The body: its principal moments of inertia, kg m2 or any other unit
    #[arg(long, value_name = "X,Y,Z", value_parser = three)]
    inertia: Option<Vector3<f64>>,
    /// Damping by the air, a torque -c I w, 1/s [default: the body's, else 0]
    #[arg(long, value_name = "C", allow_negative_numbers = true, hide_short_help = true)]
    damping: Option<f64>,
    /// The principal axes in the sensor's axes, row by row; the axes are columns [default: the body's, else the sensor's]
    #[arg(long, value_name = "NINE", value_parser = nine, allow_hyphen_values = true, hide_short_help = true)]
    axes: Option<Matrix3<f64>>,
    /// The filter
    #[arg(long, value_enum, default_value_t = Order::First, hide_short_help = true)]
    filter: Order,
    /// Its rate, 1/s: how fast errors of the estimate decay [default: chosen from noise and motion, and said]
    #[arg(long, value_name = "RATE", allow_negative_numbers = true)]
    decay: Option<f64>,
    /// Standard deviation of one measured rate for the Kalman filter, rad/s [default: that of the log]
    #[arg(long, value_name = "RAD/S", allow_negative_numbers = true, hide_short_help = true)]
    noise: Option<f64>,
    /// The first estimate of every segment, rad/s [default: what the first step tells]
    #[arg(long, value_name = "RAD/S", allow_negative_numbers = true, hide_short_help = true)]
    guess: Option<f64>,
    /// Below this the measured rates tell nothing of the hidden one, rad/s [default: 10 times their noise]
    #[arg(long, value_name = "RAD/S", allow_negative_numbers = true, hide_short_help = true)]
    floor: Option<f64>,
    /// Write every row with its estimate to this file: Parquet if its name ends so, else CSV
    #[arg(long, value_name = "FILE")]
    table: Option<PathBuf>,
    /// Draw reconstructed and measured rate on this page
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    /// Print one line of JSON (corotate/estimate/v1)
    #[arg(long)]
    json: bool,
}

/// The filters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Order {
    /// The papers': errors fall exponentially
    First,
    /// Two poles: less noise passes
    Second,
    /// Gains that weigh each step by its noise
    Kalman,
}

const EXAMPLES: &str = "\
The score is the root mean square of estimate less measured over the second half of every segment, where the log has the hidden
rate. Steps that tell nothing of it are counted; the model goes on alone there.

Examples:
  corotate identify throws.csv --by throw --json > body.json
  corotate estimate throws.csv --by throw --hidden z --body body.json --table z.csv --page z.html
  corotate estimate gyro.csv --rates wx,wy,- --hidden z --inertia 1,2,2.5        the log has no such column
  corotate estimate gyro.csv --hidden y --body body.json --filter kalman";

fn three(text: &str) -> Result<Vector3<f64>, String> {
    numbers::<3>(text).map(Vector3::from)
}

fn nine(text: &str) -> Result<Matrix3<f64>, String> {
    numbers::<9>(text).map(|numbers| Matrix3::from_row_slice(&numbers))
}

/// What is known of a body.
struct Body {
    moments: Vector3<f64>,
    damping_per_s: f64,
    axes: Option<Matrix3<f64>>,
}

/// Estimates.
pub fn estimate(arguments: &Arguments) -> Ended {
    let body = body(arguments).map_err(|failure| fail(Exit::Usage, failure))?;
    let inertia = Inertia::new(body.moments.into());
    let inertia = inertia.map_err(|error| fail(Exit::Usage, Failure::prefixed("the inertia", error)))?;
    let request = Request {
        axis: arguments.hidden,
        coefficients: inertia.coefficients(),
        damping_per_s: arguments.damping.unwrap_or(body.damping_per_s),
        axes: arguments.axes.or(body.axes),
        order: match arguments.filter {
            Order::First => FilterOrder::First,
            Order::Second => FilterOrder::Second,
            Order::Kalman => FilterOrder::Kalman,
        },
        decay_per_s: arguments.decay,
        noise_rad_s: arguments.noise,
        guess_rad_s: arguments.guess,
        floor_rad_s: arguments.floor,
    };
    let outputs = [&arguments.table, &arguments.page];
    if let Some(path) = outputs.into_iter().flatten().find(|path| is_same(path, &arguments.data)) {
        let reason = format!("{}: that is the log; name another file to write to", path.display());
        return Err(fail(Exit::Usage, Failure::new("same-file", reason)));
    }
    if cfg!(not(feature = "parquet")) && arguments.table.as_deref().is_some_and(is_parquet) {
        let reason = "--table: this program writes no Parquet; build it with `--features parquet`";
        return Err(fail(Exit::Usage, Failure::new("built-without", reason)));
    }
    let unwritten = |path: &Option<PathBuf>, error: io::Error| {
        let path = path.as_deref().unwrap_or(Path::new("")).display();
        let reason = format!("cannot write {path}: {error}; {}, or name another file", remedy(&error));
        fail(Exit::Failure, Failure::new("cannot-write", reason))
    };
    let mut page = arguments.page.is_some().then(HiddenPage::default);
    let table = arguments.table.as_deref().map(Table::begin).transpose();
    let mut table = table.map_err(|error| unwritten(&arguments.table, error))?;
    let done = estimate_log(&arguments.data, &arguments.log.options(), &request, |row, segment| {
        if let Some(page) = &mut page {
            let (told, measured) = (&row.told, row.principal_rad_s[request.axis - 1]);
            page.push(row.entry.begins, row.entry.time_s, told.rate_rad_s, measured, told.observed);
        }
        table.as_mut().map_or(Ok(()), |table| table.row(row, segment, request.axis))
    });
    let estimation = done.map_err(|error| match error {
        EstimateError::Sink(error) => unwritten(&arguments.table, error),
        error => fail(exit(&error), error),
    })?;
    table.map_or(Ok(()), Table::end).map_err(|error| unwritten(&arguments.table, error))?;
    let told = tell(&request, &estimation);
    if let (Some(page), Some(path)) = (page, &arguments.page) {
        let facts = HiddenFacts {
            title: arguments.data.display().to_string(),
            axis: AXES[request.axis - 1],
            paragraphs: told.split("\n\n").map(paragraph).collect(),
            segments: &estimation.segments,
        };
        let written = files::write(path, page.html(&facts).as_bytes());
        written.map_err(|error| unwritten(&arguments.page, error))?;
    }
    let text = match arguments.json {
        true => format!("{}\n", to_json(&request, &estimation)),
        false => {
            let files = [&arguments.table, &arguments.page].into_iter().flatten();
            files.fold(harmless(&told), |text, path| format!("{text}{}\n", path.display()))
        }
    };
    say(&text)
}

fn exit(error: &EstimateError) -> Exit {
    match error {
        EstimateError::Data(error) => exit_of(error),
        EstimateError::Sink(_) => Exit::Failure,
        EstimateError::Setup(_) | EstimateError::Axes | EstimateError::Mixed { .. } | EstimateError::NoRate { .. } => {
            Exit::Usage
        }
    }
}

/// Whether two paths lead to one file.
fn is_same(one: &Path, other: &Path) -> bool {
    let identity = |path: &Path| std::fs::metadata(path).ok().map(|about| (about.dev(), about.ino()));
    identity(one).is_some_and(|one| Some(one) == identity(other))
}

/// The body as it was given.
fn body(arguments: &Arguments) -> Result<Body, Failure> {
    let Some(path) = &arguments.body else {
        let moments = arguments.inertia.unwrap_or_else(Vector3::zeros);
        return Ok(Body { moments, damping_per_s: 0.0, axes: None });
    };
    let text = std::fs::read_to_string(path)
        .map_err(|error| format!("cannot read {}: {error}; name a file that can be read", path.display()))
        .map_err(|reason| Failure::new("cannot-read", reason))?;
    read_body(&text).map_err(|(code, reason)| {
        let remedy = "give what `corotate identify --json` printed";
        Failure::new(code, format!("{}: {reason}; {remedy}", path.display()))
    })
}

/// The body in what `identify` printed.
fn read_body(text: &str) -> Result<Body, (&'static str, String)> {
    #[derive(serde::Deserialize)]
    struct Found {
        inertia_kg_m2: [f64; 3],
        damping_per_s: f64,
        axes: Option<[[f64; 3]; 3]>,
    }
    #[derive(serde::Deserialize)]
    struct Printed {
        schema: String,
        body: Option<Found>,
    }
    let printed: Printed =
        serde_json::from_str(text).map_err(|error| ("not-a-body", format!("it has no body ({error})")))?;
    if printed.schema != "corotate/identify/v1" {
        return Err(("other-schema", format!("its schema is `{}`", printed.schema)));
    }
    let found = printed.body.ok_or_else(|| ("no-body", "the identification found no body".to_owned()))?;
    let axes = found.axes.map(|rows| Matrix3::from_fn(|row, column| rows[row][column]));
    Ok(Body { moments: found.inertia_kg_m2.into(), damping_per_s: found.damping_per_s, axes })
}

/// What tables have beside the segment's name.
const COLUMNS: [(&str, FieldKind); 7] = [
    ("row", FieldKind::U64),
    ("time_s", FieldKind::F64),
    ("estimate_rad_s", FieldKind::F64),
    ("deviation_rad_s", FieldKind::F64),
    ("measured_rad_s", FieldKind::F64),
    ("error_rad_s", FieldKind::F64),
    ("observed", FieldKind::U64),
];

/// Every row with its estimate.
enum Table {
    Csv(BufWriter<files::Created>),
    #[cfg(feature = "parquet")]
    Parquet(Box<RowGroups<files::Created>>),
}

impl Table {
    fn begin(path: &Path) -> io::Result<Self> {
        if is_parquet(path) {
            return Self::begin_parquet(path);
        }
        let mut out = BufWriter::new(files::create(path)?);
        let names = COLUMNS.map(|(name, _)| name).join(",");
        writeln!(out, "segment,{names}")?;
        Ok(Self::Csv(out))
    }

    #[cfg(feature = "parquet")]
    fn begin_parquet(path: &Path) -> io::Result<Self> {
        let columns = COLUMNS.map(|(name, kind)| (name.to_owned(), kind.into()));
        let columns = [("segment".to_owned(), ColumnKind::Word)].into_iter().chain(columns).collect();
        let about = vec![("version", env!("CARGO_PKG_VERSION").to_owned())];
        RowGroups::begin(files::create(path)?, "estimate", columns, false, about, ROWS_PER_GROUP)
            .map(|groups| Self::Parquet(Box::new(groups)))
    }

    /// Refused before anything is read.
    #[cfg(not(feature = "parquet"))]
    fn begin_parquet(_path: &Path) -> io::Result<Self> {
        Err(io::ErrorKind::Unsupported.into())
    }

    fn row(&mut self, row: &Estimated, segment: &str, axis: usize) -> io::Result<()> {
        let measured = row.principal_rad_s[axis - 1];
        let numbers = [
            row.entry.time_s,
            row.told.rate_rad_s,
            row.told.deviation_rad_s.unwrap_or(f64::NAN),
            measured,
            row.told.rate_rad_s - measured,
        ];
        let observed = u64::from(row.told.observed);
        match self {
            Self::Csv(out) => {
                write!(out, "{},{}", quoted(segment), row.entry.row)?;
                for value in numbers {
                    if value.is_finite() { write!(out, ",{value:?}")? } else { write!(out, ",")? }
                }
                writeln!(out, ",{observed}")
            }
            #[cfg(feature = "parquet")]
            Self::Parquet(groups) => {
                let [time, estimate, deviation, measured, error] = numbers.map(f64::to_bits);
                let bits = [row.entry.row, time, estimate, deviation, measured, error, observed].map(Cell::Bits);
                groups.row([Cell::Word(segment.to_owned())].into_iter().chain(bits).map(Some))
            }
        }
    }

    fn end(self) -> io::Result<()> {
        match self {
            Self::Csv(mut out) => out.flush(),
            #[cfg(feature = "parquet")]
            Self::Parquet(groups) => groups.end(),
        }
    }
}

/// Whether a table of this name is one as Parquet.
fn is_parquet(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("parquet"))
}

/// A name as a cell.
fn quoted(name: &str) -> String {
    if name.contains([',', '"', '\n', '\r']) { format!("\"{}\"", name.replace('"', "\"\"")) } else { name.to_owned() }
}

/// Median and 90th percentile of what is finite; none of nothing.
fn percentiles(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    // Between neighbours in proportion.
    let at = |part: f64| {
        let place = part * last as f64;
        let (low, rest) = (place as usize, place.fract());
        sorted[low] + rest * (sorted[(low + 1).min(last)] - sorted[low])
    };
    Some([at(0.5), at(0.9)])
}

/// What all segments say together.
struct Overall {
    error_rad_s: [f64; 2],
    measured_rad_s: f64,
    part: [f64; 2],
    scored: usize,
}

fn overall(segments: &[(String, SegmentScore)]) -> Option<Overall> {
    let scored: Vec<&SegmentScore> = segments.iter().map(|(_, score)| score).filter(|score| score.scored > 0).collect();
    Some(Overall {
        error_rad_s: percentiles(scored.iter().map(|score| score.error_rad_s))?,
        measured_rad_s: percentiles(scored.iter().map(|score| score.measured_rad_s))?[0],
        part: percentiles(scored.iter().map(|score| score.error_rad_s / score.measured_rad_s))?,
        scored: scored.len(),
    })
}

/// Returns a part of what is told without its indents, each sentence on a line of its own: a deeper indent continues one.
fn paragraph(part: &str) -> String {
    part.trim().replace("\n    ", " ").replace("\n  ", "\n")
}

fn tell(request: &Request, estimation: &Estimation) -> String {
    let mut text = String::new();
    tell_all(request, estimation, &mut text).expect("a string takes every text");
    text
}

fn tell_all(request: &Request, estimation: &Estimation, text: &mut String) -> std::fmt::Result {
    tell_log(&estimation.log, text)?;
    let [a1, a2, a3] = request.coefficients.into();
    let hidden = AXES[request.axis - 1];
    writeln!(text, "\nthe rate about {hidden}, from the other two, of a body with a = ({a1:.4}, {a2:.4}, {a3:.4})")?;
    if request.damping_per_s != 0.0 {
        writeln!(text, "  damping {:.4} 1/s", request.damping_per_s)?;
    }
    if request.axes.is_some() {
        writeln!(text, "  about principal axes that are turned against the sensor's")?;
    }
    match estimation.filter {
        FilterKind::First { decay_per_s } => writeln!(text, "  filter of first order, decay {decay_per_s:.2} 1/s")?,
        FilterKind::Second { bandwidth_rad_s } => {
            writeln!(text, "  filter of second order, bandwidth {bandwidth_rad_s:.2} rad/s")?;
        }
        FilterKind::Kalman { noise_rad_s, density, .. } => {
            writeln!(text, "  Kalman filter, noise {noise_rad_s:.2e} rad/s, density {density:.2e} rad2/s3")?;
        }
    }
    if let (true, Some(choice)) = (estimation.chosen, &estimation.choice) {
        writeln!(
            text,
            "  that rate is chosen: noise ({:.1e} rad/s) and model balance at {:.2} 1/s; segments of {:.2} s ask for {:.2} 1/s\n    \
             to forget their first estimate; --decay sets another",
            choice.noise_rad_s, choice.balance_per_s, choice.segment_s, choice.forgetting_per_s
        )?;
    }
    let (samples, unobserved) = estimation
        .segments
        .iter()
        .fold((0, 0), |(samples, unobserved), (_, score)| (samples + score.samples, unobserved + score.unobserved));
    let share = 100.0 * unobserved as f64 / samples.max(1) as f64;
    let floor = estimation.floor_rad_s;
    writeln!(
        text,
        "  not observable at {unobserved} of {samples} samples ({share:.1} %): the other two below {floor:.2e} rad/s"
    )?;
    match overall(&estimation.segments) {
        Some(overall) => {
            writeln!(
                text,
                "\nrms error over the second half of {} segments: median {:.4}, 90th percentile {:.4} rad/s",
                overall.scored, overall.error_rad_s[0], overall.error_rad_s[1]
            )?;
            writeln!(
                text,
                "  of a rate of {:.3} rad/s rms (median): {:.2} % and {:.2} % of each segment's own",
                overall.measured_rad_s,
                100.0 * overall.part[0],
                100.0 * overall.part[1]
            )?;
        }
        None => writeln!(text, "\nno score: the log does not have the rate about {hidden}")?,
    }
    if overall(&estimation.segments).is_some() && estimation.segments.len() <= LISTED {
        for (name, score) in &estimation.segments {
            let (error, measured) = (score.error_rad_s, score.measured_rad_s);
            writeln!(text, "  {name}: {error:.4} of {measured:.3} rad/s, {} samples", score.samples)?;
        }
    }
    Ok(())
}

fn to_json(request: &Request, estimation: &Estimation) -> Value {
    let filter = match estimation.filter {
        FilterKind::First { decay_per_s } => json!({ "order": "first", "decay_per_s": decay_per_s }),
        FilterKind::Second { bandwidth_rad_s } => json!({ "order": "second", "bandwidth_rad_s": bandwidth_rad_s }),
        FilterKind::Kalman { noise_rad_s, density, guess_deviation_rad_s } => json!({
            "order": "kalman", "noise_rad_s": noise_rad_s, "density_rad2_s3": density,
            "guess_deviation_rad_s": guess_deviation_rad_s,
        }),
    };
    json!({
        "schema": "corotate/estimate/v1",
        "log": log_json(&estimation.log),
        "hidden_axis": AXES[request.axis - 1],
        "coefficients": <[f64; 3]>::from(request.coefficients),
        "damping_per_s": request.damping_per_s,
        "filter": filter,
        "floor_rad_s": estimation.floor_rad_s,
        "rate_chosen": estimation.chosen,
        "choice": estimation.choice.map(|choice| json!({
            "decay_per_s": choice.decay_per_s, "balance_per_s": choice.balance_per_s,
            "forgetting_per_s": choice.forgetting_per_s, "noise_rad_s": choice.noise_rad_s,
            "drift_rad_s2": choice.drift_rad_s2, "segment_s": choice.segment_s, "interval_s": choice.interval_s,
        })),
        "score": overall(&estimation.segments).map(|overall| json!({
            "segments": overall.scored,
            "error_rad_s": { "median": overall.error_rad_s[0], "p90": overall.error_rad_s[1] },
            "measured_rad_s": { "median": overall.measured_rad_s },
            "part": { "median": overall.part[0], "p90": overall.part[1] },
        })),
        "segments": estimation.segments.iter().map(|(name, score)| json!({
            "name": name, "samples": score.samples, "scored": score.scored, "unobserved": score.unobserved,
            "error_rad_s": score.error_rad_s, "measured_rad_s": score.measured_rad_s,
        })).collect::<Vec<_>>(),
    })
}
