//! Reads rows of a Parquet file: numbers in plain columns, without nesting. Must not hold more than a batch of rows.

use super::columns::{self, Places};
use super::form::{DataError, Meaning, Options, Row, Rows};
use super::stamp::Stamp;
use super::unit::TimeUnit;
use parquet::basic::{LogicalType, TimeUnit as Unit};
use parquet::column::reader::ColumnReader;
use parquet::errors::ParquetError;
use parquet::file::reader::{FileReader, SerializedFileReader};
use std::fs::File;
use std::path::{Path, PathBuf};

/// The number of rows read at once.
const BATCH_ROWS: usize = 8192;
/// The longest part of a text shown in a message, bytes.
const SHOWN_BYTES: usize = 40;

/// A reader of a Parquet file.
pub struct ParquetLog {
    path: PathBuf,
    reader: SerializedFileReader<File>,
    places: Places,
    /// The next group of rows.
    group: usize,
    /// The columns read of the current group: stamps, rates, the key, the rest of the stamps, and an accelerometer.
    columns: Vec<Option<Column>>,
    /// The rows returned from the batch, and all its rows.
    given: usize,
    batch: usize,
    rows: u64,
}

/// One column of a group of rows, with its current batch.
struct Column {
    name: String,
    reader: ColumnReader,
    /// The definition level of a present value; 0 if every value is present.
    defined: i16,
    cells: Vec<Cell>,
}

/// A value of a column.
#[derive(Debug, Clone, PartialEq)]
enum Cell {
    None,
    Whole(i64),
    Float(f64),
    Text(Vec<u8>),
}

impl ParquetLog {
    /// Returns true if a file begins with the Parquet magic.
    pub fn is_begun(start: &[u8]) -> bool {
        start.starts_with(b"PAR1")
    }

    /// Reads the schema.
    pub fn new(file: File, path: &Path, options: &Options) -> Result<Self, DataError> {
        let form = |error: &ParquetError| form(path, 0, error);
        let reader = SerializedFileReader::new(file).map_err(|error| form(&error))?;
        let schema = reader.metadata().file_metadata().schema_descr();
        let names: Vec<String> = schema.columns().iter().map(|column| column.path().string()).collect();
        let mut places =
            columns::find(&names, path, &Options { unnamed: false, ..options.clone() }, |_| String::new())?;
        let time = places.time.map(|column| schema.column(column));
        let kind = time.as_ref().and_then(|time| time.logical_type_ref());
        if let (None, Some(LogicalType::Timestamp(about))) = (options.time_unit, kind) {
            // The type is certain; a name is only a hint.
            places.meaning.time.1 = match about.unit {
                Unit::MILLIS => TimeUnit::Milliseconds,
                Unit::MICROS => TimeUnit::Microseconds,
                Unit::NANOS => TimeUnit::Nanoseconds,
            };
            places.meaning.assumed.retain(|unit| *unit != "time");
        }
        Ok(Self { path: path.to_owned(), reader, places, group: 0, columns: Vec::new(), given: 0, batch: 0, rows: 0 })
    }

    /// Reads the next batch, from the next group once the current one has ended; returns false at the end.
    fn refill(&mut self) -> Result<bool, ParquetError> {
        loop {
            let mut count = 0;
            for column in self.columns.iter_mut().flatten() {
                count = column.read()?;
            }
            if count > 0 {
                (self.given, self.batch) = (0, count);
                return Ok(true);
            }
            if self.group >= self.reader.num_row_groups() {
                return Ok(false);
            }
            self.begin_group()?;
        }
    }

    fn begin_group(&mut self) -> Result<(), ParquetError> {
        let group = self.reader.get_row_group(self.group)?;
        let places = &self.places;
        let part = places.time_part.map(|(column, _)| column);
        let wanted = [places.time].into_iter().chain(places.rates).chain([places.by, part]);
        let wanted = wanted.chain(places.forces.into_iter().flatten().map(Some));
        let schema = self.reader.metadata().file_metadata().schema_descr();
        let open = |index: usize| {
            let about = schema.column(index);
            let name = about.path().string();
            if about.max_rep_level() > 0 {
                return Err(ParquetError::General(format!("column {name} has lists; give plain numbers")));
            }
            let reader = group.get_column_reader(index)?;
            Ok(Column { name, reader, defined: about.max_def_level(), cells: Vec::new() })
        };
        let columns = wanted.map(|index| index.map(open).transpose()).collect::<Result<_, _>>()?;
        self.columns = columns;
        self.group += 1;
        Ok(())
    }

