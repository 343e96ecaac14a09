//! Reads rows of CSV. Must not hold more than one line in memory.

use super::columns::{self, Places};
use super::form::{DataError, Meaning, Options, Row, Rows};
use super::stamp::Stamp;
use csv::{ByteRecord, ErrorKind, Reader, ReaderBuilder, Trim};
use std::io::{self, Cursor, Read};
use std::path::{Path, PathBuf};

/// The longest line, bytes.
const LINE_BYTES: usize = 1 << 20;
/// The part of the file in which the delimiter is detected, bytes.
const PEEK_BYTES: usize = 64 << 10;
/// The longest part of a cell shown in a message, characters.
const SHOWN_LETTERS: usize = 40;
/// The reason for refusing a line that is too long.
const TOO_LONG: &str = "a line is longer than 1 MiB; name a CSV file";

/// A reader of a CSV file.
pub struct Csv {
    lines: Lines,
    /// True while the current record is still to be read as a row: the first one of a file without header.
    waiting: bool,
    cells: usize,
    places: Places,
}

/// The records of a file.
struct Lines {
    path: PathBuf,
    reader: Reader<Box<dyn Read>>,
    record: ByteRecord,
}

impl Csv {
    /// Reads the header, or the first row.
    pub fn new(mut source: Box<dyn Read>, path: &Path, options: &Options) -> Result<Self, DataError> {
        let mut start = Vec::new();
        let failed = |source| DataError::Read { path: path.to_owned(), source };
        source.by_ref().take(PEEK_BYTES as u64).read_to_end(&mut start).map_err(failed)?;
        let form = |reason: &str| DataError::Form { path: path.to_owned(), line: 1, reason: reason.to_owned() };
        if start.starts_with(&[0xff, 0xfe]) || start.starts_with(&[0xfe, 0xff]) {
            return Err(form("the file is UTF-16; save it as UTF-8"));
        }
        if start.contains(&0) {
            return Err(form("the file is not text; name a CSV file"));
        }
        if start.starts_with(b"\xef\xbb\xbf") {
            // The byte order mark is not part of the first line.
            start.drain(..3);
        }
        let delimiter = delimiter(&start);
        let source: Box<dyn Read> =
            Box::new(LineEnds { source: Cursor::new(start).chain(source), length: 0, returned: false });
        let mut builder = ReaderBuilder::new();
        builder.delimiter(delimiter).comment(Some(b'#')).trim(Trim::All).has_headers(false).flexible(true);
        let reader = builder.from_reader(source);
        let mut lines = Lines { path: path.to_owned(), reader, record: ByteRecord::new() };
        if !lines.read()? {
            return Err(DataError::Empty { path: path.to_owned() });
        }
        let name = |(index, cell): (usize, &[u8])| match options.header {
            true => String::from_utf8_lossy(cell).into_owned(),
            false => (index + 1).to_string(),
        };
        let names: Vec<String> = lines.record.iter().enumerate().map(name).collect();
        let places = columns::find(&names, path, options)?;
        Ok(Self { lines, waiting: !options.header, cells: names.len(), places })
    }
}

impl Lines {
    /// Reads the next record; returns false at the end.
    fn read(&mut self) -> Result<bool, DataError> {
        self.reader.read_byte_record(&mut self.record).map_err(|error| {
            let (path, line) = (self.path.clone(), self.reader.position().line());
            match error.into_kind() {
                ErrorKind::Io(source) if source.to_string() == TOO_LONG => {
                    DataError::Form { path, line, reason: TOO_LONG.to_owned() }
                }
                ErrorKind::Io(source) => DataError::Read { path, source },
                other => DataError::Form { path, line, reason: format!("it cannot be read as CSV: {other:?}") },
            }
        })
    }

    /// Returns the line on which the current record begins. The record's own position would be before skipped lines and comments.
    fn line(&self) -> u64 {
        let line_ends = self.record.as_slice().iter().filter(|byte| **byte == b'\n').count() as u64;
        self.reader.position().line().saturating_sub(1 + line_ends)
    }

    /// Returns a cell of the current record.
    fn cell(&self, column: usize) -> &[u8] {
        self.record.get(column).unwrap_or_default()
    }

    fn no_number(&self, column: usize, name: &str, reason: &str) -> DataError {
        let whole = String::from_utf8_lossy(self.cell(column));
        let mut text: String = whole.chars().take(SHOWN_LETTERS).collect();
        text.push_str(if text.len() < whole.len() { "…" } else { "" });
        let (path, column, reason) = (self.path.clone(), name.to_owned(), reason.to_owned());
        DataError::Cell { path, line: self.line(), column, text, reason }
    }

