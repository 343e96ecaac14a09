//! The journal of a campaign: one line per finished work item, written once and never changed.
//!
//! Every line begins with the hash of its rest, which identifies lines that a killed process left incomplete: the journal ends
//! before the first of these. Must not hold more than a line in memory.

use super::table::{MarginPoint, Row, Table};
use crate::files;
use crate::system::remedy;
use rustix::fs::OFlags;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, BufRead, BufReader, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::xxh3_64;

/// The file in a campaign's directory.
pub(super) const FILE: &str = "journal";
/// Layout version of the journal.
const SCHEMA: &str = "corotate/campaign/v1";
/// Hexadecimal digits of the hash, and the space after them.
const HASH: usize = 17;

/// The reason why the results of a campaign cannot be read or written.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum JournalError {
    /// The journal is missing or cannot be read.
    #[error("{}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-read")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The journal cannot be written.
    #[error("cannot write {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-write")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Another process writes the journal.
    #[error("{}: another sweep writes this journal; wait until it ends, or name another directory with --out", path.display())]
    #[strum(serialize = "campaign-busy")]
    Busy {
        /// The file.
        path: PathBuf,
    },
    /// The journal belongs to another campaign.
    #[error("{}: holds {found}, and this is {expected}; name another directory with --out", path.display())]
    #[strum(serialize = "other-campaign")]
    Other {
        /// The file.
        path: PathBuf,
        /// The campaign of the journal.
        found: String,
        /// The campaign to write.
        expected: String,
    },
    /// The file is not a journal of this version.
    #[error("{}: is not a campaign's journal, or has another version; name a directory that `corotate sweep` made", path.display())]
    #[strum(serialize = "not-a-journal")]
    Foreign {
        /// The file.
        path: PathBuf,
    },
}

/// The first line, which identifies the campaign.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Head {
    schema: String,
    version: String,
    revision: String,
    /// The hash of everything that determines the cases.
    pub identity: String,
    /// Index and number of the shard; `None` for the whole campaign.
    pub shard: Option<[u64; 2]>,
    /// The table without rows.
    pub table: Table,
}

impl Head {
    pub fn new(identity: String, shard: Option<[u64; 2]>, table: &Table) -> Self {
        let mut table = Table { rows: Vec::new(), ..table.clone() };
        table.margins.iter_mut().for_each(|margin| margin.points.clear());
        Self {
            schema: SCHEMA.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            revision: env!("COROTATE_BUILT_REVISION").to_owned(),
            identity,
            shard,
            table,
        }
    }

    /// Returns the head of the whole campaign, of which this may be a shard.
    pub fn whole(&self) -> Self {
        Self { shard: None, ..self.clone() }
    }

    /// Returns the campaign and build in words.
    fn words(&self) -> String {
        let shard = self.shard.map_or(String::new(), |[index, count]| format!("shard {index}/{count} of "));
        let Self { identity, version, revision, table, .. } = self;
        format!("{shard}campaign `{}` ({identity}, by corotate {version} {revision})", table.name)
    }
}

/// A finished work item, one line of the journal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Entry {
    /// A case.
    Row(Row),
    /// A point of a margin.
    Margin {
        /// The margin's position in the table.
        margin: usize,
        /// The point.
        point: MarginPoint,
    },
}

/// Returns a line with its hash and line end.
pub(super) fn line<T: Serialize>(content: &T) -> String {
    let text = serde_json::to_string(content).expect("plain values are JSON");
    format!("{:016x} {text}\n", xxh3_64(text.as_bytes()))
}

/// Returns the content of a complete line; `None` for any other.
fn content<T: DeserializeOwned>(line: &[u8]) -> Option<T> {
    let text = line.strip_suffix(b"\n")?;
    let (hash, text) = text.split_at_checked(HASH)?;
    let whole = hash == format!("{:016x} ", xxh3_64(text)).as_bytes();
    serde_json::from_slice(text).ok().filter(|_| whole)
}

/// Reads a journal from its beginning.
pub(super) struct Reader {
    path: PathBuf,
    file: BufReader<File>,
    head: Head,
    line: Vec<u8>,
    /// The end of the complete lines, bytes.
    end: u64,
}

