//! Reads a log row by row: detects the file format, leaves out unusable rows, and splits it into segments.

use super::form::{Cut, DataError, Meaning, Options, Row, Rows};
#[cfg(feature = "parquet")]
use super::parquet;
use super::plausible::Plausible;
use super::stamp::Stamp;
use super::{csv, mcap, packed};
use crate::telemetry::{quantile, sorted};
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read, Seek};
use std::path::{Path, PathBuf};

/// The number of rows read ahead to find the usual interval.
const HEAD_ROWS: usize = 256;
/// The least number of intervals by which stamps are judged.
const FEWEST: usize = 8;
/// A pause longer than this multiple of the usual interval is a gap, unless `gap_s` is given.
const GAP_INTERVALS: f64 = 5.0;

/// A row of a log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// The line in the file, or the row number in a file without lines; from 1.
    pub row: u64,
    /// The number of the segment, from 0.
    pub segment: u64,
    /// True for the first row of a segment.
    pub begins: bool,
    /// The time since the log's first row, s.
    pub time_s: f64,
    /// The angular velocity, rad/s; NaN where unknown.
    pub rate_rad_s: [f64; 3],
}

/// The counts of a log's rows, and its intervals.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct Counts {
    /// Rows read.
    pub rows: u64,
    /// Rows used.
    pub used: u64,
    /// Rows left out because a needed value is missing.
    pub incomplete: u64,
    /// Rows left out because they repeat the previous stamp.
    pub repeated: u64,
    /// Steps back in time; each begins a new segment.
    pub backward: u64,
    /// Gaps in time; each begins a new segment.
    pub gaps: u64,
    /// 1 if the last row is half-written and left out.
    pub half_written: u64,
    /// 1 if the text ends at zero bytes.
    pub zero_tail: u64,
    /// Rows left out because they are outside the parts that are read.
    pub outside: u64,
    /// The time in segments, s.
    pub used_s: f64,
    /// The time from the first row to the last, s.
    pub whole_s: f64,
    /// Number of segments.
    pub segments: u64,
    /// The shortest and the longest interval within a segment, s.
    pub interval_s: [f64; 2],
}

/// A reader of a log, from its beginning to its end.
pub struct Log {
    path: PathBuf,
    rows: Box<dyn Rows>,
    may_lack: [bool; 3],
    gap_s: f64,
    plausible: Plausible,
    /// The parts that are read, and that of the last used row.
    parts: Option<Vec<[f64; 2]>>,
    part: usize,
    /// The rows read ahead.
    head: VecDeque<Row>,
    row: Row,
    first: Option<Stamp>,
    /// The time of the last used row, s.
    last_time_s: f64,
    last_key: Vec<u8>,
    counts: Counts,
    done: bool,
}

impl Log {
    /// Opens a log; `-` is the standard input. The first bytes of a file give its format: MCAP, Parquet, else CSV.
    ///
    /// # Errors
    /// [`DataError`], here and for every row.
    pub fn open(path: &Path, options: &Options) -> Result<Self, DataError> {
        if options.cut == Cut::Free {
            let reason = "the free motion is found before a log is read; give its times".to_owned();
            return Err(DataError::Option { name: "find free", reason });
        }
        Self::open_whole(path, options)
    }

    /// Opens a log; [`Cut::Free`] reads all of it, with an accelerometer.
    pub(super) fn open_whole(path: &Path, options: &Options) -> Result<Self, DataError> {
        if path.as_os_str() == "-" {
            return Self::from_csv(io::stdin(), "standard input".as_ref(), options);
        }
        let failed = |source| DataError::Read { path: path.to_owned(), source };
        let mut file = File::open(path).map_err(failed)?;
        let about = file.metadata().map_err(failed)?;
        if about.is_dir() {
            return Err(failed(io::ErrorKind::IsADirectory.into()));
        }
        let mut named = path.to_owned();
        // A pipe cannot be read twice.
        if about.is_file() {
            let peek = |file: &mut File| -> io::Result<Vec<u8>> {
                let mut start = Vec::new();
                file.by_ref().take(packed::START_BYTES).read_to_end(&mut start)?;
                file.rewind().map(|()| start)
            };
            let mut start = peek(&mut file).map_err(failed)?;
            if let Some((unpacked, name)) = packed::unpacked(&start, &mut file, path)? {
                (file, named) = (unpacked, name);
                start = peek(&mut file).map_err(failed)?;
            }
            let path = &named;
            if let Some(error) = packed::foreign(&start, path) {
                return Err(error);
            }
            if mcap::Mcap::is_begun(&start) {
                return Self::new(Box::new(mcap::Mcap::new(file, path, options)?), path, options);
            }
            #[cfg(feature = "parquet")]
            if parquet::ParquetLog::is_begun(&start) {
                return Self::new(Box::new(parquet::ParquetLog::new(file, path, options)?), path, options);
            }
            #[cfg(not(feature = "parquet"))]
            if start.starts_with(b"PAR1") {
                let reason = "it is Parquet, and this program was built without; build it with `--features parquet`";
                return Err(DataError::Form { path: path.to_owned(), line: 0, reason: reason.to_owned() });
            }
        }
        Self::from_csv(file, &named, options)
    }

