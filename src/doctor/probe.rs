//! A probe: a thread bound to one core that only wakes, and measures how late.
//!
//! It sleeps until each due time on an absolute grid and does not spin, so that it shows the machine's whole wake-up lateness. Must
//! not allocate, lock or wait for another thread while it runs.

use crate::clock::{Grid, monotonic_ns, sleep_until};
use crate::runtime::{ThreadUsage, take_probe_privileges};
use crate::telemetry::{Grant, LateRecord, Latency, Usage};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;

/// Least time between two readings of the counters without a late wake, ns: a reading takes about 1 µs.
const BASELINE_NS: u64 = 1_000_000;

/// The due times of all probes.
#[derive(Debug, Clone, Copy)]
pub struct Schedule {
    /// The grid.
    pub grid: Grid,
    /// The number of ticks.
    pub ticks: u64,
    /// The limit beyond which a wake is late, ns.
    pub late_ns: u64,
}

/// A late wake. Of a record only what concerns a thread that wakes is set.
#[derive(Debug, Clone, Copy)]
pub struct LateWake {
    /// The record of the first late tick.
    pub record: LateRecord,
    /// The number of ticks that this wake made late.
    pub ticks: u64,
}

/// The counts of a probe.
#[derive(Debug, Default)]
pub struct Wakes {
    /// The number of wakes.
    pub wakes: u64,
    /// The number of ticks without a wake of their own, because the wake before was a period late or more.
    pub missed: u64,
    /// The number of ticks beyond the limit.
    pub late: u64,
    /// The lateness at every tick, missed ones included.
    pub lateness: Latency,
}

impl Wakes {
    /// Enters a wake for `tick` and all later ticks that are due by then. Returns the next tick, and the number of late ones.
    fn enter(&mut self, schedule: &Schedule, tick: u64, woke_ns: u64) -> (u64, u64) {
        let Schedule { grid, ticks, late_ns } = *schedule;
        let last = grid.tick_at(woke_ns).clamp(tick, ticks - 1);
        for missed in tick..last {
            self.lateness.record_missed(grid.due_ns(missed), woke_ns);
        }
        self.lateness.record(grid.due_ns(last), woke_ns);
        let late = (tick..=last).filter(|tick| woke_ns.saturating_sub(grid.due_ns(*tick)) > late_ns).count() as u64;
        self.wakes += 1;
        self.missed += last - tick;
        self.late += late;
        (last + 1, late)
    }
}

/// A probe on the thread that opened it.
pub struct Probe {
    usage: ThreadUsage,
    /// The last reading of the counters, and its time, ns.
    baseline: Usage,
    since_ns: u64,
    wakes: Wakes,
    late: SyncSender<LateWake>,
}

impl Probe {
    /// Binds the calling thread to a core, with the privileges that are granted.
    pub fn open(core: usize, late: SyncSender<LateWake>) -> (Self, Vec<Grant>) {
        let grants = take_probe_privileges(core);
        let usage = ThreadUsage::open();
        (Self { usage, baseline: Usage::default(), since_ns: 0, wakes: Wakes::default(), late }, grants)
    }

    /// Wakes at all ticks, or until `ended`. Late wakes are sent while it runs; those for which there is no room are only counted.
    pub fn run(mut self, schedule: &Schedule, ended: &AtomicBool) -> Wakes {
        self.rebase(monotonic_ns());
        let mut tick = 0;
        while tick < schedule.ticks && !ended.load(Ordering::Relaxed) {
            let due_ns = schedule.grid.due_ns(tick);
            let mut woke_ns = monotonic_ns();
            while woke_ns < due_ns {
                sleep_until(due_ns);
                woke_ns = monotonic_ns();
            }
            let (next, late) = self.wakes.enter(schedule, tick, woke_ns);
            if late > 0 {
                self.send(tick, due_ns, woke_ns, late);
            } else if woke_ns.saturating_sub(self.since_ns) > BASELINE_NS {
                self.rebase(woke_ns);
            }
            tick = next;
        }
        self.wakes
    }

