//! Reads rows of a text table. Must not hold more than its begin and one line in memory.

use super::columns::{self, Places};
use super::form::{DataError, Ending, Meaning, Options, Row, Rows};
use super::stamp::Stamp;
use super::table::{self, COMMENTS, Table};
use super::unit::TimeUnit;
use csv::{ByteRecord, ErrorKind, Reader, ReaderBuilder, Trim};
use encoding_rs::{Encoding, UTF_16BE, UTF_16LE};
use encoding_rs_io::DecodeReaderBytesBuilder;
use std::fmt::Write;
use std::io::{self, Chain, Cursor, Read};
use std::path::{Path, PathBuf};

/// The longest line, bytes.
const LINE_BYTES: usize = 1 << 20;
/// The part of the file in which the table is found, bytes.
const PEEK_BYTES: usize = 64 << 10;
/// The bytes that show an encoding.
const MARK_BYTES: u64 = 4;
/// The longest part of a cell shown in a message, characters.
const SHOWN_LETTERS: usize = 40;
/// The reason for refusing a line that is too long.
const TOO_LONG: &str = "a line is longer than 1 MiB; name a CSV file";

/// A reader of a text table.
pub struct Csv {
    path: PathBuf,
    reader: Reader<Rest>,
    record: ByteRecord,
    /// The number of lines before the first row.
    before: u64,
    separator: u8,
    /// True if numbers may have a decimal comma.
    comma: bool,
    cells: usize,
    places: Places,
    rows: i64,
    half: bool,
}

/// The text from the first row on.
type Rest = Chain<Cursor<Vec<u8>>, LineEnds<Box<dyn Read>>>;

impl Csv {
    /// Finds the table and its columns.
    pub fn new(mut source: Box<dyn Read>, path: &Path, options: &Options) -> Result<Self, DataError> {
        let mut marks = Vec::new();
        source.by_ref().take(MARK_BYTES).read_to_end(&mut marks).map_err(|source| read_error(path, 1, source))?;
        let utf16 = utf16(&marks);
        // It also removes a byte order mark, and leaves other bytes as they are.
        let mut decoder = DecodeReaderBytesBuilder::new();
        decoder.encoding(utf16).utf8_passthru(true).strip_bom(true).bom_sniffing(true);
        let source: Box<dyn Read> = Box::new(decoder.build(Cursor::new(marks).chain(source)));
        let mut source = LineEnds { source, length: 0, returned: false, unterminated: false, zeros: false };
        let mut start = Vec::new();
        let failed = |source| read_error(path, 1, source);
        source.by_ref().take(PEEK_BYTES as u64).read_to_end(&mut start).map_err(failed)?;
        let form = |reason: &str| DataError::Form { path: path.to_owned(), line: 1, reason: reason.to_owned() };
        if source.zeros && !start.contains(&b'\n') {
            return Err(form("the file is not text; name a CSV file"));
        }
        let place =
            |lines: u64| start.split_inclusive(|byte| *byte == b'\n').take(lines as usize).map(<[u8]>::len).sum();
        let offset: usize = place(options.skip);
        let (text, encoding) = decoded(&start[offset..]);
        let Some(found) = table::find(&text) else { return Err(DataError::Empty { path: path.to_owned() }) };
        let (places, header, cells) = places(&found, path, options)?;
        // The place in the bytes: every line has as many as in the text.
        let skipped = options.skip + found.lines;
        let begin = place(skipped);
        let rest = Cursor::new(start.split_off(begin)).chain(source);
        let mut builder = ReaderBuilder::new();
        builder.delimiter(found.separator).comment(Some(b'#')).trim(Trim::All).has_headers(false).flexible(true);
        // Beside a decimal point, a comma groups the digits of a number.
        let point = found.first.iter().any(|cell| cell.contains('.') && cell.parse::<f64>().is_ok());
        let comma = found.separator != b',' && !point;
        if comma && table::groups_digits(text.lines().skip(found.lines as usize), found.separator) {
            let (path, line) = (path.to_owned(), skipped + 1);
            let reason = "commas group the digits of its numbers; write them without".to_owned();
            return Err(DataError::Form { path, line, reason });
        }
        let mut csv = Self {
            path: path.to_owned(),
            reader: builder.from_reader(rest),
            record: ByteRecord::new(),
            before: skipped,
            separator: found.separator,
            comma,
            cells,
            places,
            rows: 0,
            half: false,
        };
        let text = &mut csv.places.meaning.found;
        match header {
            Some(line) => write!(text, "header at line {}", options.skip + line),
            None => write!(text, "no header"),
        }
        .and_then(|()| match found.separator {
            b'\t' => write!(text, ", separated by tabs"),
            b' ' => write!(text, ", separated by spaces"),
            separator => write!(text, ", separator '{}'", char::from(separator)),
        })
        .expect("writing to a string does not fail");
        if comma && found.first.iter().any(|cell| table::is_decimal_comma(cell)) {
            text.push_str(", decimal comma");
        }
        text.push_str(if utf16.is_some() { ", UTF-16" } else { encoding });
        Ok(csv)
    }
}