    /// Reads a table as text from any source; `path` is its name in messages.
    ///
    /// The separator, the header and the first row are found, see [`Meaning::found`]. Lines that begin with `#`, `%` or `//` are
    /// comments. An empty cell, NaN, NA or null is an unknown value.
    ///
    /// # Errors
    /// [`DataError`].
    pub fn from_csv(source: impl Read + 'static, path: &Path, options: &Options) -> Result<Self, DataError> {
        Self::new(Box::new(csv::Csv::new(Box::new(source), path, options)?), path, options)
    }

    fn new(mut rows: Box<dyn Rows>, path: &Path, options: &Options) -> Result<Self, DataError> {
        if let Some(gap_s) = options.gap_s.filter(|gap_s| !(gap_s.is_finite() && *gap_s > 0.0)) {
            let reason = format!("a pause of {gap_s} s is out of range; give a number above 0");
            return Err(DataError::Option { name: "gap", reason });
        }
        let mut head = VecDeque::new();
        while head.len() < HEAD_ROWS {
            let mut row = Row::default();
            if !rows.read(&mut row)? {
                break;
            }
            head.push_back(row);
        }
        if head.is_empty() {
            return Err(DataError::Empty { path: path.to_owned() });
        }
        let usual_s = usual_interval_s(&head);
        check_order(path, &head)?;
        let plausible = Plausible::new(path, rows.meaning(), usual_s, &head)?;
        let gap_s = options.gap_s.or(usual_s.map(|usual_s| GAP_INTERVALS * usual_s)).unwrap_or(f64::INFINITY);
        Ok(Self {
            path: path.to_owned(),
            rows,
            may_lack: options.may_lack,
            gap_s,
            first: head.iter().find_map(|row| row.stamp),
            plausible,
            parts: match &options.cut {
                Cut::Between(parts) => Some(parts.clone()),
                Cut::Whole | Cut::Free => None,
            },
            part: 0,
            head,
            row: Row::default(),
            last_time_s: f64::NAN,
            last_key: Vec::new(),
            counts: Counts { interval_s: [f64::INFINITY, 0.0], ..Counts::default() },
            done: false,
        })
    }

    /// Returns the path of the log, or its name.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the meaning of the columns.
    pub fn meaning(&self) -> &Meaning {
        self.rows.meaning()
    }

    /// Returns the longest pause within a segment, s.
    pub fn gap_s(&self) -> f64 {
        self.gap_s
    }

    /// Returns the parts that are read, s since the first row; `None` for all.
    pub fn parts(&self) -> Option<&[[f64; 2]]> {
        self.parts.as_deref()
    }

    /// Returns the counts of the rows read so far.
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// Returns the name of the last row's segment: its value in the column `by`, or its number from 1.
    pub fn segment_name(&self) -> String {
        match self.last_key.is_empty() {
            true => self.counts.segments.to_string(),
            false => String::from_utf8_lossy(&self.last_key).into_owned(),
        }
    }

    /// Returns the last row's values of an accelerometer; NaN where unknown.
    pub(super) fn force(&self) -> [f64; 3] {
        self.row.force.unwrap_or([f64::NAN; 3])
    }

    /// Returns the next used row; `None` at the end.
    fn advance(&mut self) -> Result<Option<Entry>, DataError> {
        loop {
            match self.head.pop_front() {
                Some(row) => self.row = row,
                None if self.rows.read(&mut self.row)? => {}
                None => {
                    let ending = self.rows.ending();
                    self.counts.half_written = u64::from(ending.half);
                    self.counts.zero_tail = u64::from(ending.zeros);
                    return Ok(None);
                }
            }
            self.counts.rows += 1;
            if let Some(entry) = self.take() {
                let checked = self.plausible.check(&self.path, self.rows.meaning(), entry.row, entry.rate_rad_s);
                // Like any row with an error, it is not counted.
                self.counts.rows -= u64::from(checked.is_err());
                self.counts.used -= u64::from(checked.is_err());
                return checked.map(|()| Some(entry));
            }
        }
    }

