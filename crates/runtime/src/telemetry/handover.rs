//! Shared words that one process writes while others read them, possibly after the writer has died. A reader gets either the
//! whole content or nothing.
//!
//! There is one writer at a time. `tests/interleavings` explores every order in which another processor may see its stores;
//! it replaces `super::atomic`. This module does not know what the words mean or where they are stored.

use super::atomic::{AtomicU64, Ordering, fence};

/// Returns the copy of a record that is current after `commits` commits; the last of these commits writes it.
#[inline]
fn copy(copies: &[AtomicU64], commits: u64) -> &[AtomicU64] {
    let (even, odd) = copies.split_at(copies.len() / 2);
    if commits.is_multiple_of(2) { even } else { odd }
}

/// Writes the copy that is not current and makes it current with one store. `next` numbers the commit, counted from 1.
#[inline]
pub fn commit(commits: &AtomicU64, next: u64, copies: &[AtomicU64], write: impl FnOnce(&[AtomicU64])) {
    // A reader may still read the copy that is written now. The count must show it that the copy was replaced, so the store of
    // the last commit must not become visible after the stores of this one.
    fence(Ordering::Release);
    write(copy(copies, next));
    // A reader that sees the count sees the copy.
    commits.store(next, Ordering::Release);
}

/// Copies the last committed record. Returns `None` before the first commit, or if every try met a concurrent commit.
pub fn record(commits: &AtomicU64, copies: &[AtomicU64], tries: usize) -> Option<Vec<u64>> {
    for _ in 0..tries {
        let seen = commits.load(Ordering::Acquire);
        if seen == 0 {
            return None;
        }
        let words = copy(copies, seen).iter().map(|word| word.load(Ordering::Relaxed)).collect();
        fence(Ordering::Acquire);
        if commits.load(Ordering::Relaxed) == seen {
            return Some(words);
        }
    }
    None
}

/// Replaces the words in `place` and tags them with `number`. The first word is `number + 1`, or 0 while the others are written.
#[inline]
pub fn keep(place: &[AtomicU64], number: u64, words: impl Iterator<Item = u64>) {
    let Some((mark, kept)) = place.split_first() else { return };
    mark.store(0, Ordering::Relaxed);
    // A reader that sees one of the stores below also sees that the mark is 0.
    fence(Ordering::Release);
    kept.iter().zip(words).for_each(|(kept, word)| kept.store(word, Ordering::Relaxed));
    // A reader that sees the mark sees the words.
    mark.store(number + 1, Ordering::Release);
}

/// Copies the words tagged with `number`. Returns false if they are absent; `words` is then undefined.
pub fn find(place: &[AtomicU64], number: u64, words: &mut [u64]) -> bool {
    let Some((mark, kept)) = place.split_first() else { return false };
    if mark.load(Ordering::Acquire) != number + 1 {
        return false;
    }
    kept.iter().zip(words).for_each(|(kept, word)| *word = kept.load(Ordering::Relaxed));
    fence(Ordering::Acquire);
    mark.load(Ordering::Relaxed) == number + 1
}
