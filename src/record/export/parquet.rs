//! A table as Parquet, by the library's writers of columns: no Arrow is in between.
//!
//! Every bit is kept, of what is no number too. Must not hold more than the rows of one group.

use super::table::{Table, columns};
use crate::files::Created;
use crate::record::reader::{Recording, SignalInfo};
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

/// The rows that wait for their group, those of all tables together, come to so many bytes.
const WAITING_BYTES: usize = 64 << 20;
/// Every column of every group has an entry at the file's end. Beyond so many the entries weigh as much as the values, and
/// cannot be kept in memory.
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

/// What the values of a column are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColumnKind {
    Unsigned,
    Whole,
    Number,
    Flag,
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
    /// The bits of a number, or of a flag 0 or 1.
    Bits(u64),
    Word(String),
}

/// Rows, written a group at a time.
pub struct RowGroups<W: Write + Send> {
    writer: SerializedFileWriter<W>,
    columns: Vec<Waiting>,
    rows: usize,
    rows_per_group: usize,
}

/// The values of one column that wait for their group.
struct Waiting {
    kind: ColumnKind,
    bits: Vec<u64>,
    words: Vec<ByteArray>,
    /// For each row 1 where there is a value and 0 for null, if rows may be without.
    levels: Option<Vec<i16>>,
}

impl Waiting {
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
        // The schema was made of these columns.
        let Some(mut column) = group.next_column()? else { return Ok(()) };
        let there = levels.as_deref();
        match kind {
            ColumnKind::Unsigned | ColumnKind::Whole => {
                column.typed::<Int64Type>().write_batch(bytemuck::cast_slice(bits), there, None)?
            }
            ColumnKind::Number => column.typed::<DoubleType>().write_batch(bytemuck::cast_slice(bits), there, None)?,
            ColumnKind::Flag => {
                let flags: Vec<bool> = bits.iter().map(|bits| *bits != 0).collect();
                column.typed::<BoolType>().write_batch(&flags, there, None)?
            }
            ColumnKind::Word => column.typed::<ByteArrayType>().write_batch(words, there, None)?,
        };
        bits.clear();
        words.clear();
        levels.iter_mut().for_each(Vec::clear);
        column.close()
    }
}

impl<W: Write + Send> RowGroups<W> {
    /// Begins a file of these columns, with what is to be known `about` it. Where rows are `partial` any value may be null.
    pub fn begin(
        file: W,
        name: &str,
        columns: Vec<(String, ColumnKind)>,
        partial: bool,
        about: Vec<(&str, String)>,
        rows_per_group: usize,
    ) -> io::Result<Self> {
        let schema = schema(name, &columns, partial).map_err(bare)?;
        let writer = SerializedFileWriter::new(file, schema, Arc::new(properties(about))).map_err(bare)?;
        let waiting = |(_, kind)| {
            let (bits, words, levels) = (Vec::new(), Vec::new(), partial.then(Vec::new));
            Waiting { kind, bits, words, levels }
        };
        Ok(Self { writer, columns: columns.into_iter().map(waiting).collect(), rows: 0, rows_per_group })
    }

    /// Adds a row of values.
    pub fn row(&mut self, values: impl IntoIterator<Item = Option<Cell>>) -> io::Result<()> {
        self.columns.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
        self.rows += 1;
        if self.rows < self.rows_per_group { Ok(()) } else { self.write_group().map_err(bare) }
    }

    /// Writes what waits, and the end.
    pub fn end(mut self) -> io::Result<()> {
        let rest = if self.rows == 0 { Ok(()) } else { self.write_group() };
        rest.and_then(|()| self.writer.finish()).map(drop).map_err(bare)
    }

    fn write_group(&mut self) -> Result<(), ParquetError> {
        let mut group = self.writer.next_row_group()?;
        self.columns.iter_mut().try_for_each(|column| column.write(&mut group))?;
        self.rows = 0;
        group.close().map(drop)
    }
}

/// The same for all tables, for they have as many rows as there are ticks.
fn rows_per_group(recording: &Recording) -> usize {
    let row_bytes = recording.signals().iter().map(|signal| 8 * super::table::OWN.len() + signal.layout.size());
    (WAITING_BYTES / row_bytes.sum::<usize>()).max(1)
}

fn schema(name: &str, columns: &[(String, ColumnKind)], partial: bool) -> Result<TypePtr, ParquetError> {
    let field = |(name, kind): &(String, ColumnKind)| {
        let (physical, logical) = match kind {
            ColumnKind::Unsigned => (Physical::INT64, Some(LogicalType::integer(64, false))),
            ColumnKind::Whole => (Physical::INT64, None),
            ColumnKind::Number => (Physical::DOUBLE, None),
            ColumnKind::Flag => (Physical::BOOLEAN, None),
            ColumnKind::Word => (Physical::BYTE_ARRAY, Some(LogicalType::String)),
        };
        let repetition = if partial { Repetition::OPTIONAL } else { Repetition::REQUIRED };
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
        // By this version unsigned numbers are written as differences: ticks and times take next to nothing.
        .set_writer_version(WriterVersion::PARQUET_2_0)
        // Numbers that were computed hardly repeat.
        .set_dictionary_enabled(false)
        .set_compression(Compression::ZSTD(ZstdLevel::default()))
        .set_statistics_enabled(EnabledStatistics::Chunk)
        .set_offset_index_disabled(true)
        .build()
}

/// The system's reason without the library's words.
fn bare(error: ParquetError) -> io::Error {
    match error {
        ParquetError::External(source) => source.downcast().map_or_else(io::Error::other, |system| *system),
        other => io::Error::other(other),
    }
}