    fn cell_error(&self, column: usize, reason: &str) -> DataError {
        let text = self.cell(column).text();
        let text = String::from_utf8_lossy(&text[..text.len().min(SHOWN_BYTES)]).into_owned();
        let name = self.columns[column].as_ref().map_or(String::new(), |column| column.name.clone());
        DataError::Cell { path: self.path.clone(), line: self.rows, column: name, text, reason: reason.to_owned() }
    }

    /// Returns a time stamp.
    fn stamp(&self, column: usize, unit: TimeUnit) -> Result<Option<Stamp>, DataError> {
        let stamp = match self.cell(column) {
            Cell::None => return Ok(None),
            Cell::Float(value) if value.is_nan() => return Ok(None),
            Cell::Whole(value) if value.unsigned_abs() < 1 << 62 => Some(Stamp::whole(*value, unit)),
            Cell::Float(value) => Stamp::float(*value, unit),
            Cell::Whole(_) => None,
            Cell::Text(_) => return Err(self.cell_error(column, "is a text; give numbers")),
        };
        let late = || self.cell_error(column, "is out of the range of time stamps; correct it");
        stamp.map(Some).ok_or_else(late)
    }

    /// Returns a rate in its unit; NaN if it is unknown.
    fn rate(&self, column: usize) -> Result<f64, DataError> {
        match self.cell(column) {
            Cell::Text(_) => Err(self.cell_error(column, "is a text; give numbers")),
            Cell::Float(value) if value.is_infinite() => {
                Err(self.cell_error(column, "is not finite; leave unknown values empty"))
            }
            cell => Ok(cell.number()),
        }
    }

    fn cell(&self, column: usize) -> &Cell {
        self.columns.get(column).and_then(Option::as_ref).map_or(&Cell::None, |column| &column.cells[self.given])
    }
}

impl Cell {
    /// Returns the number; NaN without one.
    fn number(&self) -> f64 {
        match self {
            Self::Whole(value) => *value as f64,
            Self::Float(value) => *value,
            Self::None | Self::Text(_) => f64::NAN,
        }
    }

    fn text(&self) -> Vec<u8> {
        match self {
            Self::None => Vec::new(),
            Self::Whole(value) => value.to_string().into_bytes(),
            Self::Float(value) => value.to_string().into_bytes(),
            Self::Text(text) => text.clone(),
        }
    }
}

/// Returns the error for a file that cannot be read.
fn form(path: &Path, row: u64, error: &ParquetError) -> DataError {
    let reason =
        format!("it cannot be read as Parquet ({error}); write it again, unpacked or packed with zstd or snappy");
    DataError::Form { path: path.to_owned(), line: row, reason }
}

impl Column {
    /// Reads a batch; returns the number of rows.
    fn read(&mut self) -> Result<usize, ParquetError> {
        let defined = self.defined;
        macro_rules! read {
            ($reader:expr, $cell:expr) => {{
                let (mut levels, mut values) = (Vec::new(), Vec::new());
                let wanted = (defined > 0).then_some(&mut levels);
                let (rows, ..) = $reader.read_records(BATCH_ROWS, wanted, None, &mut values)?;
                let mut values = values.into_iter().map($cell);
                self.cells.clear();
                if defined > 0 {
                    let mut given = |level: &i16| if *level == defined { values.next() } else { None };
                    self.cells.extend(levels.iter().map(|level| given(level).unwrap_or(Cell::None)));
                } else {
                    self.cells.extend(values);
                }
                rows.min(self.cells.len())
            }};
        }
        Ok(match &mut self.reader {
            ColumnReader::Int32ColumnReader(reader) => read!(reader, |value| Cell::Whole(i64::from(value))),
            ColumnReader::Int64ColumnReader(reader) => read!(reader, Cell::Whole),
            ColumnReader::FloatColumnReader(reader) => read!(reader, |value| Cell::Float(f64::from(value))),
            ColumnReader::DoubleColumnReader(reader) => read!(reader, Cell::Float),
            ColumnReader::BoolColumnReader(reader) => read!(reader, |value| Cell::Whole(i64::from(value))),
            ColumnReader::ByteArrayColumnReader(reader) => {
                read!(reader, |value: parquet::data_type::ByteArray| Cell::Text(value.data().to_vec()))
            }
            _ => {
                let reason =
                    format!("column {} is of a type that is not read; give float, double or integers", self.name);
                return Err(ParquetError::General(reason));
            }
        })
    }
}

