//! Finds the scenario that the command line names: a shipped one by its name, a file by its path, or standard input.
//!
//! Must not validate: [`crate::config`] does.

use super::output::Failure;
use super::shipped::{campaigns, name, scenarios};
use crate::campaign::{Shipped, is_campaign};
use crate::config::{ConfigError, Document, Problem, is_name, nearest, read_text};
use crate::scenario::Scenario;
use std::borrow::Cow;
use std::fs::File;
use std::io;
use std::path::Path;

/// Standard input on the command line.
const STANDARD_INPUT: &str = "-";
/// Standard input in errors.
const STDIN: &str = "stdin";

/// Length limit of a quoted line, characters.
const MAX_QUOTED: usize = 120;

/// A change of a scenario by the command line.
pub enum Change<'a> {
    /// `--set KEY=VALUE`.
    Set(&'a str),
    /// An option that sets a key: the option, the key and the value as typed.
    Option(&'static str, &'static str, &'a str),
}

impl Change<'_> {
    fn apply(&self, document: &mut Document) -> Result<(), ConfigError> {
        match self {
            Self::Set(argument) => document.set(argument),
            Self::Option(option, key, value) => document.set_by_option(option, key, value),
        }
    }
}

/// Loads a scenario and applies changes. Without a name it is the program's first.
pub fn load<'a>(given: Option<&Path>, changes: impl IntoIterator<Item = Change<'a>>) -> Result<Scenario, Failure> {
    let shipped = |name: &str| {
        let (_, text) = scenarios().iter().find(|(known, _)| *known == name).ok_or_else(|| unknown(name))?;
        Ok(Cow::Borrowed(*text))
    };
    let none = "this program has no shipped scenario; name a scenario file";
    let first = || first().ok_or_else(|| Failure::new("no-scenario", none));
    let (text, origin) = match given {
        Some(given) => text(given, &shipped)?,
        None => text(Path::new(first()?), &shipped)?,
    };
    let resolved = Document::parse(&text, &origin).and_then(|document| {
        if is_campaign(&document) {
            let reason = "makes it a campaign; run it with `corotate sweep`, or one case of it with --case N";
            return Err(ConfigError::invalid(document.place("base"), "base", "is-campaign", reason));
        }
        changed(document, changes)
    });
    resolved.map_err(|error| quoting(error, &origin, &text))
}

/// Applies changes to a document and resolves it to a scenario.
pub fn changed<'a>(
    mut document: Document,
    changes: impl IntoIterator<Item = Change<'a>>,
) -> Result<Scenario, ConfigError> {
    changes.into_iter().try_for_each(|change| change.apply(&mut document))?;
    Scenario::resolve(document)
}

/// Reads a text: a shipped one by its name, a file by its path, or standard input. Returns it with its name in errors.
pub fn text(given: &Path, shipped: Shipped<'_>) -> Result<(Cow<'static, str>, String), ConfigError> {
    let shipped = |name: &str| Ok((shipped(name)?, format!("{name}.toml")));
    let read = |text: Result<String, ConfigError>, origin: &Path| {
        text.map(|text| (Cow::Owned(text), origin.display().to_string()))
    };
    let refuse = |path: &Path, error: io::Error| ConfigError::Read { path: path.to_owned(), reason: error.to_string() };
    match name_in(given) {
        Some(STANDARD_INPUT) => read(read_text(io::stdin().lock(), Path::new(STDIN)), Path::new(STDIN)),
        Some(name) => shipped(name),
        None => {
            let file = File::open(given).map_err(|error| refuse(given, error));
            read(file.and_then(|file| read_text(file, given)), given)
        }
    }
}

/// Returns the problems, each followed by its line of the text.
pub fn quoting(error: ConfigError, origin: &str, text: &str) -> Failure {
    let ConfigError::Invalid { problems } = error else { return error.into() };
    let quoted = |problem: Problem| {
        let line = problem.place.line.filter(|_| problem.place.origin == origin);
        let quote = line.and_then(|number| Some((number, text.lines().nth(number.checked_sub(1)?)?)));
        let quote = quote.map_or(String::new(), |(number, line)| {
            let line: String = line.chars().take(MAX_QUOTED).collect();
            format!("\n{number:>4} | {}", line.trim_end())
        });
        (format!("{problem}{quote}"), problem.code)
    };
    Failure(problems.into_iter().map(quoted).collect())
}

/// Returns the name, or `None` for a path: a file must not hide a shipped scenario of the same name.
fn name_in(given: &Path) -> Option<&str> {
    given.to_str().filter(|text| is_name(text))
}

fn first() -> Option<&'static str> {
    scenarios().first().map(|(name, _)| *name)
}

/// Returns a name for a scenario that could not be read.
pub fn stem(given: Option<&Path>) -> String {
    match given {
        None => first().unwrap_or(name()).to_owned(),
        Some(path) if path == Path::new(STANDARD_INPUT) => STDIN.to_owned(),
        Some(path) => path.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
    }
}

/// Returns the error for a name that no scenario has.
pub fn unknown(name: &str) -> ConfigError {
    if campaigns().iter().any(|(known, _)| *known == name) {
        let remedy = format!("run it with `corotate sweep {name}`, or one case of it with --case N");
        return ConfigError::Unknown { code: "is-campaign", text: format!("`{name}` is a campaign; {remedy}") };
    }
    let known: Vec<&str> = scenarios().iter().map(|(name, _)| *name).collect();
    let remedy = nearest(name, &known);
    let end = if remedy.ends_with('?') { "" } else { "." };
    let text = format!(
        "there is no scenario `{name}`; {remedy}{end} Give a file by its path, such as ./{name} or {name}.toml"
    );
    ConfigError::Unknown { code: "unknown-scenario", text }
}

/// Returns the title of a scenario: the first line of its text, if it is a comment.
pub fn title(text: &str) -> &str {
    text.lines().next().and_then(|line| line.strip_prefix('#')).unwrap_or_default().trim()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Place;

    #[test]
    fn errors_quote_their_line() {
        let text = "a = 1\nb = 2   \n";
        let quote =
            |place: Place| quoting(ConfigError::invalid(place, "b", "code", "wrong"), "x.toml", text).to_string();
        let line = |number| Place { line: Some(number), ..Place::from("x.toml") };
        assert_eq!(quote(line(2)), "x.toml:2: b: wrong [code]\n   2 | b = 2");
        assert_eq!(quote(line(99)), "x.toml:99: b: wrong [code]");
        assert_eq!(quote("x.toml".into()), "x.toml: b: wrong [code]");
        assert_eq!(quote("--set b=1".into()), "--set b=1: b: wrong [code]");
        assert_eq!(quote(Place { line: Some(1), ..Place::from("base.toml") }), "base.toml:1: b: wrong [code]");
    }
}