/// Returns the kind of UTF-16 that a text is in: by its byte order mark, or by the zero bytes of digits and Latin letters.
fn utf16(start: &[u8]) -> Option<&'static Encoding> {
    match *start {
        [0xff, 0xfe, ..] => Some(UTF_16LE),
        [0xfe, 0xff, ..] => Some(UTF_16BE),
        [first, 0, second, 0] if first != 0 && second != 0 => Some(UTF_16LE),
        [0, first, 0, second] if first != 0 && second != 0 => Some(UTF_16BE),
        _ => None,
    }
}

/// Returns the text of bytes in UTF-8, else in Latin-1, of which the programs that write it mean its superset of Windows.
fn decoded(bytes: &[u8]) -> (String, &'static str) {
    match std::str::from_utf8(bytes) {
        Ok(text) => (text.to_owned(), ""),
        // The begin ends within a letter.
        Err(error) if error.error_len().is_none() => {
            (String::from_utf8_lossy(&bytes[..error.valid_up_to()]).into(), "")
        }
        Err(_) => (bytes.iter().map(|byte| char::from(*byte)).collect(), ", not UTF-8 and read as Latin-1"),
    }
}

/// Returns the columns, the line of the header, and the number of cells of a row.
fn places(found: &Table, path: &Path, options: &Options) -> Result<(Places, Option<u64>, usize), DataError> {
    let first = |column: usize| found.first.get(column).cloned().unwrap_or_default();
    let mut refusal = None;
    if !options.unnamed {
        for (line, names) in &found.headers {
            match columns::find(names, path, options, first) {
                Ok(places) => return Ok((places, Some(*line), names.len())),
                // The first one is the most likely.
                Err(error) => refusal = refusal.or(Some(error)),
            }
        }
    }
    let numbers: Vec<String> = (1..=found.first.len()).map(|number| number.to_string()).collect();
    match (refusal, numbers.is_empty()) {
        (Some(refusal), _) => Err(refusal),
        (None, true) => Err(DataError::Empty { path: path.to_owned() }),
        (None, false) => columns::find(&numbers, path, options, first).map(|places| (places, None, numbers.len())),
    }
}

fn read_error(path: &Path, line: u64, source: io::Error) -> DataError {
    let path = path.to_owned();
    match source.to_string() == TOO_LONG {
        true => DataError::Form { path, line, reason: TOO_LONG.to_owned() },
        false => DataError::Read { path, source },
    }
}

impl Csv {
    /// Reads the next record with cells that is not a comment; returns false at the end.
    fn advance(&mut self) -> Result<bool, DataError> {
        loop {
            let read = self.reader.read_byte_record(&mut self.record).map_err(|error| {
                let (path, line) = (&self.path, self.before + self.reader.position().line());
                match error.into_kind() {
                    ErrorKind::Io(source) => read_error(path, line, source),
                    other => {
                        let reason = format!("it cannot be read as CSV: {other:?}");
                        DataError::Form { path: path.clone(), line, reason }
                    }
                }
            })?;
            if self.separator == b' ' {
                let cells = self.record.iter().flat_map(|cell| cell.split(|byte| *byte == b'\t'));
                self.record = cells.filter(|cell| !cell.is_empty()).collect();
            }
            let begins = |cell: &[u8]| COMMENTS.iter().any(|mark| cell.starts_with(mark.as_bytes()));
            if !read || !self.record.get(0).is_none_or(begins) {
                return Ok(read);
            }
        }
    }

    /// Returns the line on which the current record begins. The record's own position would be before skipped lines and comments.
    fn line(&self) -> u64 {
        let line_ends = self.record.as_slice().iter().filter(|byte| **byte == b'\n').count() as u64;
        (self.before + self.reader.position().line()).saturating_sub(1 + line_ends)
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
        let cell = std::str::from_utf8(self.cell(column)).unwrap_or("\u{fffd}");
        match table::number(cell, self.comma) {
            Some(value) if value.is_nan() => Ok(None),
            Some(value) if value.is_infinite() => {
                Err(self.no_number(column, name, "is not finite; leave unknown values empty"))
            }
            Some(value) => Ok(Some(value)),
            None if table::is_unknown(cell) => Ok(None),
            None if table::is_decimal_comma(cell) => {
                let remedy = "has a comma, and others a decimal point or commas between cells; write all with a point and no comma";
                Err(self.no_number(column, name, remedy))
            }
            None => Err(self.no_number(column, name, "is not a number; correct it, or leave the cell empty")),
        }
    }

