//! Options of a log, the rows that a file format yields, and the errors of reading.

use super::stamp::Stamp;
use super::unit::{RateUnit, TimeUnit};
use std::io;
use std::path::PathBuf;

/// Options for reading a log. Columns and units that are not given follow from the names of the columns.
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
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// The topic of an MCAP file, or the end of its name. MCAP needs no column names or units.
    pub topic: Option<String>,
    /// The column of time stamps, by name or by number from 1.
    pub time: Option<String>,
    /// The columns of the three rates; `-` for a missing one.
    pub rates: Option<[String; 3]>,
    /// The unit of the stamps. With [`TimeUnit::Count`] and no column, the rows are counted.
    pub time_unit: Option<TimeUnit>,
    /// The unit of the rates.
    pub rate_unit: Option<RateUnit>,
    /// A new value in this column begins a new segment.
    pub by: Option<String>,
    /// A longer pause begins a new segment, s.
    pub gap_s: Option<f64>,
    /// True if the columns have no names; they are called by number.
    pub unnamed: bool,
    /// The number of lines before the table, apart from those that the reader leaves out by itself.
    pub skip: u64,
    /// The rates that a row may lack; rows without another one are left out.
    pub may_lack: [bool; 3],
    /// The parts of the log that are read.
    pub cut: Cut,
}

/// The parts of a log that are read; each is a segment.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum Cut {
    /// All of it.
    #[default]
    Whole,
    /// Between times since the log's first row, s.
    Between(Vec<[f64; 2]>),
    /// The stretches in which one body moves freely: found by `identify_logs` and `estimate_log`.
    Free,
}

/// An error while reading a log.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum DataError {
    /// The system cannot read the file.
    #[error("cannot read {}: {source}; name a file that can be read", path.display())]
    #[strum(serialize = "cannot-read")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The log has no row of numbers.
    #[error("{}: it has no row of numbers; give it at least one below its header", path.display())]
    #[strum(serialize = "no-rows")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// A column is missing or ambiguous.
    #[error("{}: {reason}; {remedy}. Its columns: {columns}", path.display())]
    #[strum(serialize = "no-such-column")]
    Column {
        /// The file.
        path: PathBuf,
        /// The mistake.
        reason: String,
        /// The remedy.
        remedy: String,
        /// The columns of the log.
        columns: String,
    },
    /// A cell does not hold a valid number.
    #[error("{}:{line}: column {column}: `{text}` {reason}", path.display())]
    #[strum(serialize = "not-a-number")]
    Cell {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The column's name.
        column: String,
        /// The text of the cell.
        text: String,
        /// The mistake, and the remedy.
        reason: String,
    },
    /// A row has more or fewer cells than the header, or the first row.
    #[error(
        "{}:{line}: the row has {found} cells in place of {expected}; correct it, or if its numbers have a decimal comma \
         write them with a point", path.display()
    )]
    #[strum(serialize = "row-length")]
    Cells {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The number of cells in the row.
        found: usize,
        /// The number of cells in the header, or the first row.
        expected: usize,
    },
    /// The file does not have a known format.
    #[error("{}{}: {reason}", path.display(), if *line == 0 { String::new() } else { format!(":{line}") })]
    #[strum(serialize = "not-a-log")]
    Form {
        /// The file.
        path: PathBuf,
        /// The line, from 1; 0 for the whole file.
        line: u64,
        /// The mistake, and the remedy.
        reason: String,
    },
    /// An assumed unit is impossible.
    #[error("{}: {reason}, with {assumed}; {likely}", path.display())]
    #[strum(serialize = "implausible-unit")]
    Unit {
        /// The file.
        path: PathBuf,
        /// The contradiction.
        reason: String,
        /// The assumed units.
        assumed: String,
        /// The likely units, and the options for them.
        likely: String,
    },
    /// A column's name has a unit that is not known.
    #[error("{}: column `{column}`: `{unit}` is not a known unit; give {remedy}", path.display())]
    UnknownUnit {
        /// The file.
        path: PathBuf,
        /// The column.
        column: String,
        /// The text in place of a unit.
        unit: String,
        /// The option that replaces it.
        remedy: &'static str,
    },
    /// The stamps do not order the rows.
    #[error("{}: {count} of the first {rows} rows have {reason}", path.display())]
    #[strum(serialize = "stamps-out-of-order")]
    Order {
        /// The file.
        path: PathBuf,
        /// The number of rows that are out of order.
        count: usize,
        /// The number of rows.
        rows: usize,
        /// The mistake, and the remedy.
        reason: &'static str,
    },
    /// No free motion is found.
    #[error("{}: no stretch of it is the free motion of one body; cut it with --from and --to, or --segments", path.display())]
    #[strum(serialize = "not-free")]
    NotFree {
        /// The file.
        path: PathBuf,
    },
    /// An option has an invalid value.
    #[error("{name}: {reason}")]
    #[strum(serialize = "impossible-option")]
    Option {
        /// The option.
        name: &'static str,
        /// The mistake, and the remedy.
        reason: String,
    },
}

/// The columns of a log with their units.
#[derive(Debug, Clone, PartialEq)]
pub struct Meaning {
    /// The column of time stamps and its unit.
    pub time: (String, TimeUnit),
    /// The columns of the rates and their unit; `-` for a missing one.
    pub rates: ([String; 3], RateUnit),
    /// The units that were assumed, because neither a name nor an option gives them.
    pub assumed: Vec<&'static str>,
    /// The form of the table, such as its separator.
    pub found: String,
    /// The columns of an accelerometer that shows free motion, where that was found.
    pub forces: Option<[String; 3]>,
}

impl Meaning {
    /// Returns the assumed units as text; `None` if all are given.
    pub fn assumed_text(&self) -> Option<String> {
        let units = self.assumed.iter().map(|what| match *what {
            "time" => format!("{} in {}", self.time.0, self.time.1),
            _ => format!("{} in {}", self.rates.0.join(", "), self.rates.1),
        });
        (!self.assumed.is_empty()).then(|| format!("{}, as assumed", units.collect::<Vec<_>>().join(" and ")))
    }
}

/// One row of the file, in SI units.
#[derive(Debug, Clone, Default)]
pub(super) struct Row {
    pub number: u64,
    /// `None` if the row has no time.
    pub stamp: Option<Stamp>,
    pub rate_rad_s: [f64; 3],
    /// The values of an accelerometer in its own unit, where free motion is searched.
    pub force: Option<[f64; 3]>,
    /// The value in the column that separates segments.
    pub key: Vec<u8>,
}

/// The end of a file.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Ending {
    /// True if the last row is half-written.
    pub half: bool,
    /// True if zero bytes follow the text.
    pub zeros: bool,
}

/// A reader of one file format.
pub(super) trait Rows {
    /// Reads the next row into `row`; returns false at the end.
    fn read(&mut self, row: &mut Row) -> Result<bool, DataError>;

    /// Returns the meaning of the columns.
    fn meaning(&self) -> &Meaning;

    /// Returns how the file ended, once it has.
    fn ending(&self) -> Ending {
        Ending::default()
    }
}
