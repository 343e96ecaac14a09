//! Errors with their codes, in the form in which a command prints them. This file does not print.

use crate::config::ConfigError;
use std::fmt;

/// The mistakes of a failed command: the text and the code (docs/commands.md) of each.
pub struct Failure(pub Vec<(String, &'static str)>);

impl Failure {
    /// Creates a failure of one mistake.
    pub fn new(code: &'static str, text: impl ToString) -> Self {
        Self(vec![(text.to_string(), code)])
    }

    /// Puts the name of an option or a file before the text of each mistake.
    pub fn prefixed(prefix: impl fmt::Display, error: impl Into<Self>) -> Self {
        let Self(mistakes) = error.into();
        Self(mistakes.into_iter().map(|(text, code)| (format!("{prefix}: {text}"), code)).collect())
    }
}

impl<E: fmt::Display> From<E> for Failure
where
    for<'e> &'e E: Into<&'static str>,
{
    fn from(error: E) -> Self {
        Self::new((&error).into(), error)
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        Self(error.mistakes())
    }
}

/// Writes the code at the end of each mistake's first line; a quoted line of a file follows it.
impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, (text, code)) in self.0.iter().enumerate() {
            let (first, rest) = text.split_at(text.find('\n').unwrap_or(text.len()));
            write!(f, "{}{first} [{code}]{rest}", if index > 0 { "\n" } else { "" })?;
        }
        Ok(())
    }
}
