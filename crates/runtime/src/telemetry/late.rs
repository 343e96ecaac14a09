//! Late ticks of a role, one record each, in its ledger: the launcher and the tracing process read them while the role runs, and
//! after its death.
//!
//! Must not judge: it keeps instants and counters, and others find the cause.

use super::ledger::{Ledger, Slots};
use crate::state::{Persist, StoredWords, Words, persist_fields};
use serde::{Deserialize, Serialize};
use std::sync::atomic::{Ordering, fence};

/// The number of records that all roles of a run keep together, and bounds on that of one. Further late ticks are only counted.
const RUN_CAPACITY: usize = 16_384;
const CAPACITY: std::ops::RangeInclusive<usize> = 256..=4096;
/// The word with the thread, and the first one of the records; the word before them counts the records.
const THREAD: usize = 1;
const FIRST: usize = 2;

/// A late tick, or several missed ones in a row. All numbers are 64 bits wide, as the ledger keeps them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct LateRecord {
    /// The tick; the first one of several.
    pub tick: u64,
    /// The number of missed ticks; 0 if it was executed late or without an input.
    pub missed: u64,
    /// True if it was executed without a due input.
    pub starved: bool,
    /// True if a scripted fault stalled the role before it.
    pub stalled: bool,
    /// True if a signal had stopped the process since the record before.
    pub continued: bool,
    /// The thread.
    pub tid: u64,
    /// The sender of the input that came last or was absent, as [`RoleId::number`](crate::runtime::RoleId::number); otherwise 0.
    pub sender: u64,
    /// The due time, ns.
    pub due_ns: u64,
    /// The time at which that input was sent, ns; 0 without an input.
    pub input_ns: u64,
    /// The time from which the role had all that it needs, ns: a body at its look at the clock, another role with its last input.
    pub began_ns: u64,
    /// The time of the sample, ns; of a missed tick, the time at which the role noticed it.
    pub done_ns: u64,
    /// True if the thread slept until a time shortly before the tick, and was not seen awake before its inputs were there.
    pub slept: bool,
    /// The longest time between two looks at the clock while the role spun before the tick, ns.
    pub gap_ns: u64,
    /// The end of that time, ns.
    pub gap_end_ns: u64,
    /// The counters of the thread since `since_ns`.
    pub usage: Usage,
    /// The time of the earlier reading of the counters, ns.
    pub since_ns: u64,
}

/// Counters of a thread.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Usage {
    /// Time for which it could run and waited for a core, ns.
    pub run_delay_ns: u64,
    /// The part of that time which is usual for the thread, ns.
    pub usual_delay_ns: u64,
    /// Page faults without input or output.
    pub minor_faults: u64,
    /// Page faults with input or output.
    pub major_faults: u64,
    /// Switches to another task while it could run.
    pub preemptions: u64,
    /// Time for which the limit of a cgroup stopped its tasks, ns.
    pub throttled_ns: u64,
}

impl Usage {
    /// Returns the growth since an earlier reading.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        Self {
            run_delay_ns: self.run_delay_ns.saturating_sub(earlier.run_delay_ns),
            usual_delay_ns: self.usual_delay_ns.saturating_sub(earlier.usual_delay_ns),
            minor_faults: self.minor_faults.saturating_sub(earlier.minor_faults),
            major_faults: self.major_faults.saturating_sub(earlier.major_faults),
            preemptions: self.preemptions.saturating_sub(earlier.preemptions),
            throttled_ns: self.throttled_ns.saturating_sub(earlier.throttled_ns),
        }
    }
}

persist_fields!(Usage, run_delay_ns, usual_delay_ns, minor_faults, major_faults, preemptions, throttled_ns);
persist_fields!(
    LateRecord, tick, missed, starved, stalled, continued, tid, sender, due_ns, input_ns, began_ns, done_ns, slept,
    gap_ns, gap_end_ns, usage, since_ns
);

