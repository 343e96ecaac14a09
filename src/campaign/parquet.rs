//! The rows of a campaign as Parquet, by the library's writers of columns.
//!
//! A column has the type of its values, and what a row does not have is null. Must not hold more than the rows of one group.

use super::table::{Kind, Parameter, Row, Table, columns};
use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical, ZstdLevel};
use parquet::column::writer::ColumnWriter;
use parquet::data_type::ByteArray;
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::{Type, TypePtr};
use std::io::{self, Write};
use std::sync::Arc;

/// Rows of one group.
const GROUP: usize = 8192;

/// The values of a column that wait for their group.
enum Column {
    Flag(Vec<Option<bool>>),
    Whole(Vec<Option<i64>>),
    Number(Vec<Option<f64>>),
    Word(Vec<Option<String>>),
}

/// Writes rows, the parameters of which are of these kinds.
pub(super) fn write<W: Write + Send>(
    out: &mut W,
    table: &Table,
    kinds: Vec<Kind>,
    rows: impl Iterator<Item = io::Result<Row>>,
) -> io::Result<()> {
    let names = columns(table);
    let mut waiting = empty(table, &kinds);
    let fields = names.iter().zip(&waiting).map(|(name, column)| column.field(name).map(Arc::new));
    let schema =
        || Type::group_type_builder("case").with_fields(fields.collect::<Result<_, _>>()?).build().map(Arc::new);
    let schema: TypePtr = schema().map_err(io::Error::other)?;
    let properties = WriterProperties::builder().set_compression(Compression::ZSTD(ZstdLevel::default())).build();
    let mut writer = SerializedFileWriter::new(out, schema, Arc::new(properties)).map_err(io::Error::other)?;
    let mut group = |waiting: Vec<Column>| {
        let mut group = writer.next_row_group()?;
        waiting.into_iter().try_for_each(|column| column.write(&mut group))?;
        group.close().map(drop)
    };
    for (number, row) in rows.enumerate() {
        if number > 0 && number % GROUP == 0 {
            group(std::mem::replace(&mut waiting, empty(table, &kinds))).map_err(io::Error::other)?;
        }
        add(&mut waiting, row?);
    }
    group(waiting).and_then(|()| writer.finish().map(drop)).map_err(io::Error::other)
}

/// The columns without rows, in the order of [`columns`].
fn empty(table: &Table, kinds: &[Kind]) -> Vec<Column> {
    let (whole, number, word) =
        (|| Column::Whole(Vec::new()), || Column::Number(Vec::new()), || Column::Word(Vec::new()));
    let mut empty = vec![whole(), whole()];
    empty.extend(kinds.iter().map(|kind| match kind {
        Kind::Flag => Column::Flag(Vec::new()),
        Kind::Whole => whole(),
        Kind::Number => number(),
        Kind::Word => word(),
    }));
    empty.extend([Column::Flag(Vec::new()), word(), word(), word(), number()]);
    empty.extend(table.metrics.iter().map(|_| number()));
    empty.extend((0..6).map(|_| whole()));
    empty.extend([word(), number()]);
    empty
}

/// Adds a row to the columns.
fn add(columns: &mut [Column], row: Row) {
    let whole = |count: u64| Cell::Whole(Some(count as i64));
    let mut cells = vec![whole(row.case), whole(row.seed)];
    cells.extend(row.parameters.into_iter().map(Cell::Parameter));
    cells.push(Cell::Flag(row.accepted));
    cells.extend([Some(row.verdict), Some(row.exit.name().to_owned()), row.reason].map(Cell::Word));
    cells.push(Cell::Number(row.settled_at_s));
    cells.extend(row.metrics.into_iter().map(Cell::Number));
    cells.extend([row.executed, row.missed, row.starved, row.safe, row.lost, row.injected].map(whole));
    cells.extend([Cell::Word(Some(row.hash)), Cell::Number(row.predicted_rate_per_s)]);
    columns.iter_mut().zip(cells).for_each(|(column, cell)| column.push(cell));
}

/// One value of a row.
enum Cell {
    Flag(Option<bool>),
    Whole(Option<i64>),
    Number(Option<f64>),
    Word(Option<String>),
    Parameter(Parameter),
}

