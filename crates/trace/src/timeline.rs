//! Who ran on each core, and the states of a thread, from a window of events.
//!
//! Must not guess: before the first event that tells it, a state is unknown.

use crate::event::{Event, EventKind, Task, TaskState};
use std::collections::BTreeMap;

/// The names of the softirqs, by number.
const SOFTIRQS: [&str; 10] =
    ["HI", "TIMER", "NET_TX", "NET_RX", "BLOCK", "IRQ_POLL", "TASKLET", "SCHED", "HRTIMER", "RCU"];

/// Adds the switches away from the idle task that some virtual machines do not record for some of their cores: the task that the idle
/// core was woken for runs from its wake-up on. `events` are those of all cores in the order of time, and stay so.
pub fn complete_switches(events: &mut Vec<Event>) {
    let mut cores: BTreeMap<usize, IdleCore> = BTreeMap::new();
    let mut missing = Vec::new();
    for event in events.iter() {
        match &event.kind {
            EventKind::Switch { from, to, .. } => {
                let core = cores.entry(event.core).or_default();
                if from.tid != 0 && core.idle.is_some() {
                    missing.extend(core.switch(event.core, Some(from)));
                }
                core.records_exits |= from.tid == 0;
                core.idle = (to.tid == 0).then(|| to.clone());
                core.woken.clear();
            }
            EventKind::Waking { task, target, .. } => {
                let core = cores.entry(*target).or_default();
                core.woken.push((event.ns, task.clone()));
            }
            _ => {}
        }
    }
    missing.extend(
        cores.iter().filter(|(_, core)| !core.records_exits).filter_map(|(number, core)| core.switch(*number, None)),
    );
    if !missing.is_empty() {
        events.append(&mut missing);
        events.sort_by_key(|event| event.ns);
    }
}

#[derive(Default)]
struct IdleCore {
    /// The idle task while it runs.
    idle: Option<Task>,
    /// The tasks that were woken for the core since its last switch.
    woken: Vec<(u64, Task)>,
    records_exits: bool,
}

impl IdleCore {
    /// Returns the switch from the idle task to `expected`, or to the first task that was woken, at its wake-up.
    fn switch(&self, core: usize, expected: Option<&Task>) -> Option<Event> {
        let from = self.idle.clone()?;
        let (first_ns, first) = self.woken.first()?;
        let ns = self.woken.iter().find(|(_, task)| expected.is_some_and(|expected| expected.tid == task.tid));
        let ns = ns.map_or(*first_ns, |(ns, _)| *ns);
        let to = expected.unwrap_or(first).clone();
        Some(Event { ns, core, kind: EventKind::Switch { from, state: TaskState::Runnable, to } })
    }
}

/// A task or handler on a core.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Occupant {
    /// Nothing is known yet.
    Unknown,
    /// The idle task.
    Idle,
    /// A task.
    Task(Task),
    /// The handler of an interrupt.
    Interrupt(String),
    /// A softirq.
    Softirq(String),
}

/// A time for which a core had one occupant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Span {
    /// Begin, ns.
    pub from_ns: u64,
    /// End, ns.
    pub to_ns: u64,
    /// The occupant.
    pub occupant: Occupant,
}

/// The occupants of a core in the order of time.
#[derive(Debug, Clone, Default)]
pub struct CoreTimeline {
    /// The spans, without gaps between them.
    pub spans: Vec<Span>,
    /// The times of all events, ns.
    times: Vec<u64>,
}

impl CoreTimeline {
    /// Creates the timeline of a core from its events in the order of time, up to `end_ns`.
    pub fn new<'a>(events: impl Iterator<Item = &'a Event>, end_ns: u64) -> Self {
        let mut builder = CoreBuilder::default();
        events.for_each(|event| builder.enter(event));
        builder.close(end_ns);
        builder.timeline
    }

    /// Returns the spans that overlap a time, cut to it.
    pub fn within(&self, from_ns: u64, to_ns: u64) -> impl Iterator<Item = Span> + '_ {
        let first = self.spans.partition_point(|span| span.to_ns <= from_ns);
        self.spans[first..].iter().take_while(move |span| span.from_ns < to_ns).map(move |span| Span {
            from_ns: span.from_ns.max(from_ns),
            to_ns: span.to_ns.min(to_ns),
            occupant: span.occupant.clone(),
        })
    }

    /// Returns true if the core had no event at all between two times, its ends excluded, and had some before.
    pub fn is_silent(&self, from_ns: u64, to_ns: u64) -> bool {
        let before = self.times.partition_point(|ns| *ns <= from_ns);
        before > 0 && self.times.get(before).is_none_or(|ns| *ns >= to_ns)
    }
}

#[derive(Default)]
struct CoreBuilder {
    timeline: CoreTimeline,
    /// The task that the interrupts below interrupted.
    task: Option<Task>,
    /// The index of the first span since that task got the core.
    since: usize,
    interrupts: Vec<Occupant>,
    last_ns: Option<u64>,
    /// True once events are missing.
    lost: bool,
}

fn of_task(task: &Task) -> Occupant {
    if task.tid == 0 { Occupant::Idle } else { Occupant::Task(task.clone()) }
}

