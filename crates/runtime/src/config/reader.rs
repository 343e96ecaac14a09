//! The deserializer for all types of scenarios. From a value, it records the path to what a type refuses; from nothing, it
//! records the kind of value that a type requests. A single deserializer keeps each type compiled only once.
//!
//! Must not know what any key means.

use super::error::nearest;
use serde::de::{
    DeserializeOwned, DeserializeSeed, Deserializer, Error, Expected, IntoDeserializer, MapAccess, SeqAccess,
    Unexpected, Visitor,
};
use std::cell::RefCell;
use std::fmt::Display;
use std::iter::Enumerate;
use std::slice;
use toml::{Table, Value, map};

/// A step on the path to a value in a type.
#[derive(Debug, Clone, Copy)]
pub(super) enum Step {
    Key(&'static str),
    /// Into a list.
    Element,
    /// Into a table of any keys.
    Entry,
}

/// The kind of value that a type requests.
#[derive(Debug, Clone, Copy)]
pub(super) enum Asked {
    Any,
    Boolean,
    Integer,
    Count,
    Number,
    Text,
    Choice(&'static [&'static str]),
    List,
    Array(usize),
    Map,
    Table(&'static [&'static str]),
}

/// The reason why a type refuses a value, in words for the author of a scenario.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(super) enum Refusal {
    #[error("unknown key `{key}`")]
    UnknownKey { key: String, known: &'static [&'static str] },
    #[error("`{0}` is missing")]
    MissingKey(&'static str),
    #[error("unknown choice `{word}`; {}", nearest(word, known))]
    UnknownChoice { word: String, known: &'static [&'static str] },
    #[error("got {given}; give {wanted}")]
    WrongType { given: String, wanted: String },
    #[error("got {given} values; give {wanted}")]
    WrongLength { given: usize, wanted: String },
    /// The type's own message.
    #[error("{0}")]
    Other(String),
}

impl Refusal {
    pub fn code(&self) -> &'static str {
        match self {
            Self::UnknownKey { .. } => super::error::UNKNOWN_KEY,
            Self::MissingKey(_) => super::error::MISSING_KEY,
            Self::UnknownChoice { .. } => "unknown-choice",
            Self::WrongType { .. } => "wrong-type",
            Self::WrongLength { .. } => "wrong-length",
            Self::Other(_) => "no-such-value",
        }
    }
}

impl Error for Refusal {
    fn custom<T: Display>(message: T) -> Self {
        Self::Other(message.to_string().replace('\n', ", "))
    }

    fn invalid_type(given: Unexpected<'_>, wanted: &dyn Expected) -> Self {
        let (given, wanted) = match given {
            Unexpected::Map => ("a table".to_owned(), wanted.to_string()),
            Unexpected::Seq => ("a list".to_owned(), wanted.to_string()),
            Unexpected::UnitVariant => ("another kind of value".to_owned(), wanted.to_string()),
            given => (given.to_string(), wanted.to_string()),
        };
        let lists = given == "a table" && wanted == "a sequence";
        let wanted =
            if lists { "a list of tables, each under its name in double brackets".to_owned() } else { plain(wanted) };
        Self::WrongType { given, wanted }
    }

    fn invalid_value(given: Unexpected<'_>, wanted: &dyn Expected) -> Self {
        Self::invalid_type(given, wanted)
    }

    fn invalid_length(given: usize, wanted: &dyn Expected) -> Self {
        Self::WrongLength { given, wanted: plain(wanted.to_string()) }
    }

    fn unknown_variant(word: &str, known: &'static [&'static str]) -> Self {
        Self::UnknownChoice { word: word.to_owned(), known }
    }

    fn unknown_field(key: &str, known: &'static [&'static str]) -> Self {
        Self::UnknownKey { key: key.to_owned(), known }
    }

    fn missing_field(key: &'static str) -> Self {
        Self::MissingKey(key)
    }
}

/// Returns the expected kind of value in words for the author of a scenario, from the words of serde.
fn plain(wanted: String) -> String {
    let words = match wanted.as_str() {
        "f64" => "a number",
        "i32" | "i64" => "a whole number",
        "u64" | "usize" => "a whole number, not below 0",
        "a boolean" => "true or false",
        text if text == "a string" || text.starts_with("enum ") => "a text in quotes",
        "a sequence" => "a list",
        "fewer elements in array" => "fewer values",
        table if table == "a map" || table.starts_with("struct ") => "a table",
        text => {
            let numbers = text.strip_prefix("an array of length ").map(|length| format!("a list of {length} numbers"));
            return numbers.unwrap_or(wanted);
        }
    };
    words.to_owned()
}

