//! `corotate identify`: identifies a body's inertia from logs of its angular velocity.

use super::data::{AXES, LogArguments, TO_TEXT, axis, exit_of, log_json, three, write_log};
use super::output::{CommandResult, Exit, Failure, fail, harmless, say};
use crate::data::{Identified, Ways, identify_logs};
use crate::identify::{AxesFit, Finding, RecursiveFit, TensorFit, nearest_body};
use crate::observe::InertiaRatios;
use clap::ValueEnum;
use nalgebra::{Matrix3, SVector, Vector3};
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::PathBuf;

/// Options of `corotate identify`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Logs of one body: CSV, MCAP or Parquet; - for CSV from stdin
    #[arg(required = true)]
    data: Vec<PathBuf>,
    #[command(flatten)]
    log: LogArguments,
    /// Method whose result is printed last and passed to `estimate`
    #[arg(long, value_enum, default_value_t = Method::Axes)]
    method: Method,
    /// Symmetry axis of the body: x, y or z
    #[arg(long, value_name = "AXIS", value_parser = axis, hide_short_help = true)]
    symmetry_axis: Option<usize>,
    /// Momentum of a wheel in the body, about the sensor's axes, N m s; gives the moments their scale
    #[arg(long, value_name = "X,Y,Z", value_parser = three, allow_hyphen_values = true, hide_short_help = true,
        conflicts_with_all = ["symmetry_axis", "decay", "find_free"])]
    wheel: Option<Vector3<f64>>,
    /// Do not fit air damping
    #[arg(long)]
    no_damping: bool,
    /// Decay rate of the recursive filter, s2/rad3, or 1/rad with --symmetry-axis [default: 0, no forgetting]
    #[arg(long, value_name = "RATE", hide_short_help = true)]
    decay: Option<f64>,
    /// Print one line of JSON (corotate/identify/v1)
    #[arg(long)]
    json: bool,
}

/// The identification methods.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Method {
    /// Least squares; the principal axes are the sensor's
    Axes,
    /// Least squares of the whole tensor; finds the principal axes
    Tensor,
    /// The papers' recursive filter
    Recursive,
    /// The papers' filter for a body symmetric about --symmetry-axis
    Axisymmetric,
}

const EXAMPLES: &str = "\
A free motion determines the ratios of the moments of inertia. All methods are
computed and compared; notes name what the log does not determine. Columns are
found by name, or given. The last line is a body for a scenario.

Examples:
  corotate identify gyro.csv       columns found by name
  corotate identify throws.csv --by throw
                                   several throws of one body in a file
  corotate identify a.csv b.csv --time t --rates wx,wy,wz --time-unit ms \\
           --rate-unit deg/s       several files, columns and units given
  corotate identify gyro.csv --method tensor --json > body.json
                                   for `corotate estimate --body body.json`";

/// An identified body.
struct Body {
    moments: Vector3<f64>,
    deviation: Option<Vector3<f64>>,
    damping_per_s: f64,
    axes: Option<Matrix3<f64>>,
}

/// Executes `corotate identify`.
pub fn identify(arguments: &Arguments) -> CommandResult {
    let refuse = |code, reason| Err(fail(Exit::Usage, Failure::new(code, reason)));
    if arguments.method == Method::Axisymmetric && arguments.symmetry_axis.is_none() {
        return refuse("missing-axis", "--method axisymmetric lacks an axis; add --symmetry-axis x, y or z");
    }
    if arguments.wheel.is_some() && !matches!(arguments.method, Method::Axes | Method::Tensor) {
        return refuse("wheel-not-modelled", "the papers' filters know no wheel; give --method axes or tensor");
    }
    let ways = Ways {
        damping: !arguments.no_damping,
        decay: arguments.decay,
        symmetry_axis: arguments.symmetry_axis,
        wheel: arguments.wheel.unwrap_or_else(Vector3::zeros),
    };
    let options = arguments.log.options();
    let identified = options.and_then(|options| identify_logs(&arguments.data, &options, &ways));
    let identified = identified.map_err(|error| fail(exit_of(&error), error))?;
    let body = body(arguments, &identified);
    let text = match arguments.json {
        true => format!("{}\n", to_json(arguments, &identified, body.as_ref().ok())),
        false => {
            let mut text = String::new();
            write_results(arguments, &identified, body.as_ref().ok(), &mut text).expect(TO_TEXT);
            harmless(&text)
        }
    };
    say(&text)?;
    body.map(|_| Exit::Ok).map_err(|failure| fail(Exit::Failure, failure))
}

