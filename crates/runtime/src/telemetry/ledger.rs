//! A role's persistent state: shared memory that survives the process which writes it, so that another one continues.
//!
//! There is one record, kept twice. A commit writes the copy that is not current and makes it current by a single store, so
//! whoever looks, and whenever the writer dies, there is one whole record. Must not know what is in it.

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

/// Why a ledger could not be opened.
#[derive(Debug, thiserror::Error, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum LedgerError {
    /// The memory could not be had.
    #[error("cannot keep the state in {}: {source}; {}", path.display(), remedy(source))]
    #[strum(serialize = "cannot-keep-state")]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Another process writes in it.
    #[error("{} is held by another process: that seat is taken; end it first", path.display())]
    #[strum(serialize = "seat-taken")]
    Taken {
        /// The file.
        path: PathBuf,
    },
    /// The file is there and has another size.
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

/// A role's persistent state: the record, some words beside it that are written on their own, and the count of the
/// processes that have written.
#[derive(Debug)]
pub struct Ledger {
    memory: Rc<Memory>,
    taken: Cell<usize>,
}

#[derive(Debug)]
struct Memory {
    words: Storage,
    /// Where the words are, unless they die with this process.
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

    /// The words in a file, as many as these.
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
    /// How many processes have entered.
    const GENERATION: usize = 0;
    /// How many commits there were; the lowest bit tells which copy is current.
    const COMMITS: usize = 1;
    /// How long the record is, words.
    const LENGTH: usize = 2;
    /// The generation that is to begin without its predecessor's state; 0 if none is.
    const ANEW: usize = 3;
    const FIRST: usize = 4;
    /// How often a reader tries to read a record that is written meanwhile.
    const TRIES: usize = 1000;

    /// A ledger that dies with this process: for runs in one thread.
    pub fn private(words: usize) -> Self {
        Self::over(Storage::private(Self::FIRST + words), None)
    }

    /// The ledger in a file of shared memory, as it was left, or new and all zero; to be read.
    ///
    /// # Errors
    /// [`LedgerError`].
    pub fn shared(path: &Path, words: usize) -> Result<Self, LedgerError> {
        Ok(Self::over(Storage::shared(path, Self::FIRST + words)?, Some(path.to_owned())))
    }

    /// The same, to be written: there is one writer at a time.
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

    /// Enters as the next generation of writers, and tells which: 1 for the first.
    pub fn enter(&self) -> u64 {
        self.word(Self::GENERATION).fetch_add(1, Ordering::Relaxed) + 1
    }

    /// The generation that has entered last; 0 if none has.
    pub fn generation(&self) -> u64 {
        self.word(Self::GENERATION).load(Ordering::Relaxed)
    }

    /// Lets the next generation keep the counters and nothing else: the state may be what its predecessors died of.
    pub fn discard_state(&self) {
        self.word(Self::ANEW).store(self.generation() + 1, Ordering::Relaxed);
    }

    /// Whether the present generation is to begin without its predecessor's state.
    pub fn discards_state(&self) -> bool {
        self.word(Self::ANEW).load(Ordering::Relaxed) == self.generation()
    }

    /// The same memory, to be taken anew from its beginning.
    pub fn reopened(&self) -> Self {
        Self { memory: self.memory.clone(), taken: Cell::new(Self::FIRST) }
    }

    /// The next `count` words beside the record. Whoever takes in the same order finds the same words again.
    ///
    /// # Panics
    /// If the ledger has no more: its size is computed from the same list of what is kept in it.
    pub fn take(&self, count: usize) -> Slots {
        let begin = self.taken.replace(self.taken.get() + count);
        let words =
            self.memory.words.words().get(begin..begin + count).expect("the ledger is sized for all that it has");
        Slots { words: words.into(), _memory: self.memory.clone() }
    }

    /// Where it is, unless it dies with this process.
    pub fn path(&self) -> Option<&Path> {
        self.memory.path.as_deref()
    }

    /// Whether another process may have to continue from here: whoever writes commits every tick.
    #[inline]
    pub fn is_shared(&self) -> bool {
        self.memory.path.is_some()
    }

    /// Makes room for a record of so many words, or opens the one that is there.
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

    /// The record that is there, for whoever only reads: whatever its length is said to be, nothing is made.
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

    /// Writes a record and makes it current. Before, room must have been [reserved](Self::reserve) for as many words as
    /// `write` passes.
    #[inline]
    pub fn commit(&self, write: impl FnOnce(&mut Store<'_>)) {
        let Some(record) = self.memory.record.get() else { return };
        let commits = self.word(Self::COMMITS);
        handover::commit(commits, commits.load(Ordering::Relaxed) + 1, record.words(), |words| {
            let mut store = Store { words, at: 0 };
            write(&mut store);
            debug_assert_eq!(store.at, words.len(), "a state always takes as many words");
        });
    }

    /// The last record that was committed; none before the first, or where none can be read.
    pub fn record(&self) -> Option<Vec<u64>> {
        let record = self.open_record()?;
        handover::record(self.word(Self::COMMITS), record.words(), Self::TRIES)
    }
}

/// Writes a state into a record.
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

/// Some words of a ledger beside its record, each written whole and on its own.
#[derive(Debug)]
pub struct Slots {
    /// Looked up once: some are written in every tick.
    words: NonNull<[AtomicU64]>,
    /// What keeps them.
    _memory: Rc<Memory>,
}

impl Slots {
    /// All of them.
    #[inline]
    #[allow(unsafe_code)]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        // SAFETY: the words lie in `_memory`, which is neither moved nor freed nor written but through atomics as long as
        // `self` lives.
        unsafe { self.words.as_ref() }
    }

    /// One word.
    #[inline]
    pub fn get(&self, index: usize) -> u64 {
        self.words()[index].load(Ordering::Relaxed)
    }

    /// Writes one word. A commit that follows is not seen before it.
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
    fn whoever_opens_it_again_finds_what_was_committed_last() {
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
    fn whoever_only_reads_makes_nothing_whatever_is_in_the_file() {
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
    fn a_commit_that_was_not_finished_leaves_the_one_before() {
        let ledger = Ledger::private(0);
        ledger.reserve(2).unwrap();
        commit(&ledger, &[1, 1]);
        let died = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            ledger.commit(|store| {
                store.word(&mut 2);
                panic!("in the midst of it");
            });
        }));
        assert!(died.is_err());
        assert_eq!(ledger.record(), Some(vec![1, 1]));
        commit(&ledger, &[3, 3]);
        assert_eq!(ledger.record(), Some(vec![3, 3]));
    }

    #[test]
    fn only_the_generation_that_follows_is_distrusted() {
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

    /// Whoever reads while somebody writes gets one record whole.
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
