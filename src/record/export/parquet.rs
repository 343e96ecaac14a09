//! Tables as Parquet, written by column without Arrow.
//!
//! Keeps every bit, also of NaNs. Must not hold more than the rows of one group.

use super::table::{Table, columns};
use crate::files::Created;
use crate::record::reader::Recording;
use crate::record::track::SignalInfo;
use crate::sample::FieldKind;
use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical, ZstdLevel};
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties, WriterVersion};
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::{Type, TypePtr};
use std::io::{self, Write};
use std::sync::Arc;

/// Memory for the buffered rows of all tables together, bytes.
const BUFFER_BYTES: usize = 64 << 20;
/// Largest number of columns. The footer has an entry for every column of every group: with more columns, the entries are as
/// large as the values and no longer fit into memory.
pub const COLUMNS_MAX: usize = 1 << 14;

/// The table of a signal.
pub struct Parquet(RowGroups<Created>);

impl Table for Parquet {
    const EXTENSION: &'static str = "parquet";

    fn begin(file: Created, recording: &Recording, signal: &SignalInfo) -> io::Result<Self> {
        let (name, about) = (&signal.layout.type_name, about(recording, signal));
        let columns = columns(&signal.layout).into_iter().map(|(name, kind)| (name, kind.into())).collect();
        RowGroups::begin(file, name, columns, false, about, rows_per_group(recording)).map(Self)
    }

    fn row(&mut self, bits: &[u64]) -> io::Result<()> {
        self.0.row(bits.iter().map(|bits| Some(Cell::Bits(*bits))))
    }

    fn end(self) -> io::Result<()> {
        self.0.end()
    }
}

/// The type of a column's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColumnKind {
    /// Unsigned 64-bit integers.
    Unsigned,
    /// Signed 64-bit integers.
    Whole,
    /// Double-precision numbers.
    Number,
    /// Booleans.
    Flag,
    /// UTF-8 strings.
    Word,
}

impl From<FieldKind> for ColumnKind {
    fn from(kind: FieldKind) -> Self {
        match kind {
            FieldKind::U64 => Self::Unsigned,
            FieldKind::F64 => Self::Number,
        }
    }
}

/// The value of a row in a column.
pub enum Cell {
    /// The bits of a number; 0 or 1 for a flag.
    Bits(u64),
    /// A string.
    Word(String),
}

/// A writer of rows, one group at a time.
pub struct RowGroups<W: Write + Send> {
    writer: SerializedFileWriter<W>,
    columns: Vec<BufferedColumn>,
    rows: usize,
    rows_per_group: usize,
}

/// The values of one column in the current group.
struct BufferedColumn {
    kind: ColumnKind,
    bits: Vec<u64>,
    words: Vec<ByteArray>,
    /// The definition level of each row, 1 for a value and 0 for null; `None` if the column has no nulls.
    levels: Option<Vec<i16>>,
}

impl BufferedColumn {
    fn push(&mut self, value: Option<Cell>) {
        if let Some(levels) = &mut self.levels {
            levels.push(value.is_some().into());
        }
        match value {
            Some(Cell::Bits(bits)) => self.bits.push(bits),
            Some(Cell::Word(word)) => self.words.push(word.into_bytes().into()),
            None => {}
        }
    }

    fn write<W: Write + Send>(&mut self, group: &mut SerializedRowGroupWriter<'_, W>) -> Result<(), ParquetError> {
        let Self { kind, bits, words, levels } = self;
        // The schema has the same columns, so there is always a next one.
        let Some(mut column) = group.next_column()? else { return Ok(()) };
        let definitions = levels.as_deref();
        match kind {
            ColumnKind::Unsigned | ColumnKind::Whole => {
                column.typed::<Int64Type>().write_batch(bytemuck::cast_slice(bits), definitions, None)?
            }
            ColumnKind::Number => {
                column.typed::<DoubleType>().write_batch(bytemuck::cast_slice(bits), definitions, None)?
            }
            ColumnKind::Flag => {
                let flags: Vec<bool> = bits.iter().map(|bits| *bits != 0).collect();
                column.typed::<BoolType>().write_batch(&flags, definitions, None)?
            }
            ColumnKind::Word => column.typed::<ByteArrayType>().write_batch(words, definitions, None)?,
        };
        bits.clear();
        words.clear();
        levels.iter_mut().for_each(Vec::clear);
        column.close()
    }
}