    /// Reads a number; `None` if it is unknown.
    fn number(&self, column: usize, name: &str) -> Result<Option<f64>, DataError> {
        let cell = self.cell(column);
        if let Some(value) = std::str::from_utf8(cell).ok().and_then(|text| text.parse::<f64>().ok()) {
            return match value {
                value if value.is_nan() => Ok(None),
                value if value.is_infinite() => {
                    Err(self.no_number(column, name, "is not finite; leave unknown values empty"))
                }
                value => Ok(Some(value)),
            };
        }
        match cell {
            b"" | b"NA" | b"N/A" | b"na" | b"n/a" | b"null" | b"NULL" | b"None" => Ok(None),
            _ if is_decimal_comma(cell) => {
                Err(self.no_number(column, name, "has a decimal comma; write its numbers with a point"))
            }
            _ => Err(self.no_number(column, name, "is not a number; correct it, or leave the cell empty")),
        }
    }

    /// Reads a stamp; `None` if it is unknown.
    fn stamp(&self, column: usize, meaning: &Meaning) -> Result<Option<Stamp>, DataError> {
        let (name, unit) = &meaning.time;
        if let Some(stamp) = std::str::from_utf8(self.cell(column)).ok().and_then(|text| Stamp::digits(text, *unit)) {
            return Ok(Some(stamp));
        }
        let Some(value) = self.number(column, name)? else { return Ok(None) };
        let stamp = Stamp::float(value, *unit);
        stamp.map(Some).ok_or_else(|| self.no_number(column, name, "is out of the range of time stamps; correct it"))
    }
}

impl Rows for Csv {
    fn read(&mut self, row: &mut Row) -> Result<bool, DataError> {
        if !std::mem::take(&mut self.waiting) && !self.lines.read()? {
            return Ok(false);
        }
        let Self { lines, cells, places, .. } = self;
        if lines.record.len() != *cells {
            let (path, found) = (lines.path.clone(), lines.record.len());
            return Err(DataError::Cells { path, line: lines.line(), found, expected: *cells });
        }
        row.number = lines.line();
        row.stamp = lines.stamp(places.time, &places.meaning)?;
        let (names, unit) = &places.meaning.rates;
        for (axis, rate) in row.rate_rad_s.iter_mut().enumerate() {
            *rate = match places.rates[axis] {
                Some(column) => lines.number(column, &names[axis])?.map_or(f64::NAN, |value| value * unit.rad_s()),
                None => f64::NAN,
            };
        }
        row.key.clear();
        if let Some(column) = places.by {
            row.key.extend_from_slice(lines.cell(column));
        }
        Ok(true)
    }

    fn meaning(&self) -> &Meaning {
        &self.places.meaning
    }
}

/// Detects the delimiter: the most frequent of comma, semicolon and tab in the first line other than a comment.
fn delimiter(start: &[u8]) -> u8 {
    let mut lines = start.split(|byte| matches!(byte, b'\n' | b'\r'));
    let first = lines.find(|line| !line.is_empty() && line[0] != b'#').unwrap_or_default();
    let count = |delimiter: &u8| first.iter().filter(|byte| *byte == delimiter).count();
    // Among equal counts, `max_by_key` takes the last.
    [b'\t', b';', b','].into_iter().max_by_key(count).unwrap_or(b',')
}

/// Returns true if a cell is a number with a decimal comma.
fn is_decimal_comma(cell: &[u8]) -> bool {
    let text = String::from_utf8_lossy(cell);
    text.matches(',').count() == 1 && text.replace(',', ".").parse::<f64>().is_ok()
}

/// A reader that ends every line with `\n`, including the last, and refuses lines that are too long: a source without line ends
/// must not fill the memory.
struct LineEnds<R> {
    source: R,
    /// The bytes since the last line end.
    length: usize,
    /// True if the last byte was a carriage return, which has already become a line end.
    returned: bool,
}

impl<R: Read> Read for LineEnds<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            let read = self.source.read(buffer)?;
            if read == 0 {
                return Ok(self.last_end(buffer));
            }
            let count = self.normalise(&mut buffer[..read]);
            let last = buffer[..count].iter().rposition(|byte| *byte == b'\n');
            self.length = last.map_or(self.length + count, |last| count - last - 1);
            if self.length > LINE_BYTES {
                return Err(io::Error::new(io::ErrorKind::InvalidData, TOO_LONG));
            }
            // No byte is left if the buffer held only the `\n` of a `\r\n`.
            if count > 0 {
                return Ok(count);
            }
        }
    }
}

impl<R> LineEnds<R> {
    /// Adds the line end that the last line lacks; returns the number of bytes added.
    fn last_end(&mut self, buffer: &mut [u8]) -> usize {
        match buffer.first_mut() {
            Some(first) if self.length > 0 => {
                (*first, self.length) = (b'\n', 0);
                1
            }
            _ => 0,
        }
    }

    /// Replaces `\r\n` and `\r` with `\n`; returns the number of bytes left.
    fn normalise(&mut self, bytes: &mut [u8]) -> usize {
        if !self.returned && !bytes.contains(&b'\r') {
            return bytes.len();
        }
        let mut count = 0;
        for index in 0..bytes.len() {
            let byte = bytes[index];
            let second = byte == b'\n' && self.returned;
            self.returned = byte == b'\r';
            if !second {
                bytes[count] = if self.returned { b'\n' } else { byte };
                count += 1;
            }
        }
        count
    }
}
