//! The changes of inputs that a run has received while it runs, shared between its processes.
//!
//! One process appends, in the order of ticks; all others read. Must not know what an input means.

use crate::input::{CHANGE_WORDS, Change};
use crate::shared::SharedWords;
use std::io;
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

/// The most changes that one run receives.
pub const CHANGES_MAX: usize = 4096;
/// The most changes of a scenario.
pub const SCRIPTED_MAX: usize = 256;
/// The first word counts the changes, which follow it.
const WORDS: usize = 1 + CHANGES_MAX * CHANGE_WORDS;

/// The changes that a run has received.
#[derive(Debug, Default)]
pub struct ReceivedChanges(Memory);

#[derive(Debug)]
enum Memory {
    /// Allocated by the first append: most scenarios are only read, or run without changes.
    Private(OnceLock<Box<[AtomicU64]>>),
    Shared(SharedWords),
}

impl Default for Memory {
    fn default() -> Self {
        Self::Private(OnceLock::new())
    }
}

impl ReceivedChanges {
    /// The file name of the list, beside the ledgers of the roles.
    pub const FILE: &'static str = "inputs.changes";
    /// The size of the list in shared memory, bytes.
    pub const BYTES: usize = WORDS * size_of::<u64>();

    /// Opens the list in a file; creates an empty one if the file is missing.
    ///
    /// # Errors
    /// The system's reason.
    pub fn open(path: &Path) -> io::Result<Self> {
        let words = SharedWords::open(path, WORDS)?;
        match words.words().len() {
            WORDS => Ok(Self(Memory::Shared(words))),
            _ => Err(io::Error::other("it is a file of another version")),
        }
    }

    #[inline]
    fn words(&self) -> &[AtomicU64] {
        match &self.0 {
            Memory::Private(words) => words.get().map_or(&[], |words| words),
            Memory::Shared(words) => words.words(),
        }
    }

    fn allocated(&self) -> &[AtomicU64] {
        if let Memory::Private(words) = &self.0 {
            words.get_or_init(|| (0..WORDS).map(|_| AtomicU64::new(0)).collect());
        }
        self.words()
    }

    /// Returns the number of changes.
    #[inline]
    pub fn count(&self) -> usize {
        // Acquire: the words of the counted changes are visible too.
        self.words().first().map_or(0, |count| count.load(Ordering::Acquire) as usize)
    }

    /// Returns the change with this number, counted from 0; `None` beyond the last one, or for words that are no change.
    pub fn get(&self, number: usize) -> Option<Change> {
        let at = (number < self.count().min(CHANGES_MAX)).then_some(1 + number * CHANGE_WORDS)?;
        let words = self.words().get(at..at + CHANGE_WORDS)?;
        Change::from_words(&std::array::from_fn(|word| words[word].load(Ordering::Relaxed)))
    }

    /// Appends changes, all or none: readers see them together. Returns false if they exceed [`CHANGES_MAX`], or if
    /// `publish`, which is called just before they become visible, returns false.
    ///
    /// There is one writer. The ticks must not be before that of the last change.
    pub fn append(&self, changes: &[Change], publish: impl FnOnce() -> bool) -> bool {
        let (words, count) = (self.allocated(), self.count());
        if count.saturating_add(changes.len()) > CHANGES_MAX {
            return false;
        }
        let places = words[1 + count * CHANGE_WORDS..].chunks(CHANGE_WORDS);
        for (place, change) in places.zip(changes) {
            place.iter().zip(change.words()).for_each(|(place, word)| place.store(word, Ordering::Relaxed));
        }
        let published = publish();
        if published {
            words[0].store((count + changes.len()) as u64, Ordering::Release);
        }
        published
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::{COMPONENTS_MAX, Shape};

    fn change(tick: u64) -> Change {
        Change { tick, input: 2, shape: Shape::Ramp { ticks: 5 }, values: [tick as f64; COMPONENTS_MAX] }
    }

    #[test]
    fn readers_see_the_changes_of_one_call_together() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(ReceivedChanges::FILE);
        let writer = ReceivedChanges::open(&path).unwrap();
        let reader = ReceivedChanges::open(&path).unwrap();
        assert!(writer.append(&[change(1)], || true));
        assert!(!writer.append(&[change(7)], || false), "changes that are not published do not count");
        assert!(writer.append(&[change(2), change(2)], || reader.count() == 1));
        assert_eq!(
            (0..4).map(|number| reader.get(number)).collect::<Vec<_>>(),
            [Some(change(1)), Some(change(2)), Some(change(2)), None]
        );
    }

    #[test]
    fn a_full_list_takes_no_more() {
        let list = ReceivedChanges::default();
        assert!(list.append(&vec![change(0); CHANGES_MAX - 1], || true));
        assert!(!list.append(&[change(0); 2], || true) && list.append(&[change(0)], || true));
        assert!(!list.append(&[change(0)], || true));
        assert_eq!(list.count(), CHANGES_MAX);
    }

    /// Words that another program wrote neither panic nor read beyond the end.
    #[test]
    fn any_count_is_harmless() {
        let list = ReceivedChanges::default();
        list.allocated()[0].store(u64::MAX, Ordering::Release);
        assert_eq!(list.get(CHANGES_MAX), None);
        assert_eq!(list.get(usize::MAX / 32), None);
        assert!(!list.append(&[change(0)], || true));
    }
}
