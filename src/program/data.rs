//! Options and output that `identify` and `estimate` share for logs.

use super::output::Exit;
use crate::data::{Cut, DataError, LogAccount, Options, RateUnit, TimeUnit, read_parts};
use nalgebra::Vector3;
use std::fmt::Write;
use std::path::PathBuf;

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
    /// Rows per second, if --time is a counter or absent
    #[arg(long, value_name = "HZ", value_parser = positive, conflicts_with = "time_unit", hide_short_help = true)]
    rate_hz: Option<f64>,
    /// Unit of the rates: rad/s, deg/s, mdps, mrad/s, rpm or rev/s [default: from the columns' names, else rad/s]
    #[arg(long, value_name = "UNIT", value_parser = rate_unit, hide_short_help = true)]
    rate_unit: Option<RateUnit>,
    /// Unit of the rates, as this many rad/s
    #[arg(long, value_name = "RAD/S", value_parser = positive, conflicts_with = "rate_unit", hide_short_help = true)]
    rate_scale: Option<f64>,
    /// Begin a segment where this column changes
    #[arg(long, value_name = "NAME")]
    by: Option<String>,
    /// Begin a segment after a longer pause, s [default: 5 usual intervals]
    #[arg(long, value_name = "S", hide_short_help = true)]
    gap: Option<f64>,
    /// Read from this time on, s since the first row
    #[arg(long, value_name = "S", conflicts_with_all = ["segments", "find_free"], hide_short_help = true)]
    from: Option<f64>,
    /// Read to this time, s since the first row
    #[arg(long, value_name = "S", conflicts_with_all = ["segments", "find_free"], hide_short_help = true)]
    to: Option<f64>,
    /// Read the segments in this file: a line with begin and end of each, s since the first row
    #[arg(long, value_name = "FILE", conflicts_with = "find_free", hide_short_help = true)]
    segments: Option<PathBuf>,
    /// Find the stretches of free motion, and read only them
    #[arg(long)]
    find_free: bool,
    /// The columns have no names; name them by number, from 1
    #[arg(long, hide_short_help = true)]
    no_header: bool,
    /// Lines before the table, if they are not found out
    #[arg(long, value_name = "LINES", default_value_t = 0, hide_short_help = true)]
    skip: u64,
}

