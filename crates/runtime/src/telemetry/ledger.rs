//! A role's persistent state: shared memory that survives its writer, so that a successor can continue.
//!
//! The record is kept twice. A commit writes the copy that is not current and makes it current with one store. A reader
//! therefore finds a complete record at any time, even if the writer dies during a commit. The ledger does not know what the
//! record contains.

use super::handover;
use crate::shared::SharedWords;
use crate::state::Words;
use crate::system::remedy;
use rustix::fs::{FlockOperation, flock};
use std::cell::{Cell, OnceCell};
use std::io;
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::rc::Rc;
use std::sync::atomic::{AtomicU64, Ordering};

/// An error of opening a ledger.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum LedgerError {
    /// The memory cannot be opened.
    #[error("cannot keep the state in {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-keep-state")]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Another process writes to it.
    #[error("{} is held by another process: that seat is taken; end it first", path.display())]
    #[strum(serialize = "seat-taken")]
    Taken {
        /// The file.
        path: PathBuf,
    },
    /// The file exists with another size.
    #[error("{} holds {found} bytes, not {expected}: it was written by another version of this program", path.display())]
    #[strum(serialize = "state-size")]
    Size {
        /// The file.
        path: PathBuf,
        /// Its size.
        found: u64,
        /// The size that this version writes.
        expected: u64,
    },
}

/// A role's persistent state: the record, words beside it that are written one by one, and the count of the processes that
/// have written.
#[derive(Debug)]
pub struct Ledger {
    memory: Rc<Memory>,
    taken: Cell<usize>,
}

#[derive(Debug)]
struct Memory {
    words: Storage,
    /// The file, unless the words end with this process.
    path: Option<PathBuf>,
    /// The two copies of the record.
    record: OnceCell<Storage>,
}

#[derive(Debug)]
enum Storage {
    Private(Box<[AtomicU64]>),
    Shared(SharedWords),
}

impl Storage {
    fn private(words: usize) -> Self {
        Self::Private((0..words).map(|_| AtomicU64::new(0)).collect())
    }

    /// Opens or creates a file of `words` words.
    fn shared(path: &Path, words: usize) -> Result<Self, LedgerError> {
        let shared =
            SharedWords::open(path, words).map_err(|source| LedgerError::Open { path: path.to_owned(), source })?;
        let [found, expected] = [shared.words().len(), words].map(|words| (words * size_of::<u64>()) as u64);
        if found != expected {
            return Err(LedgerError::Size { path: path.to_owned(), found, expected });
        }
        Ok(Self::Shared(shared))
    }

    #[inline]
    fn words(&self) -> &[AtomicU64] {
        match self {
            Self::Private(words) => words,
            Self::Shared(shared) => shared.words(),
        }
    }
}

impl Ledger {
    /// The index of the number of processes that have entered.
    const GENERATION: usize = 0;
    /// The index of the number of commits; its lowest bit selects the current copy.
    const COMMITS: usize = 1;
    /// The index of the record's length in words.
    const LENGTH: usize = 2;
    /// The index of the generation that must start without its predecessor's state; 0 for no generation.
    const ANEW: usize = 3;
    const FIRST: usize = 4;
    /// The number of tries to read a record that is being written.
    const TRIES: usize = 1000;

    /// Creates a ledger that ends with this process, for runs in one thread.
    pub fn private(words: usize) -> Self {
        Self::over(Storage::private(Self::FIRST + words), None)
    }

    /// Opens the ledger in a shared-memory file for reading. A new one is all zero.
    ///
    /// # Errors
    /// [`LedgerError`].
    pub fn shared(path: &Path, words: usize) -> Result<Self, LedgerError> {
        Ok(Self::over(Storage::shared(path, Self::FIRST + words)?, Some(path.to_owned())))
    }

    /// Opens the ledger in a shared-memory file for writing. There is one writer at a time.
    ///
    /// # Errors
    /// [`LedgerError`].
    pub fn taken(path: &Path, words: usize) -> Result<Self, LedgerError> {
        let ledger = Self::shared(path, words)?;
        if let Storage::Shared(shared) = &ledger.memory.words {
            match flock(shared.file(), FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => {}
                Err(rustix::io::Errno::WOULDBLOCK) => return Err(LedgerError::Taken { path: path.to_owned() }),
                Err(error) => return Err(LedgerError::Open { path: path.to_owned(), source: error.into() }),
            }
        }
        Ok(ledger)
    }

    fn over(words: Storage, path: Option<PathBuf>) -> Self {
        Self { memory: Rc::new(Memory { words, path, record: OnceCell::new() }), taken: Cell::new(Self::FIRST) }
    }

    #[inline]
    fn word(&self, index: usize) -> &AtomicU64 {
        &self.memory.words.words()[index]
    }

