//! The causes of a late tick from the counters of its thread: the kind of each cause, without its name.
//!
//! Must not blame a role for a time in which its thread could not run.

use super::delay::Delay;
use super::model::LateKind;
use crate::runtime::page_fault_ns;
use crate::telemetry::LateRecord;
use corotate_trace::{Cause, CauseKind};
use std::sync::OnceLock;

/// The longest usual time of a page fault, in times of the shortest one.
const SLOWEST_FAULT: u64 = 4;
/// Shortest gap in a spin that is blamed on its core, ns.
const GAP_NS: u64 = 20_000;

/// A delay whose causes are found one after the other.
struct Rest {
    wait_ns: u64,
    compute_ns: u64,
    causes: Vec<Cause>,
}

impl Rest {
    /// Explains up to `ns` nanoseconds of the time in which the role waited or computed.
    fn explain(&mut self, kind: CauseKind, ns: u64) {
        let waited_ns = ns.min(self.wait_ns);
        let computed_ns = (ns - waited_ns).min(self.compute_ns);
        self.wait_ns -= waited_ns;
        self.compute_ns -= computed_ns;
        self.add(kind, waited_ns + computed_ns);
    }

    fn add(&mut self, kind: CauseKind, ns: u64) {
        if ns > 0 {
            self.causes.push(Cause::new(kind, "", ns));
        }
    }
}

/// Returns the causes of the part of a delay that no input accounts for.
pub fn causes(delay: &Delay) -> Vec<Cause> {
    static FAULT_NS: OnceLock<u64> = OnceLock::new();
    causes_if_faults_take(*FAULT_NS.get_or_init(|| SLOWEST_FAULT * page_fault_ns()), delay)
}

