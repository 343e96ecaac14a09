//! A report with the late ticks of a run of `rigid-pair` on a shared virtual machine, for tests.

use super::model::{
    CauseTotal, LateKind, LateReport, LateTick, Pattern, SCHEMA, Slice, SliceKind, Source, TickOfRole, TracerCost,
};
use corotate_trace::{Cause, CauseKind};

const PERIOD_US: f64 = 1000.0;
const LATE_US: f64 = 100.0;

/// Returns the report of a run with the kernel's trace: a core taken every 100 ms, a task of a higher priority, late timers,
/// softirqs, and ticks that follow from them.
pub fn report() -> LateReport {
    let mut ticks = Vec::new();
    for index in 0..12_u64 {
        let us = 420.0 + 37.0 * ((index * 7) % 13) as f64;
        chain(755 + 800 * index, us, Cause::new(CauseKind::CoreTaken, "hypervisor", us as u64 * 1000), &mut ticks);
    }
    for index in 0..9_u64 {
        let us = 160.0 + 90.0 * ((index * 5) % 9) as f64;
        let hog = Cause { tid: Some(4711), priority: Some(4), ..Cause::new(CauseKind::Task, "hog", us as u64 * 900) };
        chain(402 + 1091 * index, us, hog, &mut ticks);
    }
    let single = [
        (CauseKind::LateTimer, "idle core", 917.0),
        (CauseKind::LateTimer, "idle core", 341.0),
        (CauseKind::Softirq, "NET_RX", 188.0),
        (CauseKind::Interrupt, "virtio0-req.0", 131.0),
        (CauseKind::PageFault, "", 214.0),
        (CauseKind::Step, "", 319.0),
        (CauseKind::Throttled, "", 2380.0),
        (CauseKind::IdleCore, "", 119.0),
        (CauseKind::Stopped, "", 12_400.0),
    ];
    for (index, (kind, name, us)) in single.into_iter().enumerate() {
        let cause = Cause::new(kind, name, (us * 950.0) as u64);
        ticks.push(late("follower", 333 + 1013 * index as u64, us, vec![cause]));
    }
    ticks.push(late("observer", 9120, 127.0, Vec::new()));
    ticks.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    worst_with_slices(&mut ticks);
    LateReport {
        schema: SCHEMA.to_owned(),
        run: None,
        scenario: "rigid-pair".to_owned(),
        period_us: PERIOD_US,
        late_us: LATE_US,
        source: Source::Kernel,
        note: None,
        epoch_ns: 0,
        counted: 90,
        examined: ticks.iter().map(|late| late.ticks).sum(),
        traced: None,
        causes: totals(&ticks),
        ticks,
        steal_ms: [(1, 70.0)].into(),
        patterns: vec![Pattern {
            cause: "core taken by the hypervisor".to_owned(),
            compared: 73,
            period_ms: 100.0,
            ticks: 12,
            hint: Some("a processor quota has this period, here or on the host of a virtual machine".to_owned()),
        }],
        tracer: Some(TracerCost { cpu_s: 0.41, events: 212_300, overruns: 0 }),
    }
}

/// Adds a late tick of the leader, and those of observer and controller that follow from it.
fn chain(tick: u64, us: f64, cause: Cause, ticks: &mut Vec<LateTick>) {
    ticks.push(late("leader", tick, us, vec![cause]));
    for (role, sender, more) in [("observer", "leader", 2.1), ("controller", "observer", 5.4)] {
        let cause = Cause::new(CauseKind::Input, sender, (us * 1000.0) as u64);
        let caused_by = Some(TickOfRole { role: sender.to_owned(), tick });
        ticks.push(LateTick { caused_by, ..late(role, tick, us + more, vec![cause]) });
    }
}

/// Returns a late tick of `rigid-pair`.
pub fn late(role: &str, tick: u64, late_us: f64, causes: Vec<Cause>) -> LateTick {
    let periods = (late_us / PERIOD_US) as u64;
    LateTick {
        role: role.to_owned(),
        tick,
        ticks: periods.max(1),
        kind: if periods > 0 { LateKind::Missed } else { LateKind::Late },
        time_s: tick as f64 * PERIOD_US / 1e6,
        late_us,
        causes,
        caused_by: None,
        slices: Vec::new(),
    }
}

fn totals(ticks: &[LateTick]) -> Vec<CauseTotal> {
    let mut totals: Vec<CauseTotal> = Vec::new();
    for cause in ticks.iter().flat_map(|late| &late.causes) {
        let known = totals.iter_mut().find(|total| (total.kind, &total.name) == (cause.kind, &cause.name));
        match known {
            Some(total) => {
                (total.ticks, total.sum_us) = (total.ticks + 1, total.sum_us + cause.us);
                total.worst_us = total.worst_us.max(cause.us);
            }
            None => totals.push(CauseTotal {
                cause: cause.to_string(),
                kind: cause.kind,
                name: cause.name.clone(),
                ticks: 1,
                worst_us: cause.us,
                sum_us: cause.us,
            }),
        }
    }
    totals.sort_by(|a, b| b.sum_us.total_cmp(&a.sum_us));
    totals
}

/// Adds the cores around the ten worst ticks.
fn worst_with_slices(ticks: &mut [LateTick]) {
    let mut order: Vec<usize> = (0..ticks.len()).collect();
    order.sort_by(|a, b| ticks[*b].late_us.total_cmp(&ticks[*a].late_us));
    for index in order.into_iter().take(10) {
        let slices = slices(&ticks[index]);
        ticks[index].slices = slices;
    }
}

fn slices(late: &LateTick) -> Vec<Slice> {
    let end = late.late_us;
    let slice = |core, kind, name: &str, from_us, to_us| Slice { core, kind, name: name.to_owned(), from_us, to_us };
    let culprit = match late.causes.first().map(|cause| cause.kind) {
        Some(CauseKind::Task) => slice(0, SliceKind::Task, "hog", -12.0, end - 4.0),
        Some(CauseKind::LateTimer | CauseKind::IdleCore) => slice(0, SliceKind::Idle, "idle", -12.0, end - 4.0),
        _ => slice(0, SliceKind::Role, &late.role, -12.0, end - 4.0),
    };
    let mut slices = vec![
        slice(0, SliceKind::Idle, "idle", -500.0, -70.0),
        slice(0, SliceKind::Role, &late.role, -70.0, -12.0),
        culprit,
        slice(0, SliceKind::Role, &late.role, end - 4.0, end + 12.0),
        slice(0, SliceKind::Role, "observer", end + 12.0, end + 19.0),
        slice(0, SliceKind::Idle, "idle", end + 19.0, end + 500.0),
        slice(1, SliceKind::Idle, "idle", -500.0, -310.0),
        slice(1, SliceKind::Task, "kworker/1:2-events", -310.0, -120.0),
        slice(1, SliceKind::Idle, "idle", -120.0, -40.0),
        slice(1, SliceKind::Role, "follower", -40.0, 140.0),
        slice(1, SliceKind::Interrupt, "virtio0-req.0", 140.0, 146.0),
        slice(1, SliceKind::Softirq, "NET_RX", 146.0, 188.0),
        slice(1, SliceKind::Idle, "idle", 188.0, end + 25.0),
        slice(1, SliceKind::Role, "controller", end + 25.0, end + 60.0),
        slice(1, SliceKind::Idle, "idle", end + 60.0, end + 500.0),
    ];
    for at in 0..4 {
        let from = -400.0 + 250.0 * f64::from(at);
        slices.push(slice(1, SliceKind::Interrupt, "local_timer", from, from + 3.0));
    }
    slices
}
