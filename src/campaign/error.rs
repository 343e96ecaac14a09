//! Why a campaign has no results, or cannot go on.

use super::journal::JournalError;
use crate::config::ConfigError;
use crate::system::remedy;
use std::io;
use std::path::PathBuf;

/// Why a campaign has no results, or cannot go on.
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
    #[error("{} is not empty, and no campaign's; name another directory with --out", path.display())]
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
    /// Directories that are to be merged are not of one campaign.
    #[error("{} holds another campaign than {}, or another build's; merge what belongs together", other.display(), first.display())]
    #[strum(serialize = "mixed-campaigns")]
    Mixed {
        /// The first.
        first: PathBuf,
        /// The one that does not belong to it.
        other: PathBuf,
    },
    /// Pieces of work are missing.
    #[error(
        "{count} of {all} cases and points of margins are missing, number {first} first; run the shards to their end, and name them all"
    )]
    #[strum(serialize = "missing-cases")]
    Missing {
        /// How many.
        count: u64,
        /// Of how many.
        all: u64,
        /// The first, of the cases and then of the points of margins.
        first: u64,
    },
    /// Two directories tell different things of one case.
    #[error("{}: its case {case} is another than that of a directory before it; do both machines have the same processor?", path.display())]
    #[strum(serialize = "cases-disagree")]
    Disagree {
        /// The directory.
        path: PathBuf,
        /// The case.
        case: u64,
    },
}
