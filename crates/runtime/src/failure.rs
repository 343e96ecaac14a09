//! Errors with their codes, as a command prints them. Must not print.

use crate::config::ConfigError;
use std::fmt;

/// An error as it is printed: the text of each mistake, and its code (docs/commands.md).
pub struct Failure(pub Vec<(String, &'static str)>);

impl Failure {
    /// One mistake with its code.
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

/// The code ends the first line of a mistake; the line of a file that it quotes comes after.
impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, (text, code)) in self.0.iter().enumerate() {
            let (first, others) = text.split_at(text.find('\n').unwrap_or(text.len()));
            write!(f, "{}{first} [{code}]{others}", if index > 0 { "\n" } else { "" })?;
        }
        Ok(())
    }
}
