//! Finds the shape that a type reads from a scenario by letting it read: keys, kinds of values, choices, and required keys.
//!
//! Must not know what any key means, nor need anything from the type beyond `Deserialize`.

use super::reader::{Asked, Refusal, Step, asked, refusal};
use serde::de::DeserializeOwned;
use toml::Value;

/// The most steps to a value; only recursive types are deeper.
const MAX_STEPS: usize = 12;

/// The possible values at a place.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Shape {
    /// Several kinds, with the type's own description, if it has one.
    Any(Option<String>),
    Boolean,
    Integer,
    /// A whole number, not below 0.
    Count,
    Number,
    Text,
    Choice(&'static [&'static str]),
    List(Box<Shape>),
    /// A list of fixed length.
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
    /// Returns the shape that a type reads.
    pub fn read_by<T: DeserializeOwned>() -> Self {
        at::<T>(&mut Vec::new())
    }

    /// Returns the shape one step further, under a key or at a list position, and true if a value is required there.
    pub fn below(&self, step: &str) -> Option<(&Self, bool)> {
        match self {
            Self::List(element) | Self::Array(element, _) => Some((element, true)),
            Self::Map(value) => Some((value, false)),
            Self::Table { keys, .. } => keys.iter().find(|key| key.name == step).map(|key| (&key.shape, key.required)),
            _ => None,
        }
    }

    /// Returns a value of this shape, if one is known.
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

/// Returns the shape that a type reads at the end of a path.
fn at<T: DeserializeOwned>(way: &mut Vec<Step>) -> Shape {
    if way.len() > MAX_STEPS {
        return Shape::Any(None);
    }
    let further = |way: &mut Vec<Step>, step| {
        way.push(step);
        let shape = at::<T>(way);
        way.pop();
        shape
    };
    match asked::<T>(way) {
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
    // One key after the other: serde reports only the first missing key.
    while let Some(Refusal::MissingKey(name)) = refusal::<T>(way, &Value::Table(given.clone())) {
        let Some(key) = keys.iter_mut().find(|key| key.name == name && !key.required) else { break };
        key.required = true;
        let Some(example) = key.shape.example() else { break };
        given.insert(name.to_owned(), example);
    }
    let stranger = toml::Table::from_iter([("?".to_owned(), Value::Integer(0))]);
    let closed = matches!(refusal::<T>(way, &Value::Table(stranger)), Some(Refusal::UnknownKey { .. }));
    Shape::Table { keys, closed }
}

/// Returns the remedy in the message of a type that takes several kinds of values.
fn choices<T: DeserializeOwned>(way: &[Step]) -> Option<String> {
    let Some(Refusal::Other(words)) = refusal::<T>(way, &Value::Boolean(true)) else { return None };
    let (_, remedy) = words.split_once("; ")?;
    remedy.starts_with("give ").then(|| remedy.to_owned())
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
    #[serde(untagged, expecting = "unknown choice; give a word or a number")]
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
    fn the_shape_of_a_type_has_its_keys() {
        let Shape::Table { keys, closed } = Shape::read_by::<Outer>() else { panic!("it is a table") };
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