    /// Reads a stamp; `None` if it is unknown.
    fn stamp(&self, column: usize, name: &str, unit: TimeUnit) -> Result<Option<Stamp>, DataError> {
        let text = std::str::from_utf8(self.cell(column)).unwrap_or("\u{fffd}");
        // A header that is repeated has no value.
        if table::is_unknown(text) || text == name {
            return Ok(None);
        }
        if unit == TimeUnit::Clock {
            let stamp = Stamp::clock(text);
            let reason = "is not a time of day as in the first row; correct it, or leave the cell empty";
            return stamp.map(Some).ok_or_else(|| self.no_number(column, name, reason));
        }
        let point = if self.comma { text.replacen(',', ".", 1) } else { text.to_owned() };
        if let Some(stamp) = Stamp::digits(&point, unit) {
            return Ok(Some(stamp));
        }
        let Some(value) = self.number(column, name)? else { return Ok(None) };
        let stamp = Stamp::float(value, unit);
        stamp.map(Some).ok_or_else(|| self.no_number(column, name, "is out of the range of time stamps; correct it"))
    }

    /// Returns true if no record follows, and the text ends without a line end.
    fn is_half_written(&mut self) -> bool {
        let read = self.reader.read_byte_record(&mut self.record);
        read.is_ok_and(|read| !read) && self.reader.get_ref().get_ref().1.unterminated
    }

    /// Converts the current record into a row.
    fn take(&self, row: &mut Row) -> Result<(), DataError> {
        let places = &self.places;
        let extra = self.record.iter().skip(self.cells).all(<[u8]>::is_empty);
        if self.record.len() < self.cells || !extra {
            let (path, found) = (self.path.clone(), self.record.len());
            return Err(DataError::Cells { path, line: self.line(), found, expected: self.cells });
        }
        row.number = self.line();
        let (name, unit) = &places.meaning.time;
        row.stamp = match places.time {
            Some(column) => self.stamp(column, name, *unit)?,
            None => Some(Stamp::whole(self.rows, *unit)),
        };
        if let (Some((column, unit)), Some(stamp)) = (places.time_part, row.stamp) {
            row.stamp = self.stamp(column, "", unit)?.map(|part| stamp.plus(&part));
        }
        let (names, unit) = &places.meaning.rates;
        for (axis, rate) in row.rate_rad_s.iter_mut().enumerate() {
            *rate = match places.rates[axis].filter(|_| row.stamp.is_some()) {
                Some(column) => self.number(column, &names[axis])?.map_or(f64::NAN, |value| value * unit.rad_s()),
                None => f64::NAN,
            };
        }
        let force = |column| self.number(column, "").ok().flatten().unwrap_or(f64::NAN);
        row.force = places.forces.map(|columns| columns.map(force));
        row.key.clear();
        if let Some(column) = places.by {
            row.key.extend_from_slice(self.cell(column));
        }
        Ok(())
    }
}

impl Rows for Csv {
    fn read(&mut self, row: &mut Row) -> Result<bool, DataError> {
        if !self.advance()? {
            return Ok(false);
        }
        let taken = self.take(row);
        self.rows += 1;
        self.half = taken.is_err() && self.is_half_written();
        if self.half { Ok(false) } else { taken.map(|()| true) }
    }

    fn meaning(&self) -> &Meaning {
        &self.places.meaning
    }

    fn ending(&self) -> Ending {
        Ending { half: self.half, zeros: self.reader.get_ref().get_ref().1.zeros }
    }
}

/// A reader that ends every line with `\n`, including the last, ends at a zero byte, and refuses lines that are too long: a
/// source without line ends must not fill the memory.
struct LineEnds<R> {
    source: R,
    /// The bytes since the last line end.
    length: usize,
    /// True if the last byte was a carriage return, which has already become a line end.
    returned: bool,
    /// True if the source ended within a line.
    unterminated: bool,
    /// True if the text ended at a zero byte.
    zeros: bool,
}

impl<R: Read> Read for LineEnds<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            let mut read = if self.zeros || self.unterminated { 0 } else { self.source.read(buffer)? };
            if let Some(zero) = buffer[..read].iter().position(|byte| *byte == 0) {
                // A logger that lost its power leaves them in place of what it had not written.
                (self.zeros, read) = (true, zero);
            }
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
                (*first, self.length, self.unterminated) = (b'\n', 0, true);
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
