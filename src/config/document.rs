//! A scenario's text with its overrides: one table, and where each key of it came from.
//!
//! Must not know what any key means.

use super::ConfigError;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::path::Path;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// A parsed scenario text: the table, and the place of every key for error messages.
#[derive(Debug, Clone)]
pub struct Document {
    table: Table,
    /// Key path, as `follower[0].name`, to `file:line` or `--set …`.
    places: BTreeMap<String, String>,
    origin: String,
}

impl Document {
    /// Reads a file.
    ///
    /// # Errors
    /// [`ConfigError::Read`] and [`ConfigError::Syntax`].
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|error| ConfigError::Read { path: path.to_owned(), reason: error.to_string() })?;
        Self::parse(&text, &path.display().to_string())
    }

    /// Parses a text; `origin` stands for the file in error messages.
    ///
    /// # Errors
    /// [`ConfigError::Syntax`], also for a key that appears twice.
    pub fn parse(text: &str, origin: &str) -> Result<Self, ConfigError> {
        let syntax = |error: toml::de::Error| ConfigError::Syntax {
            place: error.span().map_or(origin.to_owned(), |span| format!("{origin}:{}", position(text, span.start))),
            reason: error.message().trim().replace('\n', ", "),
        };
        let spanned = DeTable::parse(text).map_err(syntax)?;
        let table = toml::from_str::<Table>(text).map_err(syntax)?;
        let mut places = BTreeMap::new();
        locate_table(spanned.get_ref(), "", &mut |path, offset| {
            places.insert(path, format!("{origin}:{}", line(text, offset)));
        });
        let document = Self { table, places, origin: origin.to_owned() };
        document.refuse_non_finite()?;
        Ok(document)
    }

    /// Applies one override of the form `key=value`; the value is TOML, or a bare word taken as a string.
    ///
    /// # Errors
    /// [`ConfigError::Override`].
    pub fn set(&mut self, argument: &str) -> Result<(), ConfigError> {
        let refuse = |reason: &str| ConfigError::Override { argument: argument.to_owned(), reason: reason.to_owned() };
        let (path, text) = argument.split_once('=').ok_or_else(|| refuse("there is no `=`"))?;
        let value = parse_value(text.trim()).ok_or_else(|| refuse("the value is neither TOML nor a bare word"))?;
        let steps: Vec<&str> = path.trim().split('.').collect();
        if steps.iter().any(|step| step.is_empty()) {
            return Err(refuse("the key is empty"));
        }
        let key = insert(&mut self.table, &steps, value).map_err(|reason| refuse(&reason))?;
        // Whatever stood below the key is gone, and its places with it.
        self.places.retain(|path, _| !is_below(path, &key));
        self.places.insert(key, format!("--set {argument}"));
        self.refuse_non_finite()
    }

    /// Takes the given top-level keys out into a document of their own.
    pub fn split_off(&mut self, keys: &[&str]) -> Self {
        let table = keys.iter().filter_map(|key| self.table.remove_entry(*key)).collect();
        Self { table, places: self.places.clone(), origin: self.origin.clone() }
    }

    /// The string at a top-level key, if there is one.
    pub fn text(&self, key: &str) -> Option<&str> {
        self.table.get(key).and_then(Value::as_str)
    }

    /// Reads the table into a type.
    ///
    /// # Errors
    /// [`ConfigError::UnknownKey`] and [`ConfigError::Value`], with the place of the key.
    pub fn read_into<T: DeserializeOwned>(&self) -> Result<T, ConfigError> {
        serde_path_to_error::deserialize(Value::Table(self.table.clone())).map_err(|error| {
            let (path, message) = (error.path().to_string(), error.inner().message().trim().to_owned());
            self.explain(if path == "." { String::new() } else { path }, &message)
        })
    }

    /// The place of a key, or of the nearest table around it, or the file.
    pub fn place(&self, key: &str) -> String {
        let mut path = key;
        loop {
            if let Some(place) = self.places.get(path) {
                return place.clone();
            }
            match path.rfind(['.', '[']) {
                Some(cut) => path = &path[..cut],
                None => return self.origin.clone(),
            }
        }
    }

    fn explain(&self, path: String, message: &str) -> ConfigError {
        // serde names the field and its known alternatives in backquotes; there is no structured way to them.
        let quoted: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
        let join = |parent: &str, field: &str| {
            if parent.is_empty() { field.to_owned() } else { format!("{parent}.{field}") }
        };
        if message.starts_with("unknown field") && !quoted.is_empty() {
            // The path ends at the unknown field itself or at its table, by the kind of map.
            let key = if path.ends_with(quoted[0]) { path } else { join(&path, quoted[0]) };
            let remedy = nearest(quoted[0], &quoted[1..]);
            return ConfigError::UnknownKey { place: self.place(&key), key, remedy };
        }
        if message.starts_with("missing field") && !quoted.is_empty() {
            let key = join(&path, quoted[0]);
            return ConfigError::Value { place: self.place(&path), key, reason: "is missing; add it".to_owned() };
        }
        ConfigError::Value { place: self.place(&path), key: path, reason: message.replace('\n', ", ") }
    }

    fn refuse_non_finite(&self) -> Result<(), ConfigError> {
        match non_finite(&Value::Table(self.table.clone()), String::new()) {
            Some((key, value)) => Err(ConfigError::Value {
                place: self.place(&key),
                key,
                reason: format!("{value} is not a finite number; no quantity here may be infinite or undefined"),
            }),
            None => Ok(()),
        }
    }
}

