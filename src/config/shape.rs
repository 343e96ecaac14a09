//! What a type reads of a scenario, found out by letting it read: keys, kinds of values, choices, which keys must be there.
//!
//! Must not know what any key means, nor need a word from the type beyond that it can be deserialized.

use super::document::read;
use serde::de::value::{Error, StrDeserializer};
use serde::de::{
    DeserializeOwned, DeserializeSeed, Deserializer, Error as _, IntoDeserializer, MapAccess, SeqAccess, Visitor,
};
use std::cell::RefCell;
use toml::Value;

/// The most steps to a value: what lies deeper is of a type that holds itself.
const MAX_STEPS: usize = 12;

/// What a value may be.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Shape {
    /// Several kinds, which the type tells in words, or not at all.
    Any(Option<String>),
    Boolean,
    Integer,
    /// A whole number, not below 0.
    Count,
    Number,
    Text,
    Choice(&'static [&'static str]),
    List(Box<Shape>),
    /// A list of so many.
    Array(Box<Shape>, usize),
    /// A table of any keys.
    Map(Box<Shape>),
    /// A table of these keys, and of others unless it is closed.
    Table {
        keys: Vec<Key>,
        closed: bool,
    },
}

/// A key of a table.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Key {
    pub name: &'static str,
    pub required: bool,
    pub shape: Shape,
}

impl Shape {
    /// What a type reads.
    pub fn of<T: DeserializeOwned>() -> Self {
        at::<T>(&mut Vec::new())
    }

    /// What lies a step further in: under a key, or at a position of a list; and whether it must be there.
    pub fn below(&self, step: &str) -> Option<(&Self, bool)> {
        match self {
            Self::List(element) | Self::Array(element, _) => Some((element, true)),
            Self::Map(value) => Some((value, false)),
            Self::Table { keys, .. } => keys.iter().find(|key| key.name == step).map(|key| (&key.shape, key.required)),
            _ => None,
        }
    }

    /// A value of this shape, if one is known.
    pub fn example(&self) -> Option<Value> {
        Some(match self {
            Self::Any(_) => return None,
            Self::Boolean => Value::Boolean(false),
            Self::Integer | Self::Count => Value::Integer(0),
            Self::Number => Value::Float(0.0),
            Self::Text => Value::String(String::new()),
            Self::Choice(choices) => Value::String((*choices.first()?).to_owned()),
            Self::List(_) => Value::Array(Vec::new()),
            Self::Array(element, length) => Value::Array(vec![element.example()?; *length]),
            Self::Map(_) => Value::Table(toml::Table::new()),
            Self::Table { keys, .. } => {
                let required = keys.iter().filter(|key| key.required);
                let entries = required.map(|key| Some((key.name.to_owned(), key.shape.example()?)));
                Value::Table(entries.collect::<Option<_>>()?)
            }
        })
    }
}

