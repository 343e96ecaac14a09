//! The changes of inputs that a run receives while it runs, carried from the launching host to the others.
//!
//! The launching host repeats what a host has not asked to follow, so a lost message costs time only. Must not decide when a change acts.

use crate::changes::ReceivedChanges;
use crate::input::{CHANGE_WORDS, Change};
use std::sync::Arc;

/// The most changes of one message.
const MESSAGE_MAX: u64 = 64;

/// The list of changes in the shared memory of this host: the launcher writes that of the launching host, the relay those of the others.
pub struct SharedChanges {
    list: Arc<ReceivedChanges>,
    /// Per host, the number of the next change that it needs.
    next: Vec<u64>,
    /// The number of changes at the last call of [`grew`](Self::grew).
    seen: u64,
}

impl SharedChanges {
    pub fn new(list: Arc<ReceivedChanges>, hosts: usize) -> Self {
        Self { list, next: vec![0; hosts], seen: 0 }
    }

    /// Returns the number of changes on this host.
    pub fn count(&self) -> u64 {
        self.list.count() as u64
    }

    /// Returns true if the list has grown since the last call.
    pub fn grew(&mut self) -> bool {
        let count = self.count();
        std::mem::replace(&mut self.seen, count) < count
    }

    /// Notes that a host needs the changes from this number on. An older request may arrive after a newer one.
    pub fn requested(&mut self, host: u8, next: u64) {
        let own = &mut self.next[usize::from(host)];
        *own = next.min(self.list.count() as u64).max(*own);
    }

    /// Returns the next changes that a host needs: the number of the first one, and their words.
    pub fn wanted_by(&self, host: u8) -> Option<(u64, Vec<u64>)> {
        let first = self.next[usize::from(host)];
        let numbers = first..self.count().min(first + MESSAGE_MAX);
        let words: Vec<u64> =
            numbers.filter_map(|number| self.list.get(number as usize)).flat_map(|change| change.words()).collect();
        (!words.is_empty()).then_some((first, words))
    }

    /// Appends the changes of a message that are not in the list yet. Returns the number of the next change that is needed.
    pub fn take(&self, first: u64, bytes: &[u8]) -> u64 {
        let (changes, rest) = bytes.as_chunks::<{ CHANGE_WORDS * size_of::<u64>() }>();
        let known = self.count().checked_sub(first).filter(|_| rest.is_empty());
        for bytes in changes.iter().skip(known.map_or(usize::MAX, |known| known as usize)) {
            let words: [u64; CHANGE_WORDS] = bytemuck::pod_read_unaligned(bytes);
            // A malformed change ends the message: later ones must keep their numbers.
            let Some(change) = Change::from_words(&words) else { break };
            if !self.list.append(&[change], || true) {
                break;
            }
        }
        self.count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::{COMPONENTS_MAX, Shape};

    fn change(tick: u64) -> Change {
        Change { tick, input: 1, shape: Shape::Step, values: [tick as f64; COMPONENTS_MAX] }
    }

    fn shared() -> SharedChanges {
        SharedChanges::new(Arc::default(), 2)
    }

    #[test]
    fn changes_arrive_once_and_in_order_whatever_is_lost_or_repeated() {
        let (mut hub, joined) = (shared(), shared());
        for tick in 0..200 {
            assert!(hub.list.append(&[change(tick)], || true) && hub.grew() && !hub.grew());
        }
        let (first, late) = hub.wanted_by(1).unwrap();
        assert_eq!((first, late.len()), (0, 64 * CHANGE_WORDS));
        while let Some((first, words)) = hub.wanted_by(1) {
            let next = joined.take(first, bytemuck::cast_slice(&words));
            assert_eq!(joined.take(first, bytemuck::cast_slice(&words)), next, "a message that arrives twice");
            assert_eq!(joined.take(next + 1, bytemuck::cast_slice(&words)), next, "after a lost message");
            hub.requested(1, next);
        }
        assert_eq!(joined.take(0, bytemuck::cast_slice(&late)), 200, "a message that arrives late");
        hub.requested(1, 3);
        assert_eq!((hub.wanted_by(1), joined.count()), (None, 200), "an old request changes nothing");
        assert!((0..200).all(|number| joined.list.get(number) == Some(change(number as u64))));
    }

    #[test]
    fn a_malformed_message_appends_nothing() {
        let joined = shared();
        let words = change(3).words();
        let bytes: &[u8] = bytemuck::cast_slice(&words);
        for (first, bytes) in [(0, &bytes[1..]), (1, bytes), (u64::MAX, bytes), (0, &[0xff; CHANGE_WORDS * 8][..])] {
            assert_eq!(joined.take(first, bytes), 0);
        }
        let mut hub = shared();
        hub.requested(1, u64::MAX);
        assert_eq!(hub.wanted_by(1), None);
        assert_eq!(joined.take(0, bytes), 1);
    }
}
