//! `corotate estimate`: estimates the rate about one axis of a body from a log of the other two.

use super::data::{AXES, LogArguments, TO_TEXT, axis, exit_of, log_json, numbers, three, write_log};
use super::output::{CommandResult, Exit, Failure, fail, harmless, say};
use crate::data::{EstimateError, Estimated, Estimation, FilterOrder, Request, estimate_log};
use crate::estimate::{FilterKind, SegmentScore, Wheel};
use crate::files;
use crate::model::Inertia;
#[cfg(feature = "parquet")]
use crate::record::{Cell, ColumnKind, RowGroups};
use crate::report::{HiddenFacts, HiddenPage};
use crate::sample::FieldKind;
use crate::system::remedy;
use nalgebra::{Matrix3, Vector3};
use serde_json::{Value, json};
use std::fmt::Write;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Number of rows per group of a Parquet table.
#[cfg(feature = "parquet")]
const ROWS_PER_GROUP: usize = 1 << 17;
/// The largest number of segments that are listed individually.
const LISTED: usize = 12;

/// The error as a part of the rate from which a body does not fit.
const MISFIT: f64 = 0.5;
const TOO_LONG: &str = "the steps are too long for the motion, which turns by more than half a turn in one, or does not fit the \
                        body; log faster, and check the units";

/// Options of `corotate estimate`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Log: CSV, MCAP or Parquet; - for CSV from stdin
    data: PathBuf,
    #[command(flatten)]
    log: LogArguments,
    /// Axis of the estimated rate: x, y or z; its column, if any, serves only the score
    #[arg(long, value_name = "AXIS", value_parser = axis)]
    hidden: usize,
    /// Body: the output of `corotate identify --json`
    #[arg(long, value_name = "FILE", conflicts_with = "inertia", required_unless_present = "inertia")]
    body: Option<PathBuf>,
    /// Body: its principal moments of inertia, in any unit
    #[arg(long, value_name = "X,Y,Z", value_parser = three)]
    inertia: Option<Vector3<f64>>,
    /// Air damping c of the torque -c I w, 1/s [default: the body's, else 0]
    #[arg(long, value_name = "C", hide_short_help = true)]
    damping: Option<f64>,
    /// Momentum of a wheel about the sensor's axes, N m s, for an inertia in kg m2 [default: the body's, else 0]
    #[arg(long, value_name = "X,Y,Z", value_parser = three, allow_hyphen_values = true, hide_short_help = true,
        conflicts_with = "find_free")]
    wheel: Option<Vector3<f64>>,
    /// Principal axes in sensor axes: a matrix row by row, axes in columns [default: the body's, else the sensor's]
    #[arg(long, value_name = "NINE", value_parser = nine, allow_hyphen_values = true, hide_short_help = true)]
    axes: Option<Matrix3<f64>>,
    /// Filter
    #[arg(long, value_enum, default_value_t = Order::First, hide_short_help = true)]
    filter: Order,
    /// Decay rate of the estimate's errors, 1/s [default: chosen from noise and motion]
    #[arg(long, value_name = "RATE")]
    decay: Option<f64>,
    /// Standard deviation of a measured rate for the Kalman filter, rad/s [default: estimated from the log]
    #[arg(long, value_name = "RAD/S", hide_short_help = true)]
    noise: Option<f64>,
    /// First estimate of every segment, rad/s [default: from the first step]
    #[arg(long, value_name = "RAD/S", hide_short_help = true)]
    guess: Option<f64>,
    /// Measured rates below this do not determine the hidden one, rad/s [default: 10 times their noise]
    #[arg(long, value_name = "RAD/S", hide_short_help = true)]
    floor: Option<f64>,
    /// Write every row with its estimate: Parquet if the name ends in .parquet, else CSV
    #[arg(long, value_name = "FILE")]
    table: Option<PathBuf>,
    /// Write a page with charts of estimated and measured rate (HTML)
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    /// Print one line of JSON (corotate/estimate/v1)
    #[arg(long)]
    json: bool,
}

/// The filters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Order {
    /// First order, as in the papers: errors decay exponentially
    First,
    /// Second order: passes less noise
    Second,
    /// Kalman: gains follow the noise of each step
    Kalman,
}

const EXAMPLES: &str = "\
The score is the rms error over the second half of every segment, if the log has
the hidden rate. Steps that do not determine it are counted; the estimate then
follows the model.

Examples:
  corotate identify throws.csv --by throw --json > body.json
  corotate estimate throws.csv --by throw --hidden z --body body.json \\
           --table z.csv --page z.html
  corotate estimate gyro.csv --rates wx,wy,- --hidden z --inertia 1,2,2.5
                                   a log without the hidden rate
  corotate estimate gyro.csv --hidden y --body body.json --filter kalman";

