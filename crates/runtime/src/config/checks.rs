//! Findings about a scenario, collected so that all of them are reported at once.

use super::document::Document;
use super::error::{ConfigError, Problem};
use std::cell::RefCell;
use std::path::PathBuf;

/// A collector of findings, so that all of them are reported at once.
pub struct Checks<'a> {
    document: &'a Document,
    problems: Vec<Problem>,
    warnings: Vec<String>,
    files: RefCell<Vec<(String, PathBuf)>>,
}

impl<'a> Checks<'a> {
    /// Creates a collector for a document, without findings.
    pub fn new(document: &'a Document) -> Self {
        Self { document, problems: Vec::new(), warnings: Vec::new(), files: RefCell::default() }
    }

    /// Records a mistake in the value at `key`. The code names the kind of mistake, in lower case with hyphens.
    pub fn refuse(&mut self, key: &str, code: &'static str, reason: impl Into<String>) {
        self.problems.push(Problem::new(self.document.place(key), key, code, reason));
    }

    /// Records that the value at `key` has no effect. The scenario stays valid.
    pub fn warn(&mut self, key: &str, reason: impl std::fmt::Display) {
        self.warnings.push(format!("{key}: {reason}"));
    }

    /// Returns the file named by the value at `key`: relative to the scenario, or to the working directory if an option gave it.
    pub fn file(&self, key: &str, name: &str) -> PathBuf {
        let here = self.document.place(key).line.is_none();
        let path = if here { name.into() } else { self.document.directory().join(name) };
        self.files.borrow_mut().push((key.to_owned(), path.clone()));
        path
    }

    /// Records a mistake unless `holds`.
    pub fn require(&mut self, holds: bool, key: &str, code: &'static str, reason: impl FnOnce() -> String) {
        if !holds {
            self.refuse(key, code, reason());
        }
    }

    /// Records a mistake if a number is not positive. Non-finite numbers were refused before.
    pub fn positive(&mut self, key: &str, value: f64) {
        self.require(value > 0.0, key, "not-positive", || format!("{value} is not above zero; give a positive number"));
    }

    /// Returns the value, or records the error with its code.
    pub fn accept<T, E: std::fmt::Display>(&mut self, key: &str, value: Result<T, E>) -> Option<T>
    where
        for<'e> &'e E: Into<&'static str>,
    {
        value.map_err(|error| self.refuse(key, (&error).into(), error.to_string())).ok()
    }

    /// Takes the files named by values, and the warnings.
    pub(crate) fn take_remarks(&mut self) -> (Vec<(String, PathBuf)>, Vec<String>) {
        (self.files.take(), std::mem::take(&mut self.warnings))
    }

    /// Keeps only the problems whose keys satisfy `keep`.
    pub(crate) fn retain(&mut self, keep: impl Fn(&str) -> bool) {
        self.problems.retain(|problem| keep(&problem.key));
    }

    /// Returns the value if there is no problem.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] with every recorded problem.
    pub fn finish<T>(self, value: Option<T>) -> Result<T, ConfigError> {
        match value {
            Some(value) if self.problems.is_empty() => Ok(value),
            _ => Err(ConfigError::Invalid { problems: self.problems }),
        }
    }
}
