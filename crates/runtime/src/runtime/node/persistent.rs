//! The persistent state of a node: committed to its ledger and restored from it.

use crate::runtime::hooks::{self, Failpoint};
use crate::state::{StoredWords, WordCount, Words};
use crate::telemetry::{Ledger, LedgerError};

/// A node with persistent state.
pub(super) trait Persistent {
    /// Returns the ledger.
    fn ledger(&self) -> &Ledger;
    /// Passes the counters and the staged samples, in the order of the role's [`Ports`](super::Ports); see
    /// [`report`](crate::runtime::report).
    fn counters<W: Words>(&mut self, words: &mut W);
    /// Passes the rest of the state.
    fn state<W: Words>(&mut self, words: &mut W);

    fn pass<W: Words>(&mut self, words: &mut W) {
        self.counters(words);
        self.state(words);
    }
}

/// Commits the state of a node if a successor may continue from it.
#[inline]
pub(super) fn commit(node: &mut impl Persistent) {
    if node.ledger().is_shared() {
        let ledger = node.ledger().reopened();
        hooks::at(Failpoint::Committing);
        ledger.commit(|store| {
            node.counters(store);
            hooks::at(Failpoint::InCommit);
            node.state(store);
        });
        hooks::at(Failpoint::Committed);
    }
}

/// Commits the state of a node for the last time, also in private memory.
pub(super) fn commit_last(node: &mut impl Persistent) {
    let ledger = node.ledger().reopened();
    // Private memory is always available; shared memory was reserved before the first tick.
    if ledger.reserve(length(node)).is_ok() {
        ledger.commit(|store| node.pass(store));
    }
}

pub(super) fn length(node: &mut impl Persistent) -> usize {
    let mut count = WordCount::default();
    node.pass(&mut count);
    count.0
}

/// The state that a node takes from its predecessor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Inherited {
    /// No predecessor, or one that committed nothing.
    Nothing,
    /// The counters only: the state is not trusted.
    Counters,
    /// Counters and state.
    All,
}

/// Restores the state that a predecessor committed.
pub(super) fn restore(node: &mut impl Persistent) -> Result<Inherited, LedgerError> {
    let ledger = node.ledger().reopened();
    ledger.reserve(length(node))?;
    let Some(record) = ledger.record() else { return Ok(Inherited::Nothing) };
    let mut words = StoredWords(&record);
    node.counters(&mut words);
    if ledger.discards_state() {
        return Ok(Inherited::Counters);
    }
    node.state(&mut words);
    Ok(Inherited::All)
}