/// Returns the body identified by `--method`.
fn body(arguments: &Arguments, identified: &Identified) -> Result<Body, Failure> {
    let forbids = |finding: &&Finding| match arguments.method {
        Method::Tensor => finding.forbids_tensor(),
        Method::Axes | Method::Recursive => finding.forbids_axes(),
        // Its single coefficient needs spin about one axis only.
        Method::Axisymmetric => finding.forbids_axes() && !matches!(finding, Finding::Unexcited { .. }),
    };
    if let Some(finding) = identified.findings.iter().find(forbids) {
        if matches!(finding, Finding::NotFree { .. } | Finding::Scaled { .. }) {
            return Err(Failure::from(*finding));
        }
        return Err(Failure::prefixed("the log does not determine a body", *finding));
    }
    let nothing =
        || Failure::new("no-motion", "the log does not determine a body: no motion can be fitted; see the notes");
    let body_from_fit = |fit: &Option<TensorFit>, turned: bool| -> Result<Body, Failure> {
        let fit = fit.as_ref().ok_or_else(nothing)?;
        let scale = fit.largest.map_or(1.0, |(largest, _)| largest);
        let (moments, deviation) = (fit.moments * scale, fit.deviation.map(|deviation| deviation * scale));
        Ok(Body { moments, deviation, damping_per_s: fit.damping_per_s, axes: turned.then_some(fit.axes) })
    };
    let damping_per_s = identified.recursive_damping_per_s;
    let known =
        |moments: Vector3<f64>| Body { moments: moments / moments.max(), deviation: None, damping_per_s, axes: None };
    let found: Body = match arguments.method {
        Method::Axes => body_from_fit(&identified.body, false)?,
        Method::Tensor => body_from_fit(&identified.tensor, true)?,
        Method::Recursive => {
            let fit = identified.recursive.as_ref().ok_or_else(nothing)?;
            let ratios = InertiaRatios::new(&fit.coefficients).map_err(|error| Failure::new("no-body", error))?;
            known(Vector3::new(1.0, ratios.second, ratios.third))
        }
        Method::Axisymmetric => {
            let (Some(fit), Some(axis)) = (&identified.axisymmetric, arguments.symmetry_axis) else {
                return Err(nothing());
            };
            let mut moments = Vector3::repeat(1.0);
            moments[axis - 1] = 1.0 - fit.coefficients.x;
            known(moments)
        }
    };
    let (inertia, flattened) = nearest_body(&found.moments)
        .map_err(|error| Failure::prefixed("the best-fitting moments are impossible for a body", error))?;
    let moments = if flattened { inertia.moments_kg_m2() } else { found.moments };
    Ok(Body { moments, ..found })
}

fn write_results(
    arguments: &Arguments,
    identified: &Identified,
    body: Option<&Body>,
    text: &mut String,
) -> std::fmt::Result {
    identified.logs.iter().try_for_each(|log| write_log(log, text))?;
    let account = &identified.account;
    let (turns, pieces) = (account.turn_rad / std::f64::consts::TAU, account.pieces);
    writeln!(
        text,
        "  {:.1} s of motion, {turns:.1} turns, up to {:.2} rad/s; {pieces} pieces for resampling\n",
        account.duration_s, account.fastest_rad_s
    )?;
    if let Some(fit) = &identified.axes {
        write_axes(fit, text)?;
    }
    if let Some(fit) = &identified.body {
        writeln!(text, "one body about the sensor's axes, least squares")?;
        write_moments(fit, text)?;
    }
    if let Some(fit) = &identified.tensor {
        write_tensor(fit, text)?;
    }
    let sensor = identified.axes.map_or(0.0, |fit| fit.residual_rad_s.norm() / 3.0_f64.sqrt());
    if let Some(fit) = &identified.recursive {
        writeln!(text, "the papers' recursive filter{}", memory_text(arguments, identified))?;
        write_recursive(fit, sensor, text)?;
        if let Ok(ratios) = InertiaRatios::new(&fit.coefficients) {
            let moments = Vector3::new(1.0, ratios.second, ratios.third);
            row("moments, largest = 1", &(moments / moments.max()), text)?;
            writeln!(text, "  a1 + a2 + a3 + a1 a2 a3            {:>11.4}", ratios.closure)?;
        }
    }
    if let (Some(fit), Some(axis)) = (&identified.axisymmetric, arguments.symmetry_axis) {
        writeln!(text, "the papers' recursive filter, symmetric about {}", AXES[axis - 1])?;
        write_recursive(fit, sensor, text)?;
        writeln!(text, "  axial / transverse moment          {:>11.4}", 1.0 - fit.coefficients.x)?;
    }
    writeln!(text)?;
    identified.findings.iter().try_for_each(|finding| writeln!(text, "note: {finding}"))?;
    let Some(body) = body else { return Ok(()) };
    let ([x, y, z], method) = (body.moments.into(), name(arguments.method));
    match arguments.wheel {
        Some(_) => writeln!(text, "\ninertia_kg_m2 = [{x:.5e}, {y:.5e}, {z:.5e}]   # method {method}"),
        None => writeln!(text, "\ninertia_kg_m2 = [{x:.6}, {y:.6}, {z:.6}]   # ratios only; method {method}"),
    }
}

