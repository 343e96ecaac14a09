//! The layout of a sample as a ROS 2 message definition, as recordings store it.
//!
//! The bytes of a sample are the body of that message in little-endian CDR: every field is naturally aligned, so no
//! conversion is needed. This module must not depend on files.

use super::field::{Field, FieldKind};
use super::stamp::Stamp;
use std::fmt::Write;

/// The MCAP name of the encoding of definitions.
pub const SCHEMA_ENCODING: &str = "ros2msg";
/// The MCAP name of the encoding of messages.
pub const MESSAGE_ENCODING: &str = "cdr";
/// The CDR header before the body of a message: little-endian, no options.
pub const CDR_HEADER: [u8; 4] = [0, 1, 0, 0];

/// Writes the message whose body is `body` into `message`.
pub fn frame(body: &[u8], message: &mut Vec<u8>) {
    message.clear();
    message.extend_from_slice(&CDR_HEADER);
    message.extend_from_slice(body);
}

/// One field of a recorded layout.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Column {
    /// The name; the unit is its last part.
    pub name: String,
    /// The type of the elements.
    pub kind: FieldKind,
    /// The number of elements.
    pub count: usize,
    /// The offset from the start of the sample, bytes.
    pub offset: usize,
}

impl Column {
    /// Returns the names of the elements: the column's name, with an index if there are several.
    pub fn elements(&self) -> impl Iterator<Item = String> + '_ {
        let scalar = self.count == 1;
        (0..self.count).map(move |index| if scalar { self.name.clone() } else { format!("{}[{index}]", self.name) })
    }
}

/// The layout of a sample.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    /// The name and version.
    pub type_name: String,
    /// All fields, those of the stamp first.
    pub columns: Vec<Column>,
}

impl Layout {
    /// Creates the layout of a sample with these fields after the stamp.
    pub fn from_fields(type_name: &str, fields: &[Field]) -> Self {
        let column = |field: &Field| Column {
            name: field.name.to_owned(),
            kind: field.kind,
            count: field.count,
            offset: field.offset,
        };
        Self { type_name: type_name.to_owned(), columns: Stamp::FIELDS.iter().chain(fields).map(column).collect() }
    }

    /// Parses a message definition written by [`definition`](Self::definition). Returns `None` if it is invalid or
    /// describes another kind of message.
    pub fn parse(definition: &str) -> Option<Self> {
        let type_name = definition.lines().next()?.strip_prefix("# ")?.to_owned();
        let (mut columns, mut offset) = (Vec::new(), 0_usize);
        let lines = definition.lines().map(|line| line.split_once('#').map_or(line, |(code, _)| code).trim());
        for line in lines.filter(|line| !line.is_empty()) {
            let (element_type, name) = line.split_once(' ')?;
            let (element, count) = match element_type.split_once('[') {
                Some((element, count)) => (element, count.strip_suffix(']')?.parse().ok()?),
                None => (element_type, 1_usize),
            };
            let kind = match element {
                "uint64" => FieldKind::U64,
                "float64" => FieldKind::F64,
                _ => return None,
            };
            columns.push(Column { name: name.trim().to_owned(), kind, count, offset });
            offset = count.checked_mul(8).and_then(|bytes| offset.checked_add(bytes))?;
        }
        let stamped = Stamp::FIELDS.iter().zip(&columns).filter(|(own, read)| own.name == read.name).count();
        (stamped == Stamp::FIELDS.len()).then_some(Self { type_name, columns })
    }

    /// Returns the length of a sample, bytes.
    pub fn size(&self) -> usize {
        self.columns.iter().map(|column| 8 * column.count).sum()
    }

    /// Returns the message definition (`ros2msg`). Its first line is the type name of the sample.
    pub fn definition(&self) -> String {
        let mut text = format!("# {}\n", self.type_name);
        for Column { name, kind, count, .. } in &self.columns {
            let kind = match kind {
                FieldKind::U64 => "uint64",
                FieldKind::F64 => "float64",
            };
            let array = if *count == 1 { String::new() } else { format!("[{count}]") };
            // Writing to a string cannot fail.
            let _ = writeln!(text, "{kind}{array} {name}");
        }
        text
    }

    /// Returns the message name: `corotate/rigid-body/truth/v1` is `corotate/msg/RigidBodyTruthV1`.
    pub fn message_name(&self) -> String {
        let words = self.type_name.split(['/', '-']).skip(1);
        let capital = |word: &str| {
            let mut letters = word.chars();
            letters.next().map_or(String::new(), |first| first.to_ascii_uppercase().to_string() + letters.as_str())
        };
        format!("corotate/msg/{}", words.map(capital).collect::<String>())
    }

    /// Returns the layout as one readable line.
    pub fn words(&self) -> String {
        let word = |column: &Column| match column.count {
            1 => column.name.clone(),
            count => format!("{}[{count}]", column.name),
        };
        let fields = self.columns.iter().skip(Stamp::FIELDS.len()).map(word).collect::<Vec<_>>();
        format!("{} ({})", self.type_name, fields.join(", "))
    }
}

/// Returns the topic under which a service's samples are recorded: a valid ROS name.
pub fn topic_of(service: &str) -> String {
    format!("/{}", service.replace('-', "_"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{OrbitMeasurement, RateEstimate, Sample};

    #[test]
    fn a_parsed_definition_equals_its_layout() {
        for layout in [
            Layout::from_fields(RateEstimate::TYPE_NAME, RateEstimate::FIELDS),
            Layout::from_fields(OrbitMeasurement::TYPE_NAME, OrbitMeasurement::FIELDS),
        ] {
            assert_eq!(Layout::parse(&layout.definition()).unwrap(), layout);
        }
        let layout = Layout::from_fields(RateEstimate::TYPE_NAME, RateEstimate::FIELDS);
        assert_eq!(layout.size(), size_of::<RateEstimate>());
        assert_eq!(layout.message_name(), "corotate/msg/RigidBodyEstimateV2");
        assert!(layout.definition().contains("\nfloat64[3] omega_rad_s\n"));
    }

    #[test]
    fn foreign_definitions_are_refused() {
        for text in ["", "uint64 tick", "# x\nuint64 tick\n", "# x\nstring name", "# x\nuint64[9999999999999999999] a"]
        {
            assert!(Layout::parse(text).is_none(), "{text}");
        }
    }
}
