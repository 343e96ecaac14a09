//! Records outages of a device from the host's requests and the device's answers.
//!
//! Must not do I/O, read a clock, or end anything.

use crate::telemetry::Outage;

/// Silence up to this duration counts as late, not as an outage, ns.
const SILENT_NS: u64 = 250_000_000;
/// Upper bound on the silence that one poll adds, in ns and, in real time, in periods: the host itself may have been
/// stopped.
const LOOK_MAX_NS: u64 = 100_000_000;
const LOOK_PERIODS: u64 = 4;
/// Number of outages that are recorded without allocation.
const OUTAGES: usize = 64;

/// The outages of one device.
pub(super) struct Absences {
    /// A longer silence is an outage, ns. Unlimited without real time: there ticks wait, and a slow device costs
    /// nothing.
    limit_ns: u64,
    look_max_ns: u64,
    wait: Option<Wait>,
    /// The last answered tick.
    answered: Option<u64>,
    ended: Vec<Wait>,
}

/// Requests without an answer, from `tick` on.
#[derive(Debug, Default)]
struct Wait {
    tick: u64,
    back_at_tick: Option<u64>,
    waited_ns: u64,
    looked_ns: u64,
    cut: bool,
    restarted: bool,
    renamed: Option<String>,
}

impl Wait {
    fn outage(&self) -> Outage {
        let seconds = self.waited_ns as f64 / 1e9;
        let mut cause = match self.cut {
            true => format!("the line to its device was cut; no answer for {seconds:.2} s"),
            false => format!("its device did not answer for {seconds:.2} s"),
        };
        if self.restarted {
            cause.push_str("; the device that answered had lost the run and started again");
        }
        if let Some(name) = &self.renamed {
            cause.push_str(&format!("; another device answered: {name}"));
        }
        let code = match self {
            Self { renamed: Some(_), .. } => "other-device",
            Self { restarted: true, .. } => "device-restarted",
            Self { cut: true, .. } => "line-cut",
            _ => "device-silent",
        };
        Outage { tick: self.tick, back_at_tick: self.back_at_tick, seconds, code: code.to_owned(), cause }
    }
}

impl Absences {
    /// Creates an empty record; `period_ns` is given only in real time.
    pub fn new(period_ns: Option<u64>, timeout_ticks: u64) -> Self {
        let limit_ns = period_ns.map_or(u64::MAX, |period_ns| SILENT_NS.max(timeout_ticks.saturating_mul(period_ns)));
        let look_max_ns = period_ns.map_or(LOOK_MAX_NS, |period_ns| LOOK_PERIODS.saturating_mul(period_ns));
        Self { limit_ns, look_max_ns, wait: None, answered: None, ended: Vec::with_capacity(OUTAGES) }
    }

    /// Records a request for a tick.
    pub fn asked(&mut self, tick: u64, now_ns: u64) {
        self.wait.get_or_insert_with(|| Wait { tick, looked_ns: now_ns, ..Wait::default() });
    }

    /// Adds the time since the last poll to the silence; `open` is the state of the line.
    pub fn look(&mut self, now_ns: u64, open: bool) {
        if let Some(wait) = &mut self.wait {
            wait.waited_ns += now_ns.saturating_sub(wait.looked_ns).min(self.look_max_ns);
            wait.looked_ns = now_ns;
            wait.cut |= !open;
        }
    }

    /// Records a new greeting: the tick that the device would answer next, and its name if the name changed.
    pub fn greeted(&mut self, next_tick: u64, renamed: Option<&str>) {
        if let Some(wait) = &mut self.wait {
            wait.restarted |= self.answered.is_some_and(|answered| next_tick <= answered);
            wait.renamed = renamed.map(str::to_owned).or(wait.renamed.take());
        }
    }

    /// Records an answered tick.
    pub fn answered(&mut self, tick: u64) {
        self.answered = Some(tick);
        if let Some(wait) = self.wait.take().filter(|wait| self.is_outage(wait)) {
            self.ended.push(Wait { back_at_tick: Some(tick), ..wait });
        }
    }

    fn is_outage(&self, wait: &Wait) -> bool {
        wait.cut || wait.restarted || wait.renamed.is_some() || wait.waited_ns > self.limit_ns
    }

    /// Returns all outages so far, including one that still lasts.
    pub fn outages(&self) -> Vec<Outage> {
        let lasting = self.wait.iter().filter(|wait| self.is_outage(wait));
        self.ended.iter().chain(lasting).map(Wait::outage).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NS: u64 = 5_000_000;

    /// Requests one tick per period. Ticks in `silent` stay unanswered; in `cut` the line is closed.
    fn outages(
        mut absences: Absences,
        silent: std::ops::Range<u64>,
        cut: std::ops::Range<u64>,
        ticks: u64,
    ) -> Vec<Outage> {
        for tick in 0..ticks {
            let now_ns = tick * PERIOD_NS;
            absences.asked(tick, now_ns);
            absences.look(now_ns, !cut.contains(&tick));
            if !silent.contains(&tick) && !cut.contains(&tick) {
                absences.answered(tick);
            }
        }
        absences.outages()
    }

    fn realtime() -> Absences {
        Absences::new(Some(PERIOD_NS), 5)
    }

    #[test]
    fn a_silence_is_an_outage_once_it_is_longer_than_the_limit() {
        assert!(outages(realtime(), 100..150, 0..0, 200).is_empty(), "0.25 s");
        let found = outages(realtime(), 100..151, 0..0, 200);
        assert_eq!((found.len(), found[0].tick, found[0].back_at_tick), (1, 100, Some(151)));
        assert!((found[0].seconds - 0.255).abs() < 1e-9, "{found:?}");
        assert!(outages(Absences::new(None, 5), 100..199, 0..0, 200).is_empty(), "without real time ticks wait");
    }

    #[test]
    fn a_cut_is_an_outage_however_short_and_lasts_to_the_end() {
        for absences in [realtime(), Absences::new(None, 5)] {
            let found = outages(absences, 0..0, 100..101, 200);
            assert_eq!((found.len(), found[0].tick, found[0].back_at_tick), (1, 100, Some(101)));
        }
        let found = outages(realtime(), 0..0, 100..200, 200);
        assert_eq!((found.len(), found[0].tick, found[0].back_at_tick), (1, 100, None));
    }

    /// A host that was stopped did not poll the line.
    #[test]
    fn time_without_a_poll_does_not_count_as_silence() {
        let mut absences = realtime();
        absences.asked(7, 0);
        absences.look(60_000_000_000, true);
        absences.answered(7);
        assert!(absences.outages().is_empty());
    }

    #[test]
    fn a_replaced_device_and_a_restarted_device_are_outages() {
        for (next_tick, renamed) in [(0, None), (8, Some("other 2"))] {
            let mut absences = realtime();
            // A device without any answer has no run to lose.
            absences.asked(7, 0);
            absences.greeted(0, None);
            absences.answered(7);
            absences.asked(8, 0);
            absences.greeted(next_tick, renamed);
            absences.answered(8);
            let found = absences.outages();
            assert_eq!((found.len(), found[0].tick), (1, 8));
            assert_eq!(found[0].cause.contains("other 2"), renamed.is_some(), "{}", found[0].cause);
        }
    }
}