/// "did you mean" for the nearest candidate, or the list of them.
pub(crate) fn nearest(word: &str, candidates: &[&str]) -> String {
    let best = candidates.iter().max_by(|a, b| strsim::jaro_winkler(word, a).total_cmp(&strsim::jaro_winkler(word, b)));
    match best {
        Some(best) if strsim::jaro_winkler(word, best) > 0.8 => format!("did you mean `{best}`?"),
        Some(_) => format!("known here: {}", candidates.join(", ")),
        None => "no key is known here".to_owned(),
    }
}

fn line(text: &str, offset: usize) -> usize {
    1 + text.as_bytes()[..offset.min(text.len())].iter().filter(|byte| **byte == b'\n').count()
}

fn position(text: &str, offset: usize) -> String {
    let before = &text.as_bytes()[..offset.min(text.len())];
    let column = 1 + before.iter().rev().take_while(|byte| **byte != b'\n').count();
    format!("{}:{column}", line(text, offset))
}

fn locate_table(table: &DeTable<'_>, path: &str, found: &mut impl FnMut(String, usize)) {
    for (key, value) in table {
        let name = key.get_ref();
        let path = if path.is_empty() { name.to_string() } else { format!("{path}.{name}") };
        found(path.clone(), key.span().start);
        locate_value(value.get_ref(), &path, found);
    }
}

fn locate_value(value: &DeValue<'_>, path: &str, found: &mut impl FnMut(String, usize)) {
    match value {
        DeValue::Table(table) => locate_table(table, path, found),
        DeValue::Array(array) => {
            for (index, element) in array.iter().enumerate() {
                let path = format!("{path}[{index}]");
                found(path.clone(), element.span().start);
                locate_value(element.get_ref(), &path, found);
            }
        }
        _ => {}
    }
}

fn is_below(path: &str, key: &str) -> bool {
    path.strip_prefix(key).is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']))
}

fn parse_value(text: &str) -> Option<Value> {
    let parsed = toml::from_str::<Table>(&format!("v = {text}")).ok().filter(|table| table.len() == 1);
    let bare = || {
        let word = !text.is_empty() && text.chars().all(|c| c.is_alphanumeric() || "-_./".contains(c));
        word.then(|| Value::String(text.to_owned()))
    };
    parsed.and_then(|mut table| table.remove("v")).or_else(bare)
}

/// Puts a value at a dotted path (a number selects an array's element) and returns the path as errors write it.
fn insert(table: &mut Table, steps: &[&str], value: Value) -> Result<String, String> {
    let mut path = steps[0].to_owned();
    let Some((last, parents)) = steps[1..].split_last() else {
        table.insert(path.clone(), value);
        return Ok(path);
    };
    let mut place = table.entry(steps[0]).or_insert_with(|| Value::Table(Table::new()));
    for step in parents {
        place = descend(place, step, &mut path)?;
    }
    *descend(place, last, &mut path)? = value;
    Ok(path)
}