impl Column {
    fn push(&mut self, cell: Cell) {
        match (self, cell) {
            (Self::Flag(values), Cell::Flag(value)) => values.push(value),
            (Self::Flag(values), Cell::Parameter(Parameter::Flag(value))) => values.push(Some(value)),
            (Self::Whole(values), Cell::Whole(value)) => values.push(value),
            (Self::Whole(values), Cell::Parameter(Parameter::Whole(value))) => values.push(Some(value)),
            (Self::Number(values), Cell::Number(value)) => values.push(value),
            (Self::Number(values), Cell::Parameter(parameter)) => values.push(parameter.number()),
            (Self::Word(values), Cell::Word(value)) => values.push(value.filter(|value| !value.is_empty())),
            (Self::Word(values), Cell::Parameter(parameter)) => values.push(Some(parameter.to_string())),
            // Kinds are those of all rows.
            (Self::Flag(values), _) => values.push(None),
            (Self::Whole(values), _) => values.push(None),
            (Self::Number(values), _) => values.push(None),
            (Self::Word(values), _) => values.push(None),
        }
    }

    fn field(&self, name: &str) -> Result<Type, ParquetError> {
        let (physical, logical) = match self {
            Self::Flag(_) => (Physical::BOOLEAN, None),
            Self::Whole(_) => (Physical::INT64, None),
            Self::Number(_) => (Physical::DOUBLE, None),
            Self::Word(_) => (Physical::BYTE_ARRAY, Some(LogicalType::String)),
        };
        let builder = Type::primitive_type_builder(name, physical).with_logical_type(logical);
        builder.with_repetition(Repetition::OPTIONAL).build()
    }

    fn write<W: Write + Send>(self, group: &mut SerializedRowGroupWriter<'_, W>) -> Result<(), ParquetError> {
        // The schema was made of these columns.
        let Some(mut writer) = group.next_column()? else { return Ok(()) };
        match (self, writer.untyped()) {
            (Self::Flag(values), ColumnWriter::BoolColumnWriter(writer)) => {
                writer.write_batch(&there(&values), Some(&levels(&values)), None)?;
            }
            (Self::Whole(values), ColumnWriter::Int64ColumnWriter(writer)) => {
                writer.write_batch(&there(&values), Some(&levels(&values)), None)?;
            }
            (Self::Number(values), ColumnWriter::DoubleColumnWriter(writer)) => {
                writer.write_batch(&there(&values), Some(&levels(&values)), None)?;
            }
            (Self::Word(values), ColumnWriter::ByteArrayColumnWriter(writer)) => {
                let words: Vec<ByteArray> = values.iter().flatten().map(|word| word.as_str().into()).collect();
                writer.write_batch(&words, Some(&levels(&values)), None)?;
            }
            _ => return Err(ParquetError::General("a column is of another type than its schema".to_owned())),
        }
        writer.close()
    }
}

/// The values that are there.
fn there<T: Copy>(values: &[Option<T>]) -> Vec<T> {
    values.iter().copied().flatten().collect()
}

/// For each row 1 where there is a value, and 0 for null.
fn levels<T>(values: &[Option<T>]) -> Vec<i16> {
    values.iter().map(|value| i16::from(value.is_some())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::campaign::table::tests::table;
    use parquet::file::reader::{FileReader, SerializedFileReader};
    use parquet::record::Field;

    /// Every column by its name, with its type and with null where there is nothing.
    #[test]
    fn rows_are_read_back_as_they_were() {
        let table = table();
        let mut other = table.rows[0].clone();
        (other.accepted, other.parameters) = (None, vec![Parameter::Whole(2)]);
        let mut file = tempfile::tempfile().unwrap();
        let rows = [table.rows[0].clone(), other].map(Ok);
        write(&mut file, &table, vec![Kind::Number], rows.into_iter()).unwrap();
        let read = SerializedFileReader::new(file).unwrap();
        let read: Vec<_> = read.get_row_iter(None).unwrap().map(Result::unwrap).collect();
        assert_eq!(read.len(), 2);
        let field =
            |row: usize, name: &str| read[row].get_column_iter().find(|(known, _)| *known == name).unwrap().1.clone();
        for (row, name, expected) in [
            (0, "case", Field::Long(3)),
            (0, "controller.gain_per_s", Field::Double(0.1 + 0.2)),
            (1, "controller.gain_per_s", Field::Double(2.0)),
            (0, "accepted", Field::Bool(true)),
            (1, "accepted", Field::Null),
            (0, "reason", Field::Null),
            (0, "exit", Field::Str("completed".into())),
            (0, "sync_error_rad_s.last", Field::Double(1e-300)),
            (0, "sync_error_rad_s.settled_max", Field::Null),
            (1, "hash", Field::Str("00ff00ff00ff00ff".into())),
        ] {
            assert_eq!(field(row, name), expected, "{name}");
        }
        let names: Vec<String> = read[0].get_column_iter().map(|(name, _)| name.clone()).collect();
        assert_eq!(names, columns(&table));
    }
}
