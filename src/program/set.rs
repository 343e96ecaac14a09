//! `corotate set` and `corotate get`: change inputs of a running loop, and print their values.

use super::output::{CommandResult, Exit, Failure, fail, harmless, remark, say};
use super::runs;
use crate::config::{ConfigError, Document, Variability};
use crate::files;
use crate::inputs::{Answer, InputError, WantedChange, change, current};
use crate::scenario::Scenario;
use crate::seat::scenario_of;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use toml::Value;
use toml_edit::{DocumentMut, Item};

/// Options of `corotate set`.
#[derive(clap::Args)]
#[command(after_long_help = SET_EXAMPLES)]
pub struct SetArguments {
    /// The run (its directory or domain; default: the newest), then the
    /// inputs to change, all at the same tick
    #[arg(required_unless_present = "save", value_name = "[RUN] KEY=VALUE")]
    words: Vec<String>,
    /// The tick from which the changes act [default: the earliest]
    #[arg(long, value_name = "TICK")]
    at: Option<u64>,
    /// Change the values linearly over this time, s
    #[arg(long, value_name = "SECONDS", default_value = "0", value_parser = seconds)]
    ramp: f64,
    /// Write the values that differ from this scenario's to its file, and keep
    /// its comments and order
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// Set values with which the loop does not converge
    #[arg(long)]
    force: bool,
    /// Print the answer as a line of JSON
    #[arg(long)]
    json: bool,
}

/// Options of `corotate get`.
#[derive(clap::Args)]
#[command(after_long_help = GET_EXAMPLES)]
pub struct GetArguments {
    /// The run (its directory or domain; default: the newest), then the keys
    /// to print [default: all]
    #[arg(value_name = "[RUN] KEY")]
    words: Vec<String>,
    /// Print the values as a line of JSON
    #[arg(long)]
    json: bool,
}

const SET_EXAMPLES: &str = "\
`corotate get` lists the inputs of a run, `corotate check --tunable` those of a
scenario. A change acts in every role at the same tick, is part of the run's
recording, and is replayed with it.

Examples:
  corotate set controller.gain_per_s=[6,6,6]
  corotate set follower.0.offset_rad_s=[0,0,0.2] --ramp 2
  corotate set runs/pair actuator.safe=true --at 5000
  corotate set --save pair.toml    keep what was found";

const GET_EXAMPLES: &str = "\
Examples:
  corotate get                     all inputs of the newest run
  corotate get controller.gain_per_s --json";

/// The remedy for a word that changes nothing.
const ASSIGN: &str = "write KEY=VALUE, as in `corotate set controller.gain_per_s=[6,6,6]`";

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds) if (0.0..=1e9).contains(&seconds) => Ok(seconds),
        _ => Err("give a time of 0 s or more".to_owned()),
    }
}

/// Changes inputs of a running loop.
pub fn set(arguments: &SetArguments) -> CommandResult {
    let (run, assignments) = split(&arguments.words, |word| word.contains('='));
    let changes = assignments.iter().map(|word| wanted(word, arguments.ramp)).collect::<Result<Vec<_>, _>>();
    let changes = changes.map_err(|failure| fail(Exit::Usage, failure))?;
    if changes.is_empty() && arguments.save.is_none() {
        return Err(fail(Exit::Usage, Failure::new("no-change", format!("there is no input to change; {ASSIGN}"))));
    }
    let root = runs::domain(run.map(Path::new))?;
    if changes.is_empty() {
        return save(&root, arguments, changes);
    }
    let answer = change(&root, changes.clone(), arguments.at, arguments.force);
    let answer = answer.map_err(|error| fail(exit_of(&error), failure(&error)))?;
    if arguments.json {
        say(&format!("{}\n", serde_json::to_string(&answer).expect("plain values are JSON")))?;
        return save(&root, arguments, changes);
    }
    let Answer::Accepted { tick, time_s, delay_ms } = answer else {
        return Err(fail(Exit::Failure, Failure::new("malformed", "the launcher's answer has no tick")));
    };
    let delay = delay_ms.map_or(String::new(), |delay_ms| format!(", {delay_ms:.1} ms after the request"));
    let mut text = String::new();
    for WantedChange { key, value, .. } in &changes {
        writeln!(text, "{key} = {value} from tick {tick} ({time_s:.3} s){delay}").expect("writing to a string works");
    }
    say(&harmless(&text))?;
    save(&root, arguments, changes)
}

