//! `corotate estimate`: estimates the rate about one axis of a body from a log of the other two.

mod results;
mod table;

use super::data::{AXES, LogArguments, TO_TEXT, axis, exit_of, numbers, three};
use super::output::{CommandResult, Exit, Failure, fail, harmless, say};
use crate::data::{EstimateError, FilterOrder, Request, estimate_log};
use crate::estimate::Wheel;
use crate::files;
use crate::model::Inertia;
use crate::report::{HiddenFacts, HiddenPage};
use crate::system::remedy;
use nalgebra::{Matrix3, Vector3};
use results::{paragraph, to_json, useless, write_results};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use table::{Table, is_parquet};

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
    let request = request(arguments).map_err(|failure| fail(Exit::Usage, failure))?;
    check_outputs(arguments).map_err(|failure| fail(Exit::Usage, failure))?;
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

/// Returns the settings that the options give.
fn request(arguments: &Arguments) -> Result<Request, Failure> {
    let body = body(arguments)?;
    let inertia = Inertia::new(body.moments.into()).map_err(|error| Failure::prefixed("the inertia", error))?;
    Ok(Request {
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
    })
}

/// Refuses files that cannot be written before a long log is read.
fn check_outputs(arguments: &Arguments) -> Result<(), Failure> {
    let outputs = [&arguments.table, &arguments.page];
    if let Some(path) = outputs.into_iter().flatten().find(|path| is_same(path, &arguments.data)) {
        let reason = format!("cannot write {}: it is the log; name another file", path.display());
        return Err(Failure::new("same-file", reason));
    }
    if cfg!(not(feature = "parquet")) && arguments.table.as_deref().is_some_and(is_parquet) {
        let reason = "--table: this program was built without Parquet; build it with `--features parquet`";
        return Err(Failure::new("built-without", reason));
    }
    Ok(())
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
