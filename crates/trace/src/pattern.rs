//! Periods with which late ticks repeat.

/// Candidates, ms, with a frequent reason for each.
const CANDIDATES: [(f64, &str); 7] = [
    (1.0, "a timer of 1 kHz, such as a kernel's tick with CONFIG_HZ=1000"),
    (4.0, "a kernel's tick with CONFIG_HZ=250"),
    (10.0, "a kernel's tick with CONFIG_HZ=100"),
    (20.0, "heartbeats of the roles"),
    (50.0, ""),
    (100.0, "a limit on processor time (cgroup quota) of this machine, or of the host around it"),
    (1000.0, "the period of real-time throttling (sched_rt_period_us), or a task that runs every second"),
];
/// Late ticks within this number of loop periods are one event.
const BURST_PERIODS: u64 = 3;
/// The fewest events that are compared.
const EVENTS_MIN: usize = 5;
/// The largest probability that events without a period look like this.
const CHANCE_MAX: f64 = 1e-3;

/// A period with which events repeat.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Period {
    /// The period, ms.
    pub period_ms: f64,
    /// The number of events at the same phase.
    pub same_phase: u64,
    /// The number of compared events.
    pub events: u64,
    /// A frequent reason for this period; may be empty.
    pub hint: &'static str,
}

/// Returns the periods with which late ticks repeat, from their due times, ns, and the period of the loop, ns.
///
/// The events' phases of each candidate period are compared with a uniform distribution: how probable is it that so many lie within one
/// twentieth of the period? Of a period and
/// its multiple one is returned.
pub fn periods(due_ns: &[u64], loop_period_ns: u64) -> Vec<Period> {
    let events = bursts(due_ns, loop_period_ns);
    if events.len() < EVENTS_MIN {
        return Vec::new();
    }
    let found = |(period_ms, hint): (f64, &'static str)| {
        let period_ns = (period_ms * 1e6) as u64;
        // The due times are multiples of the loop's period, and so are the differences of the phases.
        let width_ns = (period_ns / 20).max(loop_period_ns / 2);
        let part = (width_ns.div_ceil(loop_period_ns) * loop_period_ns) as f64 / period_ns as f64;
        let cycles = events.last()?.saturating_sub(*events.first()?) / period_ns;
        if period_ns < 4 * loop_period_ns || cycles < EVENTS_MIN as u64 - 1 {
            return None;
        }
        let same_phase = most_in_window(&events, period_ns, width_ns);
        let chance = CANDIDATES.len() as f64 / part * tail(events.len(), same_phase, part);
        let period = Period { period_ms, same_phase: same_phase as u64, events: events.len() as u64, hint };
        (chance < CHANCE_MAX && 3 * same_phase >= events.len()).then_some(period)
    };
    let found: Vec<Period> = CANDIDATES.into_iter().filter_map(found).collect();
    let is_multiple = |long: &Period, short: &Period| {
        let ratio = long.period_ms / short.period_ms;
        ratio > 1.5 && ratio.fract() == 0.0
    };
    // Of two such periods, the longer one explains the other if it has nearly as many events.
    let explains = |long: &Period, short: &Period| 10 * long.same_phase >= 8 * short.same_phase;
    let is_better = |rival: &Period, period: &Period| {
        is_multiple(rival, period) && explains(rival, period) || is_multiple(period, rival) && !explains(period, rival)
    };
    found.iter().filter(|period| !found.iter().any(|rival| is_better(rival, period))).copied().collect()
}

/// Returns the first instants of late ticks that follow each other closely.
fn bursts(due_ns: &[u64], loop_period_ns: u64) -> Vec<u64> {
    let mut sorted = due_ns.to_vec();
    sorted.sort_unstable();
    let mut events = Vec::new();
    let mut last_ns: Option<u64> = None;
    for ns in sorted {
        if last_ns.is_none_or(|last_ns| ns - last_ns > BURST_PERIODS * loop_period_ns) {
            events.push(ns);
        }
        last_ns = Some(ns);
    }
    events
}

/// Returns the largest number of events whose phases lie within a window of this width.
fn most_in_window(events: &[u64], period_ns: u64, width_ns: u64) -> usize {
    let mut phases: Vec<u64> = events.iter().map(|ns| ns % period_ns).collect();
    phases.sort_unstable();
    let count = phases.len();
    let wrapped: Vec<u64> = phases.iter().copied().chain(phases.iter().map(|phase| phase + period_ns)).collect();
    let within = |first: usize| wrapped[first..].partition_point(|phase| *phase < wrapped[first] + width_ns);
    (0..count).map(within).max().unwrap_or(0).min(count)
}

/// Returns the probability that at least `least` of `count` independent events of probability `part` occur.
fn tail(count: usize, least: usize, part: f64) -> f64 {
    // The term for k, from that for k - 1, in logarithms.
    let mut log_term = count as f64 * (1.0 - part).ln();
    let mut sum = 0.0;
    for k in 0..=count {
        if k >= least {
            sum += log_term.exp();
        }
        log_term += ((count - k) as f64 / (k + 1) as f64 * part / (1.0 - part)).ln();
    }
    sum.min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Instants without a period, the same in every run of the test.
    fn scattered(count: u64) -> impl Iterator<Item = u64> {
        let mut state = 1_u64;
        (0..count).map(move |_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) % 10_000 * MS
        })
    }

    #[test]
    fn a_quota_is_found_among_other_late_ticks() {
        let quota = [755, 3155, 3555, 3655, 7755, 8255, 9155].map(|tick| 5_000_000_007 + tick * MS);
        let periods = periods(&[&quota[..], &scattered(3).collect::<Vec<_>>()].concat(), MS);
        assert_eq!(periods.len(), 1, "{periods:?}");
        assert_eq!((periods[0].period_ms, periods[0].events), (100.0, 10));
        assert!(periods[0].same_phase >= 7);
    }

    #[test]
    fn scattered_and_few_late_ticks_have_no_period() {
        for count in [0, 1, 4, 20, 200] {
            assert_eq!(periods(&scattered(count).collect::<Vec<_>>(), MS), [], "{count}");
        }
        assert_eq!(periods(&[0, 100 * MS, 200 * MS, 300 * MS], MS), [], "four are too few");
    }

    #[test]
    fn the_kernels_tick_is_seen_by_a_fast_loop_only() {
        let ticks: Vec<u64> = (0..100).map(|index| index * index * 4 * MS + 300_000).collect();
        let found: Vec<f64> = periods(&ticks, MS / 10).iter().map(|period| period.period_ms).collect();
        assert_eq!(found, [4.0]);
        assert_eq!(periods(&scattered(100).collect::<Vec<_>>(), MS), []);
    }

    #[test]
    fn a_burst_is_one_event() {
        let bursts: Vec<u64> = (0..8).flat_map(|burst| (0..50).map(move |tick| (burst * 1000 + tick) * MS)).collect();
        let periods = periods(&bursts, MS);
        assert_eq!((periods.len(), periods[0].period_ms, periods[0].events), (1, 1000.0, 8));
    }

    #[test]
    fn the_tail_of_a_binomial_distribution_is_exact() {
        assert!((tail(3, 2, 0.5) - 0.5).abs() < 1e-12 && (tail(10, 0, 0.1) - 1.0).abs() < 1e-12);
        assert!((tail(4, 4, 0.05) / 0.05_f64.powi(4) - 1.0).abs() < 1e-12);
    }
}
