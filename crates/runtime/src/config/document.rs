//! A scenario's text with its overrides: one table, and the origin of each key.
//!
//! Must not know what any key means.

use super::error::{ConfigError, PathError, Place, Problem};
use super::error::{MISSING_KEY, UNKNOWN_KEY, most_similar, nearest};
use super::reader::{Refusal, read};
use super::run_id::RunId;
use super::shape::Shape;
use serde::de::DeserializeOwned;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::sync::OnceLock;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// The longest text, bytes. A longer text is not a scenario and may be endless.
const MAX_BYTES: u64 = 1 << 20;
/// The most mistakes reported at once.
const MAX_MISTAKES: usize = 20;
/// The most steps in the key of an override. No key is that deep.
const MAX_STEPS: usize = 16;
/// The range of nonzero quantities in magnitude, so that a product of a few stays within the floating-point range.
const SMALLEST: f64 = 1e-30;
const LARGEST: f64 = 1e30;

/// A parsed scenario text: the table, and the place of every key for error messages.
#[derive(Debug, Clone)]
pub struct Document {
    pub(super) table: Table,
    /// The place of each key path, such as `follower[0].name`: a line of the file or `--set …`.
    pub(super) places: BTreeMap<String, Place>,
    pub(super) origin: String,
    /// The run named in the file's first line.
    run: Option<RunId>,
    /// Top-level keys that were split off; they count as known.
    elsewhere: BTreeSet<String>,
    /// In a probe document, the shape of the first type read from it.
    asked: Option<OnceLock<Shape>>,
}