fn nine(text: &str) -> Result<Matrix3<f64>, String> {
    numbers::<9>(text).map(|numbers| Matrix3::from_row_slice(&numbers))
}

/// Properties of a body.
struct Body {
    moments: Vector3<f64>,
    damping_per_s: f64,
    wheel: Option<Vector3<f64>>,
    axes: Option<Matrix3<f64>>,
}

/// Executes `corotate estimate`.
pub fn estimate(arguments: &Arguments) -> CommandResult {
    let body = body(arguments).map_err(|failure| fail(Exit::Usage, failure))?;
    let inertia = Inertia::new(body.moments.into());
    let inertia = inertia.map_err(|error| fail(Exit::Usage, Failure::prefixed("the inertia", error)))?;
    let request = Request {
        axis: arguments.hidden,
        coefficients: inertia.coefficients(),
        damping_per_s: arguments.damping.unwrap_or(body.damping_per_s),
        wheel: arguments.wheel.or(body.wheel).map(|momentum| Wheel { momentum, moments: body.moments }),
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
        let reason = format!("cannot write {}: it is the log; name another file", path.display());
        return Err(fail(Exit::Usage, Failure::new("same-file", reason)));
    }
    if cfg!(not(feature = "parquet")) && arguments.table.as_deref().is_some_and(is_parquet) {
        let reason = "--table: this program was built without Parquet; build it with `--features parquet`";
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
    let options = arguments.log.options().map_err(|error| fail(exit_of(&error), error))?;
    let done = estimate_log(&arguments.data, &options, &request, |row, segment| {
        if let Some(page) = &mut page {
            let (estimate, measured) = (&row.estimate, row.principal_rad_s[request.axis - 1]);
            page.push(row.entry.begins, row.entry.time_s, estimate.rate_rad_s, measured, estimate.observed);
        }
        table.as_mut().map_or(Ok(()), |table| table.row(row, segment, request.axis))
    });
    let estimation = done.map_err(|error| match error {
        EstimateError::Sink(error) => unwritten(&arguments.table, error),
        error => fail(exit(&error), error),
    })?;
    table.map_or(Ok(()), Table::end).map_err(|error| unwritten(&arguments.table, error))?;
    let mut results = String::new();
    write_results(&request, &estimation, &mut results).expect(TO_TEXT);
    if let (Some(page), Some(path)) = (page, &arguments.page) {
        let facts = HiddenFacts {
            title: arguments.data.display().to_string(),
            axis: AXES[request.axis - 1],
            paragraphs: results.split("\n\n").map(paragraph).collect(),
            segments: &estimation.segments,
        };
        let written = files::write(path, page.html(&facts).as_bytes());
        written.map_err(|error| unwritten(&arguments.page, error))?;
    }
    let text = match arguments.json {
        true => format!("{}\n", to_json(&request, &estimation)),
        false => {
            let files = [&arguments.table, &arguments.page].into_iter().flatten();
            files.fold(harmless(&results), |text, path| format!("{text}{}\n", path.display()))
        }
    };
    say(&text)?;
    useless(&estimation).map_or(Ok(Exit::Ok), |failure| Err(fail(Exit::Failure, failure)))
}

/// Returns the reason why no sample has a usable estimate.
fn useless(estimation: &Estimation) -> Option<Failure> {
    let [samples, unobserved, too_long] = totals(&estimation.segments);
    let steps = samples.saturating_sub(estimation.segments.len() as u64);
    if 10 * estimation.diverged > samples {
        let reason = "the estimate diverged: the body or its damping is another one, or a unit; see the numbers above";
        return Some(Failure::new("diverged", reason));
    }
    if unobserved < steps || steps == 0 {
        return None;
    }
    Some(match 2 * too_long > unobserved {
        true => Failure::new("steps-too-long", format!("no estimate: {TOO_LONG}")),
        false => {
            let floor = estimation.floor_rad_s;
            let remedy = "give --floor, otherwise ten times the noise of the log's start, or take out outliers there";
            let reason =
                format!("no estimate: both measured rates are below {floor:.2e} rad/s at every sample; {remedy}");
            Failure::new("never-observed", reason)
        }
    })
}

/// Returns the numbers of samples, of unobservable steps, and of those that were too long.
fn totals(segments: &[(String, SegmentScore)]) -> [u64; 3] {
    segments.iter().fold([0; 3], |[samples, unobserved, too_long], (_, score)| {
        [samples + score.samples, unobserved + score.unobserved, too_long + score.too_long]
    })
}

/// Returns a number with four decimals, or in powers of ten if it is large.
fn figure(value: f64) -> String {
    if value.abs() < 1e6 { format!("{value:.4}") } else { format!("{value:.3e}") }
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

/// Returns true if both paths lead to the same file.
fn is_same(a: &Path, b: &Path) -> bool {
    let identity = |path: &Path| std::fs::metadata(path).ok().map(|about| (about.dev(), about.ino()));
    identity(a).is_some_and(|file| Some(file) == identity(b))
}

/// Returns the body given by the options.
fn body(arguments: &Arguments) -> Result<Body, Failure> {
    let Some(path) = &arguments.body else {
        let moments = arguments.inertia.unwrap_or_else(Vector3::zeros);
        return Ok(Body { moments, damping_per_s: 0.0, wheel: None, axes: None });
    };
    let text = std::fs::read_to_string(path)
        .map_err(|error| format!("cannot read {}: {error}; name a readable file", path.display()))
        .map_err(|reason| Failure::new("cannot-read", reason))?;
    read_body(&text).map_err(|(code, reason)| {
        let remedy = "give the output of `corotate identify --json`";
        Failure::new(code, format!("{}: {reason}; {remedy}", path.display()))
    })
}

/// Parses the output of `identify`.
fn read_body(text: &str) -> Result<Body, (&'static str, String)> {
    #[derive(serde::Deserialize)]
    struct Found {
        inertia_kg_m2: [f64; 3],
        damping_per_s: f64,
        wheel_n_m_s: Option<[f64; 3]>,
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
    let wheel = found.wheel_n_m_s.map(Vector3::from);
    Ok(Body { moments: found.inertia_kg_m2.into(), damping_per_s: found.damping_per_s, wheel, axes })
}

/// Columns of tables, after the segment's name.
const COLUMNS: [(&str, FieldKind); 7] = [
    ("row", FieldKind::U64),
    ("time_s", FieldKind::F64),
    ("estimate_rad_s", FieldKind::F64),
    ("deviation_rad_s", FieldKind::F64),
    ("measured_rad_s", FieldKind::F64),
    ("error_rad_s", FieldKind::F64),
    ("observed", FieldKind::U64),
];

/// A writer of rows with estimates.
enum Table {
    Csv(Box<csv::Writer<files::Created>>),
    #[cfg(feature = "parquet")]
    Parquet(Box<RowGroups<files::Created>>),
}

impl Table {
    fn begin(path: &Path) -> io::Result<Self> {
        if is_parquet(path) {
            return Self::begin_parquet(path);
        }
        let mut out = csv::Writer::from_writer(files::create(path)?);
        out.write_record(["segment"].into_iter().chain(COLUMNS.map(|(name, _)| name)))?;
        Ok(Self::Csv(Box::new(out)))
    }

    #[cfg(feature = "parquet")]
    fn begin_parquet(path: &Path) -> io::Result<Self> {
        let columns = COLUMNS.map(|(name, kind)| (name.to_owned(), kind.into()));
        let columns = [("segment".to_owned(), ColumnKind::Word)].into_iter().chain(columns).collect();
        let about = vec![("version", env!("CARGO_PKG_VERSION").to_owned())];
        RowGroups::begin(files::create(path)?, "estimate", columns, false, about, ROWS_PER_GROUP)
            .map(|groups| Self::Parquet(Box::new(groups)))
    }

    /// Fails: built without Parquet.
    #[cfg(not(feature = "parquet"))]
    fn begin_parquet(_path: &Path) -> io::Result<Self> {
        Err(io::ErrorKind::Unsupported.into())
    }

    fn row(&mut self, row: &Estimated, segment: &str, axis: usize) -> io::Result<()> {
        let measured = row.principal_rad_s[axis - 1];
        let numbers = [
            row.entry.time_s,
            row.estimate.rate_rad_s,
            row.estimate.deviation_rad_s.unwrap_or(f64::NAN),
            measured,
            row.estimate.rate_rad_s - measured,
        ];
        let observed = u64::from(row.estimate.observed);
        match self {
            Self::Csv(out) => {
                let text = |value: f64| if value.is_finite() { format!("{value:?}") } else { String::new() };
                let cells = [segment.to_owned(), row.entry.row.to_string()].into_iter().chain(numbers.map(text));
                Ok(out.write_record(cells.chain([observed.to_string()]))?)
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

/// Returns true if the table's name ends in .parquet.
fn is_parquet(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("parquet"))
}

/// Returns median and 90th percentile of the finite values; `None` without any.
fn percentiles(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    // Linear interpolation between neighbours.
    let at = |part: f64| {
        let place = part * last as f64;
        let (low, rest) = (place as usize, place.fract());
        sorted[low] + rest * (sorted[(low + 1).min(last)] - sorted[low])
    };
    Some([at(0.5), at(0.9)])
}

/// Statistics over all segments.
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

/// Returns a part as per cent.
fn percent(part: f64) -> String {
    if part < 1e4 { format!("{:.2}", 100.0 * part) } else { format!("{:.2e}", 100.0 * part) }
}

/// Returns a part of the text without its indents, one sentence per line; a deeper indent continues a sentence.
fn paragraph(part: &str) -> String {
    part.trim().replace("\n    ", " ").replace("\n  ", "\n")
}

fn write_results(request: &Request, estimation: &Estimation, text: &mut String) -> std::fmt::Result {
    write_log(&estimation.log, text)?;
    let [a1, a2, a3] = request.coefficients.into();
    let hidden = AXES[request.axis - 1];
    writeln!(text, "\nestimate of the rate about {hidden}, for a body with a = ({a1:.4}, {a2:.4}, {a3:.4})")?;
    if request.damping_per_s != 0.0 {
        writeln!(text, "  damping {:.4} 1/s", request.damping_per_s)?;
    }
    if let Some(wheel) = request.wheel {
        let [x, y, z] = wheel.momentum.into();
        writeln!(text, "  wheel of ({x:.3e}, {y:.3e}, {z:.3e}) N m s")?;
    }
    if request.axes.is_some() {
        writeln!(text, "  the principal axes are rotated against the sensor's")?;
    }
    match estimation.filter {
        FilterKind::First { decay_per_s } => writeln!(text, "  first-order filter, decay {decay_per_s:.2} 1/s")?,
        FilterKind::Second { bandwidth_rad_s } => {
            writeln!(text, "  second-order filter, bandwidth {bandwidth_rad_s:.2} rad/s")?;
        }
        FilterKind::Kalman { noise_rad_s, density, .. } => {
            writeln!(text, "  Kalman filter, noise {noise_rad_s:.2e} rad/s, density {density:.2e} rad2/s3")?;
        }
    }
    if let (true, Some(choice)) = (estimation.chosen, &estimation.choice) {
        writeln!(
            text,
            "  chosen decay: noise ({:.1e} rad/s) and model errors balance at {:.2} 1/s; segments of {:.2} s need {:.2} 1/s\n    \
             to forget their first estimate; change it with --decay",
            choice.noise_rad_s, choice.balance_per_s, choice.segment_s, choice.forgetting_per_s
        )?;
    }
    let [samples, unobserved, too_long] = totals(&estimation.segments);
    let blind = unobserved - too_long;
    let share = 100.0 * blind as f64 / samples.max(1) as f64;
    let floor = estimation.floor_rad_s;
    writeln!(
        text,
        "  not observable at {blind} of {samples} samples ({share:.1} %): both measured rates below {floor:.2e} rad/s"
    )?;
    if too_long > 0 {
        writeln!(text, "  ambiguous at {too_long} of {samples} samples: {TOO_LONG}")?;
    }
    if estimation.diverged > 0 {
        let diverged = estimation.diverged;
        writeln!(
            text,
            "  diverged at {diverged} of {samples} samples: the body or its damping is another one, or a unit"
        )?;
    }
    match overall(&estimation.segments) {
        Some(Overall { error_rad_s, measured_rad_s, part, scored }) => {
            let ([error, worst], [share, most]) = (error_rad_s.map(figure), part.map(percent));
            writeln!(
                text,
                "\nrms error over the second half of {scored} segments: median {error}, 90th percentile {worst} rad/s\n  \
                 relative to the rate, {measured_rad_s:.3} rad/s rms (median): median {share} %, 90th percentile {most} %"
            )?;
            if part[0] > MISFIT {
                text.push_str("note: the body does not fit this motion: its axes, its moments, its damping or a unit is another\n");
            }
            for (name, score) in estimation.segments.iter().filter(|_| estimation.segments.len() <= LISTED) {
                let (error, measured) = (score.error_rad_s, score.measured_rad_s);
                writeln!(text, "  {name}: {} of {measured:.3} rad/s, {} samples", figure(error), score.samples)?;
            }
            Ok(())
        }
        None if estimation.log.meaning.rates.0[request.axis - 1] == "-" => {
            writeln!(text, "\nno score: the log lacks the rate about {hidden}")
        }
        None => writeln!(text, "\nno score: no sample has both an estimate and a measured rate about {hidden}"),
    }
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
        "wheel_n_m_s": request.wheel.map(|wheel| <[f64; 3]>::from(wheel.momentum)),
        "filter": filter,
        "floor_rad_s": estimation.floor_rad_s,
        "rate_chosen": estimation.chosen,
        "diverged": estimation.diverged,
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
            "too_long": score.too_long,
            "error_rad_s": score.error_rad_s, "measured_rad_s": score.measured_rad_s,
        })).collect::<Vec<_>>(),
    })
}