/// Writes the present values of a run, and those of changes that may act later, to the scenario file of `--save`, where they differ.
fn save(root: &Path, arguments: &SetArguments, changes: Vec<WantedChange>) -> CommandResult {
    let Some(path) = &arguments.save else { return Ok(Exit::Ok) };
    let (_, mut values) = current(root).map_err(|error| fail(exit_of(&error), failure(&error)))?;
    values.extend(changes.into_iter().map(|change| (change.key, change.value)));
    match saved(path, &values) {
        Ok(keys) => {
            let names = if keys.is_empty() { "nothing differs".to_owned() } else { keys.join(", ") };
            remark(&format!("{}: {names}", path.display()));
            Ok(Exit::Ok)
        }
        Err(failure) => Err(fail(Exit::Usage, failure)),
    }
}

/// Changes the values in a scenario file that differ from the given ones, and returns their keys.
fn saved(path: &Path, values: &BTreeMap<String, Value>) -> Result<Vec<String>, Failure> {
    let refuse = |error: &dyn std::fmt::Display| {
        Failure::new("cannot-write", format!("{}: {error}; name a scenario file that can be written", path.display()))
    };
    let text = std::fs::read_to_string(path).map_err(|error| refuse(&error))?;
    let scenario = Scenario::load(path, &[])?;
    let mut document: DocumentMut = text.parse().map_err(|error| refuse(&error))?;
    // As the file would have them: a typed list may have integers.
    let written = |(key, value): (&String, &Value)| {
        let (_, info) = scenario.inputs.find(key).ok()?;
        Some((info.key.clone(), info.to_toml(&info.from_toml(value).ok()?)))
    };
    let values: BTreeMap<String, Value> = values.iter().filter_map(written).collect();
    let differs = |(key, value): &(&String, &Value)| {
        scenario.inputs.find(key).is_ok_and(|(_, info)| info.to_toml(&info.initial) != **value)
    };
    let keys: Vec<String> = values.iter().filter(differs).map(|(key, _)| key.clone()).collect();
    for key in &keys {
        put(document.as_item_mut(), &key.split('.').collect::<Vec<_>>(), &values[key]);
    }
    let text = document.to_string();
    let written = Scenario::parse(&text, &path.display().to_string(), &[])?;
    let missing = keys
        .iter()
        .find(|key| written.inputs.find(key).map_or(true, |(_, info)| info.to_toml(&info.initial) != values[*key]));
    if let Some(key) = missing {
        return Err(Failure::new(
            "no-value",
            format!("{}: {key} has no place there; add the key first", path.display()),
        ));
    }
    if !keys.is_empty() {
        files::write(path, text.as_bytes()).map_err(|error| refuse(&error))?;
    }
    Ok(keys)
}

/// Puts a value at a path; a comment on its line stays.
fn put(item: &mut Item, steps: &[&str], value: &Value) {
    let Some((first, rest)) = steps.split_first() else {
        let decor = item.as_value().map(|old| old.decor().clone());
        let mut new = edited(value);
        decor.into_iter().for_each(|decor| *new.decor_mut() = decor);
        *item = Item::Value(new);
        return;
    };
    let inner = match first.parse::<usize>() {
        Ok(index) => item.get_mut(index),
        Err(_) => item.as_table_like_mut().map(|table| {
            let empty = if rest.is_empty() { Item::None } else { Item::Table(toml_edit::Table::new()) };
            table.entry(first).or_insert(empty)
        }),
    };
    inner.into_iter().for_each(|inner| put(inner, rest, value));
}

