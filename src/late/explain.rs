//! The causes of a late tick from the kernel's events around it.

use super::delay::Delay;
use super::model::{LateKind, Slice, SliceKind};
use corotate_trace::{Cause, CauseKind, Duty, Facts, Occupant, Phase, Window};

/// The time before the due time and after the end of a delay that a timeline shows, ns.
const MARGIN_NS: u64 = 200_000;
/// Longest time that a timeline shows, ns, and its largest number of slices.
const SHOWN_NS: u64 = 20_000_000;
const SLICES: usize = 400;

/// Returns the causes of the part of a delay that no input accounts for; `None` if events are missing. `sender` is the thread of the
/// sender of its input, or 0; `limited` is true if a cgroup limits the processor time of the roles.
pub fn causes(delay: &Delay, sender: i32, limited: bool, window: &Window) -> Option<Vec<Cause>> {
    if window.has_losses() {
        return None;
    }
    let record = &delay.record;
    if record.stalled {
        return Some(vec![Cause::new(CauseKind::Fault, "", delay.ns() - delay.input_ns())]);
    }
    let usage = &record.usage;
    let facts = Facts { throttled_ns: usage.throttled_ns, major_faults: usage.major_faults > 0, limited };
    let gap = (record.gap_end_ns.saturating_sub(record.gap_ns), record.gap_end_ns);
    let timed = record.slept;
    let duty = if delay.sender().is_none() { Duty::Timer { gap } } else { Duty::Wake { sender, timed, gap } };
    let (from_ns, began_ns) = (delay.own_from_ns(), delay.began_ns());
    let wait = Phase { from_ns, to_ns: began_ns, duty };
    let compute = Phase { from_ns: began_ns, to_ns: record.done_ns, duty: Duty::Compute };
    let phases = if delay.kind() == LateKind::Starved { &[][..] } else { &[wait, compute] };
    Some(window.blame(record.tid as i32, facts, phases))
}

/// Returns what kept the sender of the last input, of which no late tick is known, from sending it.
pub fn input_causes(delay: &Delay, sender: i32, window: &Window) -> Vec<Cause> {
    let (from_ns, to_ns) = (delay.record.due_ns, delay.own_from_ns());
    let duty = Duty::Wake { sender: 0, timed: false, gap: (0, 0) };
    if window.has_losses() {
        Vec::new()
    } else {
        window.blame(sender, Facts::default(), &[Phase { from_ns, to_ns, duty }])
    }
}

/// Returns the occupants of the cores around a late tick. `role` names the role of a thread.
pub fn slices(delay: &Delay, window: &Window, role: impl Fn(i32) -> Option<String>) -> Vec<Slice> {
    let due_ns = delay.record.due_ns;
    let from_ns = due_ns.saturating_sub(MARGIN_NS);
    let to_ns = (delay.record.done_ns + MARGIN_NS).min(from_ns + SHOWN_NS);
    let us = |ns: u64| (ns as f64 - due_ns as f64) / 1e3;
    let slice = |(core, span): (usize, corotate_trace::Span)| {
        let (kind, name) = match span.occupant {
            Occupant::Unknown => return None,
            Occupant::Idle => (SliceKind::Idle, String::new()),
            Occupant::Task(task) => match role(task.tid) {
                Some(name) => (SliceKind::Role, name),
                None => (SliceKind::Task, task.name),
            },
            Occupant::Interrupt(name) => (SliceKind::Interrupt, name),
            Occupant::Softirq(name) => (SliceKind::Softirq, name),
        };
        Some(Slice { core, kind, name, from_us: us(span.from_ns), to_us: us(span.to_ns) })
    };
    window.spans(from_ns, to_ns).filter_map(slice).take(SLICES).collect()
}