impl Document {
    /// Reads a file.
    ///
    /// # Errors
    /// [`ConfigError::Read`] and [`ConfigError::Invalid`].
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let refuse = |error: io::Error| ConfigError::Read { path: path.to_owned(), reason: error.to_string() };
        let text = File::open(path).map_err(refuse).and_then(|file| read_text(file, path))?;
        Self::parse(&text, &path.display().to_string())
    }

    /// Parses a text; error messages give `origin` as the file.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`], also for a key that appears twice.
    pub fn parse(text: &str, origin: &str) -> Result<Self, ConfigError> {
        let syntax = |error: toml::de::Error| {
            let place = error.span().map_or(origin.into(), |span| position(origin, text.as_bytes(), span.start));
            let key = error.span().and_then(|span| text.get(span)).unwrap_or_default();
            // The parser reports errors only as text.
            let (code, reason) = match error.message().trim() {
                "duplicate key" => ("duplicate-key", format!("duplicate key `{key}`")),
                message if message.ends_with("expected any valid TOML value") => {
                    ("syntax", "the number has too many digits; give a smaller number".to_owned())
                }
                message => ("syntax", message.replace('\n', ", ")),
            };
            ConfigError::invalid(place, "", code, format!("{reason}; correct the line"))
        };
        let spanned = DeTable::parse(text).map_err(syntax)?;
        let table = toml::from_str::<Table>(text).map_err(syntax)?;
        let ends: Vec<usize> = text.match_indices('\n').map(|(offset, _)| offset).collect();
        let mut places = BTreeMap::new();
        locate_table(spanned.get_ref(), "", &mut |path, offset| {
            let line = 1 + ends.partition_point(|end| *end < offset);
            places.insert(path, Place::line(origin, line));
        });
        let run = text.lines().next().and_then(RunId::in_comments_of);
        let document = Self { table, places, origin: origin.to_owned(), run, elsewhere: BTreeSet::new(), asked: None };
        document.refuse_absurd()?;
        Ok(document)
    }

    /// Returns the run named in the file's first line.
    pub fn run(&self) -> Option<RunId> {
        self.run
    }

    /// Applies an override of the form `key=value`; the value is TOML, or a bare word as a string.
    ///
    /// # Errors
    /// [`ConfigError::Override`].
    pub fn set(&mut self, argument: &str) -> Result<(), ConfigError> {
        let refuse = |source| ConfigError::Override { argument: argument.to_owned(), source };
        let (path, text) = argument.split_once('=').ok_or(PathError::NoEquals).map_err(refuse)?;
        self.assign(path, text, format!("--set {argument}").into()).map_err(refuse)?;
        self.refuse_absurd()
    }

    /// Applies a command-line option that overrides one key.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`].
    pub fn set_by_option(&mut self, option: &str, key: &str, text: &str) -> Result<(), ConfigError> {
        let place = Place::from(format!("{option} {text}"));
        self.assign(key, text, place.clone()).map_err(|error| {
            ConfigError::invalid(place, key, (&error).into(), format!("{error}; write it as in a scenario"))
        })?;
        self.refuse_absurd()
    }

    /// Parses a value and puts it at a path; records its place.
    fn assign(&mut self, path: &str, text: &str, place: Place) -> Result<(), PathError> {
        let value = parse_value(text.trim()).ok_or(PathError::NoValue)?;
        self.put_value(path, value, place)
    }

    /// Puts a value at a path and records its place.
    pub(super) fn put_value(&mut self, path: &str, value: Value, place: Place) -> Result<(), PathError> {
        // List positions are also accepted in brackets, as error messages write them.
        let path = path.trim().replace('[', ".").replace(']', "");
        let steps: Vec<&str> = path.split('.').collect();
        if steps.iter().any(|step| step.is_empty()) {
            return Err(PathError::EmptyKey);
        }
        if steps.len() > MAX_STEPS {
            return Err(PathError::TooDeep);
        }
        let key = insert(&mut self.table, &steps, value)?;
        // All values below the key are replaced, so their places are removed.
        self.places.retain(|path, _| !is_below(path, &key));
        // The override also created the missing tables on the path.
        for (end, _) in key.match_indices(['.', '[']) {
            self.places.entry(key[..end].to_owned()).or_insert_with(|| place.clone());
        }
        self.places.insert(key, place);
        Ok(())
    }

    /// Moves the given top-level keys into a new document.
    pub fn split_off(&mut self, keys: &[&str]) -> Self {
        let table = keys.iter().filter_map(|key| self.table.remove_entry(*key)).collect();
        self.elsewhere.extend(keys.iter().map(|key| (*key).to_owned()));
        self.part(table)
    }

    /// Moves the keys of a table for which `taken` returns true into a table of the same name in a new document.
    pub fn split_off_within(&mut self, table: &str, taken: impl Fn(&str) -> bool) -> Self {
        let keys = self.table.get_mut(table).and_then(Value::as_table_mut);
        let split = keys.map_or_else(Table::new, |keys| {
            let (out, kept) = std::mem::take(keys).into_iter().partition(|(key, _)| taken(key));
            *keys = kept;
            out
        });
        let table = Table::from_iter([(table.to_owned(), Value::Table(split))]);
        self.part(table)
    }

    /// Returns a document of a table that was removed from this one.
    pub(super) fn part(&self, table: Table) -> Self {
        let (places, origin) = (self.places.clone(), self.origin.clone());
        Self { table, places, origin, run: None, elsewhere: BTreeSet::new(), asked: None }
    }

    /// Creates an empty probe document that records the shape of the first type read from it.
    pub(crate) fn asking() -> Self {
        let (table, places, origin) = (Table::new(), BTreeMap::new(), String::new());
        Self { table, places, origin, run: None, elsewhere: BTreeSet::new(), asked: Some(OnceLock::new()) }
    }

    /// Returns the shape of the first type read from a probe document.
    pub(crate) fn asked(self) -> Option<Shape> {
        self.asked?.into_inner()
    }

    /// Refuses a list, as from `[[key]]`, at top-level keys that hold one table each: serde would take its elements for the
    /// table's values.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`].
    pub fn refuse_lists(&self, keys: &[&str]) -> Result<(), ConfigError> {
        match keys.iter().find(|key| self.table.get(**key).is_some_and(Value::is_array)) {
            Some(key) => Err(ConfigError::invalid(
                self.place(key),
                *key,
                "wrong-type",
                format!("is a list; write [{key}], once"),
            )),
            None => Ok(()),
        }
    }

    /// Returns the string at a top-level key, if any.
    pub fn text(&self, key: &str) -> Option<&str> {
        self.table.get(key).and_then(Value::as_str)
    }

    /// Reads the table into a type.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] with all mistakes, each with its key's place.
    pub fn read_into<T: DeserializeOwned>(&self) -> Result<T, ConfigError> {
        if let Some(asked) = &self.asked {
            let _ = asked.set(Shape::read_by::<T>());
        }
        self.read_once().map_err(|problem| ConfigError::Invalid { problems: self.with_further_mistakes::<T>(*problem) })
    }

    fn read_once<T: DeserializeOwned>(&self) -> Result<T, Box<Problem>> {
        read(&self.table).map_err(|(path, refusal)| Box::new(self.problem(path, &refusal)))
    }

    /// Returns a mistake and those found after repairing it, repeatedly.
    fn with_further_mistakes<T: DeserializeOwned>(&self, first: Problem) -> Vec<Problem> {
        let (shape, mut repaired, mut found) = (Shape::read_by::<T>(), self.clone(), Vec::<Problem>::new());
        let mut next = Some(first);
        for _ in 0..MAX_MISTAKES {
            // A mistake that could not be repaired is found again.
            let Some(problem) = next.take().filter(|problem| !found.contains(problem)) else { break };
            if repaired.repair(&problem, &shape) {
                next = repaired.read_once::<T>().err().map(|problem| *problem);
            }
            found.push(problem);
        }
        // A misspelt key is not reported as missing too.
        let misspelt = found.iter().filter(|problem| problem.code == UNKNOWN_KEY);
        let meant: Vec<String> = misspelt.filter_map(|problem| problem.meant.clone()).collect();
        found.retain(|problem| problem.code != MISSING_KEY || !meant.contains(&problem.key));
        found
    }

    /// Removes a mistake from the table, so that the next one can be found. Returns false if that is not possible.
    fn repair(&mut self, problem: &Problem, shape: &Shape) -> bool {
        let path = problem.key.replace('[', ".").replace(']', "");
        let steps: Vec<&str> = path.split('.').collect();
        let known = steps.iter().try_fold((shape, true), |(shape, _), step| shape.below(step));
        match known.filter(|(_, required)| *required).and_then(|(shape, _)| shape.example()) {
            Some(example) => insert(&mut self.table, &steps, example).is_ok(),
            None => self.remove(&steps).is_some(),
        }
    }

    fn remove(&mut self, steps: &[&str]) -> Option<Value> {
        let (last, parents) = steps.split_last()?;
        let Some((first, inner)) = parents.split_first() else { return self.table.remove(*last) };
        let parent = inner.iter().try_fold(self.table.get_mut(*first)?, |parent, step| match parent {
            Value::Table(table) => table.get_mut(*step),
            Value::Array(list) => list.get_mut(step.parse::<usize>().ok()?),
            _ => None,
        });
        parent?.as_table_mut()?.remove(*last)
    }

    /// Returns the directory of the file, to which the files that it names are relative.
    pub fn directory(&self) -> &Path {
        Path::new(&self.origin).parent().unwrap_or(Path::new(""))
    }

    /// Returns the place of a key, or of the nearest enclosing table, or the file.
    pub fn place(&self, key: &str) -> Place {
        let mut path = key;
        loop {
            if let Some(place) = self.places.get(path) {
                return place.clone();
            }
            match path.rfind(['.', '[']) {
                Some(cut) => path = &path[..cut],
                None => return self.origin.as_str().into(),
            }
        }
    }

    fn problem(&self, path: String, refusal: &Refusal) -> Problem {
        let join = |field: &str| if path.is_empty() { field.to_owned() } else { format!("{path}.{field}") };
        match refusal {
            Refusal::UnknownKey { key: field, known } => {
                let key = join(field);
                let elsewhere = self.elsewhere.iter().filter(|_| path.is_empty()).map(String::as_str);
                let known: Vec<&str> = known.iter().copied().chain(elsewhere).collect();
                let reason = format!("unknown key; {}", nearest(field, &known));
                let meant = most_similar(field, &known).map(join);
                Problem { meant, ..Problem::new(self.place(&key), key, UNKNOWN_KEY, reason) }
            }
            Refusal::MissingKey(field) => {
                let key = join(field);
                Problem::new(self.place(&key), key, MISSING_KEY, "is missing; add it")
            }
            other => Problem::new(self.place(&path), path, other.code(), other.to_string()),
        }
    }

    fn refuse_absurd(&self) -> Result<(), ConfigError> {
        self.refuse_absurd_value(&Value::Table(self.table.clone()), String::new())
    }

    /// Refuses implausible numbers in the value at a path.
    pub(super) fn refuse_absurd_value(&self, value: &Value, path: String) -> Result<(), ConfigError> {
        match absurd(value, path) {
            Some((key, value)) => {
                let (code, reason) = if value.is_finite() {
                    let range = format!("give 0 or {SMALLEST:e} to {LARGEST:e} in magnitude");
                    ("absurd-number", format!("{value:e} is out of range; {range}"))
                } else {
                    ("not-finite", format!("{value} is not a finite number; give one"))
                };
                Err(ConfigError::invalid(self.place(&key), key, code, reason))
            }
            None => Ok(()),
        }
    }
}

