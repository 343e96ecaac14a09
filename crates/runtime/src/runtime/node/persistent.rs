//! The part of a node that outlives its process: committed to its ledger, and restored from there.

use crate::runtime::hooks::{self, Failpoint};
use crate::state::{Count, Restore, Words};
use crate::telemetry::{Ledger, LedgerError};

/// What of a node outlives its process.
pub(super) trait Persistent {
    /// Where it is kept.
    fn ledger(&self) -> &Ledger;
    /// Passes the counters, and what is committed to be sent, in the order of the role's [`Ports`](super::Ports); see
    /// [`report`](crate::runtime::report).
    fn counters<W: Words>(&mut self, words: &mut W);
    /// Passes everything else.
    fn state<W: Words>(&mut self, words: &mut W);

    fn pass<W: Words>(&mut self, words: &mut W) {
        self.counters(words);
        self.state(words);
    }
}

/// Commits the state of a node, where another process may have to continue from it.
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

/// Commits the state of a node for the last time, wherever it is kept.
pub(super) fn commit_last(node: &mut impl Persistent) {
    let ledger = node.ledger().reopened();
    // Room in private memory can always be had, and that in shared memory was taken before the first tick.
    if ledger.reserve(length(node)).is_ok() {
        ledger.commit(|store| node.pass(store));
    }
}

pub(super) fn length(node: &mut impl Persistent) -> usize {
    let mut count = Count::default();
    node.pass(&mut count);
    count.0
}

/// What a node has of its predecessor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Inherited {
    /// There was none, or it had not begun.
    Nothing,
    /// The counters alone: the state is not trusted.
    Counters,
    /// All.
    All,
}

/// Reads what a predecessor committed.
pub(super) fn restore(node: &mut impl Persistent) -> Result<Inherited, LedgerError> {
    let ledger = node.ledger().reopened();
    ledger.reserve(length(node))?;
    let Some(record) = ledger.record() else { return Ok(Inherited::Nothing) };
    let mut words = Restore(&record);
    node.counters(&mut words);
    if ledger.discards_state() {
        return Ok(Inherited::Counters);
    }
    node.state(&mut words);
    Ok(Inherited::All)
}