/// Reads a table into a type. The error holds the key of the refused value, as `a.b[0]`, and the reason.
pub(super) fn read<T: DeserializeOwned>(table: &Table) -> Result<T, (String, Refusal)> {
    let notes = Notes::default();
    let reader = Reader { source: Source::Table(table), notes: &notes, depth: 0 };
    T::deserialize(reader).map_err(|refusal| (notes.path(), refusal))
}

/// Returns the kind of value that a type requests at the end of a path.
pub(super) fn asked<T: DeserializeOwned>(way: &[Step]) -> Option<Asked> {
    let notes = Notes::default();
    // This always fails: there is no value at the end.
    let _ = T::deserialize(Reader { source: Source::at_end(way, None), notes: &notes, depth: 0 });
    notes.asked.into_inner()
}

/// Returns the names of a struct's fields as serde has them; empty for other types.
pub(crate) fn keys_of<T: DeserializeOwned>() -> &'static [&'static str] {
    match asked::<T>(&[]) {
        Some(Asked::Table(names)) => names,
        _ => &[],
    }
}

/// Returns the reason why a type refuses a value at the end of a path, if it does. A key missing elsewhere does not count.
pub(super) fn refusal<T: DeserializeOwned>(way: &[Step], value: &Value) -> Option<Refusal> {
    let notes = Notes::default();
    let error = T::deserialize(Reader { source: Source::at_end(way, Some(value)), notes: &notes, depth: 0 }).err()?;
    (notes.steps.borrow().len() >= way.len()).then_some(error)
}

/// The records made while a type reads.
#[derive(Default)]
struct Notes {
    /// The steps to the current value, or to the refused one.
    steps: RefCell<Vec<String>>,
    asked: RefCell<Option<Asked>>,
}

impl Notes {
    /// Returns the key at the end of the steps.
    fn path(&self) -> String {
        self.steps.borrow().concat().trim_start_matches('.').to_owned()
    }
}

/// The value to be read.
#[derive(Clone, Copy)]
enum Source<'a> {
    Table(&'a Table),
    List(&'a [Value]),
    Plain(&'a Value),
    /// A table or a list of one entry: a step on a path, the rest of the path, and the value at its end.
    Step(&'a Step, &'a [Step], Option<&'a Value>),
    /// No value: the type is only probed.
    Nothing,
}

impl<'a> Source<'a> {
    fn new(value: &'a Value) -> Self {
        match value {
            Value::Table(table) => Self::Table(table),
            Value::Array(list) => Self::List(list),
            plain => Self::Plain(plain),
        }
    }

    fn at_end(way: &'a [Step], end: Option<&'a Value>) -> Self {
        match (way, end) {
            ([step, way @ ..], end) => Self::Step(step, way, end),
            ([], Some(value)) => Self::new(value),
            ([], None) => Self::Nothing,
        }
    }
}

/// The deserializer.
#[derive(Clone, Copy)]
struct Reader<'a> {
    source: Source<'a>,
    notes: &'a Notes,
    /// The number of steps to the value.
    depth: usize,
}

impl Reader<'_> {
    /// Passes the value to the visitor; records the requested kind if there is no value.
    fn give<'de, V: Visitor<'de>>(self, asked: Asked, visitor: V) -> Result<V::Value, Refusal> {
        let (rest, length) = match self.source {
            Source::Table(table) => (Rest::Table(table.iter()), None),
            Source::List(list) => (Rest::List(list.iter().enumerate()), Some(list.len())),
            Source::Step(step, way, end) => {
                let single = |name| Rest::One(Some((name, Source::at_end(way, end))));
                match (step, asked) {
                    (Step::Key(name), Asked::Table(_)) => (single(name), None),
                    (Step::Entry, Asked::Map) => (single("element"), None),
                    (Step::Element, Asked::List | Asked::Array(_)) => (single("element"), Some(1)),
                    _ => return Err(Refusal::custom("the way does not lead on")),
                }
            }
            Source::Plain(Value::String(text)) => return visitor.visit_str(text),
            Source::Plain(Value::Integer(number)) => return visitor.visit_i64(*number),
            Source::Plain(Value::Float(number)) => return visitor.visit_f64(*number),
            Source::Plain(Value::Boolean(flag)) => return visitor.visit_bool(*flag),
            // Only dates are left, and a name may look like one; tables and lists are never plain.
            Source::Plain(date) => return visitor.visit_str(&date.to_string()),
            Source::Nothing => {
                self.notes.asked.replace(Some(asked));
                return Err(Refusal::custom("there is only what is asked"));
            }
        };
        let mut entries = Entries { rest, value: None, notes: self.notes, depth: self.depth };
        let Some(length) = length else { return visitor.visit_map(entries) };
        let read = visitor.visit_seq(&mut entries)?;
        match entries.rest.next() {
            Some(_) => Err(Refusal::invalid_length(length, &"fewer elements in array")),
            None => Ok(read),
        }
    }
}

macro_rules! plain {
    ($($method:ident: $asked:ident)*) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Refusal> {
            self.give(Asked::$asked, visitor)
        }
    )*};
}

