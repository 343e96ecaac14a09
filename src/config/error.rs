//! What can be wrong with a scenario, told so that its author can mend it.

use std::path::PathBuf;

/// Why a scenario was refused. Nothing has been started.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("{}: cannot be read: {reason}; give the path of a scenario file, or a name that `corotate init --list` tells", shown(&path.display().to_string()))]
    Read {
        /// The path as given.
        path: PathBuf,
        /// The system's reason.
        reason: String,
    },
    /// The text is not TOML, or a key appears twice.
    #[error("{}: {}; correct the line", shown(place), shown(reason))]
    Syntax {
        /// File, line and column.
        place: String,
        /// The parser's reason.
        reason: String,
    },
    /// No key of this name is known.
    #[error("{}: {}: unknown key; {remedy}", shown(place), shown(key))]
    UnknownKey {
        /// File and line, or the option.
        place: String,
        /// The key's full path.
        key: String,
        /// The nearest known key or the list of them.
        remedy: String,
    },
    /// A key has a value of the wrong type, or is missing.
    #[error("{}: {}: {}", shown(place), shown(key), shown(reason))]
    Value {
        /// File and line, or the option.
        place: String,
        /// The key's full path.
        key: String,
        /// Reason and remedy.
        reason: String,
    },
    /// An override on the command line has not the form key=value, or leads nowhere.
    #[error(
        "--set {}: {}; write --set key=value, for example --set leader.initial_rate_rad_s=[0.6,-0.4,0.8] or --set follower.0.name=chaser",
        shown(argument),
        shown(reason)
    )]
    Override {
        /// The argument as given.
        argument: String,
        /// What is wrong with it.
        reason: String,
    },
    /// Several mistakes, all of them at once; or values that are well-formed but make no sense.
    #[error("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Invalid {
        /// One entry per finding, at least one.
        problems: Vec<Problem>,
    },
}

impl ConfigError {
    /// This mistake and others, if there are some, told at once. What is no mistake of a key stands alone.
    pub(crate) fn and(self, others: impl IntoIterator<Item = Self>) -> Self {
        let others: Vec<Problem> =
            others.into_iter().filter_map(|other| other.into_problems().ok()).flatten().collect();
        if others.is_empty() {
            return self;
        }
        match self.into_problems() {
            Ok(problems) => Self::Invalid { problems: [problems, others].concat() },
            Err(error) => error,
        }
    }

    /// Returns the mistake with a suggestion: a top-level key that belongs into a table is named with that table.
    pub(crate) fn within(self, nested: &[String]) -> Self {
        match self {
            Self::UnknownKey { place, key, remedy } => {
                let remedy = nested_remedy(&key, nested).unwrap_or(remedy);
                Self::UnknownKey { place, key, remedy }
            }
            Self::Invalid { mut problems } => {
                for problem in &mut problems {
                    let remedy = nested_remedy(&problem.key, nested);
                    if let Some(remedy) = remedy.filter(|_| problem.reason.starts_with(UNKNOWN)) {
                        problem.reason = format!("{UNKNOWN}; {remedy}");
                    }
                }
                Self::Invalid { problems }
            }
            error => error,
        }
    }

    /// Whether it is the same mistake.
    pub(super) fn is(&self, other: &Self) -> bool {
        self.to_string() == other.to_string()
    }

    /// The key that is missing, if that is the mistake.
    pub(super) fn missing(&self) -> Option<&String> {
        match self {
            Self::Value { key, reason, .. } => reason.starts_with("is missing").then_some(key),
            _ => None,
        }
    }

    /// The key that was probably meant by one that is unknown.
    pub(super) fn meant(&self) -> Option<String> {
        let Self::UnknownKey { key, remedy, .. } = self else { return None };
        let meant = remedy.strip_prefix("did you mean `")?.strip_suffix("`?")?;
        Some(key.rsplit_once('.').map_or(meant.to_owned(), |(table, _)| format!("{table}.{meant}")))
    }

    fn into_problems(self) -> Result<Vec<Problem>, Self> {
        match self {
            Self::UnknownKey { place, key, remedy } => {
                Ok(vec![Problem { place, key, reason: format!("{UNKNOWN}; {remedy}") }])
            }
            Self::Value { place, key, reason } => Ok(vec![Problem { place, key, reason }]),
            Self::Invalid { problems } => Ok(problems),
            error => Err(error),
        }
    }
}

/// The message for an unknown key.
const UNKNOWN: &str = "unknown key";

/// "did you mean" for the key of a table whose last part is a top-level key's name, or much like it.
fn nested_remedy(key: &str, nested: &[String]) -> Option<String> {
    if key.contains(['.', '[']) || key.len() > 64 {
        return None;
    }
    let likeness = |path: &&String| strsim::jaro_winkler(key, path.rsplit('.').next().unwrap_or(path));
    let best = nested.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(&best) > 0.9).then(|| format!("did you mean `{best}`?"))
}

/// One value that makes no sense.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{}: {}: {}", shown(place), shown(key), shown(reason))]
pub struct Problem {
    /// File and line, or the option.
    pub place: String,
    /// The key's full path.
    pub key: String,
    /// Reason and remedy.
    pub reason: String,
}

/// The most of one part of a message, characters.
const MAX_SHOWN: usize = 400;

/// Text from outside on one line: nothing that moves a terminal's cursor, and of a long text the beginning and the end.
fn shown(text: &str) -> String {
    let clean = |c: char| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c };
    let text: Vec<char> = text.chars().map(clean).collect();
    match text.len() {
        0..=MAX_SHOWN => text.iter().collect(),
        length => text[..MAX_SHOWN / 2].iter().chain(&[' ', '…', ' ']).chain(&text[length - MAX_SHOWN / 2..]).collect(),
    }
}
