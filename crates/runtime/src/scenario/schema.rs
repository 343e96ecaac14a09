//! A JSON Schema of scenario files, for editors: built from the types that read them, with the comments of shipped scenarios.
//!
//! The schema does not cover rules between keys; these are checked when a scenario is resolved.

use super::registry;
use crate::config::raw::Raw;
use crate::config::{Key, Shape};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// The newest dialect that editors of TOML support.
const DIALECT: &str = "http://json-schema.org/draft-07/schema#";

/// The comments of shipped scenarios on their keys, by rig and path, as `leader.measured_axes`.
type Notes = BTreeMap<(String, String), String>;

/// Returns the schema of a program's scenarios. `shipped` are the name and text of each scenario that it ships.
pub fn schema(program: &str, shipped: &[(&str, &str)]) -> Value {
    let notes = notes(shipped);
    let rigs = registry::shapes();
    let names: Vec<&str> = rigs.iter().map(|(name, _)| *name).collect();
    let Shape::Table { keys: common, .. } = Shape::read_by::<Raw>() else { unreachable!("a scenario is a table") };
    let mut properties = Map::new();
    for key in &common {
        properties.insert(key.name.to_owned(), of_key(key, "", &notes, None));
    }
    properties["rig"] = with_note(json!({ "enum": names }), "rig", &notes, None);
    // The rig defines the bounds of watched quantities and metrics.
    properties["watchdog"]["patternProperties"] = json!({ "_max$": { "type": "number" } });
    properties["accept"]["additionalProperties"] = json!({ "type": "number" });
    // Editors complete keys from here, independently of the rig.
    for section in registry::sections() {
        let section_of = |(name, keys): &(&str, Vec<Key>)| {
            keys.iter().find(|key| key.name == section).map(|key| of_key(key, "", &notes, Some(name)))
        };
        let mut shapes: Vec<Value> = rigs.iter().filter_map(section_of).collect();
        shapes.dedup();
        let shape = if shapes.len() == 1 { shapes.remove(0) } else { json!({ "anyOf": shapes }) };
        properties.insert(section.to_owned(), shape);
    }
    for role in RATED {
        let alone = || json!({ "properties": { "every_ticks": every_ticks() }, "additionalProperties": false });
        properties.entry(role).or_insert_with(alone);
    }
    let required: Vec<&str> = common.iter().filter(|key| key.required).map(|key| key.name).collect();
    let cases: Vec<Value> = rigs.iter().map(|(name, keys)| case(name, keys, &notes)).collect();
    json!({
        "$schema": DIALECT,
        "title": format!("A scenario of {program}"),
        "type": "object",
        "properties": properties,
        "required": required,
        "additionalProperties": false,
        "allOf": cases,
    })
}

/// Returns the schema of a rig's own tables, which applies if the scenario selects this rig.
fn case(name: &str, keys: &[Key], notes: &Notes) -> Value {
    let mut properties = Map::new();
    for section in registry::sections() {
        let own = keys.iter().find(|key| key.name == section);
        properties.insert(section.to_owned(), own.map_or(json!(false), |key| of_key(key, "", notes, Some(name))));
    }
    let required: Vec<&str> = keys.iter().filter(|key| key.required).map(|key| key.name).collect();
    json!({
        "if": { "properties": { "rig": { "const": name } }, "required": ["rig"] },
        "then": { "properties": properties, "required": required },
    })
}

fn of_key(key: &Key, parent: &str, notes: &Notes, rig: Option<&str>) -> Value {
    let path = if parent.is_empty() { key.name.to_owned() } else { format!("{parent}.{}", key.name) };
    let mut value = with_note(of_shape(&key.shape, &path, notes, rig), &path, notes, rig);
    if RATED.contains(&&*path) {
        value["properties"]["every_ticks"] = every_ticks();
    }
    value
}

/// The tables of a rig that also hold the role's rate.
const RATED: [&str; 2] = ["controller", "observer"];

