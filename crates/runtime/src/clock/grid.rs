//! Pure arithmetic of the time grid. Must not read a clock.

/// The ticks T_k = epoch + k·h.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    /// T_0, ns.
    pub epoch_ns: u64,
    /// h, ns; not zero.
    pub period_ns: u64,
}

impl Grid {
    /// Returns T_k, ns.
    #[inline]
    pub fn due_ns(&self, tick: u64) -> u64 {
        self.epoch_ns + tick * self.period_ns
    }

    /// Returns the latest tick due at `now_ns`; 0 before the epoch.
    #[inline]
    pub fn tick_at(&self, now_ns: u64) -> u64 {
        now_ns.saturating_sub(self.epoch_ns) / self.period_ns
    }

    /// Returns the first tick that is due at or after `now_ns`.
    pub fn next_at(&self, now_ns: u64) -> u64 {
        now_ns.saturating_sub(self.epoch_ns).div_ceil(self.period_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tick_begins_exactly_when_it_is_due() {
        let grid = Grid { epoch_ns: 1_000_003, period_ns: 333_333 };
        for tick in [0, 1, 7, 1_000_000_007] {
            assert_eq!(grid.tick_at(grid.due_ns(tick)), tick);
            assert_eq!(grid.tick_at(grid.due_ns(tick + 1) - 1), tick);
        }
        assert_eq!((grid.tick_at(0), grid.next_at(0)), (0, 0), "before the epoch");
        assert_eq!((grid.next_at(grid.due_ns(7)), grid.next_at(grid.due_ns(7) + 1)), (7, 8));
    }
}