fn descend<'a>(place: &'a mut Value, step: &str, path: &mut String) -> Result<&'a mut Value, String> {
    match place {
        Value::Table(table) => {
            *path = format!("{path}.{step}");
            Ok(table.entry(step).or_insert_with(|| Value::Table(Table::new())))
        }
        Value::Array(array) => {
            let length = array.len();
            let index: usize =
                step.parse().map_err(|_| format!("`{path}` is a list: `{step}` is not a position in it"))?;
            let element = array
                .get_mut(index)
                .ok_or_else(|| format!("`{path}` has {length} entries, counted from 0: no {index}"))?;
            *path = format!("{path}[{index}]");
            Ok(element)
        }
        _ => Err(format!("`{path}` is a plain value: there is no `{step}` below it")),
    }
}

fn non_finite(value: &Value, path: String) -> Option<(String, f64)> {
    match value {
        Value::Float(number) if !number.is_finite() => Some((path, *number)),
        Value::Array(array) => {
            array.iter().enumerate().find_map(|(index, value)| non_finite(value, format!("{path}[{index}]")))
        }
        Value::Table(table) => table.iter().find_map(|(key, value)| {
            non_finite(value, if path.is_empty() { key.clone() } else { format!("{path}.{key}") })
        }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "a = 1\n[b]\nc = [1.0, 2.0]\n\n[[d]]\ne = 3\n";

    fn parse(text: &str) -> Result<Document, String> {
        Document::parse(text, "x.toml").map_err(|error| error.to_string())
    }

    #[test]
    fn knows_the_line_of_every_key() {
        let document = parse(TEXT).unwrap();
        for (key, place) in [("a", "x.toml:1"), ("b.c", "x.toml:3"), ("b.c[1]", "x.toml:3"), ("d[0].e", "x.toml:6")] {
            assert_eq!(document.place(key), place, "{key}");
        }
        assert_eq!(document.place("b.missing"), "x.toml:2", "the table around it");
        assert_eq!(document.place("missing"), "x.toml");
    }

    #[test]
    fn an_override_replaces_the_value_and_its_place() {
        let mut document = parse(TEXT).unwrap();
        for argument in ["b.c=[5.0]", "d.0.e=word", "a = 7", "new.deep=true"] {
            document.set(argument).unwrap();
        }
        assert_eq!(document.table["b"]["c"][0].as_float(), Some(5.0));
        assert_eq!(document.table["d"][0]["e"].as_str(), Some("word"));
        assert_eq!(document.table["a"].as_integer(), Some(7));
        assert_eq!(document.table["new"]["deep"].as_bool(), Some(true));
        assert_eq!(document.place("b.c[0]"), "--set b.c=[5.0]");
    }

    #[test]
    fn a_bad_override_is_refused_with_its_reason() {
        let mut document = parse(TEXT).unwrap();
        for (argument, reason) in [
            ("a", "no `=`"),
            ("=1", "key is empty"),
            ("b..c=1", "key is empty"),
            ("a.b=1", "plain value"),
            ("d.7.e=1", "no 7"),
            ("d.x.e=1", "not a position"),
            ("a=", "neither TOML"),
            ("a=[1,", "neither TOML"),
            ("a=1\nb=2", "neither TOML"),
        ] {
            let error = document.set(argument).unwrap_err().to_string();
            assert!(error.contains(reason), "{argument:?}: {error}");
        }
    }

    #[test]
    fn refuses_bad_syntax_duplicates_and_non_finite_numbers_with_their_line() {
        for (text, expected) in [
            ("a = 1\na = 2", "x.toml:2:1: duplicate key"),
            ("a = 1\nb = [", "x.toml:2:"),
            ("a = 1\n[b]\nc = nan", "x.toml:3: b.c: NaN is not a finite number"),
            ("a = [1, inf]", "x.toml:1: a[1]: inf is not"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.starts_with(expected), "{error}");
        }
        assert!(parse("a = 1").unwrap().set("a=-inf").unwrap_err().to_string().starts_with("--set a=-inf: a: -inf"));
    }

    #[test]
    fn suggests_the_nearest_key() {
        assert_eq!(nearest("tick_hertz", &["tick_hz", "name"]), "did you mean `tick_hz`?");
        assert_eq!(nearest("zzz", &["tick_hz", "name"]), "known here: tick_hz, name");
    }
}
