//! The time grid T_k = epoch + k·h and how to wait on it. Never a relative sleep: deadlines are absolute, so nothing drifts.

mod grid;

pub use grid::Grid;

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};

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

/// Nanoseconds on CLOCK_MONOTONIC.
#[inline]
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Sleeps until `due_ns` on the monotonic clock; returns at once if that is past. A signal may end it early.
#[inline]
pub fn sleep_until(due_ns: u64) {
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
