//! The error of a campaign.

use super::journal::JournalError;
use crate::config::ConfigError;
use crate::system::remedy;
use std::io;
use std::path::PathBuf;

/// The reason why a campaign has no results, or cannot continue.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum SweepError {
    /// The journal.
    #[error(transparent)]
    #[strum(transparent)]
    Journal(#[from] JournalError),
    /// The campaign in a directory.
    #[error(transparent)]
    #[strum(serialize = "refused-scenario")]
    Config(#[from] ConfigError),
    /// The directory holds something else.
    #[error("{} is not empty and holds no campaign; name another directory with --out", path.display())]
    #[strum(serialize = "not-a-campaign")]
    Foreign {
        /// The directory.
        path: PathBuf,
    },
    /// A file cannot be written.
    #[error("{}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Directories to merge belong to different campaigns.
    #[error("{} and {} hold different campaigns or builds; merge the shards of one campaign and build", path.display(), first.display())]
    #[strum(serialize = "mixed-campaigns")]
    Mixed {
        /// The first directory.
        first: PathBuf,
        /// The directory that differs.
        path: PathBuf,
    },
    /// Work items are missing.
    #[error(
        "{count} of {all} cases and margin points are missing, the first is number {first}; complete all shards, and name them all"
    )]
    #[strum(serialize = "missing-cases")]
    Missing {
        /// The number of missing items.
        count: u64,
        /// The number of all items.
        all: u64,
        /// The first missing item; margin points follow the cases.
        first: u64,
    },
    /// Two directories hold different results of one case.
    #[error("{}: case {case} differs from the result in another directory; run all shards on processors of one architecture", path.display())]
    #[strum(serialize = "cases-disagree")]
    Disagree {
        /// The directory.
        path: PathBuf,
        /// The case.
        case: u64,
    },
}