/// A step on the way to a value.
#[derive(Debug, Clone, Copy)]
enum Step {
    Key(&'static str),
    /// Into a list.
    Element,
    /// Into a table of any keys.
    Entry,
}

/// What the type asks for where the way ends.
enum Asked {
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

/// The shape of what the type reads at the end of a way.
fn at<T: DeserializeOwned>(way: &mut Vec<Step>) -> Shape {
    if way.len() > MAX_STEPS {
        return Shape::Any(None);
    }
    let asked = RefCell::new(None);
    let _ = T::deserialize(Probe { way, asked: &asked });
    let further = |way: &mut Vec<Step>, step| {
        way.push(step);
        let shape = at::<T>(way);
        way.pop();
        shape
    };
    match asked.into_inner() {
        None => Shape::Any(None),
        Some(Asked::Any) => Shape::Any(choices::<T>(way)),
        Some(Asked::Boolean) => Shape::Boolean,
        Some(Asked::Integer) => Shape::Integer,
        Some(Asked::Count) => Shape::Count,
        Some(Asked::Number) => Shape::Number,
        Some(Asked::Text) => Shape::Text,
        Some(Asked::Choice(choices)) => Shape::Choice(choices),
        Some(Asked::List) => Shape::List(Box::new(further(way, Step::Element))),
        Some(Asked::Array(length)) => Shape::Array(Box::new(further(way, Step::Element)), length),
        Some(Asked::Map) => Shape::Map(Box::new(further(way, Step::Entry))),
        Some(Asked::Table(names)) => table::<T>(way, names),
    }
}

fn table<T: DeserializeOwned>(way: &mut Vec<Step>, names: &'static [&'static str]) -> Shape {
    let mut key = |name| {
        way.push(Step::Key(name));
        let shape = at::<T>(way);
        way.pop();
        Key { name, required: false, shape }
    };
    let mut keys: Vec<Key> = names.iter().map(|name| key(*name)).collect();
    let mut given = toml::Table::new();
    // One after the other: only the first that is missing is complained of.
    while let Some(name) = refusal::<T>(way, Value::Table(given.clone())).as_deref().and_then(missing) {
        let Some(key) = keys.iter_mut().find(|key| key.name == name && !key.required) else { break };
        key.required = true;
        let Some(example) = key.shape.example() else { break };
        given.insert(name.to_owned(), example);
    }
    let stranger = toml::Table::from_iter([("?".to_owned(), Value::Integer(0))]);
    let closed = refusal::<T>(way, Value::Table(stranger)).is_some_and(|reason| reason.contains("unknown field"));
    Shape::Table { keys, closed }
}

/// Why a value is refused at the end of a way, if it is.
fn refusal<T: DeserializeOwned>(way: &[Step], value: Value) -> Option<String> {
    let whole = way.iter().rev().fold(value, |value, step| match step {
        Step::Key(name) => Value::Table(toml::Table::from_iter([((*name).to_owned(), value)])),
        Step::Element => Value::Array(vec![value]),
        Step::Entry => Value::Table(toml::Table::from_iter([("element".to_owned(), value)])),
    });
    // What is missing around it is no refusal of it.
    let (path, reason) = read::<T>(whole).err()?;
    (path.iter().count() >= way.len()).then_some(reason)
}

/// The key in a message as "missing field `a`".
fn missing(reason: &str) -> Option<&str> {
    reason.split_once("missing field `")?.1.split_once('`').map(|(name, _)| name)
}

/// What a type that takes several kinds of values says to one that it does not take.
fn choices<T: DeserializeOwned>(way: &[Step]) -> Option<String> {
    refusal::<T>(way, Value::Boolean(true))?
        .split_once("; ")
        .map(|(_, remedy)| remedy.to_owned())
        .filter(|remedy| remedy.starts_with("give "))
}

/// A deserializer that has tables and lists with one entry each, and notes what the type asks for where the way ends.
#[derive(Clone, Copy)]
struct Probe<'a> {
    way: &'a [Step],
    asked: &'a RefCell<Option<Asked>>,
}

impl<'a> Probe<'a> {
    /// One step on, if there is one; a table of named keys has one only by its name.
    fn step(self) -> Option<(&'static str, Self)> {
        let (step, way) = self.way.split_first()?;
        let name = match step {
            Step::Key(name) => name,
            Step::Element | Step::Entry => "element",
        };
        Some((name, Self { way, ..self }))
    }

    /// There is never more than is asked: always an error.
    fn arrive<T>(self, asked: Asked) -> Result<T, Error> {
        if self.way.is_empty() {
            self.asked.replace(Some(asked));
        }
        Err(Error::custom("there is only what is asked"))
    }
}

macro_rules! plain {
    ($($method:ident: $asked:ident)*) => {$(
        fn $method<V: Visitor<'de>>(self, _visitor: V) -> Result<V::Value, Error> {
            self.arrive(Asked::$asked)
        }
    )*};
}

