//! Memory for a role's books that survives the role: a process that takes a dead one's seat goes on with its counters.
//!
//! Words are written one by one and never locked: whoever dies in between leaves each of them whole. Must not know what
//! is counted.

use crate::shared::SharedWords;
use rustix::fs::{FlockOperation, flock};
use std::cell::Cell;
use std::io;
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::rc::Rc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Why a ledger could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum LedgerError {
    /// The memory could not be had.
    #[error("cannot keep the books in {}: {source}; is there room in /dev/shm?", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Another process writes in it.
    #[error("{} is held by another process: that seat is taken; end it first", path.display())]
    Taken {
        /// The file.
        path: PathBuf,
    },
    /// The file is there and has another size.
    #[error("{} holds {found} bytes, not {expected}: it was written by another version of this program", path.display())]
    Size {
        /// The file.
        path: PathBuf,
        /// Its size.
        found: u64,
        /// The size of this version's books.
        expected: u64,
    },
}

/// A fixed number of words, handed out in order, and the count of those who have come to write in them.
#[derive(Debug)]
pub struct Ledger {
    memory: Rc<Memory>,
    taken: Cell<usize>,
}

#[derive(Debug)]
enum Memory {
    Private(Box<[AtomicU64]>),
    Shared(SharedWords),
}

impl Memory {
    #[inline]
    fn words(&self) -> &[AtomicU64] {
        match self {
            Self::Private(words) => words,
            Self::Shared(shared) => shared.words(),
        }
    }
}

impl Ledger {
    const GENERATION: usize = 0;
    const FIRST: usize = 1;

    /// A ledger that dies with this process: for runs in one thread.
    pub fn private(words: usize) -> Self {
        Self::over(Memory::Private((0..Self::FIRST + words).map(|_| AtomicU64::new(0)).collect()))
    }

    /// The ledger in a file of shared memory, as it was left, or new and all zero; to be read.
    ///
    /// # Errors
    /// [`LedgerError`].
    pub fn shared(path: &Path, words: usize) -> Result<Self, LedgerError> {
        let words = Self::FIRST + words;
        let shared =
            SharedWords::open(path, words).map_err(|source| LedgerError::Open { path: path.to_owned(), source })?;
        let [found, expected] = [shared.words().len(), words].map(|words| (words * size_of::<u64>()) as u64);
        if found != expected {
            return Err(LedgerError::Size { path: path.to_owned(), found, expected });
        }
        Ok(Self::over(Memory::Shared(shared)))
    }

    /// The same, to be written: there is one writer at a time.
    ///
    /// # Errors
    /// [`LedgerError`].
    pub fn taken(path: &Path, words: usize) -> Result<Self, LedgerError> {
        let ledger = Self::shared(path, words)?;
        match &*ledger.memory {
            Memory::Shared(shared) if flock(shared.file(), FlockOperation::NonBlockingLockExclusive).is_err() => {
                Err(LedgerError::Taken { path: path.to_owned() })
            }
            _ => Ok(ledger),
        }
    }

    fn over(memory: Memory) -> Self {
        Self { memory: Rc::new(memory), taken: Cell::new(Self::FIRST) }
    }

    /// Enters as the next generation of writers, and tells which: 1 for the first.
    pub fn enter(&self) -> u64 {
        self.memory.words()[Self::GENERATION].fetch_add(1, Ordering::Relaxed) + 1
    }

    /// The generation that has entered last; 0 if none has.
    pub fn generation(&self) -> u64 {
        self.memory.words()[Self::GENERATION].load(Ordering::Relaxed)
    }

    /// The same memory, to be taken anew from its beginning.
    pub fn reopened(&self) -> Self {
        Self { memory: self.memory.clone(), taken: Cell::new(Self::FIRST) }
    }

    /// The next `count` words. Whoever takes in the same order finds the same words again.
    ///
    /// # Panics
    /// If the ledger has no more: its size is computed from the same list of books that are opened in it.
    pub fn take(&self, count: usize) -> Words {
        let begin = self.taken.replace(self.taken.get() + count);
        let words = self.memory.words().get(begin..begin + count).expect("the ledger is sized for all of its books");
        Words { words: words.into(), _memory: self.memory.clone() }
    }
}

/// Some words of a ledger.
#[derive(Debug)]
pub struct Words {
    /// Looked up once: the books are written many times in every tick.
    words: NonNull<[AtomicU64]>,
    /// What keeps them.
    _memory: Rc<Memory>,
}

impl Words {
    #[inline]
    #[allow(unsafe_code)]
    fn words(&self) -> &[AtomicU64] {
        // SAFETY: the words lie in `_memory`, which is neither moved nor freed nor written but through atomics as long as
        // `self` lives.
        unsafe { self.words.as_ref() }
    }

    /// One word.
    #[inline]
    pub fn get(&self, index: usize) -> u64 {
        self.words()[index].load(Ordering::Relaxed)
    }

    /// Writes one word; what was written before is seen before, by whoever outlives this process.
    #[inline]
    pub fn set(&self, index: usize, value: u64) {
        self.words()[index].store(value, Ordering::Release);
    }

    /// Writes words in order, from `begin` on.
    #[inline]
    pub fn set_all(&self, begin: usize, values: &[u64]) {
        for (word, value) in self.words()[begin..][..values.len()].iter().zip(values) {
            word.store(*value, Ordering::Release);
        }
    }

    /// Adds to one word. There is one writer.
    #[inline]
    pub fn add(&self, index: usize, amount: u64) {
        self.set(index, self.get(index).wrapping_add(amount));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whoever_opens_it_again_finds_what_was_written() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("books");
        let (first, second) = (Ledger::shared(&path, 5).unwrap(), Ledger::shared(&path, 5).unwrap());
        assert_eq!((first.enter(), second.enter(), first.generation()), (1, 2, 2));
        let (_, ours) = (first.take(2), first.take(3));
        let (_, theirs) = (second.take(2), second.take(3));
        ours.set(2, 7);
        ours.add(2, 1);
        assert_eq!((theirs.get(2), theirs.get(0)), (8, 0));
        let writer = Ledger::taken(&path, 5).unwrap();
        assert!(matches!(Ledger::taken(&path, 5), Err(LedgerError::Taken { .. })));
        drop(writer);
        Ledger::taken(&path, 5).unwrap();
        drop((first, ours));
        assert_eq!(theirs.get(2), 8);
        assert!(matches!(Ledger::shared(&path, 6), Err(LedgerError::Size { found: 48, expected: 56, .. })));
        assert!(matches!(Ledger::shared(directory.path(), 6), Err(LedgerError::Open { .. })));
    }
}
