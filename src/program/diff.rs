//! `corotate diff`: compares two recordings.

use super::output::{CommandResult, Exit, Failure, fail, harmless, remark, say};
use super::record::{exit_of, exit_with, open};
use super::runs;
use crate::record::{Comparison, SignalDiff, Tolerances, ValueDiff, diff as compare};
use std::fmt::Write;
use std::path::PathBuf;

/// Options of `corotate diff`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// A run's directory, a recording, or latest
    a: PathBuf,
    /// The second [default: the newest other recording in runs/]
    b: Option<PathBuf>,
    /// Absolute tolerance, in the field's unit
    #[arg(long, value_name = "X", default_value_t = 0.0)]
    absolute: f64,
    /// Relative tolerance, as a part of the larger number
    #[arg(long, value_name = "X", default_value_t = 0.0)]
    relative: f64,
    /// Accept incomplete recordings
    #[arg(long)]
    accept_incomplete: bool,
    /// Print one JSON object on stdout (corotate/diff/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/diff/v1";

const EXAMPLES: &str = "\
Compares all values at ticks that both recordings have, except times and
generations. Exit code 3 if they differ.

Examples:
  corotate diff runs/before        with the newest other recording, bit for bit
  corotate diff a/run.mcap b/run.mcap --absolute 1e-9
                                   numbers within 1e-9 rad/s, rad/s2, ...";

/// Executes `corotate diff`.
pub fn diff(arguments: &Arguments) -> CommandResult {
    let tolerances = Tolerances { absolute: arguments.absolute, relative: arguments.relative };
    let bad = [("absolute", arguments.absolute), ("relative", arguments.relative)]
        .into_iter()
        .find(|(_, x)| !(0.0..).contains(x));
    if let Some((name, value)) = bad {
        return Err(fail(
            Exit::Usage,
            Failure::new("negative", format!("--{name} {value}: invalid tolerance; give 0 or more")),
        ));
    }
    let files = files(arguments).map_err(|failure| fail(Exit::Usage, failure))?;
    let failed = |error| fail(exit_of(&error), error);
    let open = |file| open(file, arguments.accept_incomplete).map_err(failed);
    let (a, b) = (open(&files[0])?, open(&files[1])?);
    let words = |comparison| if arguments.json { json(&files, comparison) } else { harmless(&table(comparison)) };
    let comparison = compare(&a, &b, tolerances).map_err(failed)?;
    say(&words(&comparison))?;
    let exit = if comparison.same() { Exit::Ok } else { Exit::NotAccepted };
    Ok(exit_with(&a, exit_with(&b, exit)))
}

/// Returns the two recordings. The second defaults to the newest other recording in `runs/`.
fn files(arguments: &Arguments) -> Result<[PathBuf; 2], Failure> {
    let a = runs::recording(Some(&arguments.a))?;
    if arguments.b.is_some() {
        return Ok([a, runs::recording(arguments.b.as_deref())?]);
    }
    let b = runs::newest_recording(&a)
        .ok_or_else(|| Failure::new("no-other-run", "runs/ has no other run with a recording; name the second run"))?;
    remark(&format!("compared with {}", b.display()));
    Ok([a, b])
}

/// Returns the comparison as JSON. A number that is not finite is null.
fn json(files: &[PathBuf; 2], comparison: &Comparison) -> String {
    let value = |first: &ValueDiff| serde_json::json!({ "tick": first.tick, "field": first.field, "a": first.values[0], "b": first.values[1] });
    let signal = |signal: &SignalDiff| {
        let max = signal
            .max
            .as_ref()
            .map(|(max, field, tick)| serde_json::json!({ "difference": max, "field": field, "tick": tick }));
        serde_json::json!({
            "signal": signal.name,
            "same": signal.same(),
            "compared_ticks": signal.compared,
            "only_a_ticks": signal.only[0],
            "only_b_ticks": signal.only[1],
            "beyond": signal.beyond,
            "first": signal.first.as_ref().map(value),
            "max": max,
            "rms": signal.rms,
        })
    };
    let object = serde_json::json!({
        "schema": SCHEMA,
        "a": files[0].display().to_string(),
        "b": files[1].display().to_string(),
        "same": comparison.same(),
        "signals": comparison.signals.iter().map(signal).collect::<Vec<_>>(),
        "only_a": comparison.only[0],
        "only_b": comparison.only[1],
    });
    format!("{object}\n")
}

fn table(comparison: &Comparison) -> String {
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = match comparison.first() {
        Some((signal, first)) => writeln!(
            text,
            "first difference: tick {}, {} {}: {:e} and {:e}",
            first.tick, signal.name, first.field, first.values[0], first.values[1]
        ),
        None => writeln!(text, "no value differs"),
    };
    let _ = writeln!(
        text,
        "{:<28} {:>9} {:>7} {:>7} {:>9} {:>10} {:>10}  largest at",
        "signal", "compared", "only a", "only b", "beyond", "max", "rms"
    );
    for signal in &comparison.signals {
        let (max, at) = signal
            .max
            .as_ref()
            .map_or((0.0, String::new()), |(max, field, tick)| (*max, format!("tick {tick}, {field}")));
        let [a, b] = signal.only;
        let _ = writeln!(
            text,
            "{:<28} {:>9} {a:>7} {b:>7} {:>9} {max:>10.2e} {:>10.2e}  {at}",
            signal.name, signal.compared, signal.beyond, signal.rms
        );
    }
    for (which, names) in ["a", "b"].iter().zip(&comparison.only) {
        for name in names {
            let _ = writeln!(text, "{name}: only in {which}");
        }
    }
    text
}