impl<W: Write + Send> RowGroups<W> {
    /// Begins a file with these columns and the metadata `about`. If `nullable`, any value may be null.
    pub fn begin(
        file: W,
        name: &str,
        columns: Vec<(String, ColumnKind)>,
        nullable: bool,
        about: Vec<(&str, String)>,
        rows_per_group: usize,
    ) -> io::Result<Self> {
        let schema = schema(name, &columns, nullable).map_err(io_error)?;
        let writer = SerializedFileWriter::new(file, schema, Arc::new(properties(about))).map_err(io_error)?;
        let column = |(_, kind)| {
            let (bits, words, levels) = (Vec::new(), Vec::new(), nullable.then(Vec::new));
            BufferedColumn { kind, bits, words, levels }
        };
        Ok(Self { writer, columns: columns.into_iter().map(column).collect(), rows: 0, rows_per_group })
    }

    /// Adds a row of values.
    pub fn row(&mut self, values: impl IntoIterator<Item = Option<Cell>>) -> io::Result<()> {
        self.columns.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
        self.rows += 1;
        if self.rows < self.rows_per_group { Ok(()) } else { self.write_group().map_err(io_error) }
    }

    /// Writes the buffered rows and the footer.
    pub fn end(mut self) -> io::Result<()> {
        let rest = if self.rows == 0 { Ok(()) } else { self.write_group() };
        rest.and_then(|()| self.writer.finish()).map(drop).map_err(io_error)
    }

    fn write_group(&mut self) -> Result<(), ParquetError> {
        let mut group = self.writer.next_row_group()?;
        self.columns.iter_mut().try_for_each(|column| column.write(&mut group))?;
        self.rows = 0;
        group.close().map(drop)
    }
}

/// Returns the rows per group of every table. All tables grow equally fast: each has a row per tick.
fn rows_per_group(recording: &Recording) -> usize {
    let row_bytes = recording.signals().iter().map(|signal| 8 * super::table::COMMON.len() + signal.layout.size());
    (BUFFER_BYTES / row_bytes.sum::<usize>()).max(1)
}

fn schema(name: &str, columns: &[(String, ColumnKind)], nullable: bool) -> Result<TypePtr, ParquetError> {
    let field = |(name, kind): &(String, ColumnKind)| {
        let (physical, logical) = match kind {
            ColumnKind::Unsigned => (Physical::INT64, Some(LogicalType::integer(64, false))),
            ColumnKind::Whole => (Physical::INT64, None),
            ColumnKind::Number => (Physical::DOUBLE, None),
            ColumnKind::Flag => (Physical::BOOLEAN, None),
            ColumnKind::Word => (Physical::BYTE_ARRAY, Some(LogicalType::String)),
        };
        let repetition = if nullable { Repetition::OPTIONAL } else { Repetition::REQUIRED };
        let builder = Type::primitive_type_builder(name, physical).with_logical_type(logical);
        builder.with_repetition(repetition).build().map(Arc::new)
    };
    let fields = columns.iter().map(field).collect::<Result<_, _>>()?;
    Type::group_type_builder(name).with_fields(fields).build().map(Arc::new)
}

fn about(recording: &Recording, signal: &SignalInfo) -> Vec<(&'static str, String)> {
    let run = recording.info();
    vec![
        ("service", signal.service.clone()),
        ("type", signal.layout.type_name.clone()),
        ("scenario_name", run.scenario_name.clone()),
        ("scenario_hash", run.scenario_hash.clone()),
        ("seed", run.seed.to_string()),
        ("version", run.version.clone()),
        ("revision", run.revision.clone()),
    ]
}

fn properties(about: Vec<(&str, String)>) -> WriterProperties {
    let about = about.into_iter().map(|(key, value)| KeyValue::new(format!("corotate.{key}"), value));
    WriterProperties::builder()
        .set_key_value_metadata(Some(about.collect()))
        // Version 2 encodes integers as differences, so ticks and times take almost no space.
        .set_writer_version(WriterVersion::PARQUET_2_0)
        // Computed numbers rarely repeat.
        .set_dictionary_enabled(false)
        .set_compression(Compression::ZSTD(ZstdLevel::default()))
        .set_statistics_enabled(EnabledStatistics::Chunk)
        .set_offset_index_disabled(true)
        .build()
}

/// Unwraps the system's error from the library's.
fn io_error(error: ParquetError) -> io::Error {
    match error {
        ParquetError::External(source) => source.downcast().map_or_else(io::Error::other, |system| *system),
        error => io::Error::other(error),
    }
}