impl Rows for ParquetLog {
    fn read(&mut self, row: &mut Row) -> Result<bool, DataError> {
        if self.given == self.batch && !self.refill().map_err(|error| form(&self.path, self.rows, &error))? {
            return Ok(false);
        }
        self.rows += 1;
        row.number = self.rows;
        let unit = self.places.meaning.time.1;
        row.stamp = match self.places.time {
            Some(_) => self.stamp(0, unit)?,
            None => Some(Stamp::whole((self.rows - 1) as i64, unit)),
        };
        if let (Some((_, unit)), Some(stamp)) = (self.places.time_part, row.stamp) {
            row.stamp = self.stamp(5, unit)?.map(|part| stamp.plus(&part));
        }
        let rad_s = self.places.meaning.rates.1.rad_s();
        for (axis, rate) in row.rate_rad_s.iter_mut().enumerate() {
            *rate = self.rate(1 + axis)? * rad_s;
        }
        row.force = self.places.forces.map(|_| [6, 7, 8].map(|column| self.cell(column).number()));
        row.key = self.cell(4).text();
        self.given += 1;
        Ok(true)
    }

    fn meaning(&self) -> &Meaning {
        &self.places.meaning
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Log, RateUnit};
    use super::*;
    use parquet::basic::Compression;
    use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, FloatType, Int64Type};
    use parquet::file::properties::WriterProperties;
    use parquet::file::writer::SerializedFileWriter;
    use parquet::schema::parser::parse_message_type;
    use std::sync::Arc;

    /// Two groups of 10 000 rows at 100 Hz; every tenth value of y is missing.
    fn file(path: &Path, compression: Compression) {
        let text = "message log { optional binary throw (UTF8); required int64 stamp (TIMESTAMP(MICROS,true)); \
                    required double wx; optional float wy; required int64 wz; }";
        let schema = Arc::new(parse_message_type(text).unwrap());
        let properties = Arc::new(WriterProperties::builder().set_compression(compression).build());
        let mut writer = SerializedFileWriter::new(File::create(path).unwrap(), schema, properties).unwrap();
        for group in 0..2_i64 {
            let rows = || group * 10_000..(group + 1) * 10_000;
            let mut into = writer.next_row_group().unwrap();
            macro_rules! column {
                ($kind:ty, $values:expr, $levels:expr) => {{
                    let (values, levels): (Vec<_>, Option<Vec<i16>>) = ($values.collect(), $levels);
                    let mut column = into.next_column().unwrap().unwrap();
                    column.typed::<$kind>().write_batch(&values, levels.as_deref(), None).unwrap();
                    column.close().unwrap();
                }};
            }
            let is_given = |row: &i64| row % 10 != 0;
            column!(
                ByteArrayType,
                rows().map(|row| ByteArray::from(format!("t{}", row / 5_000).into_bytes())),
                Some(vec![1; 10_000])
            );
            column!(Int64Type, rows().map(|row| 1_763_800_000_000_000 + 10_000 * row), None);
            column!(DoubleType, rows().map(|row| row as f64), None);
            let levels = rows().map(|row| i16::from(is_given(&row))).collect();
            column!(FloatType, rows().filter(is_given).map(|row| row as f32), Some(levels));
            column!(Int64Type, rows(), None);
            into.close().unwrap();
        }
        writer.close().unwrap();
    }

    #[test]
    fn numeric_columns_are_read_across_groups_with_missing_values() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log.parquet");
        for compression in [Compression::UNCOMPRESSED, Compression::SNAPPY] {
            file(&path, compression);
            let options = Options {
                by: Some("throw".to_owned()),
                rate_unit: Some(RateUnit::RadiansPerSecond),
                ..Options::default()
            };
            let mut log = Log::open(&path, &options).unwrap();
            let mut count = 0;
            for entry in log.by_ref() {
                let entry = entry.unwrap();
                let row = (entry.row - 1) as f64;
                assert_eq!(entry.rate_rad_s, [row; 3]);
                assert!((entry.time_s - row * 0.01).abs() < 1e-9, "{entry:?}");
                count += 1;
            }
            assert_eq!(count, 18_000);
            let counts = log.counts();
            assert_eq!((counts.rows, counts.incomplete, counts.segments), (20_000, 2_000, 4));
            assert!(log.meaning().assumed.is_empty());
        }
    }

    #[test]
    fn a_text_column_and_a_truncated_file_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log.parquet");
        file(&path, Compression::UNCOMPRESSED);
        let rates = Some(["throw", "wy", "wz"].map(str::to_owned));
        let refused = Log::open(&path, &Options { rates, ..Options::default() }).err().unwrap().to_string();
        assert!(refused.contains("column throw: `t0` is a text; give numbers"), "{refused}");
        let whole = std::fs::read(&path).unwrap();
        std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
        let cut = Log::open(&path, &Options::default()).err().unwrap().to_string();
        assert!(cut.contains("cannot be read as Parquet"), "{cut}");
    }
}