impl<'de> Deserializer<'de> for Probe<'_> {
    type Error = Error;

    plain! {
        deserialize_any: Any deserialize_ignored_any: Any deserialize_unit: Any deserialize_bytes: Any
        deserialize_byte_buf: Any deserialize_bool: Boolean
        deserialize_i8: Integer deserialize_i16: Integer deserialize_i32: Integer deserialize_i64: Integer
        deserialize_i128: Integer deserialize_u8: Count deserialize_u16: Count deserialize_u32: Count deserialize_u64: Count
        deserialize_u128: Count deserialize_f32: Number deserialize_f64: Number
        deserialize_char: Text deserialize_str: Text deserialize_string: Text deserialize_identifier: Text
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_some(self)
    }

    fn deserialize_unit_struct<V: Visitor<'de>>(self, _name: &'static str, _visitor: V) -> Result<V::Value, Error> {
        self.arrive(Asked::Any)
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _name: &'static str, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        match self.step() {
            Some((_, probe)) => visitor.visit_seq(One(Some((None, probe)))),
            None => self.arrive(Asked::List),
        }
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, length: usize, visitor: V) -> Result<V::Value, Error> {
        match self.step() {
            Some((_, probe)) => visitor.visit_seq(One(Some((None, probe)))),
            None => self.arrive(Asked::Array(length)),
        }
    }

    fn deserialize_tuple_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        length: usize,
        visitor: V,
    ) -> Result<V::Value, Error> {
        self.deserialize_tuple(length, visitor)
    }

    fn deserialize_map<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        match self.step() {
            Some((name, probe)) => visitor.visit_map(One(Some((Some(name), probe)))),
            None => self.arrive(Asked::Map),
        }
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        names: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        match self.step() {
            Some((name, probe)) => visitor.visit_map(One(Some((Some(name), probe)))),
            None => self.arrive(Asked::Table(names)),
        }
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _name: &'static str,
        names: &'static [&'static str],
        _visitor: V,
    ) -> Result<V::Value, Error> {
        self.arrive(Asked::Choice(names))
    }
}

/// The one entry of a table or a list; its key is taken first.
struct One<'a>(Option<(Option<&'static str>, Probe<'a>)>);

impl<'de> MapAccess<'de> for One<'_> {
    type Error = Error;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, Error> {
        let name = self.0.as_mut().and_then(|(name, _)| name.take());
        let key = |name: &'static str| -> StrDeserializer<'static, Error> { name.into_deserializer() };
        name.map(|name| seed.deserialize(key(name))).transpose()
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, Error> {
        let (_, probe) = self.0.take().ok_or_else(|| Error::custom("there is one entry"))?;
        seed.deserialize(probe)
    }
}

impl<'de> SeqAccess<'de> for One<'_> {
    type Error = Error;

    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, Error> {
        self.0.take().map(|(_, probe)| seed.deserialize(probe)).transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;
    use std::collections::BTreeMap;

    #[derive(Deserialize)]
    #[serde(rename_all = "kebab-case")]
    enum Kind {
        OneWay,
        Other,
    }

    #[derive(Deserialize)]
    #[serde(untagged, expecting = "there is no such choice; give a word or a number")]
    #[expect(dead_code, reason = "only its shape is looked at")]
    enum Either {
        Word(String),
        Number(f64),
    }

    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    #[expect(dead_code, reason = "only its shape is looked at")]
    struct Inner {
        kind: Kind,
        either: Option<Either>,
        #[serde(default)]
        deep: Vec<Inner>,
    }

    #[derive(Deserialize)]
    #[expect(dead_code, reason = "only its shape is looked at")]
    struct Outer {
        name: String,
        #[serde(default)]
        on: bool,
        axes: [f64; 3],
        cores: Vec<usize>,
        offset: Option<i32>,
        limits: BTreeMap<String, f64>,
        inner: Inner,
    }

    #[test]
    fn a_type_tells_its_keys() {
        let Shape::Table { keys, closed } = Shape::of::<Outer>() else { panic!("it is a table") };
        assert!(!closed);
        let required: Vec<&str> = keys.iter().filter(|key| key.required).map(|key| key.name).collect();
        assert_eq!(required, ["name", "axes", "cores", "limits", "inner"]);
        let shape = |name: &str| &keys.iter().find(|key| key.name == name).unwrap().shape;
        assert_eq!(shape("axes"), &Shape::Array(Box::new(Shape::Number), 3));
        assert_eq!(shape("cores"), &Shape::List(Box::new(Shape::Count)));
        assert_eq!(shape("limits"), &Shape::Map(Box::new(Shape::Number)));
        assert_eq!([shape("name"), shape("on"), shape("offset")], [&Shape::Text, &Shape::Boolean, &Shape::Integer]);
        let Shape::Table { keys, closed: true } = shape("inner") else { panic!("it is a closed table") };
        assert_eq!((keys[0].required, &keys[0].shape), (true, &Shape::Choice(&["one-way", "other"])));
        assert_eq!(
            (keys[1].required, &keys[1].shape),
            (false, &Shape::Any(Some("give a word or a number".to_owned())))
        );
        assert!(
            matches!(&keys[2].shape, Shape::List(inner) if matches!(**inner, Shape::Table { .. })),
            "to some depth"
        );
    }
}
