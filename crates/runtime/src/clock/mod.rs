//! The time grid T_k = epoch + k·h and waiting on it. Deadlines are absolute: a relative sleep would drift.

mod arrivals;
mod grid;
mod minimum;
mod run_clock;

pub use arrivals::{ArrivalEstimate, ArrivalEstimator};
pub use grid::Grid;
pub use minimum::{MinimumFilter, Observation, OffsetLine};
pub use run_clock::{Correction, RunClock, STEEPEST, adopt, release};

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, DynamicClockId, Timespec, clock_gettime, clock_gettime_dynamic};

/// Source of time stamps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// CLOCK_MONOTONIC.
    Monotonic,
    /// No time: lockstep and in-process runs read no clock and have no latencies.
    None,
}

impl Clock {
    /// Returns the time on the monotonic clock, or 0 without a clock, ns.
    #[inline]
    pub fn now_ns(self) -> u64 {
        match self {
            Self::Monotonic => monotonic_ns(),
            Self::None => 0,
        }
    }
}

/// Returns the time on the clock of the run, ns: CLOCK_MONOTONIC or, in a run on several hosts, that of the launching
/// host [as this one knows it](adopt).
#[inline]
pub fn monotonic_ns() -> u64 {
    let raw_ns = raw_ns();
    run_clock::correction().map_or(raw_ns, |correction| correction.apply(raw_ns))
}

/// Returns the clock of the run less this host's own CLOCK_MONOTONIC at present, ns.
pub fn correction_ns() -> i64 {
    run_clock::correction().map_or(0, |correction| correction.at(raw_ns()))
}

/// Returns the time on this host's own CLOCK_MONOTONIC, ns.
#[inline]
pub fn raw_ns() -> u64 {
    nanoseconds(clock_gettime(ClockId::Monotonic))
}

/// Returns the offset from CLOCK_MONOTONIC to CLOCK_TAI on this host, ns; 0 on a system without CLOCK_TAI.
pub fn tai_offset_ns() -> i64 {
    let between = || {
        let before_ns = raw_ns();
        let tai_ns = nanoseconds(clock_gettime_dynamic(DynamicClockId::Tai).ok()?);
        let after_ns = raw_ns();
        Some((after_ns - before_ns, tai_ns as i64 - (before_ns / 2 + after_ns / 2) as i64))
    };
    // The fastest of several readings was not interrupted.
    let fastest = (0..5).filter_map(|_| between()).min();
    fastest.map_or(0, |(_, offset_ns)| offset_ns)
}

fn nanoseconds(time: Timespec) -> u64 {
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// Sleeps until `due_ns` on the clock of the run; returns at once if that is past. A signal may end the sleep early.
#[inline]
pub fn sleep_until(due_ns: u64) {
    let due_ns = match run_clock::correction() {
        Some(correction) => due_ns.saturating_add_signed(-correction.at(raw_ns())),
        None => due_ns,
    };
    let due = Timespec { tv_sec: (due_ns / 1_000_000_000) as i64, tv_nsec: (due_ns % 1_000_000_000) as _ };
    // The caller reads the clock again, interrupted or not.
    let _ = clock_nanosleep_absolute(ClockId::Monotonic, &due);
}

/// The longest time between two looks at the clock of a thread that spins: it is short unless something takes the thread's core.
#[derive(Debug, Clone, Copy, Default)]
pub struct SpinGap {
    last_ns: u64,
    longest_ns: u64,
    end_ns: u64,
}

impl SpinGap {
    /// Enters a look at the clock.
    #[inline]
    pub fn look(&mut self, now_ns: u64) {
        let gap_ns = now_ns - self.last_ns.min(now_ns);
        if gap_ns > self.longest_ns && self.last_ns > 0 {
            (self.longest_ns, self.end_ns) = (gap_ns, now_ns);
        }
        self.last_ns = now_ns;
    }

    /// Makes the next look the first one after a sleep.
    #[inline]
    pub fn pause(&mut self) {
        self.last_ns = 0;
    }

    /// Returns the longest time, ns.
    pub fn longest_ns(&self) -> u64 {
        self.longest_ns
    }

    /// Returns the end of the longest time, ns.
    pub fn end_ns(&self) -> u64 {
        self.end_ns
    }
}

/// Sleeps until `lead_ns` before `due_ns`, then spins until `due_ns`. Returns the time at the end.
///
/// The spin lasts at most `lead_ns`.
#[inline]
pub fn wait_until(due_ns: u64, lead_ns: u64, gap: &mut SpinGap) -> u64 {
    loop {
        let now = monotonic_ns();
        gap.look(now);
        if now >= due_ns {
            return now;
        }
        if now + lead_ns < due_ns {
            sleep_until(due_ns - lead_ns);
            gap.pause();
        } else {
            std::hint::spin_loop();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn never_returns_before_the_deadline() {
        for lead_ns in [0, 100_000, 10_000_000] {
            let due = monotonic_ns() + 2_000_000;
            assert!(wait_until(due, lead_ns, &mut SpinGap::default()) >= due);
        }
        assert!(wait_until(0, 1_000, &mut SpinGap::default()) > 0, "a past deadline returns at once");
    }

    #[test]
    fn only_the_time_between_looks_of_a_spinning_thread_is_a_gap() {
        let mut gap = SpinGap::default();
        for now_ns in [1000, 1010, 1050, 1060] {
            gap.look(now_ns);
        }
        gap.pause();
        gap.look(9000);
        gap.look(8990);
        assert_eq!((gap.longest_ns(), gap.end_ns()), (40, 1050));
    }
}
