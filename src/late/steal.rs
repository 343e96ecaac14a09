//! The time for which the hypervisor ran something else on a core, from the kernel's counters.
//!
//! Must not fail: without the counters there is no time.

use std::collections::BTreeMap;

/// The resolution of `/proc/stat`, ms: its unit is 1/USER_HZ, 10 ms on all architectures of this program.
const TICK_MS: f64 = 10.0;

/// The stolen time of each core since the start of the machine.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Steal(BTreeMap<usize, u64>);

impl Steal {
    /// Reads the counters of this machine.
    pub fn read() -> Self {
        Self::parse(&std::fs::read_to_string("/proc/stat").unwrap_or_default())
    }

    /// Reads the counters from the text of `/proc/stat`: `cpuN user nice system idle iowait irq softirq steal ...`.
    fn parse(text: &str) -> Self {
        let core = |line: &str| {
            let mut words = line.strip_prefix("cpu")?.split_ascii_whitespace();
            let core = words.next()?.parse().ok().filter(|_| !line.starts_with("cpu "))?;
            Some((core, words.nth(7)?.parse().ok()?))
        };
        Self(text.lines().filter_map(core).collect())
    }

    /// Returns the time stolen since an earlier reading, ms, of each core that lost some.
    pub fn since_ms(&self, before: &Self) -> BTreeMap<usize, f64> {
        let grown = self.0.iter().filter_map(|(core, now)| Some((*core, now.checked_sub(*before.0.get(core)?)?)));
        grown.filter(|(_, ticks)| *ticks > 0).map(|(core, ticks)| (core, ticks as f64 * TICK_MS)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_stolen_time_is_that_of_each_core() {
        let before =
            "cpu  10 0 10 900 5 0 2 73 0 0\ncpu0 5 0 5 450 2 0 1 40 0 0\ncpu1 5 0 5 450 3 0 1 33 0 0\nintr 5 1\n";
        let after = "cpu  20 0 20 990 5 0 2 80 0 0\ncpu0 9 0 9 480 2 0 1 47 0 0\ncpu1 9 0 9 480 3 0 1 33 0 0\nctxt 9\n";
        let grown = Steal::parse(after).since_ms(&Steal::parse(before));
        assert_eq!(grown, BTreeMap::from([(0, 70.0)]));
        assert!(Steal::parse(before).since_ms(&Steal::parse(after)).is_empty(), "counters that went back");
        // Linux 2.6 has no steal; a core may be switched on during the run.
        assert_eq!(Steal::parse("cpu0 5 0 5 450 2 0 1\n"), Steal::default());
        assert!(Steal::parse(after).since_ms(&Steal::default()).is_empty());
    }

    proptest! {
        #[test]
        fn strange_texts_give_nothing(text in "(cpu[0-9]{0,3}( [0-9-]{0,25}){0,12}\n|\\PC{0,20}\n){0,5}") {
            let _ = Steal::parse(&text).since_ms(&Steal::parse("cpu0 0 0 0 0 0 0 0 0\n"));
        }
    }
}
