//! The errors of reports.
use crate::campaign::JournalError;
use crate::config::{ConfigError, RunId};
use crate::record::RecordError;
use std::io;
use std::path::PathBuf;

/// The reason that no report can be made.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum ReportError {
    /// The file or directory does not exist.
    #[error("{} does not exist; give the directory of a run, or its run.mcap", path.display())]
    #[strum(serialize = "no-such-run")]
    Nothing {
        /// The given path.
        path: PathBuf,
    },
    /// The directory contains neither a summary nor a recording.
    #[error(
        "{} has neither summary.json nor run.mcap; give the directory that `corotate run` printed at its end",
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
        /// The error of the system.
        source: io::Error,
    },
    /// The summary is not of this version.
    #[error("cannot read the summary {}: {reason}; use the version of corotate that wrote it", path.display())]
    #[strum(serialize = "unreadable-summary")]
    Summary {
        /// The file.
        path: PathBuf,
        /// The part that is invalid.
        reason: String,
    },
    /// The late ticks are not of this version.
    #[error("cannot read {}: {reason}; remove it, or use the version of corotate that wrote it", path.display())]
    #[strum(serialize = "unreadable-late-ticks")]
    LateTicks {
        /// The file.
        path: PathBuf,
        /// The part that is invalid.
        reason: String,
    },
    /// A latency distribution is invalid.
    #[error("{} is not a percentile distribution: {reason}; remove it, or run again", path.display())]
    #[strum(serialize = "unreadable-latency")]
    Latency {
        /// The file.
        path: PathBuf,
        /// The part that is invalid.
        reason: String,
    },
    /// The directory contains files of two runs.
    #[error(
        "{} belongs to {} and {} to {}: a report shows one run; remove the files of one, or give its run.mcap alone",
        files[0].0.display(), named(files[0].1), files[1].0.display(), named(files[1].1)
    )]
    TwoRuns {
        /// Two files with different runs, each with its run.
        files: Box<[(PathBuf, Option<RunId>); 2]>,
    },
    /// The scenario is refused.
    #[error("this version refuses the scenario of the run: {0}")]
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
    /// A campaign was given with an option or a second path that applies to runs only.
    #[error("{} is a campaign: its page shows neither fields nor a second run; give it without {with}", path.display())]
    #[strum(serialize = "campaign-alone")]
    CampaignWith {
        /// The directory.
        path: PathBuf,
        /// The option or the second path.
        with: &'static str,
    },
    /// The recording has no field of this name.
    #[error("the recording has no field `{name}`; its fields are: {known}")]
    #[strum(serialize = "no-such-field")]
    Field {
        /// The given name.
        name: String,
        /// The names of all fields.
        known: String,
    },
    /// The reference run failed.
    #[error("cannot compute the reference run with full state: {reason}")]
    #[strum(serialize = "counterpart-failed")]
    Counterpart {
        /// The error of the run.
        reason: String,
    },
    /// The page cannot be written.
    #[error("cannot write {}: {source}; name another file with --out", path.display())]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
}

fn named(run: Option<RunId>) -> String {
    run.map_or("a run without an identifier".to_owned(), |run| format!("run {run}"))
}