impl Reader {
    pub fn open(directory: &Path) -> Result<Self, JournalError> {
        let path = directory.join(FILE);
        let refuse = |source| JournalError::Read { path: path.clone(), source };
        let mut file = BufReader::new(files::open(&path).map_err(refuse)?);
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

    /// Returns the next line; `None` at the end, or before the first incomplete line.
    pub fn next(&mut self) -> Result<Option<Entry>, JournalError> {
        self.line.clear();
        let read = self.file.read_until(b'\n', &mut self.line);
        read.map_err(|source| JournalError::Read { path: self.path.clone(), source })?;
        let entry = content(&self.line);
        self.end += if entry.is_some() { self.line.len() as u64 } else { 0 };
        Ok(entry)
    }
}

/// The offset of a missing line: the head is there.
const NOWHERE: u64 = 0;

/// Writes a journal. No other process can write it meanwhile.
pub(super) struct Journal {
    path: PathBuf,
    file: File,
    /// The offset of each work item's line, bytes.
    offsets: Vec<u64>,
    end: u64,
}

impl Drop for Journal {
    fn drop(&mut self) {
        // Closing is not enough: a child process may have inherited the file.
        let _ = self.file.unlock();
    }
}

impl Journal {
    /// Creates a journal, or continues one of the same campaign. `pieces` is the number of work items, `place` returns the item of
    /// an entry.
    pub fn open(
        directory: &Path,
        head: &Head,
        pieces: u64,
        place: impl Fn(&Entry) -> Option<u64>,
    ) -> Result<Self, JournalError> {
        let path = directory.join(FILE);
        let refuse = |source| JournalError::Write { path: path.clone(), source };
        let mut options = OpenOptions::new();
        let file = files::open_with(&path, options.read(true).append(true).create(true), OFlags::NOFOLLOW);
        let mut file = file.map_err(refuse)?;
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => return Err(JournalError::Busy { path }),
            Err(TryLockError::Error(source)) => return Err(refuse(source)),
            Ok(()) => {}
        }
        let first = line(head);
        // The writer was killed before the first line was complete.
        let begun =
            std::fs::read(&path).ok().filter(|_| file.metadata().is_ok_and(|file| file.len() < first.len() as u64));
        if begun.is_some_and(|begun| first.as_bytes().starts_with(&begun)) {
            file.set_len(0).and_then(|()| file.write_all(first.as_bytes())).map_err(refuse)?;
        }
        let mut reader = Reader::open(directory)?;
        if reader.head() != head {
            return Err(JournalError::Other { path, found: reader.head().words(), expected: head.words() });
        }
        let mut offsets = vec![NOWHERE; pieces as usize];
        let mut end = reader.end;
        while let Some(entry) = reader.next()? {
            if let Some(offset) = place(&entry).and_then(|place| offsets.get_mut(place as usize)) {
                *offset = end;
            }
            end = reader.end;
        }
        // An incomplete line is discarded.
        file.set_len(end).map_err(refuse)?;
        Ok(Self { path, file, offsets, end })
    }

    /// Returns true if this work item is done.
    pub fn has(&self, place: u64) -> bool {
        self.offsets.get(place as usize).is_some_and(|offset| *offset != NOWHERE)
    }

    /// Returns the number of finished work items.
    pub fn done(&self) -> u64 {
        self.offsets.iter().filter(|offset| **offset != NOWHERE).count() as u64
    }

    /// Writes a finished work item: the whole line at once.
    pub fn add(&mut self, place: u64, entry: &Entry) -> Result<(), JournalError> {
        let line = line(entry);
        let written = self.file.write_all(line.as_bytes());
        written.map_err(|source| JournalError::Write { path: self.path.clone(), source })?;
        self.offsets[place as usize] = self.end;
        self.end += line.len() as u64;
        Ok(())
    }

    /// Returns the entries in the order of the work items.
    pub fn entries(&self) -> Result<impl Iterator<Item = Result<Entry, JournalError>> + '_, JournalError> {
        let mut lines = self.lines()?;
        let offsets = self.offsets.iter().filter(|offset| **offset != NOWHERE);
        Ok(offsets.map(move |offset| lines.at(*offset)))
    }

    /// Returns random access to the entries.
    pub fn lines(&self) -> Result<Lines<'_>, JournalError> {
        let refuse = |source| JournalError::Read { path: self.path.clone(), source };
        Ok(Lines { journal: self, file: BufReader::new(File::open(&self.path).map_err(refuse)?), line: Vec::new() })
    }
}

/// Random access to the entries of a journal.
pub(super) struct Lines<'a> {
    journal: &'a Journal,
    file: BufReader<File>,
    line: Vec<u8>,
}

impl Lines<'_> {
    /// Returns the entry of a work item, if it is done.
    pub fn entry(&mut self, place: u64) -> Result<Option<Entry>, JournalError> {
        if self.journal.has(place) { self.at(self.journal.offsets[place as usize]).map(Some) } else { Ok(None) }
    }

    fn at(&mut self, offset: u64) -> Result<Entry, JournalError> {
        self.line.clear();
        let read = self.file.seek(SeekFrom::Start(offset)).and_then(|_| self.file.read_until(b'\n', &mut self.line));
        let path = || self.journal.path.clone();
        read.map_err(|source| JournalError::Read { path: path(), source })?;
        content(&self.line).ok_or_else(|| JournalError::Foreign { path: path() })
    }
}