/// The late ticks that a node has counted since it started, and its last one. The driver compares the numbers with earlier ones.
#[derive(Debug, Clone, Copy, Default)]
pub struct LateTicks {
    /// The number of missed ticks.
    pub missed: u64,
    /// The tick after the last missed one.
    pub missed_end: u64,
    /// The number of ticks executed late or without an input.
    pub executed: u64,
    /// The last of those.
    pub last: LateRecord,
}

/// The records of a role's late ticks in its ledger.
#[derive(Debug)]
pub struct LateLog {
    slots: Slots,
    capacity: usize,
}

impl LateLog {
    fn capacity(roles: usize) -> usize {
        (RUN_CAPACITY / roles.max(1)).clamp(*CAPACITY.start(), *CAPACITY.end())
    }

    /// Returns the number of ledger words in a run of this number of roles.
    pub fn words(roles: usize) -> usize {
        FIRST + Self::capacity(roles) * RECORD_WORDS
    }

    /// Opens the records in a run of this number of roles; `ledger` has given all parts before them.
    pub fn open(ledger: &Ledger, roles: usize) -> Self {
        Self { slots: ledger.take(Self::words(roles)), capacity: Self::capacity(roles) }
    }

    /// Announces the thread whose late ticks follow.
    pub fn set_thread(&self, tid: u64) {
        self.slots.set(THREAD, tid);
    }

    /// Returns the last announced thread; 0 before the first.
    pub fn thread(&self) -> u64 {
        self.slots.get(THREAD)
    }

    /// Returns the number of late ticks that were entered; the first ones are kept.
    pub fn entered(&self) -> u64 {
        let entered = self.slots.get(0);
        fence(Ordering::Acquire);
        entered
    }

    /// Enters a late tick.
    pub fn push(&self, mut record: LateRecord) {
        let entered = self.slots.get(0);
        if (entered as usize) < self.capacity {
            let mut at = SlotWords { slots: &self.slots, at: FIRST + entered as usize * RECORD_WORDS };
            record.persist(&mut at);
            fence(Ordering::Release);
        }
        self.slots.set(0, entered + 1);
    }

    /// Returns the kept records from the one with this index on.
    pub fn records(&self, from: usize) -> impl Iterator<Item = LateRecord> {
        let end = (self.entered() as usize).min(self.capacity);
        (from..end).map(|index| {
            let first = FIRST + index * RECORD_WORDS;
            let words: Vec<u64> = (first..first + RECORD_WORDS).map(|word| self.slots.get(word)).collect();
            let mut record = LateRecord::default();
            record.persist(&mut StoredWords(&words));
            record
        })
    }
}

/// The number of words of a record; a test compares it with the fields.
const RECORD_WORDS: usize = 21;

struct SlotWords<'a> {
    slots: &'a Slots,
    at: usize,
}

impl Words for SlotWords<'_> {
    fn word(&mut self, value: &mut u64) {
        self.slots.set(self.at, *value);
        self.at += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::state::length;

    #[test]
    fn the_first_records_are_kept_and_all_are_counted() {
        const ROLES: usize = 10;
        assert_eq!(length(&mut LateRecord::default()), RECORD_WORDS);
        let capacity = LateLog::capacity(ROLES);
        assert_eq!([0, 1, 4, 10, 1000].map(LateLog::capacity), [4096, 4096, 4096, 1638, 256]);
        let ledger = Ledger::private(LateLog::words(ROLES));
        let (log, reader) = (LateLog::open(&ledger, ROLES), LateLog::open(&ledger.reopened(), ROLES));
        assert_eq!((reader.entered(), reader.records(0).count()), (0, 0));
        let record = |tick: u64| LateRecord {
            tick,
            starved: tick.is_multiple_of(2),
            due_ns: tick << 20,
            usage: Usage { run_delay_ns: tick, ..Usage::default() },
            since_ns: u64::MAX,
            ..LateRecord::default()
        };
        (0..capacity as u64 + 3).for_each(|tick| log.push(record(tick)));
        assert_eq!(reader.entered(), capacity as u64 + 3);
        let kept: Vec<LateRecord> = reader.records(5).collect();
        assert_eq!((kept.len(), kept[0], kept[capacity - 6]), (capacity - 5, record(5), record(capacity as u64 - 1)));
    }
}
