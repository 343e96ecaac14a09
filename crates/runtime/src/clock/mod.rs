//! The time grid T_k = epoch + k·h and how to wait on it. Never a relative sleep: deadlines are absolute, so nothing drifts.

mod grid;
mod run_clock;

pub use grid::Grid;
pub use run_clock::{Correction, RunClock, STEEPEST, adopt};

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, DynamicClockId, Timespec, clock_gettime, clock_gettime_dynamic};

/// Where time comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// CLOCK_MONOTONIC.
    Monotonic,
    /// None: lockstep and in-process runs look at no time, so they have no latencies either.
    None,
}

impl Clock {
    /// Nanoseconds on the monotonic clock, or 0 where there is no time.
    #[inline]
    pub fn now_ns(self) -> u64 {
        match self {
            Self::Monotonic => monotonic_ns(),
            Self::None => 0,
        }
    }
}

/// Nanoseconds on the clock of the run: CLOCK_MONOTONIC, and where the run has several hosts, that of the one which launched it,
/// [as this one knows it](adopt).
#[inline]
pub fn monotonic_ns() -> u64 {
    let raw_ns = raw_ns();
    run_clock::correction().map_or(raw_ns, |correction| correction.apply(raw_ns))
}

/// Nanoseconds on this host's own CLOCK_MONOTONIC.
#[inline]
pub fn raw_ns() -> u64 {
    nanoseconds(clock_gettime(ClockId::Monotonic))
}

/// Nanoseconds from CLOCK_MONOTONIC to CLOCK_TAI on this host; 0 on a system without it.
pub fn tai_offset_ns() -> i64 {
    let between = || {
        let before_ns = raw_ns();
        let tai_ns = nanoseconds(clock_gettime_dynamic(DynamicClockId::Tai).ok()?);
        let after_ns = raw_ns();
        Some((after_ns - before_ns, tai_ns as i64 - (before_ns / 2 + after_ns / 2) as i64))
    };
    // Of several readings the one that nothing came between.
    let fastest = (0..5).filter_map(|_| between()).min();
    fastest.map_or(0, |(_, offset_ns)| offset_ns)
}

fn nanoseconds(time: Timespec) -> u64 {
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// Sleeps until `due_ns` on the clock of the run; returns at once if that is past. A signal may end it early.
#[inline]
pub fn sleep_until(due_ns: u64) {
    let due_ns = match run_clock::correction() {
        Some(correction) => due_ns.saturating_add_signed(-correction.at(raw_ns())),
        None => due_ns,
    };
    let due = Timespec { tv_sec: (due_ns / 1_000_000_000) as i64, tv_nsec: (due_ns % 1_000_000_000) as _ };
    // Interrupted or not, the caller looks at the clock again.
    let _ = clock_nanosleep_absolute(ClockId::Monotonic, &due);
}

/// Waits until `due_ns`: sleeps until `lead_ns` before, then spins. Returns the time at which it ended.
///
/// The spin is bounded by the lead: a wake that comes early is followed by at most that much of it.
#[inline]
pub fn wait_until(due_ns: u64, lead_ns: u64) -> u64 {
    loop {
        let now = monotonic_ns();
        if now >= due_ns {
            return now;
        }
        if now + lead_ns < due_ns {
            sleep_until(due_ns - lead_ns);
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
            assert!(wait_until(due, lead_ns) >= due);
        }
        assert!(wait_until(0, 1_000) > 0, "a past deadline returns at once");
    }
}
