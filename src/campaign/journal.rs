//! The journal of a campaign: a line per finished piece of work, written once and never changed.
//!
//! Every line begins with the hash of the rest, so that what a killed process left unfinished is known from what it finished:
//! the journal ends before the first line that is not whole. Must not hold more of it than a line.

use super::table::{MarginPoint, Row, Table};
use crate::system::remedy;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::xxh3_64;

/// The file in a campaign's directory.
pub(super) const FILE: &str = "journal";
/// Layout version of the journal.
const SCHEMA: &str = "corotate/campaign/v1";
/// Hexadecimal digits of the hash, and the space after them.
const HASH: usize = 17;

/// Why the results of a campaign cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// There is none, or it cannot be read.
    #[error("{}: {source}; {}", path.display(), remedy(source))]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// It does not begin as a journal does.
    #[error("{}: is no campaign's journal, or of another version; name a directory that `corotate sweep` made", path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
    },
}

/// The first line: whose journal it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Head {
    schema: String,
    version: String,
    revision: String,
    /// What the cases follow from, as a hash.
    pub identity: String,
    /// Which part of the cases it is, of how many; none for all.
    pub shard: Option<[u64; 2]>,
    /// The table without rows.
    pub table: Table,
}

impl Head {
    #[cfg_attr(not(test), expect(dead_code, reason = "written by the sweep"))]
    pub fn new(identity: String, shard: Option<[u64; 2]>, table: &Table) -> Self {
        let mut table = Table { rows: Vec::new(), ..table.clone() };
        table.margins.iter_mut().for_each(|margin| margin.points.clear());
        Self {
            schema: SCHEMA.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            revision: env!("COROTATE_REVISION").to_owned(),
            identity,
            shard,
            table,
        }
    }
}

/// Any other line: a finished piece of work.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Entry {
    /// A case.
    Row(Row),
    /// A point of a margin, by the margin's position in the table.
    Margin { margin: usize, point: MarginPoint },
}

/// A line with its hash and its end.
#[cfg_attr(not(test), expect(dead_code, reason = "written by the sweep"))]
pub(super) fn line<T: Serialize>(content: &T) -> String {
    let text = serde_json::to_string(content).expect("plain values are JSON");
    format!("{:016x} {text}\n", xxh3_64(text.as_bytes()))
}

/// What a whole line says; none of any other.
fn content<T: DeserializeOwned>(line: &[u8]) -> Option<T> {
    let text = line.strip_suffix(b"\n")?;
    let (hash, text) = text.split_at_checked(HASH)?;
    let whole = hash == format!("{:016x} ", xxh3_64(text)).as_bytes();
    serde_json::from_slice(text).ok().filter(|_| whole)
}

/// A journal that is read from its beginning.
pub(super) struct Reader {
    path: PathBuf,
    file: BufReader<File>,
    head: Head,
    line: Vec<u8>,
    /// Where the lines that are whole end, bytes.
    end: u64,
}

impl Reader {
    pub fn open(directory: &Path) -> Result<Self, JournalError> {
        let path = directory.join(FILE);
        let refuse = |source| JournalError::Read { path: path.clone(), source };
        let mut file = BufReader::new(File::open(&path).map_err(refuse)?);
        let mut line = Vec::new();
        file.read_until(b'\n', &mut line).map_err(refuse)?;
        let head = content::<Head>(&line).filter(|head| head.schema == SCHEMA);
        match head {
            Some(head) => Ok(Self { end: line.len() as u64, path, file, head, line }),
            None => Err(JournalError::Foreign { path }),
        }
    }

    pub fn head(&self) -> &Head {
        &self.head
    }

    /// The next line; none at the end, or before the first that is not whole.
    pub fn next(&mut self) -> Result<Option<Entry>, JournalError> {
        self.line.clear();
        let read = self.file.read_until(b'\n', &mut self.line);
        read.map_err(|source| JournalError::Read { path: self.path.clone(), source })?;
        let entry = content(&self.line);
        self.end += if entry.is_some() { self.line.len() as u64 } else { 0 };
        Ok(entry)
    }
}
