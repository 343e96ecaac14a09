//! Mistakes of a scenario, each with its code, place and remedy.

use std::fmt;
use std::path::PathBuf;

/// The reason why a scenario was refused. Nothing has been started.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("{}: cannot be read: {reason}; give the path of a scenario file, or a name from `corotate init --list`", shown(&path.display().to_string()))]
    Read {
        /// The path as given.
        path: PathBuf,
        /// The system's reason.
        reason: String,
    },
    /// No scenario, or no campaign, of this name ships with the program.
    #[error("{text}")]
    Unknown {
        /// The stable code of the mistake.
        code: &'static str,
        /// Reason and remedy.
        text: String,
    },
    /// An override on the command line does not have the form key=value, or its path does not exist.
    #[error(
        "--set {}: {source}; write --set key=value, for example --set leader.initial_rate_rad_s=[0.6,-0.4,0.8] or --set follower.0.name=chaser",
        shown(argument)
    )]
    Override {
        /// The argument as given.
        argument: String,
        /// The mistake in it.
        source: PathError,
    },
    /// Mistakes in the text, or in values.
    #[error("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Invalid {
        /// One entry per finding, at least one.
        problems: Vec<Problem>,
    },
}

/// The reason why a value cannot be put at a path.
#[derive(Debug, Clone, PartialEq, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum PathError {
    /// The argument has no value.
    #[error("there is no `=`")]
    NoEquals,
    /// The value cannot be read.
    #[error("the value is neither TOML nor a bare word")]
    NoValue,
    /// A step of the path is empty.
    #[error("the key is empty")]
    EmptyKey,
    /// The path has too many steps.
    #[error("the key has too many parts")]
    TooDeep,
    /// A list is followed by something other than a number.
    #[error("`{}` is a list: `{}` is not a position in it", shown(path), shown(step))]
    NotAPosition {
        /// The list.
        path: String,
        /// As given.
        step: String,
    },
    /// The list has no such position.
    #[error("`{}` has {length} entries, counted from 0; there is no entry {index}", shown(path))]
    NoElement {
        /// The list.
        path: String,
        /// Its length.
        length: usize,
        /// As given.
        index: usize,
    },
    /// The path continues below a plain value.
    #[error("`{}` is a plain value: there is no `{}` below it", shown(path), shown(step))]
    PlainValue {
        /// The value.
        path: String,
        /// As given.
        step: String,
    },
}

impl ConfigError {
    /// Creates an error of a single mistake.
    pub fn invalid(place: Place, key: impl Into<String>, code: &'static str, reason: impl Into<String>) -> Self {
        Problem::new(place, key, code, reason).into()
    }

    /// Returns the text of each mistake with its code.
    pub fn mistakes(&self) -> Vec<(String, &'static str)> {
        match self {
            Self::Read { .. } => vec![(self.to_string(), "cannot-read-scenario")],
            Self::Unknown { code, text } => vec![(text.clone(), code)],
            Self::Override { source, .. } => vec![(self.to_string(), source.into())],
            Self::Invalid { problems } => problems.iter().map(|problem| (problem.to_string(), problem.code)).collect(),
        }
    }

    /// Adds the problems of further errors to this one, if it consists of problems itself.
    pub(crate) fn and(self, further: impl IntoIterator<Item = Self>) -> Self {
        match self {
            Self::Invalid { mut problems } => {
                problems.extend(further.into_iter().flat_map(|error| match error {
                    Self::Invalid { problems } => problems,
                    _ => Vec::new(),
                }));
                Self::Invalid { problems }
            }
            error => error,
        }
    }

    /// Adds a suggestion to each unknown top-level key that belongs into a table: the key with that table.
    pub(crate) fn within(mut self, nested: &[String]) -> Self {
        if let Self::Invalid { problems } = &mut self {
            for problem in problems.iter_mut().filter(|problem| problem.code == UNKNOWN_KEY) {
                if let Some(meant) = nested_key(&problem.key, nested) {
                    problem.reason = format!("unknown key; did you mean `{meant}`?");
                }
            }
        }
        self
    }
}