    /// Enters as the next generation of writers, and returns its number: 1 for the first.
    pub fn enter(&self) -> u64 {
        self.word(Self::GENERATION).fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Returns the latest generation; 0 before the first.
    pub fn generation(&self) -> u64 {
        self.word(Self::GENERATION).load(Ordering::Relaxed)
    }

    /// Makes the next generation keep only the counters, because the state may be what its predecessors failed on.
    pub fn discard_state(&self) {
        self.word(Self::ANEW).store(self.generation() + 1, Ordering::Relaxed);
    }

    /// Returns true if the current generation must start without its predecessor's state.
    pub fn discards_state(&self) -> bool {
        self.word(Self::ANEW).load(Ordering::Relaxed) == self.generation()
    }

    /// Returns the same memory with every word free to be taken again.
    pub fn reopened(&self) -> Self {
        Self { memory: self.memory.clone(), taken: Cell::new(Self::FIRST) }
    }

    /// Takes the next `count` words beside the record. A process that takes in the same order gets the same words.
    ///
    /// # Panics
    /// If no words are left. The ledger's size is computed from the same list of parts that take from it.
    pub fn take(&self, count: usize) -> Slots {
        let begin = self.taken.replace(self.taken.get() + count);
        let words = self
            .memory
            .words
            .words()
            .get(begin..begin + count)
            .expect("the ledger has room for every part that takes words");
        Slots { words: words.into(), _memory: self.memory.clone() }
    }

    /// Returns the file, or `None` if the ledger ends with this process.
    pub fn path(&self) -> Option<&Path> {
        self.memory.path.as_deref()
    }

    /// Returns true if another process may continue from here. The writer then commits every tick.
    #[inline]
    pub fn is_shared(&self) -> bool {
        self.memory.path.is_some()
    }

    /// Makes room for a record of `words` words, or opens the existing one.
    ///
    /// # Errors
    /// [`LedgerError`].
    pub fn reserve(&self, words: usize) -> Result<(), LedgerError> {
        if self.memory.record.get().is_none() {
            let storage = match self.record_path() {
                Some(path) => Storage::shared(&path, 2 * words)?,
                None => Storage::private(2 * words),
            };
            let _ = self.memory.record.set(storage);
            self.word(Self::LENGTH).store(words as u64, Ordering::Relaxed);
        }
        Ok(())
    }

    /// Opens the existing record for reading. Creates nothing, whatever length the ledger claims.
    fn open_record(&self) -> Option<&Storage> {
        let words = self.word(Self::LENGTH).load(Ordering::Relaxed) as usize;
        if self.memory.record.get().is_none() && words > 0 {
            let storage = Storage::Shared(SharedWords::existing(&self.record_path()?).ok()?);
            let whole = words.checked_mul(2) == Some(storage.words().len());
            whole.then(|| self.memory.record.set(storage));
        }
        self.memory.record.get()
    }

    fn record_path(&self) -> Option<PathBuf> {
        self.memory.path.as_ref().map(|path| path.with_extension("state"))
    }

    /// Writes a record and makes it current. Room for as many words as `write` passes must be [reserved](Self::reserve) before.
    #[inline]
    pub fn commit(&self, write: impl FnOnce(&mut Store<'_>)) {
        let Some(record) = self.memory.record.get() else { return };
        let commits = self.word(Self::COMMITS);
        handover::commit(commits, commits.load(Ordering::Relaxed) + 1, record.words(), |words| {
            let mut store = Store { words, at: 0 };
            write(&mut store);
            debug_assert_eq!(store.at, words.len(), "a state always has the same number of words");
        });
    }

    /// Returns the last committed record. Returns `None` before the first commit, or if no record can be read.
    pub fn record(&self) -> Option<Vec<u64>> {
        let record = self.open_record()?;
        handover::record(self.word(Self::COMMITS), record.words(), Self::TRIES)
    }
}

/// A writer of a state into a record.
#[derive(Debug)]
pub struct Store<'a> {
    words: &'a [AtomicU64],
    at: usize,
}

impl Words for Store<'_> {
    #[inline]
    fn word(&mut self, value: &mut u64) {
        if let Some(word) = self.words.get(self.at) {
            word.store(*value, Ordering::Relaxed);
        }
        self.at += 1;
    }
}

/// Words of a ledger beside its record. Each is written atomically and independently.
#[derive(Debug)]
pub struct Slots {
    /// The words, looked up once because some are written in every tick.
    words: NonNull<[AtomicU64]>,
    /// Keeps the words alive.
    _memory: Rc<Memory>,
}

