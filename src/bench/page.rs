//! Shared memory between a sender and a receiver: two mailboxes and two bells, the least that two processes need.
//!
//! Every access is atomic; nobody locks. Must not outlive its domain: the files are two of the domain's.

use crate::shared::{SharedHalves, SharedWords};
use rustix::thread::futex;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};

/// Words of one mailbox with what belongs to it, a multiple of a cache line's.
const BOX_WORDS: usize = 64;
/// Where a mailbox has its number and the samples' words: each on cache lines of its own.
const NUMBER: usize = 0;
const CONTENT: usize = 16;
/// Bells are a cache line apart.
const BELL_STRIDE: usize = 16;

/// The mapped mailboxes and bells.
#[derive(Debug)]
pub(super) struct Page {
    boxes: SharedWords,
    bells: SharedHalves,
}

impl Page {
    /// Maps the mailboxes at a path and the bells beside them, made if they are not there.
    pub fn open(path: &Path) -> io::Result<Self> {
        let mut bells = path.as_os_str().to_owned();
        bells.push("_bells");
        Ok(Self {
            boxes: SharedWords::open(path, 2 * BOX_WORDS)?,
            bells: SharedHalves::open(bells.as_ref(), 2 * BELL_STRIDE)?,
        })
    }

    #[inline]
    fn word(&self, direction: usize, index: usize) -> &AtomicU64 {
        &self.boxes.words()[(direction & 1) * BOX_WORDS + index]
    }

    #[inline]
    fn bell(&self, direction: usize) -> &AtomicU32 {
        &self.bells.halves()[(direction & 1) * BELL_STRIDE]
    }

    /// Puts words into the mailbox of a direction.
    #[inline]
    pub fn put(&self, direction: usize, words: &[u64]) {
        for (index, word) in words.iter().enumerate() {
            self.word(direction, CONTENT + index).store(*word, Ordering::Relaxed);
        }
        self.word(direction, NUMBER).store(words[0], Ordering::Release);
    }

    /// Takes words out, if their first is not `last`; they must be taken before the next are put.
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

    /// Rings the bell of a direction.
    #[inline]
    pub fn ring(&self, direction: usize) -> io::Result<()> {
        let bell = self.bell(direction);
        bell.fetch_add(1, Ordering::Release);
        futex::wake(bell, futex::Flags::empty(), 1)?;
        Ok(())
    }

    /// How often the bell of a direction was rung; to be read before the mailbox is looked into.
    #[inline]
    pub fn rung(&self, direction: usize) -> u32 {
        let rung = self.bell(direction).load(Ordering::Acquire);
        fence(Ordering::SeqCst);
        rung
    }

    /// Waits until the bell was rung more often than `rung`.
    #[inline]
    pub fn wait(&self, direction: usize, rung: u32) {
        let at_most = rustix::time::Timespec { tv_sec: 1, tv_nsec: 0 };
        // Rung meanwhile, interrupted or late: the caller looks again.
        let _ = futex::wait(self.bell(direction), futex::Flags::empty(), rung, Some(&at_most));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_put_is_taken_once() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("page");
        let (here, there) = (Page::open(&path).unwrap(), Page::open(&path).unwrap());
        let mut words = [0; 32];
        assert!(!there.take(0, 0, &mut words));
        here.put(0, &[7; 32]);
        assert!(there.take(0, 0, &mut words) && words == [7; 32]);
        assert!(!there.take(0, 7, &mut words) && !here.take(1, 0, &mut words), "the other direction is another box");
        let before = there.rung(0);
        here.ring(0).unwrap();
        there.wait(0, before);
        assert_eq!(there.rung(0), before + 1);
    }
}
