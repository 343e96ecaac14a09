//! How words of shared memory are read while they are written, or after their writer has died: whole, or not at all.
//!
//! There is one writer at a time. `tests/interleavings` explores every order in which another processor may see its stores,
//! with other atomics in the place of `super::atomic`. Must not know what the words mean, nor where they are.

use super::atomic::{AtomicU64, Ordering, fence};

/// Of two copies of a record the one that is current after so many commits, or is written by the last of them.
#[inline]
fn copy(copies: &[AtomicU64], commits: u64) -> &[AtomicU64] {
    let (even, odd) = copies.split_at(copies.len() / 2);
    if commits.is_multiple_of(2) { even } else { odd }
}

/// Writes the copy that is not current, and makes it current by a single store: the `next` commit, counted from 1.
#[inline]
pub fn commit(commits: &AtomicU64, next: u64, copies: &[AtomicU64], write: impl FnOnce(&[AtomicU64])) {
    // Readers that still read the copy which is written now must see by the count that it was replaced: the store of the last
    // commit is not to be seen after the stores of this one.
    fence(Ordering::Release);
    write(copy(copies, next));
    // Whoever sees the count sees the copy.
    commits.store(next, Ordering::Release);
}

/// Copies the record that was committed last; none before the first, and none if there were others meanwhile at every try.
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

/// Writes words in the place of others, with their number: first the number + 1, or 0 while they are written.
#[inline]
pub fn keep(place: &[AtomicU64], number: u64, words: impl Iterator<Item = u64>) {
    let Some((mark, kept)) = place.split_first() else { return };
    mark.store(0, Ordering::Relaxed);
    // Whoever sees one of the words that follow sees that those before are gone.
    fence(Ordering::Release);
    kept.iter().zip(words).for_each(|(kept, word)| kept.store(word, Ordering::Relaxed));
    // Whoever sees the number sees the words.
    mark.store(number + 1, Ordering::Release);
}

/// Copies the words of this number; false if they are not there, and then what was copied is of no use.
pub fn find(place: &[AtomicU64], number: u64, words: &mut [u64]) -> bool {
    let Some((mark, kept)) = place.split_first() else { return false };
    if mark.load(Ordering::Acquire) != number + 1 {
        return false;
    }
    kept.iter().zip(words).for_each(|(kept, word)| *word = kept.load(Ordering::Relaxed));
    fence(Ordering::Acquire);
    mark.load(Ordering::Relaxed) == number + 1
}
