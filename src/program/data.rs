//! Options and output that `identify` and `estimate` share for logs.

use super::output::Exit;
use crate::data::{DataError, LogAccount, Options, RateUnit, TimeUnit};
use std::fmt::Write;

/// Options for reading a log.
#[derive(clap::Args)]
pub struct LogArguments {
    /// Topic in an MCAP file, or the end of its name [default: the only one with an angular velocity]
    #[arg(long, value_name = "TOPIC", hide_short_help = true)]
    topic: Option<String>,
    /// Column of time stamps [default: found by its name]
    #[arg(long, value_name = "NAME", hide_short_help = true)]
    time: Option<String>,
    /// Columns of the rates about x, y and z; - if absent [default: found by name]
    #[arg(long, value_name = "X,Y,Z", value_parser = three_names)]
    rates: Option<Names>,
    /// Unit of the time stamps: s, ms, us or ns [default: from the column's name, else s]
    #[arg(long, value_name = "UNIT", value_parser = time_unit, hide_short_help = true)]
    time_unit: Option<TimeUnit>,
    /// Unit of the rates: rad/s or deg/s [default: from the columns' names, else rad/s]
    #[arg(long, value_name = "UNIT", value_parser = rate_unit, hide_short_help = true)]
    rate_unit: Option<RateUnit>,
    /// Begin a segment where this column changes
    #[arg(long, value_name = "NAME")]
    by: Option<String>,
    /// Begin a segment after a longer pause, s [default: 5 usual intervals]
    #[arg(long, value_name = "S", allow_negative_numbers = true, hide_short_help = true)]
    gap: Option<f64>,
    /// The first row is data; name columns by number, from 1
    #[arg(long, hide_short_help = true)]
    no_header: bool,
}

impl LogArguments {
    /// Returns the options for the reader.
    pub fn options(&self) -> Options {
        Options {
            topic: self.topic.clone(),
            time: self.time.clone(),
            rates: self.rates.as_ref().map(|names| names.0.clone()),
            time_unit: self.time_unit,
            rate_unit: self.rate_unit,
            by: self.by.clone(),
            gap_s: self.gap,
            header: !self.no_header,
            needed: [true; 3],
        }
    }
}

/// Three columns; a type of its own, because clap takes an array for a list.
#[derive(Clone)]
struct Names([String; 3]);

fn three_names(text: &str) -> Result<Names, String> {
    let names: Vec<String> = text.split(',').map(|name| name.trim().to_owned()).collect();
    <[String; 3]>::try_from(names)
        .map(Names)
        .map_err(|_| "give three names separated by commas, such as wx,wy,wz".to_owned())
}

/// Parses `N` numbers separated by commas.
pub fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let parsed: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse::<f64>()).collect();
    let numbers = parsed.ok().and_then(|numbers| <[f64; N]>::try_from(numbers).ok());
    let finite = numbers.filter(|numbers| numbers.iter().all(|number| number.is_finite()));
    finite.ok_or_else(|| format!("give {N} finite numbers separated by commas"))
}

fn time_unit(name: &str) -> Result<TimeUnit, String> {
    TimeUnit::parse(name).ok_or_else(|| "the units of time are s, ms, us and ns".to_owned())
}

fn rate_unit(name: &str) -> Result<RateUnit, String> {
    RateUnit::parse(name).ok_or_else(|| "the units of rates are rad/s and deg/s".to_owned())
}

/// Parses an axis, a letter or a number from 1 to 3.
pub fn axis(name: &str) -> Result<usize, String> {
    match name {
        "x" | "1" => Ok(1),
        "y" | "2" => Ok(2),
        "z" | "3" => Ok(3),
        _ => Err("the axes are x, y and z".to_owned()),
    }
}

/// The letters of the axes.
pub const AXES: [&str; 3] = ["x", "y", "z"];

/// Returns the exit code for a log that cannot be read: `Usage` if the user can correct its name or contents.
pub fn exit_of(error: &DataError) -> Exit {
    match error {
        DataError::Read { source, .. } if source.kind() != std::io::ErrorKind::NotFound => Exit::Failure,
        _ => Exit::Usage,
    }
}

/// Writes the columns, units and counts of rows of a log.
pub fn write_log(log: &LogAccount, text: &mut String) -> std::fmt::Result {
    let (meaning, counts) = (&log.meaning, &log.counts);
    writeln!(text, "{}: {} of {} rows, {} segments", log.path.display(), counts.used, counts.rows, counts.segments)?;
    let assumed = |what: &str| if meaning.assumed.contains(&what) { " (assumed)" } else { "" };
    let ((time, time_unit), (rates, rate_unit)) = (&meaning.time, &meaning.rates);
    let (time_note, rate_note) = (assumed("time"), assumed("rate"));
    writeln!(text, "  {time} in {time_unit}{time_note}; {} in {rate_unit}{rate_note}", rates.join(", "))?;
    let [shortest, longest] = counts.interval_s;
    if longest > 0.0 {
        writeln!(text, "  intervals of {shortest:.6} to {longest:.6} s")?;
    }
    for (count, what) in [
        (counts.incomplete, "rows without a needed value, left out"),
        (counts.repeated, "rows that repeat the stamp of the row before, left out"),
        (counts.backward, "steps back in time, each begins a segment"),
        (counts.gaps, "pauses, each begins a segment"),
    ] {
        if count > 0 {
            writeln!(text, "  {count} {what}")?;
        }
    }
    Ok(())
}

/// Returns the same facts as JSON.
pub fn log_json(log: &LogAccount) -> serde_json::Value {
    serde_json::json!({
        "file": log.path.display().to_string(),
        "time": { "column": log.meaning.time.0, "unit": log.meaning.time.1.to_string() },
        "rates": { "columns": log.meaning.rates.0, "unit": log.meaning.rates.1.to_string() },
        "assumed_units": log.meaning.assumed,
        "counts": log.counts,
    })
}
