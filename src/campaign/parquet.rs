//! The rows of a campaign as Parquet.
//!
//! A column has the type of its values; a missing value is null. Must not hold more than the rows of one group.

use super::table::{Kind, Parameter, Row, Table, columns};
use crate::record::{Cell, ColumnKind, RowGroups};
use std::io::{self, Write};

/// Rows of one group.
const GROUP: usize = 8192;

/// Writes rows; `parameters` holds the kinds of their parameters.
pub(super) fn write<W: Write + Send>(
    out: W,
    table: &Table,
    parameters: &[Kind],
    rows: impl Iterator<Item = io::Result<Row>>,
) -> io::Result<()> {
    use ColumnKind::{Flag, Number, Whole, Word};
    let parameter_kinds = parameters.iter().map(|kind| match kind {
        Kind::Flag => Flag,
        Kind::Whole => Whole,
        Kind::Number => Number,
        Kind::Word => Word,
    });
    let mut kinds = vec![Whole; 2];
    kinds.extend(parameter_kinds.chain([Flag, Word, Word, Word, Number]));
    kinds.extend(table.metrics.iter().map(|_| Number).chain([Whole; 6]).chain([Word, Number]));
    let columns = columns(table).into_iter().zip(kinds).collect();
    let mut groups = RowGroups::begin(out, "case", columns, true, Vec::new(), GROUP)?;
    for row in rows {
        groups.row(values(row?, parameters))?;
    }
    groups.end()
}

/// Returns the values of a row, in the order of [`columns`].
fn values(row: Row, parameters: &[Kind]) -> Vec<Option<Cell>> {
    let whole = |count: u64| Some(Cell::Bits(count));
    let number = |value: Option<f64>| value.map(|value| Cell::Bits(value.to_bits()));
    let word = |word: Option<String>| word.filter(|word| !word.is_empty()).map(Cell::Word);
    let mut values = vec![whole(row.case), whole(row.seed)];
    values.extend(row.parameters.iter().zip(parameters).map(|(parameter, kind)| match (kind, parameter) {
        (Kind::Flag, Parameter::Flag(flag)) => whole((*flag).into()),
        (Kind::Whole, Parameter::Whole(value)) => Some(Cell::Bits(*value as u64)),
        (Kind::Number, parameter) => number(parameter.number()),
        (_, parameter) => Some(Cell::Word(parameter.to_string())),
    }));
    values.push(row.accepted.map(|accepted| Cell::Bits(accepted.into())));
    values.extend([Some(row.verdict), Some(row.exit.name().to_owned()), row.reason].map(word));
    values.extend([row.settled_at_s].into_iter().chain(row.metrics).map(number));
    values.extend([row.executed, row.missed, row.starved, row.safe, row.lost, row.injected].map(whole));
    values.extend([word(Some(row.hash)), number(row.predicted_rate_per_s)]);
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::campaign::table::tests::table;
    use parquet::file::reader::{FileReader, SerializedFileReader};
    use parquet::record::Field;

    /// Every column by its name, with its type, and null for a missing value.
    #[test]
    fn rows_are_read_back_as_they_were() {
        let table = table();
        let mut second = table.rows[0].clone();
        (second.accepted, second.parameters) = (None, vec![Parameter::Whole(2)]);
        let mut file = tempfile::tempfile().unwrap();
        let rows = [table.rows[0].clone(), second].map(Ok);
        write(&mut file, &table, &[Kind::Number], rows.into_iter()).unwrap();
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