impl<'de> Deserializer<'de> for Reader<'_> {
    type Error = Refusal;

    plain! {
        deserialize_any: Any deserialize_ignored_any: Any deserialize_unit: Any deserialize_bytes: Any
        deserialize_byte_buf: Any deserialize_bool: Boolean
        deserialize_i8: Integer deserialize_i16: Integer deserialize_i32: Integer deserialize_i64: Integer
        deserialize_i128: Integer deserialize_u8: Count deserialize_u16: Count deserialize_u32: Count deserialize_u64: Count
        deserialize_u128: Count deserialize_f32: Number deserialize_f64: Number
        deserialize_char: Text deserialize_str: Text deserialize_string: Text deserialize_identifier: Text
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Refusal> {
        visitor.visit_some(self)
    }

    fn deserialize_unit_struct<V: Visitor<'de>>(self, _name: &'static str, visitor: V) -> Result<V::Value, Refusal> {
        self.give(Asked::Any, visitor)
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _name: &'static str, visitor: V) -> Result<V::Value, Refusal> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Refusal> {
        self.give(Asked::List, visitor)
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, length: usize, visitor: V) -> Result<V::Value, Refusal> {
        self.give(Asked::Array(length), visitor)
    }

    fn deserialize_tuple_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        length: usize,
        visitor: V,
    ) -> Result<V::Value, Refusal> {
        self.deserialize_tuple(length, visitor)
    }

    fn deserialize_map<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Refusal> {
        self.give(Asked::Map, visitor)
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        names: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Refusal> {
        self.give(Asked::Table(names), visitor)
    }

    /// Reads a choice: a word without nested values.
    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _name: &'static str,
        names: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Refusal> {
        match self.source {
            Source::Plain(Value::String(word)) => visitor.visit_enum(word.as_str().into_deserializer()),
            _ => self.give(Asked::Choice(names), visitor),
        }
    }
}

/// The entries of a table or a list.
struct Entries<'a> {
    rest: Rest<'a>,
    /// The step and the value of the entry whose key was read last.
    value: Option<(String, Source<'a>)>,
    notes: &'a Notes,
    depth: usize,
}