impl LogArguments {
    /// Returns the options for the reader.
    ///
    /// # Errors
    /// [`DataError`] for a file of segments.
    pub fn options(&self) -> Result<Options, DataError> {
        let cut = match (&self.segments, self.from.or(self.to)) {
            (Some(path), _) => Cut::Between(read_parts(path)?),
            (None, None) if self.find_free => Cut::Free,
            (None, None) => Cut::Whole,
            _ => Cut::Between(vec![[self.from.unwrap_or(f64::NEG_INFINITY), self.to.unwrap_or(f64::INFINITY)]]),
        };
        Ok(Options {
            topic: self.topic.clone(),
            time: self.time.clone(),
            rates: self.rates.as_ref().map(|names| names.0.clone()),
            time_unit: self.time_unit.or(self.rate_hz.map(TimeUnit::Count)),
            rate_unit: self.rate_unit.or(self.rate_scale.map(RateUnit::Scale)),
            by: self.by.clone(),
            gap_s: self.gap,
            unnamed: self.no_header,
            skip: self.skip,
            cut,
            ..Options::default()
        })
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

/// Parses a vector.
pub fn three(text: &str) -> Result<Vector3<f64>, String> {
    numbers::<3>(text).map(Vector3::from)
}

fn time_unit(name: &str) -> Result<TimeUnit, String> {
    TimeUnit::parse(name).ok_or_else(|| "the units of time are s, ms, us and ns".to_owned())
}

fn rate_unit(name: &str) -> Result<RateUnit, String> {
    RateUnit::parse(name).ok_or_else(|| "the units of rates are rad/s, deg/s, mdps, mrad/s, rpm and rev/s".to_owned())
}

fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number: &f64| number.is_finite() && *number > 0.0);
    number.ok_or_else(|| "give a number above 0".to_owned())
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

/// The reason why writing text needs no error.
pub const TO_TEXT: &str = "writing to a string does not fail";
/// The letters of the axes.
pub const AXES: [&str; 3] = ["x", "y", "z"];

/// Returns the exit code for a log that cannot be read: `Usage` if the user can correct its name or contents.
pub fn exit_of(error: &DataError) -> Exit {
    match error {
        DataError::Read { source, .. } if source.kind() != std::io::ErrorKind::NotFound => Exit::Failure,
        DataError::Unit { .. } | DataError::NotFree { .. } => Exit::Failure,
        _ => Exit::Usage,
    }
}

/// Writes the columns, units and counts of rows of a log.
pub fn write_log(log: &LogAccount, text: &mut String) -> std::fmt::Result {
    let (meaning, counts) = (&log.meaning, &log.counts);
    let (path, found) = (log.path.display(), if meaning.found.is_empty() { "" } else { ", " });
    let (used, rows, segments) = (counts.used, counts.rows, counts.segments);
    writeln!(text, "{path}: {used} of {rows} rows, {segments} segments{found}{}", meaning.found)?;
    let assumed = |what: &str| if meaning.assumed.contains(&what) { " (assumed)" } else { "" };
    let ((time, time_unit), (rates, rate_unit)) = (&meaning.time, &meaning.rates);
    let (time_note, rate_note) = (assumed("time"), assumed("rate"));
    let list = |names: &[String; 3]| {
        names.each_ref().map(|name| if name == "-" { "-".to_owned() } else { format!("`{name}`") }).join(", ")
    };
    let free = meaning.forces.as_ref().map_or(String::new(), |names| format!("; free motion shown by {}", list(names)));
    let rates = list(rates);
    writeln!(
        text,
        "  time from `{time}` in {time_unit}{time_note}; rates from {rates} in {rate_unit}{rate_note}{free}"
    )?;
    if let Some(parts) = &log.parts {
        let (used_s, whole_s) = (counts.used_s, counts.whole_s);
        writeln!(text, "  {used_s:.1} of {whole_s:.1} s read: [{}]", timeline(parts, whole_s))?;
    }
    let [shortest, longest] = counts.interval_s;
    if longest > 0.0 {
        writeln!(text, "  intervals of {shortest:.6} to {longest:.6} s")?;
    }
    for (count, what) in [
        (counts.incomplete, "rows without a needed value, left out"),
        (counts.repeated, "rows that repeat the stamp of the row before, left out"),
        (counts.backward, "steps back in time, each begins a segment"),
        (counts.gaps, "pauses, each begins a segment"),
        (counts.half_written, "row at the end, half-written and left out"),
        (counts.zero_tail, "end at zero bytes, of which nothing is read"),
    ] {
        if count > 0 {
            writeln!(text, "  {count} {what}")?;
        }
    }
    Ok(())
}

/// Draws the parts of a log along its time.
fn timeline(parts: &[[f64; 2]], whole_s: f64) -> String {
    const COLUMNS: usize = 80;
    let width_s = whole_s / COLUMNS as f64;
    let read = |column: usize| {
        let (begin_s, end_s) = (column as f64 * width_s, (column + 1) as f64 * width_s);
        parts.iter().map(|[begin, end]| (end.min(end_s) - begin.max(begin_s)).max(0.0)).sum::<f64>() / width_s
    };
    (0..COLUMNS).map(|column| [' ', '.', '-', '=', '#'][(4.0 * read(column)).ceil().clamp(0.0, 4.0) as usize]).collect()
}

/// Returns the same facts as JSON.
pub fn log_json(log: &LogAccount) -> serde_json::Value {
    serde_json::json!({
        "file": log.path.display().to_string(),
        "time": { "column": log.meaning.time.0, "unit": log.meaning.time.1.to_string() },
        "rates": { "columns": log.meaning.rates.0, "unit": log.meaning.rates.1.to_string() },
        "assumed_units": log.meaning.assumed,
        "table": log.meaning.found,
        "accelerometer": log.meaning.forces,
        "parts_s": log.parts.as_ref().map(|parts| parts.iter().map(|part| part.map(|s| s.is_finite().then_some(s)))
            .collect::<Vec<_>>()),
        "counts": log.counts,
    })
}
