//! What `identify` and `estimate` share: how a log is named, read and told of.

use super::output::Exit;
use crate::data::{DataError, LogAccount, Options, RateUnit, TimeUnit};
use std::fmt::Write;

/// How a log is to be read.
#[derive(clap::Args)]
pub struct LogArguments {
    /// The topic of an MCAP file, or the end of its name [default: the only one with an angular velocity]
    #[arg(long, value_name = "TOPIC", hide_short_help = true)]
    topic: Option<String>,
    /// The column of time stamps [default: the one that is called so]
    #[arg(long, value_name = "NAME", hide_short_help = true)]
    time: Option<String>,
    /// The columns of the rates about x, y and z; a - for one that is not there [default: those that are called so]
    #[arg(long, value_name = "X,Y,Z", value_parser = three_names)]
    rates: Option<Names>,
    /// The unit of the stamps: s, ms, us or ns [default: what the column's name says, else s]
    #[arg(long, value_name = "UNIT", value_parser = time_unit, hide_short_help = true)]
    time_unit: Option<TimeUnit>,
    /// The unit of the rates: rad/s or deg/s [default: what the columns' names say, else rad/s]
    #[arg(long, value_name = "UNIT", value_parser = rate_unit, hide_short_help = true)]
    rate_unit: Option<RateUnit>,
    /// A new value in this column begins a new segment: another throw, another run
    #[arg(long, value_name = "NAME")]
    by: Option<String>,
    /// A longer pause begins a new segment, s [default: 5 usual intervals]
    #[arg(long, value_name = "S", allow_negative_numbers = true, hide_short_help = true)]
    gap: Option<f64>,
    /// The first row has no names; columns are then named by number, from 1
    #[arg(long, hide_short_help = true)]
    no_header: bool,
}

impl LogArguments {
    /// The same for the reader.
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
        .map_err(|_| "give three names with commas between, as wx,wy,wz".to_owned())
}

/// So many numbers with commas between, as an option has them.
pub fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let parsed: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse::<f64>()).collect();
    let numbers = parsed.ok().and_then(|numbers| <[f64; N]>::try_from(numbers).ok());
    let finite = numbers.filter(|numbers| numbers.iter().all(|number| number.is_finite()));
    finite.ok_or_else(|| format!("give {N} finite numbers with commas between"))
}

fn time_unit(name: &str) -> Result<TimeUnit, String> {
    TimeUnit::parse(name).ok_or_else(|| "the units of time are s, ms, us and ns".to_owned())
}

fn rate_unit(name: &str) -> Result<RateUnit, String> {
    RateUnit::parse(name).ok_or_else(|| "the units of rates are rad/s and deg/s".to_owned())
}

/// An axis by its letter or its number, 1 to 3.
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

/// The exit code of a log that cannot be read: what is in it, or how it was named, is the user's to mend.
pub fn exit_of(error: &DataError) -> Exit {
    match error {
        DataError::Read { source, .. } if source.kind() != std::io::ErrorKind::NotFound => Exit::Failure,
        _ => Exit::Usage,
    }
}

/// What was read, and what was not.
pub fn tell_log(log: &LogAccount, text: &mut String) -> std::fmt::Result {
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
        (counts.incomplete, "rows without a value that is needed, left out"),
        (counts.repeated, "rows with the stamp of the row before, left out"),
        (counts.backward, "steps back in time, each the begin of a segment"),
        (counts.gaps, "pauses, each the begin of a segment"),
    ] {
        if count > 0 {
            writeln!(text, "  {count} {what}")?;
        }
    }
    Ok(())
}

/// The same for programs.
pub fn log_json(log: &LogAccount) -> serde_json::Value {
    serde_json::json!({
        "file": log.path.display().to_string(),
        "time": { "column": log.meaning.time.0, "unit": log.meaning.time.1.to_string() },
        "rates": { "columns": log.meaning.rates.0, "unit": log.meaning.rates.1.to_string() },
        "assumed_units": log.meaning.assumed,
        "counts": log.counts,
    })
}
