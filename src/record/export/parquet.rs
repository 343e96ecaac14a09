//! A table as Parquet, by the library's writers of columns: no Arrow is in between.
//!
//! Every bit is kept, of what is no number too. Must not hold more than the rows of one group.

use super::table::{Table, columns};
use crate::files::Created;
use crate::record::reader::{Recording, SignalInfo};
use crate::sample::FieldKind;
use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical, ZstdLevel};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties, WriterVersion};
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::{Type, TypePtr};
use std::io;
use std::sync::Arc;

/// The rows that wait for their group, those of all tables together, come to so many bytes.
const WAITING_BYTES: usize = 64 << 20;
/// Every column of every group has an entry at the file's end. Beyond so many the entries weigh as much as the values, and
/// cannot be kept in memory.
pub const COLUMNS_MAX: usize = 1 << 14;

/// The table of a signal.
pub struct Parquet(RowGroups);

impl Table for Parquet {
    const EXTENSION: &'static str = "parquet";

    fn begin(file: Created, recording: &Recording, signal: &SignalInfo) -> io::Result<Self> {
        let (name, about) = (&signal.layout.type_name, about(recording, signal));
        RowGroups::begin(file, name, None, columns(&signal.layout), about, rows_per_group(recording)).map(Self)
    }

    fn row(&mut self, bits: &[u64]) -> io::Result<()> {
        self.0.row(None, bits)
    }

    fn end(self) -> io::Result<()> {
        self.0.end()
    }
}

/// Rows of numbers, and of a text before them where that is asked for, written a group at a time.
pub struct RowGroups {
    writer: SerializedFileWriter<Created>,
    texts: Option<Vec<ByteArray>>,
    columns: Vec<Waiting>,
    rows_per_group: usize,
}

/// The bits of one column that wait for their group.
struct Waiting {
    kind: FieldKind,
    bits: Vec<u64>,
}

impl RowGroups {
    /// A file of these columns, `text` the first if there is one, with what is to be known `about` it.
    pub fn begin(
        file: Created,
        name: &str,
        text: Option<&str>,
        columns: Vec<(String, FieldKind)>,
        about: Vec<(&str, String)>,
        rows_per_group: usize,
    ) -> io::Result<Self> {
        let schema = schema(name, text, &columns).map_err(bare)?;
        let writer = SerializedFileWriter::new(file, schema, Arc::new(properties(about))).map_err(bare)?;
        let waiting = |(_, kind)| Waiting { kind, bits: Vec::with_capacity(rows_per_group) };
        let columns = columns.into_iter().map(waiting).collect();
        Ok(Self { writer, texts: text.map(|_| Vec::new()), columns, rows_per_group })
    }

    /// Adds a row.
    pub fn row(&mut self, text: Option<&str>, bits: &[u64]) -> io::Result<()> {
        if let Some(texts) = &mut self.texts {
            texts.push(text.unwrap_or_default().into());
        }
        self.columns.iter_mut().zip(bits).for_each(|(column, word)| column.bits.push(*word));
        if self.waiting() < self.rows_per_group { Ok(()) } else { self.write_group().map_err(bare) }
    }

    /// Writes what waits, and the end.
    pub fn end(mut self) -> io::Result<()> {
        let rest = if self.waiting() == 0 { Ok(()) } else { self.write_group() };
        rest.and_then(|()| self.writer.close()).map(drop).map_err(bare)
    }

    /// How many rows wait.
    fn waiting(&self) -> usize {
        self.columns.first().map_or(0, |column| column.bits.len())
    }

    fn write_group(&mut self) -> Result<(), ParquetError> {
        let mut group = self.writer.next_row_group()?;
        if let Some(texts) = &mut self.texts
            && let Some(mut column) = group.next_column()?
        {
            column.typed::<ByteArrayType>().write_batch(texts, None, None)?;
            column.close()?;
            texts.clear();
        }
        for Waiting { kind, bits } in &mut self.columns {
            // The schema was made of these columns.
            let Some(mut column) = group.next_column()? else { break };
            match kind {
                FieldKind::U64 => column.typed::<Int64Type>().write_batch(bytemuck::cast_slice(bits), None, None)?,
                FieldKind::F64 => column.typed::<DoubleType>().write_batch(bytemuck::cast_slice(bits), None, None)?,
            };
            column.close()?;
            bits.clear();
        }
        group.close().map(drop)
    }
}

/// The same for all tables, for they have as many rows as there are ticks.
fn rows_per_group(recording: &Recording) -> usize {
    let row_bytes = recording.signals().iter().map(|signal| 8 * super::table::OWN.len() + signal.layout.size());
    (WAITING_BYTES / row_bytes.sum::<usize>()).max(1)
}

fn schema(name: &str, text: Option<&str>, columns: &[(String, FieldKind)]) -> Result<TypePtr, ParquetError> {
    let field = |(name, kind): &(String, FieldKind)| {
        let of = match kind {
            FieldKind::U64 => {
                let unsigned = LogicalType::integer(64, false);
                Type::primitive_type_builder(name, Physical::INT64).with_logical_type(Some(unsigned))
            }
            FieldKind::F64 => Type::primitive_type_builder(name, Physical::DOUBLE),
        };
        of.with_repetition(Repetition::REQUIRED).build().map(Arc::new)
    };
    let text = text.map(|name| {
        let of = Type::primitive_type_builder(name, Physical::BYTE_ARRAY).with_logical_type(Some(LogicalType::String));
        of.with_repetition(Repetition::REQUIRED).build().map(Arc::new)
    });
    let fields = text.into_iter().chain(columns.iter().map(field)).collect::<Result<_, _>>()?;
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