/// Faults that could take a whole computation, if each took `fault_ns`, are its cause.
fn causes_if_faults_take(fault_ns: u64, delay: &Delay) -> Vec<Cause> {
    let LateRecord { done_ns, usage, stalled, continued, slept, gap_ns, gap_end_ns, .. } = delay.record;
    if delay.kind() == LateKind::Starved {
        return Vec::new();
    }
    let (from_ns, began_ns) = (delay.own_from_ns(), delay.began_ns());
    let compute_ns = done_ns.saturating_sub(began_ns);
    let mut rest = Rest { wait_ns: began_ns - from_ns, compute_ns, causes: Vec::new() };
    if stalled {
        rest.explain(CauseKind::Fault, u64::MAX);
    }
    rest.explain(CauseKind::Throttled, usage.throttled_ns);
    let unusual_ns = usage.run_delay_ns.saturating_sub(usage.throttled_ns).saturating_sub(usage.usual_delay_ns);
    rest.explain(CauseKind::Task, unusual_ns);
    if continued {
        rest.explain(CauseKind::Stopped, u64::MAX);
    }
    let faults_ns = usage.minor_faults.saturating_mul(fault_ns);
    if usage.major_faults > 0 || faults_ns > 0 && faults_ns >= rest.compute_ns {
        let faults_ns = std::mem::take(&mut rest.compute_ns);
        rest.add(CauseKind::PageFault, faults_ns);
    }
    // The gap of a spin lies before the role began.
    let gap_from_ns = gap_end_ns.saturating_sub(gap_ns).max(from_ns);
    let taken_ns = gap_end_ns.min(began_ns).saturating_sub(gap_from_ns).min(rest.wait_ns);
    if taken_ns >= GAP_NS {
        rest.wait_ns -= taken_ns;
        rest.add(CauseKind::CoreTaken, taken_ns);
    }
    // Usual waiting is a better guess than a cause without any sign.
    let waited_ns = usage.usual_delay_ns.min(rest.wait_ns);
    rest.wait_ns -= waited_ns;
    rest.add(CauseKind::Task, waited_ns);
    // A body that did not spin before its tick overslept, or was still busy with the tick before.
    if delay.sender().is_none() && gap_end_ns == 0 {
        let rest_ns = std::mem::take(&mut rest.wait_ns);
        rest.add(if slept { CauseKind::LateTimer } else { CauseKind::Step }, rest_ns);
    }
    let computed_ns = rest.compute_ns;
    rest.add(CauseKind::Step, computed_ns);
    rest.causes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::RoleId;
    use crate::telemetry::Usage;

    const US: u64 = 1000;

    /// A body that looks at the clock 900 µs late, with these counters.
    fn body(record: LateRecord) -> Vec<(CauseKind, f64)> {
        let instants = LateRecord { due_ns: 1000 * US, began_ns: 1900 * US, done_ns: 1900 * US, ..record };
        of_role(RoleId::Plant(0), instants)
    }

    fn of_role(role: RoleId, record: LateRecord) -> Vec<(CauseKind, f64)> {
        let delay = Delay { role, record, period_ns: 1000 * US };
        let causes = causes_if_faults_take(4 * US, &delay);
        let sum: f64 = causes.iter().map(|cause| cause.us).sum();
        assert!(sum <= (delay.ns() - delay.input_ns()) as f64 / 1e3, "{causes:?}");
        causes.into_iter().map(|cause| (cause.kind, cause.us)).collect()
    }

    fn usage(usage: Usage) -> LateRecord {
        LateRecord { usage, slept: true, ..LateRecord::default() }
    }

    #[test]
    fn each_counter_explains_its_part_of_a_delay() {
        let run_delay_ns = 700 * US;
        assert_eq!(
            body(usage(Usage { run_delay_ns, ..Usage::default() })),
            [(CauseKind::Task, 700.0), (CauseKind::LateTimer, 200.0)]
        );
        // A stopped task waits for its core too.
        let (run_delay_ns, throttled_ns) = (80_000 * US, 80_000 * US);
        let quota = usage(Usage { run_delay_ns, throttled_ns, ..Usage::default() });
        assert_eq!(body(quota), [(CauseKind::Throttled, 900.0)]);
        assert_eq!(body(LateRecord { continued: true, ..usage(Usage::default()) }), [(CauseKind::Stopped, 900.0)]);
        let stalled = LateRecord { stalled: true, ..usage(Usage { run_delay_ns: 900 * US, ..Usage::default() }) };
        assert_eq!(body(stalled), [(CauseKind::Fault, 900.0)]);
        let gap = LateRecord { gap_ns: 940 * US, gap_end_ns: 1899 * US, ..usage(Usage::default()) };
        assert_eq!(body(gap), [(CauseKind::CoreTaken, 899.0)]);
        assert_eq!(body(LateRecord::default()), [(CauseKind::Step, 900.0)], "it was busy with the tick before");
        assert_eq!(body(usage(Usage::default())), [(CauseKind::LateTimer, 900.0)]);
    }

    #[test]
    fn a_computation_is_told_from_page_faults_in_it_and_from_its_input() {
        let record = |usage| LateRecord {
            sender: RoleId::Plant(0).number(),
            due_ns: 1000 * US,
            input_ns: 1100 * US,
            began_ns: 1103 * US,
            done_ns: 1500 * US,
            usage,
            ..LateRecord::default()
        };
        let of_observer = |usage| of_role(RoleId::Observer(0), record(usage));
        assert_eq!(of_observer(Usage::default()), [(CauseKind::Step, 397.0)]);
        let minor_faults = 200;
        assert_eq!(of_observer(Usage { minor_faults, ..Usage::default() }), [(CauseKind::PageFault, 397.0)]);
        let few = Usage { minor_faults: 20, ..Usage::default() };
        assert_eq!(of_observer(few), [(CauseKind::Step, 397.0)], "20 faults take 80 us");
        let starved = LateRecord { starved: true, ..record(Usage::default()) };
        assert_eq!(of_role(RoleId::Observer(0), starved), []);
    }
}