/// Reads a scenario's text to its end; error messages give `origin` as the file.
///
/// # Errors
/// [`ConfigError::Read`], and [`ConfigError::Invalid`] if it is not UTF-8.
pub fn read_text(reader: impl Read, origin: &Path) -> Result<String, ConfigError> {
    let refuse = |reason: String| ConfigError::Read { path: origin.to_owned(), reason };
    let mut bytes = Vec::new();
    reader.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(|error| refuse(error.to_string()))?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(refuse(format!("it is longer than {MAX_BYTES} bytes")));
    }
    String::from_utf8(bytes).map_err(|error| {
        let place = position(&origin.display().to_string(), error.as_bytes(), error.utf8_error().valid_up_to());
        ConfigError::invalid(place, "", "not-utf8", "this is not UTF-8 text; correct the line")
    })
}

/// Returns the line and the column of an offset in a text.
fn position(origin: &str, text: &[u8], offset: usize) -> Place {
    let before = &text[..offset.min(text.len())];
    let column = 1 + before.iter().rev().take_while(|byte| **byte != b'\n').count();
    let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
    Place { column: Some(column), ..Place::line(origin, line) }
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
        let word = !text.is_empty() && text.chars().all(|c| c.is_alphanumeric() || "-_./%".contains(c));
        word.then(|| Value::String(text.to_owned()))
    };
    parsed.and_then(|mut table| table.remove("v")).or_else(bare)
}

