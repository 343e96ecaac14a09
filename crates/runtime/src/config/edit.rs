//! Edits of a document, for programs that derive many scenarios from one.
//!
//! Must not know what any key means.

use super::document::Document;
use super::error::{ConfigError, Place};
use std::collections::BTreeMap;
use toml::{Table, Value};

impl Document {
    /// Returns true if a top-level key exists.
    pub fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// Returns the whole table.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// Returns the value at a path, written as in an override.
    pub fn get(&self, path: &str) -> Option<&Value> {
        let mut steps = path.split('.');
        let first = self.table.get(steps.next()?)?;
        steps.try_fold(first, |parent, step| match parent {
            Value::Array(list) => list.get(step.parse::<usize>().ok()?),
            table => table.get(step),
        })
    }

    /// Puts a value at a path, as an override does; error messages give `place` as the key's place.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] if the path does not exist, or the value is not a plausible quantity.
    pub fn put(&mut self, path: &str, value: Value, place: &Place) -> Result<(), ConfigError> {
        let copy = value.clone();
        self.put_value(path, value, place.clone()).map_err(|error| {
            let reason = format!("{error}; name a key of the scenario, as for --set");
            ConfigError::invalid(place.clone(), path, (&error).into(), reason)
        })?;
        self.refuse_absurd_value(&copy, path.to_owned())
    }

    /// Returns the document without a top-level key.
    #[must_use]
    pub fn without(&self, key: &str) -> Self {
        let mut rest = self.clone();
        rest.table.remove(key);
        rest
    }

    /// Removes the table at a top-level key and returns it as a document.
    pub fn take(&mut self, key: &str) -> Option<Self> {
        let Some(Value::Table(_)) = self.table.get(key) else { return None };
        let Some(Value::Table(table)) = self.table.remove(key) else { return None };
        let prefix = format!("{key}.");
        let inner = |(path, place): (&String, &Place)| Some((path.strip_prefix(&prefix)?.to_owned(), place.clone()));
        let places = self.places.iter().filter_map(inner).collect();
        let mut taken = self.part(table);
        taken.places = places;
        Some(taken)
    }

    /// Moves the elements of the list at a top-level key from another document to the list here.
    pub fn append(&mut self, key: &str, source: &mut Self) {
        let Some(Value::Array(added)) = source.table.remove(key) else { return };
        let list = self.table.entry(key).or_insert_with(|| Value::Array(Vec::new()));
        let Value::Array(list) = list else { return };
        let first = list.len();
        let elements = |index: usize, offset: usize| format!("{key}[{}]", index + offset);
        let mut places = BTreeMap::new();
        for index in 0..added.len() {
            let (from, to) = (elements(index, 0), elements(index, first));
            let below = source.places.iter().filter_map(|(path, place)| Some((path.strip_prefix(&from)?, place)));
            places.extend(below.map(|(rest, place)| (format!("{to}{rest}"), place.clone())));
        }
        list.extend(added);
        self.places.extend(places);
    }

    /// Removes an element from the list at a top-level key; later elements move up and keep their places.
    pub fn remove_element(&mut self, key: &str, index: usize) {
        let Some(Value::Array(list)) = self.table.get_mut(key) else { return };
        if index >= list.len() {
            return;
        }
        list.remove(index);
        let moved = |path: String| {
            let number =
                path.strip_prefix(key).and_then(|rest| rest.strip_prefix('[')).and_then(|rest| rest.split_once(']'));
            match number.and_then(|(number, rest)| Some((number.parse::<usize>().ok()?, rest))) {
                Some((number, _)) if number == index => None,
                Some((number, rest)) if number > index => Some(format!("{key}[{}]{rest}", number - 1)),
                _ => Some(path),
            }
        };
        let places = std::mem::take(&mut self.places);
        self.places = places.into_iter().filter_map(|(path, place)| Some((moved(path)?, place))).collect();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str, origin: &str) -> Document {
        Document::parse(text, origin).unwrap()
    }

    #[test]
    fn elements_keep_their_places_when_others_are_added_or_removed() {
        let mut document = parse("[[fault]]\na = 1\n", "base.toml");
        let mut source = parse("x = 1\n[[fault]]\nb = 2\n[[fault]]\nc = [3]\n", "other.toml");
        document.append("fault", &mut source);
        assert_eq!(document.place("fault[2].c[0]"), Place::line("other.toml", 5));
        assert_eq!(document.get("fault.2.c.0"), Some(&Value::Integer(3)));
        assert!(source.has("x") && !source.has("fault"));
        document.remove_element("fault", 1);
        assert_eq!(document.place("fault[1].c[0]"), Place::line("other.toml", 5));
        assert_eq!(document.place("fault[0].a"), Place::line("base.toml", 2));
        assert_eq!(document.get("fault.1.c.0"), Some(&Value::Integer(3)));
        assert_eq!(document.get("fault.2"), None);
    }

    #[test]
    fn a_removed_table_keeps_its_lines() {
        let mut document = parse("x = 1\n[scenario]\na = 1\n[scenario.b]\nc = 2\n", "file.toml");
        let inner = document.take("scenario").unwrap();
        assert_eq!((inner.place("b.c"), inner.get("b.c")), (Place::line("file.toml", 5), Some(&Value::Integer(2))));
        assert!(document.take("scenario").is_none() && document.take("x").is_none() && document.has("x"));
    }

    #[test]
    fn a_value_is_put_like_an_override() {
        let mut document = parse("a = [1.0, 2.0]\n[b]\nc = 1\n", "file.toml");
        document.put("a.1", Value::Float(5.0), &Place::line("map.toml", 7)).unwrap();
        assert_eq!(
            (document.get("a.1"), document.place("a[1]")),
            (Some(&Value::Float(5.0)), Place::line("map.toml", 7))
        );
        for (path, value, expected) in
            [("a.9", 1.0, "no-element"), ("b.c.d", 1.0, "plain-value"), ("b.c", f64::NAN, "not-finite")]
        {
            let error = document.clone().put(path, Value::Float(value), &Place::line("map.toml", 8)).unwrap_err();
            let (text, code) = &error.mistakes()[0];
            assert!(text.starts_with(&format!("map.toml:8: {path}: ")) && *code == expected, "{error}");
        }
    }
}