/// The entries that have not been read.
enum Rest<'a> {
    Table(map::Iter<'a, String, Value>),
    List(Enumerate<slice::Iter<'a, Value>>),
    One(Option<(&'static str, Source<'a>)>),
}

impl<'a> Iterator for Rest<'a> {
    /// The key, the step to be recorded, and the value.
    type Item = (&'a str, String, Source<'a>);

    fn next(&mut self) -> Option<Self::Item> {
        match self {
            Self::Table(rest) => rest.next().map(|(key, value)| (key.as_str(), format!(".{key}"), Source::new(value))),
            Self::List(rest) => rest.next().map(|(index, value)| ("", format!("[{index}]"), Source::new(value))),
            Self::One(rest) => rest.take().map(|(key, source)| (key, format!(".{key}"), source)),
        }
    }
}

impl<'a> Entries<'a> {
    fn next(&mut self) -> Option<(&'a str, String, Source<'a>)> {
        self.notes.steps.borrow_mut().truncate(self.depth);
        self.rest.next()
    }

    /// Reads the value one step further; the step stays recorded if the value is refused.
    fn enter<'de, S: DeserializeSeed<'de>>(
        &self,
        step: String,
        source: Source<'_>,
        seed: S,
    ) -> Result<S::Value, Refusal> {
        self.notes.steps.borrow_mut().push(step);
        let read = seed.deserialize(Reader { source, notes: self.notes, depth: self.depth + 1 })?;
        self.notes.steps.borrow_mut().truncate(self.depth);
        Ok(read)
    }
}

impl<'de> MapAccess<'de> for Entries<'_> {
    type Error = Refusal;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, Refusal> {
        let Some((key, step, source)) = self.next() else { return Ok(None) };
        self.value = Some((step, source));
        let key: serde::de::value::StrDeserializer<'_, Refusal> = key.into_deserializer();
        seed.deserialize(key).map(Some)
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, Refusal> {
        let (step, source) = self.value.take().ok_or_else(|| Refusal::custom("a key comes before its value"))?;
        self.enter(step, source, seed)
    }
}

impl<'de> SeqAccess<'de> for &mut Entries<'_> {
    type Error = Refusal;

    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, Refusal> {
        let Some((_, step, source)) = self.next() else { return Ok(None) };
        self.enter(step, source, seed).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;
    use std::collections::BTreeMap;

    #[derive(Debug, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    enum Kind {
        OneWay,
    }

    #[derive(Debug, Deserialize)]
    #[serde(untagged)]
    enum Either {
        Matrix([[f64; 2]; 2]),
        Word(String),
    }

    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Inner {
        kind: Kind,
        either: Either,
        pair: Option<[f64; 2]>,
    }

    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        name: String,
        count: u64,
        inner: Vec<Inner>,
        #[serde(default)]
        limits: BTreeMap<String, f64>,
    }

    const TEXT: &str = "name = 'a'\ncount = 3\nlimits = { x = 1 }\n\
        inner = [{ kind = 'one-way', either = [[1, 2.5], [3, 4]] }, { kind = 'one-way', either = 'w', pair = [1, 2] }]";

    fn read_text(text: &str) -> Result<Outer, (String, Refusal)> {
        read(&toml::from_str(text).unwrap())
    }

    #[test]
    fn a_valid_table_is_read() {
        let Outer { name, count, inner, limits } = read_text(TEXT).unwrap();
        assert_eq!((&*name, count, limits["x"]), ("a", 3, 1.0));
        let [first, second] = &inner[..] else { panic!("there are two") };
        assert!(matches!((&first.kind, &first.either), (Kind::OneWay, Either::Matrix([[1.0, 2.5], [3.0, 4.0]]))));
        assert!(matches!((&second.either, second.pair), (Either::Word(word), Some([1.0, 2.0])) if word == "w"));
        assert!(matches!((first.pair, &second.kind), (None, Kind::OneWay)));
    }

    #[test]
    fn a_refusal_has_its_path_and_reason() {
        let kind =
            |given: &str, wanted: &str| Refusal::WrongType { given: given.to_owned(), wanted: wanted.to_owned() };
        let length = |given, wanted: &str| Refusal::WrongLength { given, wanted: wanted.to_owned() };
        let unknown = |key: &str, known| Refusal::UnknownKey { key: key.to_owned(), known };
        let choice = |word: &str, known| Refusal::UnknownChoice { word: word.to_owned(), known };
        let variants = "data did not match any variant of untagged enum Either".to_owned();
        let whole = "a whole number, not below 0";
        for (from, to, path, refusal) in [
            ("count = 3", "count = -3", "count", kind("integer `-3`", whole)),
            ("count = 3", "count = 1979-05-27", "count", kind("string \"1979-05-27\"", whole)),
            ("count = 3", "counts = 3", "", unknown("counts", &["name", "count", "inner", "limits"])),
            ("count = 3\n", "", "", Refusal::MissingKey("count")),
            ("x = 1", "x = 'a'", "limits.x", kind("string \"a\"", "a number")),
            ("'w'", "1", "inner[1].either", Refusal::Other(variants)),
            // A path refused by one variant must not affect the path of the next field.
            ("pair = [1, 2]", "pair = [1, true]", "inner[1].pair[1]", kind("boolean `true`", "a number")),
            ("pair = [1, 2]", "pair = [1, 2, 3]", "inner[1].pair", length(3, "fewer values")),
            ("pair = [1, 2]", "pair = [1]", "inner[1].pair", length(1, "a list of 2 numbers")),
            ("pair = [1, 2]", "pear = 1", "inner[1]", unknown("pear", &["kind", "either", "pair"])),
            ("'one-way', either = 'w'", "'way', either = 'w'", "inner[1].kind", choice("way", &["one-way"])),
            ("'one-way', either = 'w'", "2, either = 'w'", "inner[1].kind", kind("integer `2`", "a text in quotes")),
            ("inner = [", "inner = [2, ", "inner[0]", kind("integer `2`", "a table")),
        ] {
            assert!(TEXT.contains(from), "{from}");
            let refused = read_text(&TEXT.replace(from, to)).unwrap_err();
            assert_eq!(refused, (path.to_owned(), refusal), "{to}");
        }
    }
}