    fn rebase(&mut self, now_ns: u64) {
        (self.baseline, self.since_ns) = (self.usage.read(), now_ns);
    }

    fn send(&mut self, tick: u64, due_ns: u64, woke_ns: u64, ticks: u64) {
        let (before, since_ns) = (self.baseline, self.since_ns);
        self.rebase(woke_ns);
        let record = LateRecord {
            tick,
            tid: self.usage.tid(),
            due_ns,
            began_ns: woke_ns,
            done_ns: woke_ns,
            slept: true,
            usage: self.baseline.since(&before),
            since_ns,
            ..LateRecord::default()
        };
        // A full channel keeps the earlier wakes.
        let _ = self.late.try_send(LateWake { record, ticks });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::sync_channel;

    const MS: u64 = 1_000_000;
    const SCHEDULE: Schedule =
        Schedule { grid: Grid { epoch_ns: 1000 * MS, period_ns: MS }, ticks: 100, late_ns: 100_000 };

    /// A wake that is 3.05 periods late leaves three ticks without a wake; the last one is not late.
    #[test]
    fn a_missed_tick_counts_with_its_own_lateness() {
        let mut wakes = Wakes::default();
        assert_eq!(wakes.enter(&SCHEDULE, 0, 1000 * MS + 99_000), (1, 0));
        assert_eq!(wakes.enter(&SCHEDULE, 1, 1004 * MS + 50_000), (5, 3));
        assert_eq!(wakes.enter(&SCHEDULE, 5, 1005 * MS + 200_000), (6, 1));
        assert_eq!((wakes.wakes, wakes.missed, wakes.late), (3, 3, 4));
        let figures = wakes.lateness.percentiles();
        assert_eq!((figures.count, figures.missed), (6, 3));
        assert!((figures.max_us - 3050.0).abs() < 4.0 && (figures.p50_us - 200.0).abs() < 1.0, "{figures:?}");
        // No tick is entered beyond the last one.
        assert_eq!(wakes.enter(&SCHEDULE, 98, 2000 * MS).0, 100);
        assert_eq!(wakes.lateness.percentiles().count, 8);
    }

    #[test]
    fn every_tick_is_counted_once_and_late_wakes_are_sent_as_far_as_there_is_room() {
        let (late, received) = sync_channel(1);
        let core = crate::runtime::usable_cores()[0];
        let wakes = std::thread::spawn(move || {
            let (probe, grants) = Probe::open(core, late);
            assert_eq!(grants.len(), 2, "{grants:?}");
            // Ten due times have passed.
            let grid = Grid { epoch_ns: monotonic_ns() - 10 * MS, period_ns: MS };
            let schedule = Schedule { grid, ticks: 50, late_ns: 0 };
            probe.run(&schedule, &AtomicBool::new(false))
        });
        let wakes = wakes.join().unwrap();
        assert_eq!((wakes.wakes + wakes.missed, wakes.lateness.percentiles().count), (50, 50));
        assert!(wakes.missed >= 10 && wakes.late >= 11, "{wakes:?}");
        let sent: Vec<LateWake> = received.iter().collect();
        assert_eq!(sent.len(), 1, "room for one");
        let LateWake { record, ticks } = sent[0];
        assert!(record.tick == 0 && ticks >= 11 && record.done_ns - record.due_ns >= 10 * MS, "{record:?}");
    }

    #[test]
    fn a_probe_ends_early() {
        let (late, _received) = sync_channel(1);
        let (probe, _) = std::thread::spawn(move || {
            let (probe, _) = Probe::open(0, late);
            (probe.run(&SCHEDULE, &AtomicBool::new(true)).wakes, ())
        })
        .join()
        .unwrap();
        assert_eq!(probe, 0);
    }
}
