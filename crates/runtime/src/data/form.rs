//! What is told of a log beforehand, what a form of file gives of it, and why it cannot be read.

use super::stamp::Stamp;
use super::unit::{RateUnit, TimeUnit};
use std::io;
use std::path::PathBuf;

/// What is known of a log beforehand. All that is not given is taken from the names of its columns.
///
/// ```
/// # extern crate corotate_runtime as corotate;
/// use corotate::data::{Log, Options, RateUnit};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let text = "run;t [ms];wx;wy;wz\na;0;180;0;90\na;10;;0;90\na;20;180;0;90\nb;0;0;0;0\n";
/// let options = Options { rate_unit: Some(RateUnit::DegreesPerSecond), by: Some("run".into()), ..Options::default() };
/// let mut log = Log::from_csv(text.as_bytes(), "gyro.csv".as_ref(), &options)?;
/// let first = log.next().expect("there are rows")?;
/// assert_eq!(first.rate_rad_s[0], std::f64::consts::PI);
/// let second = log.next().expect("the row without wx is left out")?;
/// assert_eq!((second.row, second.time_s, second.begins), (4, 0.02, false));
/// let third = log.next().expect("another run")?;
/// assert_eq!((third.segment, third.begins), (1, true));
/// assert_eq!(log.counts().incomplete, 1);
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone)]
pub struct Options {
    /// The topic of an MCAP file, or the end of its name. Such a file needs none of the other names and units.
    pub topic: Option<String>,
    /// The column of time stamps, by name, or by number from 1 where there is no header.
    pub time: Option<String>,
    /// The columns of the three rates; a `-` stands for one that the log does not have.
    pub rates: Option<[String; 3]>,
    /// The unit of the stamps.
    pub time_unit: Option<TimeUnit>,
    /// The unit of the rates.
    pub rate_unit: Option<RateUnit>,
    /// A new value in this column begins a new segment.
    pub by: Option<String>,
    /// A longer pause begins a new segment, s.
    pub gap_s: Option<f64>,
    /// Whether the first row has names.
    pub header: bool,
    /// Rows that lack one of these rates are left out.
    pub needed: [bool; 3],
}

impl Default for Options {
    fn default() -> Self {
        Self {
            topic: None,
            time: None,
            rates: None,
            time_unit: None,
            rate_unit: None,
            by: None,
            gap_s: None,
            header: true,
            needed: [true; 3],
        }
    }
}

/// Why a log cannot be read.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum DataError {
    /// The system says no.
    #[error("cannot read {}: {source}; name a file that can be read", path.display())]
    #[strum(serialize = "cannot-read")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// There is not one row of numbers.
    #[error("{}: it has no row of numbers; give it at least one below its header", path.display())]
    #[strum(serialize = "no-rows")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// A column is not there, or it is not clear which one is meant.
    #[error("{}: {reason}; {remedy}. Its columns: {columns}", path.display())]
    #[strum(serialize = "no-such-column")]
    Column {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
        /// What to do.
        remedy: String,
        /// The columns that there are.
        columns: String,
    },
    /// What stands in a cell is no number.
    #[error("{}:{line}: column {column}: `{text}` {reason}", path.display())]
    #[strum(serialize = "not-a-number")]
    Cell {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The column's name.
        column: String,
        /// What stands there.
        text: String,
        /// Why it is none, and what to do.
        reason: String,
    },
    /// A row has more or fewer cells than the others.
    #[error(
        "{}:{line}: the row has {found} cells, the first one has {expected}; mend it, or if its numbers have a decimal comma \
         write them with a point", path.display()
    )]
    #[strum(serialize = "row-length")]
    Cells {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// How many it has.
        found: usize,
        /// How many it should have.
        expected: usize,
    },
    /// The file is no text of lines.
    #[error("{}:{line}: {reason}", path.display())]
    #[strum(serialize = "not-a-log")]
    Form {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// The unit was assumed, and cannot be right.
    #[error(
        "{}: the usual interval is {interval_s} s if the stamps are in {unit}, as assumed; say what they are in with a unit of \
         time (s, ms, us, ns)", path.display()
    )]
    #[strum(serialize = "implausible-unit")]
    Unit {
        /// The file.
        path: PathBuf,
        /// The usual interval.
        interval_s: f64,
        /// The unit that was assumed.
        unit: TimeUnit,
    },
    /// An option is no possible one.
    #[error("{name}: {reason}")]
    #[strum(serialize = "impossible-option")]
    Option {
        /// The option.
        name: &'static str,
        /// What is wrong, and what to do.
        reason: String,
    },
}

/// What was made of the names of a log's columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Meaning {
    /// The column of time, and its unit.
    pub time: (String, TimeUnit),
    /// The columns of the rates, and their unit; a `-` for one that is not there.
    pub rates: ([String; 3], RateUnit),
    /// The units that no name and no option told.
    pub assumed: Vec<&'static str>,
}

/// One row as the file has it, but in SI units.
#[derive(Debug, Clone, Default)]
pub(super) struct Row {
    pub number: u64,
    /// None in a row without time.
    pub stamp: Option<Stamp>,
    pub rate_rad_s: [f64; 3],
    /// What stands in the column that segments are told by.
    pub key: Vec<u8>,
}

/// A form of file.
pub(super) trait Rows {
    /// Reads the next row into `row`; false at the end.
    fn read(&mut self, row: &mut Row) -> Result<bool, DataError>;

    /// What its columns mean.
    fn meaning(&self) -> &Meaning;
}