impl Slots {
    /// Returns all words.
    #[inline]
    #[allow(unsafe_code)]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        // SAFETY: the words lie in `_memory`, which lives as long as `self`. It is not moved or freed, and all writes to it
        // are atomic.
        unsafe { self.words.as_ref() }
    }

    /// Returns one word.
    #[inline]
    pub fn get(&self, index: usize) -> u64 {
        self.words()[index].load(Ordering::Relaxed)
    }

    /// Writes one word. A reader that sees a later commit also sees this word.
    #[inline]
    pub fn set(&self, index: usize, value: u64) {
        self.words()[index].store(value, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicBool;

    fn commit(ledger: &Ledger, values: &[u64]) {
        ledger.commit(|store| values.iter().for_each(|value| store.word(&mut value.clone())));
    }

    #[test]
    fn a_reopened_ledger_has_the_last_commit() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("x.books");
        let (first, second) = (Ledger::shared(&path, 5).unwrap(), Ledger::shared(&path, 5).unwrap());
        assert_eq!((first.enter(), second.enter(), first.generation()), (1, 2, 2));
        assert_eq!(second.record(), None);
        first.reserve(3).unwrap();
        assert_eq!(second.record(), None, "nothing was committed");
        commit(&first, &[1, 2, 3]);
        commit(&first, &[4, 5, 6]);
        assert_eq!(second.record(), Some(vec![4, 5, 6]));
        let (_, ours, _, theirs) = (first.take(2), first.take(3), second.take(2), second.take(3));
        ours.set(2, 7);
        assert_eq!(theirs.get(2), 7);
        let writer = Ledger::taken(&path, 5).unwrap();
        assert!(matches!(Ledger::taken(&path, 5), Err(LedgerError::Taken { .. })));
        drop(writer);
        let successor = Ledger::taken(&path, 5).unwrap();
        drop((first, ours));
        assert_eq!((successor.record(), theirs.get(2)), (Some(vec![4, 5, 6]), 7));
        assert!(matches!(Ledger::shared(&path, 6), Err(LedgerError::Size { found: 72, expected: 80, .. })));
        assert!(matches!(Ledger::shared(&path, 5).unwrap().reserve(4), Err(LedgerError::Size { .. })));
        assert!(matches!(Ledger::shared(directory.path(), 6), Err(LedgerError::Open { .. })));
    }

    #[test]
    fn a_reader_creates_no_file_whatever_length_is_claimed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("x.books");
        let writer = Ledger::shared(&path, 0).unwrap();
        for length in [1, 1 << 40, u64::MAX / 2 + 2, u64::MAX] {
            writer.word(Ledger::LENGTH).store(length, Ordering::Relaxed);
            assert_eq!(Ledger::shared(&path, 0).unwrap().record(), None);
            assert!(!path.with_extension("state").exists(), "{length}");
        }
        writer.reserve(3).unwrap();
        commit(&writer, &[1, 2, 3]);
        writer.word(Ledger::LENGTH).store(u64::MAX / 2 + 4, Ordering::Relaxed);
        assert_eq!(Ledger::shared(&path, 0).unwrap().record(), None, "twice that is 6, and there are 6 words");
    }

    #[test]
    fn an_unfinished_commit_leaves_the_previous_record() {
        let ledger = Ledger::private(0);
        ledger.reserve(2).unwrap();
        commit(&ledger, &[1, 1]);
        let died = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            ledger.commit(|store| {
                store.word(&mut 2);
                panic!("during the commit");
            });
        }));
        assert!(died.is_err());
        assert_eq!(ledger.record(), Some(vec![1, 1]));
        commit(&ledger, &[3, 3]);
        assert_eq!(ledger.record(), Some(vec![3, 3]));
    }

    #[test]
    fn only_the_next_generation_discards_the_state() {
        let ledger = Ledger::private(0);
        ledger.enter();
        assert!(!ledger.discards_state());
        ledger.discard_state();
        assert!(!ledger.discards_state());
        ledger.enter();
        assert!(ledger.discards_state());
        ledger.enter();
        assert!(!ledger.discards_state());
    }

    /// A reader that runs beside a writer gets complete records only.
    #[test]
    fn no_reader_sees_parts_of_two_records() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("x.books");
        let (done, seen) = (AtomicBool::new(false), std::sync::atomic::AtomicU64::new(0));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let ledger = Ledger::shared(&path, 0).unwrap();
                ledger.reserve(64).unwrap();
                let mut value = 0;
                while seen.load(Ordering::Relaxed) < 2_000 {
                    value += 1;
                    commit(&ledger, &[value; 64]);
                }
                done.store(true, Ordering::Relaxed);
            });
            let ledger = Ledger::shared(&path, 0).unwrap();
            while !done.load(Ordering::Relaxed) {
                if let Some(record) = ledger.record() {
                    assert!(record.iter().all(|word| *word == record[0]), "{record:?}");
                    seen.fetch_add(1, Ordering::Relaxed);
                }
            }
        });
    }
}