fn every_ticks() -> Value {
    json!({ "type": "integer", "minimum": 1 })
}

fn of_shape(shape: &Shape, path: &str, notes: &Notes, rig: Option<&str>) -> Value {
    let inner = |shape: &Shape| of_shape(shape, path, notes, rig);
    match shape {
        Shape::Any(None) => json!({}),
        Shape::Any(Some(words)) => json!({ "description": words }),
        Shape::Boolean => json!({ "type": "boolean" }),
        Shape::Integer => json!({ "type": "integer" }),
        Shape::Count => json!({ "type": "integer", "minimum": 0 }),
        Shape::Number => json!({ "type": "number" }),
        Shape::Text => json!({ "type": "string" }),
        Shape::Choice(names) => json!({ "enum": names }),
        Shape::List(element) => json!({ "type": "array", "items": inner(element) }),
        Shape::Array(element, length) => {
            json!({ "type": "array", "items": inner(element), "minItems": length, "maxItems": length })
        }
        Shape::Map(value) => json!({ "type": "object", "additionalProperties": inner(value) }),
        Shape::Table { keys, closed } => {
            let properties: Map<_, _> =
                keys.iter().map(|key| (key.name.to_owned(), of_key(key, path, notes, rig))).collect();
            let required: Vec<&str> = keys.iter().filter(|key| key.required).map(|key| key.name).collect();
            json!({
                "type": "object",
                "properties": properties,
                "required": required,
                "additionalProperties": !closed,
            })
        }
    }
}

/// Adds the comment of a shipped scenario on this key: one of the rig, or of any rig for a common key.
fn with_note(mut value: Value, path: &str, notes: &Notes, rig: Option<&str>) -> Value {
    let fits = |(commented, at): &&(String, String)| at == path && rig.is_none_or(|rig| commented == rig);
    if let Some(note) = notes.keys().find(fits).and_then(|key| notes.get(key)) {
        value["description"] = json!(note);
    }
    value
}

/// Returns the comments behind keys and table heads; the first one if a key has several.
fn notes(shipped: &[(&str, &str)]) -> Notes {
    let mut notes = Notes::new();
    for (_, text) in shipped {
        let rig = toml::from_str::<toml::Table>(text).ok();
        let rig = rig.as_ref().and_then(|table| table.get("rig")?.as_str()).unwrap_or_default();
        let mut section = String::new();
        for line in text.lines().filter(|line| !line.starts_with('#')) {
            let (content, note) = line.split_once(" # ").unwrap_or((line, ""));
            let path = match (content.trim().strip_prefix('['), content.split_once(" = ")) {
                (Some(head), _) => {
                    section = head.trim_matches(['[', ']']).to_owned();
                    section.clone()
                }
                (None, Some((key, _))) if section.is_empty() => key.trim().to_owned(),
                (None, Some((key, _))) => format!("{section}.{}", key.trim()),
                (None, None) => continue,
            };
            if !note.is_empty() {
                notes.entry((rig.to_owned(), path)).or_insert_with(|| note.trim().to_owned());
            }
        }
    }
    notes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;

    #[test]
    fn keys_have_the_comments_of_shipped_scenarios() {
        let schema = schema("corotate", &SHIPPED);
        assert_eq!(schema["properties"]["rig"]["enum"], json!(["rigid-body", "orbit-hold", "orbit-rendezvous"]));
        assert_eq!(schema["required"], json!(["name", "rig", "tick_hz", "duration_s"]));
        let described = schema["properties"]["tick_hz"]["description"].as_str().unwrap();
        assert!(SHIPPED[0].1.contains(described), "{described}");
        let clock = &schema["properties"]["clock"]["enum"];
        assert_eq!(clock, &json!(["realtime", "lockstep", "in-process"]));
        let case = &schema["allOf"][0]["then"]["properties"];
        assert_eq!(case["leader"]["properties"]["inertia_kg_m2"]["maxItems"], 3);
        assert_eq!(case["spacecraft"], false, "a table of another rig");
    }
}