/// Returns the name of a method on the command line.
fn name(method: Method) -> String {
    method.to_possible_value().map_or(String::new(), |value| value.get_name().to_owned())
}

fn memory_text(arguments: &Arguments, identified: &Identified) -> String {
    let memory = arguments.decay.map_or(", no forgetting".to_owned(), |decay| format!(", decay {decay}"));
    let damping = identified.recursive_damping_per_s;
    if damping == 0.0 { memory } else { format!("{memory}, assuming damping {damping:.3} 1/s") }
}

fn write_axes(fit: &AxesFit, text: &mut String) -> std::fmt::Result {
    writeln!(text, "each sensor axis alone, least squares          {:>6}{:>12}{:>12}", "x", "y", "z")?;
    row("coefficient a", &fit.coefficients, text)?;
    deviations(fit.deviation.as_ref(), text)?;
    if fit.damping_per_s != Vector3::zeros() {
        row("damping, 1/s", &fit.damping_per_s, text)?;
        deviations(fit.damping_deviation_per_s.as_ref(), text)?;
    }
    row("R2, explained part", &fit.r_squared, text)?;
    row("residual, rad/s rms", &fit.residual_rad_s, text)?;
    writeln!(text, "  a1 + a2 + a3 + a1 a2 a3, ideally 0 {:>11.4}", fit.closure())
}

fn write_tensor(fit: &TensorFit, text: &mut String) -> std::fmt::Result {
    writeln!(text, "the whole tensor, least squares")?;
    write_moments(fit, text)?;
    for (sensor, letter) in AXES.iter().enumerate() {
        row(&format!("principal axes, {letter} component"), &fit.axes.row(sensor).transpose(), text)?;
    }
    row("angle to sensor axes, degrees", &fit.tilt_rad().map(f64::to_degrees), text)?;
    deviations(fit.axes_deviation_rad.map(|deviation| deviation.map(f64::to_degrees)).as_ref(), text)?;
    row("R2, explained part", &fit.r_squared, text)
}

fn write_moments(fit: &TensorFit, text: &mut String) -> std::fmt::Result {
    row("moments, largest = 1", &fit.moments, text)?;
    deviations(fit.deviation.as_ref(), text)?;
    if let Some((largest, deviation)) = fit.largest {
        let deviation = deviation.map_or(String::new(), |deviation| format!(" (standard deviation {deviation:.1e})"));
        writeln!(text, "  largest moment, kg m2              {largest:>11.4e}{deviation}")?;
    }
    damping(fit, text)
}

fn damping(fit: &TensorFit, text: &mut String) -> std::fmt::Result {
    if fit.damping_per_s == 0.0 {
        return Ok(());
    }
    let deviation =
        fit.damping_deviation_per_s.map_or(String::new(), |deviation| format!(" (standard deviation {deviation:.4})"));
    writeln!(text, "  damping, 1/s                       {:>11.4}{deviation}", fit.damping_per_s)
}

fn write_recursive<const N: usize>(fit: &RecursiveFit<N>, noise_rad_s: f64, text: &mut String) -> std::fmt::Result {
    row("coefficient a", &fit.coefficients, text)?;
    deviations(fit.deviation_per_rad_s.map(|deviation| deviation * noise_rad_s).as_ref(), text)?;
    let [used, unexcited, ambiguous] = fit.steps;
    writeln!(
        text,
        "  {used} steps used, {unexcited} skipped without excitation, {ambiguous} skipped as too long for the motion"
    )
}