impl Table {
    /// Returns true if a directory holds the results of a campaign.
    pub fn is_in(directory: &Path) -> bool {
        directory.join(FILE).is_file()
    }

    /// Reads the results of a campaign from its directory, complete or not.
    ///
    /// # Errors
    /// [`JournalError`].
    pub fn read(directory: &Path) -> Result<Self, JournalError> {
        let mut opened = Reader::open(directory)?;
        let mut table = opened.head().table.clone();
        while let Some(entry) = opened.next()? {
            table.add(entry);
        }
        table.rows.sort_by_key(|row| row.case);
        table.rows.dedup_by_key(|row| row.case);
        for margin in &mut table.margins {
            margin.points.sort_by_key(|point| point.case);
            margin.points.dedup_by_key(|point| point.case);
        }
        Ok(table)
    }

    fn add(&mut self, entry: Entry) {
        match entry {
            Entry::Row(row) => self.rows.push(row),
            Entry::Margin { margin, point } => {
                self.margins.get_mut(margin).into_iter().for_each(|margin| margin.points.push(point.clone()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::campaign::Find;
    use crate::campaign::table::tests::table;
    use proptest::prelude::*;

    fn entry(case: u64) -> Entry {
        Entry::Row(Row { case, ..table().rows[0].clone() })
    }

    fn place(entry: &Entry) -> Option<u64> {
        let Entry::Row(row) = entry else { return None };
        Some(row.case)
    }

    fn open(directory: &Path) -> Result<Journal, JournalError> {
        Journal::open(directory, &Head::new("01".to_owned(), None, &table()), 8, place)
    }

    fn cases(journal: &Journal) -> Vec<u64> {
        journal.entries().unwrap().map(|entry| place(&entry.unwrap()).unwrap()).collect()
    }

    proptest! {
        /// The end of a journal is lost, or one byte is changed: the complete lines before that remain and the journal continues.
        #[test]
        fn complete_lines_survive_damage_after_them(cut: prop::sample::Index, flipped: bool) {
            let directory = tempfile::tempdir().unwrap();
            let mut journal = open(directory.path()).unwrap();
            for case in [5, 0, 3] {
                journal.add(case, &entry(case)).unwrap();
            }
            prop_assert_eq!(cases(&journal), [0, 3, 5]);
            drop(journal);
            let path = directory.path().join(FILE);
            let mut bytes = std::fs::read(&path).unwrap();
            let ends: Vec<usize> = (0..bytes.len()).filter(|at| bytes[*at] == b'\n').collect();
            let cut = ends[0] + 1 + cut.index(bytes.len() - ends[0] - 1);
            if flipped { bytes[cut] ^= 1 } else { bytes.truncate(cut) }
            std::fs::write(&path, &bytes).unwrap();
            let whole = ends.iter().filter(|end| **end < cut).count() - 1;
            let mut journal = open(directory.path()).unwrap();
            prop_assert_eq!(journal.done(), whole as u64);
            journal.add(7, &entry(7)).unwrap();
            let mut expected = [5, 0, 3][..whole].to_vec();
            expected.push(7);
            expected.sort_unstable();
            prop_assert_eq!(cases(&journal), expected);
        }
    }

    #[test]
    fn an_incomplete_first_line_is_written_again() {
        let directory = tempfile::tempdir().unwrap();
        let head = line(&Head::new("01".to_owned(), None, &table()));
        for bytes in [&b""[..], &head.as_bytes()[..head.len() / 2]] {
            std::fs::write(directory.path().join(FILE), bytes).unwrap();
            assert_eq!(open(directory.path()).unwrap().done(), 0);
        }
    }

    #[test]
    fn a_journal_is_continued_by_its_own_campaign_and_one_process() {
        let directory = tempfile::tempdir().unwrap();
        let journal = open(directory.path()).unwrap();
        assert!(matches!(open(directory.path()), Err(JournalError::Busy { .. })));
        drop(journal);
        for (identity, shard) in [("02", None), ("01", Some([0, 2]))] {
            let head = Head::new(identity.to_owned(), shard, &table());
            let refused = Journal::open(directory.path(), &head, 8, place);
            assert!(matches!(refused, Err(JournalError::Other { .. })), "{identity}");
        }
        let mut margins = table();
        margins.margins[0].find = Find::Smallest;
        assert!(Journal::open(directory.path(), &Head::new("01".to_owned(), None, &margins), 8, place).is_err());
        std::fs::write(directory.path().join(FILE), "letter\n").unwrap();
        assert!(matches!(open(directory.path()), Err(JournalError::Foreign { .. })));
        assert_eq!(std::fs::read(directory.path().join(FILE)).unwrap(), b"letter\n");
    }
}