    /// Counts the current row and returns its entry; `None` if it is left out.
    fn take(&mut self) -> Option<Entry> {
        let known = |(may_lack, rate): (&bool, &f64)| *may_lack || rate.is_finite();
        let complete = self.may_lack.iter().zip(&self.row.rate_rad_s).all(known);
        let (Some(stamp), true) = (self.row.stamp, complete) else {
            self.counts.incomplete += 1;
            return None;
        };
        let time_s = stamp.since_s(self.first.get_or_insert(stamp));
        self.counts.whole_s = self.counts.whole_s.max(time_s);
        let mut new_part = false;
        if let Some(parts) = &self.parts {
            let Some(part) = parts.iter().position(|[begin, end]| (*begin..=*end).contains(&time_s)) else {
                self.counts.outside += 1;
                return None;
            };
            new_part = part != self.part;
            self.part = part;
        }
        let interval_s = time_s - self.last_time_s;
        let new_key = self.counts.used == 0 || new_part || self.row.key != self.last_key;
        if !new_key && interval_s == 0.0 {
            self.counts.repeated += 1;
            return None;
        }
        let (backward, gap) = (!new_key && interval_s < 0.0, !new_key && interval_s > self.gap_s);
        self.counts.backward += u64::from(backward);
        self.counts.gaps += u64::from(gap);
        let begins = new_key || backward || gap;
        if begins {
            self.counts.segments += 1;
        } else {
            let [shortest, longest] = &mut self.counts.interval_s;
            (*shortest, *longest) = (shortest.min(interval_s), longest.max(interval_s));
            self.counts.used_s += interval_s;
        }
        if new_key {
            self.last_key.clone_from(&self.row.key);
        }
        self.counts.used += 1;
        self.last_time_s = time_s;
        let segment = self.counts.segments - 1;
        Some(Entry { row: self.row.number, segment, begins, time_s, rate_rad_s: self.row.rate_rad_s })
    }
}

impl Iterator for Log {
    type Item = Result<Entry, DataError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let next = self.advance().transpose();
        // Reading ends at the first error.
        self.done = !matches!(next, Some(Ok(_)));
        next
    }
}

/// Returns the intervals between neighbouring rows, s, with the rows.
fn intervals(head: &VecDeque<Row>) -> impl Iterator<Item = (f64, &Row, &Row)> {
    let pairs = head.iter().zip(head.iter().skip(1)).filter(|(last, next)| last.key == next.key);
    pairs.filter_map(|(last, next)| Some((next.stamp?.since_s(&last.stamp?), last, next)))
}

/// Returns the median of the intervals above zero, s.
fn usual_interval_s(head: &VecDeque<Row>) -> Option<f64> {
    quantile(&sorted(intervals(head).map(|(interval_s, ..)| interval_s).filter(|interval_s| *interval_s > 0.0)), 0.5)
}

/// Refuses stamps of which many fall, or are the same for several samples.
fn check_order(path: &Path, head: &VecDeque<Row>) -> Result<(), DataError> {
    let rows = intervals(head).count();
    let earlier = intervals(head).filter(|(interval_s, ..)| *interval_s < 0.0).count();
    let moves = |last: &Row, next: &Row| last.rate_rad_s.iter().zip(next.rate_rad_s).any(|(a, b)| (a - b).abs() > 0.0);
    let equal = intervals(head).filter(|(interval_s, last, next)| *interval_s == 0.0 && moves(last, next)).count();
    let (count, reason) = if 4 * earlier > rows {
        (earlier, "an earlier stamp than the row before; sort the rows by time, or name another column of time")
    } else if 3 * equal > 2 * rows {
        let reason = "the stamp of the row before, and other rates: the stamps are too coarse; name a finer column of time, or give \
                      the rows per second (--rate-hz)";
        (equal, reason)
    } else {
        return Ok(());
    };
    if rows < FEWEST { Ok(()) } else { Err(DataError::Order { path: path.to_owned(), count, rows, reason }) }
}