impl From<Problem> for ConfigError {
    fn from(problem: Problem) -> Self {
        Self::Invalid { problems: vec![problem] }
    }
}

pub(super) const UNKNOWN_KEY: &str = "unknown-key";
pub(super) const MISSING_KEY: &str = "missing-key";

/// Returns the nested key whose last part equals a top-level key, or resembles it closely.
fn nested_key<'a>(key: &str, nested: &'a [String]) -> Option<&'a String> {
    if key.contains(['.', '[']) || key.len() > 64 {
        return None;
    }
    let likeness = |path: &&String| strsim::jaro_winkler(key, path.rsplit('.').next().unwrap_or(path));
    let best = nested.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(&best) > 0.9).then_some(best)
}

/// Returns the candidate most similar to a word, if it is similar enough.
pub(super) fn most_similar<'a>(word: &str, candidates: &[&'a str]) -> Option<&'a str> {
    // A longer word is not a typing error, and comparing it is slow.
    let likeness = |known: &str| if word.len() > 64 { 0.0 } else { strsim::jaro_winkler(word, known) };
    let best = candidates.iter().copied().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(best) > 0.8).then_some(best)
}

/// Returns "did you mean" with the nearest candidate, or the list of candidates.
pub fn nearest(word: &str, candidates: &[&str]) -> String {
    match most_similar(word, candidates) {
        Some(best) => format!("did you mean `{best}`?"),
        None if candidates.is_empty() => "no key is known here".to_owned(),
        None => format!("known here: {}", candidates.join(", ")),
    }
}

/// The place of a key: file, line and column, or an option.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// The file, or the option with its value.
    pub origin: String,
    /// The line in the file, from 1.
    pub line: Option<usize>,
    /// The column in the line, from 1.
    pub column: Option<usize>,
}

impl Place {
    /// Creates the place of a line of a file.
    pub(crate) fn line(origin: &str, line: usize) -> Self {
        Self { line: Some(line), ..origin.into() }
    }
}

impl<T: Into<String>> From<T> for Place {
    fn from(origin: T) -> Self {
        Self { origin: origin.into(), line: None, column: None }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&shown(&self.origin))?;
        [self.line, self.column].into_iter().flatten().try_for_each(|number| write!(f, ":{number}"))
    }
}

/// A mistake in a line that is not TOML, in a key, or in a value.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// The place of the key.
    pub place: Place,
    /// The key's full path; empty if the text is not TOML.
    pub key: String,
    /// The stable code of the kind of mistake.
    pub code: &'static str,
    /// Reason and remedy.
    pub reason: String,
    /// The key that was probably meant, if the key is unknown.
    pub(super) meant: Option<String>,
}

impl Problem {
    pub(super) fn new(place: Place, key: impl Into<String>, code: &'static str, reason: impl Into<String>) -> Self {
        Self { place, key: key.into(), code, reason: reason.into(), meant: None }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.place)?;
        if !self.key.is_empty() {
            write!(f, "{}: ", shown(&self.key))?;
        }
        f.write_str(&shown(&self.reason))
    }
}

/// The longest part of a message, characters.
const MAX_SHOWN: usize = 400;

/// Returns foreign text for one line of output: without control characters, and of a long text only the beginning and the end.
fn shown(text: &str) -> String {
    let clean = |c: char| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c };
    let text: Vec<char> = text.chars().map(clean).collect();
    match text.len() {
        0..=MAX_SHOWN => text.iter().collect(),
        length => text[..MAX_SHOWN / 2].iter().chain(&[' ', '…', ' ']).chain(&text[length - MAX_SHOWN / 2..]).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn suggests_the_nearest_key() {
        assert_eq!(nearest("tick_hertz", &["tick_hz", "name"]), "did you mean `tick_hz`?");
        assert_eq!(nearest("zzz", &["tick_hz", "name"]), "known here: tick_hz, name");
    }
}