/// Puts a value at a dotted path (a number selects an array's element) and returns the path as errors write it.
fn insert(table: &mut Table, steps: &[&str], value: Value) -> Result<String, PathError> {
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

fn descend<'a>(place: &'a mut Value, step: &str, path: &mut String) -> Result<&'a mut Value, PathError> {
    match place {
        Value::Table(table) => {
            *path = format!("{path}.{step}");
            Ok(table.entry(step).or_insert_with(|| Value::Table(Table::new())))
        }
        Value::Array(array) => {
            let length = array.len();
            let index: usize =
                step.parse().map_err(|_| PathError::NotAPosition { path: path.clone(), step: step.to_owned() })?;
            let element =
                array.get_mut(index).ok_or_else(|| PathError::NoElement { path: path.clone(), length, index })?;
            *path = format!("{path}[{index}]");
            Ok(element)
        }
        _ => Err(PathError::PlainValue { path: path.clone(), step: step.to_owned() }),
    }
}

fn absurd(value: &Value, path: String) -> Option<(String, f64)> {
    let plausible = |number: f64| number == 0.0 || (SMALLEST..=LARGEST).contains(&number.abs());
    match value {
        // Every integer is in range, and a seed may be any integer.
        Value::Float(number) if !plausible(*number) => Some((path, *number)),
        Value::Array(array) => {
            array.iter().enumerate().find_map(|(index, value)| absurd(value, format!("{path}[{index}]")))
        }
        Value::Table(table) => table.iter().find_map(|(key, value)| {
            absurd(value, if path.is_empty() { key.clone() } else { format!("{path}.{key}") })
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
            assert_eq!(document.place(key).to_string(), place, "{key}");
        }
        assert_eq!(document.place("b.missing"), Place::line("x.toml", 2), "the table around it");
        assert_eq!(document.place("missing"), "x.toml".into());
    }

    #[test]
    fn keys_that_were_split_off_twice_are_named_once() {
        let mut document = parse(TEXT).unwrap();
        for keys in [&["b", "d"][..], &["b"]] {
            let _ = document.split_off(keys);
        }
        let unknown = Refusal::UnknownKey { key: "zzz".to_owned(), known: &["a"] };
        assert_eq!(document.problem(String::new(), &unknown).reason, "unknown key; known here: a, b, d");
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
        assert_eq!(document.place("b.c[0]"), "--set b.c=[5.0]".into());
    }

    #[test]
    fn a_bad_override_is_refused_with_its_reason() {
        let mut document = parse(TEXT).unwrap();
        for (argument, code) in [
            ("a", "no-equals"),
            ("=1", "empty-key"),
            ("b..c=1", "empty-key"),
            ("a.b=1", "plain-value"),
            ("d.7.e=1", "no-element"),
            ("d.x.e=1", "not-a-position"),
            ("a=", "no-value"),
            ("a=[1,", "no-value"),
            ("a=1\nb=2", "no-value"),
        ] {
            assert_eq!(document.set(argument).unwrap_err().mistakes()[0].1, code, "{argument:?}");
        }
    }

    #[test]
    fn refuses_bad_syntax_duplicates_and_non_finite_numbers_with_their_line() {
        for (text, expected) in [
            ("a = 1\na = 2", "x.toml:2:1: duplicate key `a`"),
            ("a = 1\nb = [", "x.toml:2:"),
            ("a = 1\n[b]\nc = nan", "x.toml:3: b.c: NaN is not a finite number"),
            ("a = [1, inf]", "x.toml:1: a[1]: inf is not"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.starts_with(expected), "{error}");
        }
        assert!(parse("a = 1").unwrap().set("a=-inf").unwrap_err().to_string().starts_with("--set a=-inf: a: -inf"));
    }
}
