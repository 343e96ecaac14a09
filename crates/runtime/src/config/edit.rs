//! Changes of a document by whoever makes many scenarios of one.
//!
//! Must not know what any key means.

use super::{ConfigError, Document, Place};
use std::collections::BTreeMap;
use toml::{Table, Value};

impl Document {
    /// Whether there is something at a top-level key.
    pub fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// The whole of it.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// What is at a path, as an override names it.
    pub fn get(&self, path: &str) -> Option<&Value> {
        let mut steps = path.split('.');
        let first = self.table.get(steps.next()?)?;
        steps.try_fold(first, |place, step| match place {
            Value::Array(list) => list.get(step.parse::<usize>().ok()?),
            other => other.get(step),
        })
    }

    /// Puts a value at a path, as an override does; `place` stands for the key's place in error messages.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] where the path leads nowhere, or where the value is no quantity.
    pub fn put(&mut self, path: &str, value: Value, place: &Place) -> Result<(), ConfigError> {
        let judged = value.clone();
        self.put_value(path, value, place.clone()).map_err(|error| {
            let reason = format!("{error}; name a key of the scenario, as --set does");
            ConfigError::invalid(place.clone(), path, (&error).into(), reason)
        })?;
        self.refuse_absurd_value(&judged, path.to_owned())
    }

    /// Takes the table at a top-level key out, as a document.
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

    /// Takes the list at a top-level key out of another document and adds its elements to the list here.
    pub fn append(&mut self, key: &str, other: &mut Self) {
        let Some(Value::Array(added)) = other.table.remove(key) else { return };
        let list = self.table.entry(key).or_insert_with(|| Value::Array(Vec::new()));
        let Value::Array(list) = list else { return };
        let first = list.len();
        let elements = |index: usize, offset: usize| format!("{key}[{}]", index + offset);
        let mut places = BTreeMap::new();
        for index in 0..added.len() {
            let (from, to) = (elements(index, 0), elements(index, first));
            let below = other.places.iter().filter_map(|(path, place)| Some((path.strip_prefix(&from)?, place)));
            places.extend(below.map(|(rest, place)| (format!("{to}{rest}"), place.clone())));
        }
        list.extend(added);
        self.places.extend(places);
    }

    /// Takes an element out of the list at a top-level key; those behind it move up, and keep their places.
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
    fn elements_that_are_added_and_taken_out_keep_their_places() {
        let mut document = parse("[[fault]]\na = 1\n", "base.toml");
        let mut other = parse("x = 1\n[[fault]]\nb = 2\n[[fault]]\nc = [3]\n", "other.toml");
        document.append("fault", &mut other);
        assert_eq!(document.place("fault[2].c[0]"), Place::line("other.toml", 5));
        assert_eq!(document.get("fault.2.c.0"), Some(&Value::Integer(3)));
        assert!(other.has("x") && !other.has("fault"));
        document.remove_element("fault", 1);
        assert_eq!(document.place("fault[1].c[0]"), Place::line("other.toml", 5));
        assert_eq!(document.place("fault[0].a"), Place::line("base.toml", 2));
        assert_eq!(document.get("fault.1.c.0"), Some(&Value::Integer(3)));
        assert_eq!(document.get("fault.2"), None);
    }

    #[test]
    fn a_table_that_is_taken_out_knows_its_lines() {
        let mut document = parse("x = 1\n[scenario]\na = 1\n[scenario.b]\nc = 2\n", "file.toml");
        let inner = document.take("scenario").unwrap();
        assert_eq!((inner.place("b.c"), inner.get("b.c")), (Place::line("file.toml", 5), Some(&Value::Integer(2))));
        assert!(document.take("scenario").is_none() && document.take("x").is_none() && document.has("x"));
    }

    #[test]
    fn a_value_goes_where_an_override_would_put_it() {
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
