//! Shared memory between a sender and a receiver: two mailboxes and two futexes, the minimum for two processes.
//!
//! Every access is atomic, without locks. Must not outlive its domain, to which its two files belong.

use crate::shared::{SharedHalves, SharedWords};
use rustix::thread::futex;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};

/// Words of one mailbox with its number, a multiple of a cache line.
const BOX_WORDS: usize = 64;
/// Offsets of a mailbox's number and of the sample's words, on separate cache lines.
const NUMBER: usize = 0;
const CONTENT: usize = 16;
/// The distance between futexes, half words: one cache line.
const FUTEX_STRIDE: usize = 16;

/// The mapped mailboxes and futexes.
#[derive(Debug)]
pub(super) struct Page {
    boxes: SharedWords,
    futexes: SharedHalves,
}

impl Page {
    /// Maps the mailboxes at a path and the futexes beside them; creates missing files.
    pub fn open(path: &Path) -> io::Result<Self> {
        let mut futexes = path.as_os_str().to_owned();
        futexes.push("_bells");
        Ok(Self {
            boxes: SharedWords::open(path, 2 * BOX_WORDS)?,
            futexes: SharedHalves::open(futexes.as_ref(), 2 * FUTEX_STRIDE)?,
        })
    }

    #[inline]
    fn word(&self, direction: usize, index: usize) -> &AtomicU64 {
        &self.boxes.words()[(direction & 1) * BOX_WORDS + index]
    }

    #[inline]
    fn futex(&self, direction: usize) -> &AtomicU32 {
        &self.futexes.halves()[(direction & 1) * FUTEX_STRIDE]
    }

    /// Puts words into the mailbox of a direction.
    #[inline]
    pub fn put(&self, direction: usize, words: &[u64]) {
        for (index, word) in words.iter().enumerate() {
            self.word(direction, CONTENT + index).store(*word, Ordering::Relaxed);
        }
        self.word(direction, NUMBER).store(words[0], Ordering::Release);
    }

    /// Takes the words, if their first is not `last`; they must be taken before the next are put.
    #[inline]
    pub fn take(&self, direction: usize, last: u64, words: &mut [u64]) -> bool {
        if self.word(direction, NUMBER).load(Ordering::Acquire) == last {
            return false;
        }
        for (index, word) in words.iter_mut().enumerate() {
            *word = self.word(direction, CONTENT + index).load(Ordering::Relaxed);
        }
        true
    }

    /// Notifies the futex of a direction.
    #[inline]
    pub fn notify(&self, direction: usize) -> io::Result<()> {
        let futex = self.futex(direction);
        futex.fetch_add(1, Ordering::Release);
        futex::wake(futex, futex::Flags::empty(), 1)?;
        Ok(())
    }

    /// Returns the number of notifications of a direction's futex; call it before reading the mailbox.
    #[inline]
    pub fn notified(&self, direction: usize) -> u32 {
        let notified = self.futex(direction).load(Ordering::Acquire);
        fence(Ordering::SeqCst);
        notified
    }

    /// Waits until the futex was notified more often than `notified`.
    #[inline]
    pub fn wait(&self, direction: usize, notified: u32) {
        let timeout = rustix::time::Timespec { tv_sec: 1, tv_nsec: 0 };
        // After a notification, an interruption or the timeout, the caller reads the mailbox again.
        let _ = futex::wait(self.futex(direction), futex::Flags::empty(), notified, Some(&timeout));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_taken_once() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("page");
        let (here, there) = (Page::open(&path).unwrap(), Page::open(&path).unwrap());
        let mut words = [0; 32];
        assert!(!there.take(0, 0, &mut words));
        here.put(0, &[7; 32]);
        assert!(there.take(0, 0, &mut words) && words == [7; 32]);
        assert!(!there.take(0, 7, &mut words) && !here.take(1, 0, &mut words), "the other direction is another box");
        let before = there.notified(0);
        here.notify(0).unwrap();
        there.wait(0, before);
        assert_eq!(there.notified(0), before + 1);
    }
}
