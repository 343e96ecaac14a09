//! What the memory model allows: every order in which a reader may see the stores of a writer (loom), for what processes hand
//! over to each other in shared memory. The code is the library's own, with loom's atomics in the place of the processor's.

#![cfg(test)]

mod atomic {
    pub use loom::sync::atomic::{AtomicU64, Ordering, fence};
}
#[path = "../../../src/telemetry/handover.rs"]
mod handover;

use atomic::{AtomicU64, Ordering};
use loom::sync::Arc;

fn words(count: usize) -> Arc<Vec<AtomicU64>> {
    Arc::new((0..count).map(|_| AtomicU64::new(0)).collect())
}

/// Whoever reads a record while it is replaced, twice so that its own copy is written again, gets one whole.
#[test]
fn a_record_is_read_whole() {
    loom::model(|| {
        let (commits, copies) = (words(1), words(4));
        let (written, copied) = (commits.clone(), copies.clone());
        let writer = loom::thread::spawn(move || {
            for value in 1..=3 {
                handover::commit(&written[0], &copied, |words| {
                    words.iter().for_each(|word| word.store(value, Ordering::Relaxed));
                });
            }
        });
        if let Some(record) = handover::record(&commits[0], &copies, 1) {
            assert!(record[0] == record[1] && record[0] > 0, "{record:?}");
        }
        writer.join().unwrap();
        assert_eq!(handover::record(&commits[0], &copies, 1), Some(vec![3, 3]));
    });
}

/// Whoever looks for a number finds its words, or nothing.
#[test]
fn what_is_kept_is_found_whole() {
    for number in [0, 1] {
        loom::model(move || {
            let place = words(3);
            let kept = place.clone();
            let writer = loom::thread::spawn(move || {
                for number in 0..2 {
                    handover::keep(&kept, number, [10 + number; 2].into_iter());
                }
            });
            let mut found = [0; 2];
            if handover::find(&place, number, &mut found) {
                assert_eq!(found, [10 + number; 2]);
            }
            writer.join().unwrap();
            assert_eq!(handover::find(&place, 1, &mut found), true);
        });
    }
}
