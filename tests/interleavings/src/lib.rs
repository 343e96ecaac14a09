//! Model checks (loom) of the data that processes exchange in shared memory: all orders in which a reader may see the
//! stores of a writer. The code is the library's own, with loom's atomics instead of the processor's. A check also
//! fails if it explores too few orders to be meaningful.

#![cfg(test)]

mod atomic {
    pub use loom::sync::atomic::{AtomicU64, Ordering, fence};
}
#[path = "../../../crates/runtime/src/telemetry/handover.rs"]
mod handover;

use atomic::{AtomicU64, Ordering};
use loom::sync::Arc;
use std::sync::atomic::AtomicUsize;

fn words(count: usize) -> Arc<Vec<AtomicU64>> {
    Arc::new((0..count).map(|_| AtomicU64::new(0)).collect())
}

/// Runs a reader against a writer in every order. `read` returns true if it found data, which must happen in some
/// orders.
fn race(write: fn(&[AtomicU64], &[AtomicU64]), read: fn(&[AtomicU64], &[AtomicU64]) -> bool) {
    let counts = std::sync::Arc::new([(); 2].map(|()| AtomicUsize::new(0)));
    let outcomes = counts.clone();
    loom::model(move || {
        let (word, copies) = (words(1), words(4));
        let (written_word, written_copies) = (word.clone(), copies.clone());
        let writer = loom::thread::spawn(move || write(&written_word, &written_copies));
        let got = read(&word, &copies);
        writer.join().unwrap();
        outcomes[usize::from(got)].fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    });
    let [nothing, something] = [0, 1].map(|got| counts[got].load(std::sync::atomic::Ordering::Relaxed));
    println!("{nothing} orders in which the reader finds nothing, {something} in which it finds data");
    assert!(nothing > 10 && something > 10, "{nothing} {something}");
}

/// A reader gets a whole record while it is replaced, twice so that the reader's own copy is overwritten.
#[test]
fn a_record_is_read_whole() {
    let write: fn(&[AtomicU64], &[AtomicU64]) = |commits, copies| {
        for value in 1..=3 {
            handover::commit(&commits[0], value, copies, |words| {
                words.iter().for_each(|word| word.store(value, Ordering::Relaxed));
            });
        }
    };
    race(write, |commits, copies| {
        let record = handover::record(&commits[0], copies, 1);
        record.is_some_and(|record| {
            assert!(record[0] == record[1] && record[0] > 0, "{record:?}");
            true
        })
    });
}

/// A reader finds all words of a number, or nothing.
#[test]
fn stored_words_are_found_whole() {
    let write: fn(&[AtomicU64], &[AtomicU64]) = |_, place| {
        for number in 0..2 {
            handover::keep(&place[..3], number, [10 + number; 2].into_iter());
        }
    };
    race(write, |_, place| {
        let mut found = [0; 2];
        let is_found = handover::find(&place[..3], 0, &mut found);
        assert!(!is_found || found == [10; 2], "{found:?}");
        is_found
    });
}
