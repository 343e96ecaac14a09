//! The causes of a late tick from the counters of its thread: the kind of each cause, without its name.
//!
//! Must not blame a role for a time in which its thread could not run.

use super::delay::Delay;
use super::{Cause, CauseKind, LateKind};
use crate::telemetry::LateRecord;

/// The longest usual time of a page fault, ns: a virtual machine takes some 2 µs. Faults that could take a whole computation at this rate
/// are its cause.
const FAULT_NS: u64 = 4_000;
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
    rest.explain(CauseKind::Task, usage.run_delay_ns.saturating_sub(usage.throttled_ns));
    if continued {
        rest.explain(CauseKind::Stopped, u64::MAX);
    }
    let faults_ns = usage.minor_faults.saturating_mul(FAULT_NS);
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
    // A body that did not spin before its tick overslept, or was still busy with the tick before.
    if delay.sender().is_none() && gap_end_ns == 0 {
        let rest_ns = std::mem::take(&mut rest.wait_ns);
        rest.add(if slept { CauseKind::LateTimer } else { CauseKind::Step }, rest_ns);
    }
    let computed_ns = rest.compute_ns;
    rest.add(CauseKind::Step, computed_ns);
    rest.causes
}