fn row<const N: usize>(label: &str, values: &SVector<f64, N>, text: &mut String) -> std::fmt::Result {
    write!(text, "  {label:<34} ")?;
    values.iter().enumerate().try_for_each(|(column, value)| {
        let width = if column == 0 { 11 } else { 12 };
        write!(text, "{value:>width$.4}")
    })?;
    writeln!(text)
}

fn deviations<const N: usize>(values: Option<&SVector<f64, N>>, text: &mut String) -> std::fmt::Result {
    values.map_or(Ok(()), |values| row("  standard deviation", values, text))
}

fn to_json(arguments: &Arguments, identified: &Identified, body: Option<&Body>) -> Value {
    let account = &identified.account;
    let steps = |[used, unexcited, ambiguous]: &[u64; 3]| json!({ "used": used, "unexcited": unexcited, "ambiguous": ambiguous });
    let recursive = |fit: &RecursiveFit<3>| {
        json!({
            "coefficients": triple(&fit.coefficients),
            "deviation_per_rad_s": fit.deviation_per_rad_s.as_ref().map(triple),
            "excitation": fit.excitation,
            "steps": steps(&fit.steps),
            "damping_taken_per_s": identified.recursive_damping_per_s,
        })
    };
    json!({
        "schema": "corotate/identify/v1",
        "logs": identified.logs.iter().map(log_json).collect::<Vec<_>>(),
        "motion": {
            "samples": account.samples, "segments": account.segments, "pieces": account.pieces,
            "duration_s": account.duration_s, "turn_rad": account.turn_rad, "fastest_rad_s": account.fastest_rad_s,
        },
        "axes": identified.axes.as_ref().map(|fit| json!({
            "coefficients": triple(&fit.coefficients),
            "deviation": fit.deviation.as_ref().map(triple),
            "damping_per_s": triple(&fit.damping_per_s),
            "damping_deviation_per_s": fit.damping_deviation_per_s.as_ref().map(triple),
            "r_squared": triple(&fit.r_squared),
            "residual_rad_s": triple(&fit.residual_rad_s),
            "excitation_rad_s": triple(&fit.excitation_rad_s),
            "closure": fit.closure(),
        })),
        "one_body": identified.body.as_ref().map(tensor_json),
        "tensor": identified.tensor.as_ref().map(tensor_json),
        "recursive": identified.recursive.as_ref().map(recursive),
        "axisymmetric": identified.axisymmetric.map(|fit| json!({
            "axis": arguments.symmetry_axis,
            "coefficient": fit.coefficients.x,
            "deviation_per_rad_s": fit.deviation_per_rad_s.map(|deviation| deviation.x),
            "excitation_rad": fit.excitation,
            "steps": steps(&fit.steps),
        })),
        "findings": identified.findings.iter().map(ToString::to_string).collect::<Vec<_>>(),
        "body": body.map(|body| json!({
            "method": name(arguments.method),
            "inertia_kg_m2": triple(&body.moments),
            "inertia_deviation": body.deviation.as_ref().map(triple),
            "damping_per_s": body.damping_per_s,
            "wheel_n_m_s": arguments.wheel.as_ref().map(triple),
            "axes": body.axes.as_ref().map(rows),
        })),
    })
}

fn tensor_json(fit: &TensorFit) -> Value {
    json!({
        "moments": triple(&fit.moments),
        "deviation": fit.deviation.as_ref().map(triple),
        "axes": rows(&fit.axes),
        "largest_kg_m2": fit.largest.map(|(largest, _)| largest),
        "largest_deviation_kg_m2": fit.largest.and_then(|(_, deviation)| deviation),
        "axes_deviation_rad": fit.axes_deviation_rad.as_ref().map(triple),
        "tilt_rad": triple(&fit.tilt_rad()),
        "damping_per_s": fit.damping_per_s,
        "damping_deviation_per_s": fit.damping_deviation_per_s,
        "r_squared": triple(&fit.r_squared),
        "distinction": fit.distinction,
    })
}

fn triple(vector: &Vector3<f64>) -> [f64; 3] {
    (*vector).into()
}

/// Returns a matrix row by row; its columns are the principal axes.
fn rows(matrix: &Matrix3<f64>) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|row| [0, 1, 2].map(|column| matrix[(row, column)]))
}
