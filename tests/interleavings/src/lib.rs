//! What the memory model allows: the orders in which a reader may see the stores of a writer (loom), for what processes hand
//! over to each other in shared memory. The code is the library's own, with loom's atomics in the place of the processor's.
//! A run fails, too, if it explores so few orders that it could not tell.

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

/// Lets a reader race a writer in every order; `read` tells whether it has got something, which must happen in some.
fn race(write: fn(&[AtomicU64], &[AtomicU64]), read: fn(&[AtomicU64], &[AtomicU64]) -> bool) {
    let counts = std::sync::Arc::new([(); 2].map(|()| AtomicUsize::new(0)));
    let told = counts.clone();
    loom::model(move || {
        let (one, other) = (words(1), words(4));
        let (written, also) = (one.clone(), other.clone());
        let writer = loom::thread::spawn(move || write(&written, &also));
        let got = read(&one, &other);
        writer.join().unwrap();
        told[usize::from(got)].fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    });
    let [nothing, something] = [0, 1].map(|got| counts[got].load(std::sync::atomic::Ordering::Relaxed));
    println!("{nothing} orders in which the reader gets nothing, {something} in which it gets something");
    assert!(nothing > 10 && something > 10, "{nothing} {something}");
}

/// Whoever reads a record while it is replaced, twice so that its own copy is written again, gets one whole.
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

/// Whoever looks for a number finds its words, or nothing.
#[test]
fn what_is_kept_is_found_whole() {
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
