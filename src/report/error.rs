//! Why there is no report.

use crate::campaign::JournalError;
use crate::config::{ConfigError, RunId};
use crate::record::RecordError;
use std::io;
use std::path::PathBuf;

/// Why there is no report.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum ReportError {
    /// There is no such file or directory.
    #[error("{} does not exist; give the directory of a run, or its run.mcap", path.display())]
    #[strum(serialize = "no-such-run")]
    Nothing {
        /// What was given.
        path: PathBuf,
    },
    /// The directory is no run's.
    #[error(
        "{} has neither summary.json nor run.mcap; give the directory that `corotate run` named at its end",
        path.display()
    )]
    #[strum(serialize = "no-results")]
    NoRun {
        /// The directory.
        path: PathBuf,
    },
    /// A file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    #[strum(serialize = "cannot-read")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The summary is none of this version's.
    #[error("{} is no summary that can be shown: {reason}; use the version that wrote it", path.display())]
    #[strum(serialize = "unreadable-summary")]
    Summary {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A latency distribution is none.
    #[error("{} is no percentile distribution: {reason}; remove it, or run again", path.display())]
    #[strum(serialize = "unreadable-latency")]
    Latency {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The directory holds files of two runs.
    #[error(
        "{} is of {} and {} of {}: a page shows one run; remove the files of one, or give its run.mcap alone",
        files[0].0.display(), named(files[0].1), files[1].0.display(), named(files[1].1)
    )]
    TwoRuns {
        /// Two of them, each with its run.
        files: Box<[(PathBuf, Option<RunId>); 2]>,
    },
    /// The scenario is refused.
    #[error("the run's scenario is refused by this version: {0}")]
    #[strum(serialize = "refused-scenario")]
    Scenario(#[from] ConfigError),
    /// The recording cannot be used.
    #[error(transparent)]
    #[strum(transparent)]
    Record(#[from] RecordError),
    /// The results of a campaign cannot be read.
    #[error(transparent)]
    #[strum(transparent)]
    Campaign(#[from] JournalError),
    /// A campaign has a page of its own.
    #[error("{} holds a campaign, which is shown alone and has no fields; give it without {with}", path.display())]
    #[strum(serialize = "campaign-alone")]
    CampaignWith {
        /// The directory.
        path: PathBuf,
        /// What it was given with.
        with: &'static str,
    },
    /// There is no such field.
    #[error("the recording shows no field `{name}`; it has: {known}")]
    #[strum(serialize = "no-such-field")]
    Field {
        /// As given.
        name: String,
        /// Those there are.
        known: String,
    },
    /// The run to compare with failed.
    #[error("the same motion with full state, for comparison, failed: {reason}")]
    #[strum(serialize = "counterpart-failed")]
    Counterpart {
        /// Why.
        reason: String,
    },
    /// The page cannot be written.
    #[error("cannot write {}: {source}; name another file with --out", path.display())]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

fn named(run: Option<RunId>) -> String {
    run.map_or("a run without an identifier".to_owned(), |run| format!("run {run}"))
}