impl CoreBuilder {
    fn enter(&mut self, event: &Event) {
        self.close(event.ns);
        self.timeline.times.push(event.ns);
        match &event.kind {
            EventKind::Switch { from, to, .. } => {
                if self.task.is_none() && !self.lost {
                    // It ran since the first event.
                    let occupant = of_task(from);
                    let unknown = self.timeline.spans.iter_mut().filter(|span| span.occupant == Occupant::Unknown);
                    unknown.for_each(|span| span.occupant = occupant.clone());
                }
                self.rename(from);
                if self.task.as_ref().is_some_and(|task| task.tid == 0) && from.tid != 0 {
                    // The core has left its idle task at an unknown time.
                    let idle =
                        self.timeline.spans[self.since..].iter_mut().filter(|span| span.occupant == Occupant::Idle);
                    idle.for_each(|span| span.occupant = Occupant::Unknown);
                }
                self.task = Some(to.clone());
                self.since = self.timeline.spans.len();
                self.interrupts.clear();
            }
            EventKind::IrqEntry { name, .. } => self.interrupts.push(Occupant::Interrupt(name.clone())),
            EventKind::VectorEntry { name } => self.interrupts.push(Occupant::Interrupt((*name).to_owned())),
            EventKind::SoftirqEntry { vector } => {
                let name = SOFTIRQS.get(*vector as usize).map_or_else(|| vector.to_string(), |name| (*name).to_owned());
                self.interrupts.push(Occupant::Softirq(name));
            }
            EventKind::IrqExit | EventKind::VectorExit | EventKind::SoftirqExit => _ = self.interrupts.pop(),
            EventKind::Lost => {
                self.lost = true;
                self.task = None;
                self.interrupts.clear();
            }
            EventKind::Waking { .. } | EventKind::PageFault { .. } => {}
        }
    }

    /// Gives the current task its name and priority at its end: it may have changed both since it got the core.
    fn rename(&mut self, last: &Task) {
        if self.task.as_ref().is_some_and(|task| task.tid == last.tid && task != last) {
            let spans = self.timeline.spans[self.since..].iter_mut();
            let own = spans.filter(|span| matches!(&span.occupant, Occupant::Task(task) if task.tid == last.tid));
            own.for_each(|span| span.occupant = of_task(last));
        }
    }

    /// Ends the current span.
    fn close(&mut self, ns: u64) {
        let from_ns = self.last_ns.replace(ns).unwrap_or(ns);
        if from_ns >= ns {
            return;
        }
        let occupant = match (self.interrupts.last(), &self.task) {
            (Some(interrupt), _) => interrupt.clone(),
            (None, None) => Occupant::Unknown,
            (None, Some(task)) => of_task(task),
        };
        match self.timeline.spans.last_mut() {
            Some(span) if span.occupant == occupant => span.to_ns = ns,
            _ => self.timeline.spans.push(Span { from_ns, to_ns: ns, occupant }),
        }
    }
}

/// The state of a thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ThreadState {
    /// It runs on this core.
    Running(usize),
    /// It can run, and waits for this core.
    Ready(usize),
    /// It sleeps; it last ran, or will be woken, on this core.
    Sleeping(usize),
    /// It waits for input or output, or for a page.
    Uninterruptible,
    /// A signal or a debugger has stopped it.
    Stopped,
}

/// The states of a thread in the order of time: begin, end, state.
#[derive(Debug, Clone, Default)]
pub struct ThreadTimeline {
    states: Vec<(u64, u64, ThreadState)>,
    /// The times of its page faults, ns.
    pub page_faults: Vec<u64>,
}

impl ThreadTimeline {
    /// Creates the timeline of a thread from the events of all cores in the order of time, from `from_ns` to `to_ns`.
    pub fn new(tid: i32, events: &[Event], from_ns: u64, to_ns: u64) -> Self {
        let mut timeline = Self::default();
        let (mut since_ns, mut state) = (from_ns, None);
        for event in events {
            let Some((before, after)) = change(tid, event, state) else {
                if matches!(event.kind, EventKind::PageFault { tid: faulting } if faulting == tid) {
                    timeline.page_faults.push(event.ns);
                }
                continue;
            };
            timeline.push(since_ns, event.ns, state.or(before));
            (since_ns, state) = (event.ns, Some(after));
        }
        timeline.push(since_ns, to_ns, state);
        timeline
    }

    fn push(&mut self, from_ns: u64, to_ns: u64, state: Option<ThreadState>) {
        if let Some(state) = state.filter(|_| from_ns < to_ns) {
            self.states.push((from_ns, to_ns, state));
        }
    }

    /// Returns the states within a time, cut to it.
    pub fn within(&self, from_ns: u64, to_ns: u64) -> impl Iterator<Item = (u64, u64, ThreadState)> + '_ {
        let cut = move |(from, to, state): &(u64, u64, ThreadState)| ((*from).max(from_ns), (*to).min(to_ns), *state);
        self.states.iter().map(cut).filter(|(from, to, _)| from < to)
    }
}

/// Returns the state of a thread before an event, as far as the event tells it, and after it; `None` if the event is not about it.
fn change(tid: i32, event: &Event, known: Option<ThreadState>) -> Option<(Option<ThreadState>, ThreadState)> {
    match &event.kind {
        EventKind::Switch { from, state, .. } if from.tid == tid => {
            let after = match state {
                TaskState::Runnable => ThreadState::Ready(event.core),
                TaskState::Sleeping | TaskState::Gone => ThreadState::Sleeping(event.core),
                TaskState::Uninterruptible => ThreadState::Uninterruptible,
                TaskState::Stopped => ThreadState::Stopped,
            };
            Some((Some(ThreadState::Running(event.core)), after))
        }
        EventKind::Switch { to, .. } if to.tid == tid => Some((None, ThreadState::Running(event.core))),
        EventKind::Waking { task, target, .. } if task.tid == tid => match known {
            // It was about to sleep and has not left its core.
            Some(running @ ThreadState::Running(_)) => Some((None, running)),
            Some(ThreadState::Ready(_)) => Some((None, ThreadState::Ready(*target))),
            _ => Some((Some(ThreadState::Sleeping(*target)), ThreadState::Ready(*target))),
        },
        _ => None,
    }
}