/// Returns a value of an input as text would have it.
fn edited(value: &Value) -> toml_edit::Value {
    match value {
        Value::Boolean(on) => (*on).into(),
        Value::Array(list) => list.iter().filter_map(Value::as_float).collect(),
        value => value.as_float().unwrap_or_default().into(),
    }
}

/// Prints the values of inputs of a running loop.
pub fn get(arguments: &GetArguments) -> CommandResult {
    let is_key = |word: &str| word.contains('.') && !word.contains('/') && !Path::new(word).exists();
    let (run, keys) = split(&arguments.words, is_key);
    let root = runs::domain(run.map(Path::new))?;
    let shown = scenario_of(&root).map_err(InputError::from).and_then(|scenario| Ok((scenario, current(&root)?)));
    let (scenario, (tick, mut values)) = shown.map_err(|error| fail(exit_of(&error), failure(&error)))?;
    if !keys.is_empty() {
        let found = keys.iter().map(|key| scenario.inputs.find(key).map(|(_, info)| info.key.clone()));
        let found = found.collect::<Result<Vec<_>, _>>();
        let found = found.map_err(|reason| fail(Exit::Usage, Failure::new("not-tunable", reason)))?;
        values.retain(|key, _| found.contains(key));
    }
    if arguments.json {
        return say(&format!("{}\n", serde_json::json!({ "tick": tick, "values": values })));
    }
    let lines: String = values.iter().map(|(key, value)| format!("{key} = {value}\n")).collect();
    say(&harmless(&lines))
}

/// Returns the lines that `corotate check --tunable` prints: the inputs of a scenario with their meaning and range.
pub fn tunable(scenario: &Scenario) -> String {
    let inputs = &scenario.inputs.infos;
    if inputs.is_empty() {
        return "nothing in this scenario can change while it runs\n".to_owned();
    }
    let line = |info: &crate::config::InputInfo| {
        let variability = match info.variability {
            Variability::Tunable => "tunable",
            Variability::Input => "input",
            Variability::Switch => "switch",
        };
        let range = match (info.variability, info.range) {
            (Variability::Switch, _) | (_, (f64::NEG_INFINITY, f64::INFINITY)) => String::new(),
            (_, (least, f64::INFINITY)) => format!(", above {least}"),
            (_, (least, largest)) => {
                format!(", {} to {}", crate::analysis::digits(least), crate::analysis::digits(largest))
            }
        };
        let (key, value) = (&info.key, info.to_toml(&info.initial));
        format!("{key} = {value}\n  {variability}{range}: {}\n", info.description)
    };
    inputs.iter().map(line).collect()
}

/// Splits the words of a command into the run, if the first word is one, and the rest.
fn split(words: &[String], is_rest: impl Fn(&str) -> bool) -> (Option<&str>, &[String]) {
    match words.split_first() {
        Some((first, rest)) if !is_rest(first) => (Some(first), rest),
        _ => (None, words),
    }
}

/// Reads an assignment such as `controller.gain_per_s=[6,6,6]`.
fn wanted(word: &str, ramp_s: f64) -> Result<WantedChange, Failure> {
    let mut document = Document::parse("", "set")?;
    let key = word.split('=').next().unwrap_or_default().trim().replace('[', ".").replace(']', "");
    document.set(word).map_err(|error| match error {
        ConfigError::Override { argument, source } => {
            Failure::new((&source).into(), format!("{argument}: {source}; {ASSIGN}"))
        }
        error => error.into(),
    })?;
    let value = document.get(&key).cloned();
    let value = value.ok_or_else(|| Failure::new("no-value", format!("{word}: there is no value; {ASSIGN}")))?;
    Ok(WantedChange { key, value, ramp_s })
}

fn failure(error: &InputError) -> Failure {
    Failure::new(error.code(), error)
}

fn exit_of(error: &InputError) -> Exit {
    match error {
        InputError::Unreachable { .. } | InputError::Malformed { .. } => Exit::Failure,
        _ => Exit::Usage,
    }
}
