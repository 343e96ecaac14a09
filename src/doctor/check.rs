//! One line of the report: what was found, and the verdict on it.

use serde::Serialize;

/// The verdict of one line of the report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// No change is needed.
    Ok,
    /// It works, but can be improved or is unknown.
    Warn,
    /// It causes missed deadlines.
    Bad,
}

impl Verdict {
    /// Returns the word in the report.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Bad => "bad",
        }
    }
}

/// One line of the report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Check {
    /// The name of the checked item.
    pub name: &'static str,
    /// The value that was found.
    pub found: String,
    /// The verdict on it.
    pub verdict: Verdict,
    /// The remedy; `None` if the verdict is ok.
    pub remedy: Option<String>,
}

impl Check {
    pub(super) fn ok(name: &'static str, found: impl Into<String>) -> Self {
        Self { name, found: found.into(), verdict: Verdict::Ok, remedy: None }
    }

    pub(super) fn warn(name: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { name, found: found.into(), verdict: Verdict::Warn, remedy: Some(remedy.into()) }
    }

    pub(super) fn bad(name: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { name, found: found.into(), verdict: Verdict::Bad, remedy: Some(remedy.into()) }
    }
}
