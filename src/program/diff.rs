//! `corotate diff`: two recordings beside each other.

use super::output::{Ended, Exit, Failure, fail, harmless, remark, say};
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
    /// Another [default: the newest other recording in runs/]
    b: Option<PathBuf>,
    /// So much may numbers differ, in the field's own unit
    #[arg(long, value_name = "X", default_value_t = 0.0)]
    absolute: f64,
    /// So much may numbers differ, as a part of the larger one
    #[arg(long, value_name = "X", default_value_t = 0.0)]
    relative: f64,
    /// Go on with what there is of a recording that is not complete
    #[arg(long)]
    accept_incomplete: bool,
    /// Print one JSON object on stdout (corotate/diff/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/diff/v1";

const EXAMPLES: &str = "\
Values are compared at ticks that both recordings have; times and generations
are not. Exit code 3 if they differ.

Examples:
  corotate diff runs/before        that run and the newest one, bit for bit
  corotate diff a/run.mcap b/run.mcap --absolute 1e-9
                                   numbers within 1e-9 rad/s, rad/s2, ...";

/// Compares.
pub fn diff(arguments: &Arguments) -> Ended {
    let tolerances = Tolerances { absolute: arguments.absolute, relative: arguments.relative };
    let bad = [("absolute", arguments.absolute), ("relative", arguments.relative)]
        .into_iter()
        .find(|(_, x)| !(0.0..).contains(x));
    if let Some((name, value)) = bad {
        return Err(fail(Exit::Usage, Failure::new("negative", format!("--{name} {value}: a tolerance is 0 or more"))));
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

/// The two recordings. Without a second name it is the newest other recording in `runs/`.
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

/// All of it for programs. A number that is not finite is null.
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
