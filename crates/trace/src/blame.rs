//! The causes of a delay of a thread, from the timelines of the cores and of the thread.
//!
//! Each nanosecond of a delay has at most one cause, so the parts never add up to more than the delay.

use crate::cause::{Cause, CauseKind};
use crate::event::{Event, EventKind, Task};
use crate::timeline::{CoreTimeline, Occupant, Span, ThreadState, ThreadTimeline, complete_switches};
use std::collections::BTreeMap;

/// Page faults that follow each other within this time belong together, ns.
const FAULTS_NS: u64 = 50_000;
/// Shortest time without any event that counts as a core taken, ns. Running code of the kernel and short pauses of the host are below.
const SILENCE_NS: u64 = 20_000;

/// Longest time for which an idle core may take to run a task that it was woken for, where a limit could stop the task, ns.
const IDLE_NS: u64 = 200_000;
/// The name of a core that was taken without any event on it, and of a timer that was late on an idle core.
const HYPERVISOR: &str = "hypervisor";
const IDLE_CORE: &str = "idle core";

/// Events of all cores around a late tick.
#[derive(Debug)]
pub struct Window {
    from_ns: u64,
    to_ns: u64,
    events: Vec<Event>,
    cores: BTreeMap<usize, CoreTimeline>,
    /// True if events are missing in it.
    lost: bool,
}

/// A part of a delay, and what the thread had to do in it.
#[derive(Debug, Clone, Copy)]
pub struct Phase {
    /// Begin, ns.
    pub from_ns: u64,
    /// End, ns.
    pub to_ns: u64,
    /// The duty of the thread.
    pub duty: Duty,
}

/// The duty of a thread in a part of a delay.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Duty {
    /// Its timer should have woken it, or its spin should have ended. `gap` is the longest time between two looks at the clock in the
    /// spin, begin and end, ns.
    Timer {
        /// The gap.
        gap: (u64, u64),
    },
    /// The input is there: the thread `sender` should have woken it, or its spin should have ended.
    Wake {
        /// The thread of the sender, or 0.
        sender: i32,
        /// True if it has not spun: it sleeps until its timer expires.
        timed: bool,
        /// The gap.
        gap: (u64, u64),
    },
    /// It computes.
    Compute,
}

/// The facts about a thread that no event tells.
#[derive(Debug, Clone, Copy, Default)]
pub struct Facts {
    /// Time for which the limit of a cgroup stopped it, ns.
    pub throttled_ns: u64,
    /// True if a cgroup limits its processor time: then it is stopped if it can run and its core is idle.
    pub limited: bool,
    /// True if it took page faults with input or output.
    pub major_faults: bool,
}

impl Window {
    /// Creates the window from `from_ns` to `to_ns`. `events` are those of all cores, in any order.
    pub fn new(mut events: Vec<Event>, from_ns: u64, to_ns: u64) -> Self {
        events.sort_by_key(|event| event.ns);
        complete_switches(&mut events);
        let lost = events.iter().any(|event| event.kind == EventKind::Lost && (from_ns..to_ns).contains(&event.ns));
        let mut numbers: Vec<usize> = events.iter().map(|event| event.core).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let timeline = |core: usize| {
            let on_core = events.iter().filter(move |event| event.core == core);
            (core, CoreTimeline::new(on_core, to_ns))
        };
        let cores = numbers.into_iter().map(timeline).collect();
        Self { from_ns, to_ns, events, cores, lost }
    }

    /// Returns true if events are missing in it, so that no cause is certain.
    pub fn has_losses(&self) -> bool {
        self.lost
    }

    /// Returns the number of events.
    pub fn events(&self) -> usize {
        self.events.len()
    }

    /// Returns the occupants of the cores between two times: core and span.
    pub fn spans(&self, from_ns: u64, to_ns: u64) -> impl Iterator<Item = (usize, Span)> + '_ {
        self.cores.iter().flat_map(move |(core, timeline)| timeline.within(from_ns, to_ns).map(|span| (*core, span)))
    }

    /// Returns the causes of a delay of a thread, in phases, the largest part first.
    pub fn blame(&self, tid: i32, facts: Facts, phases: &[Phase]) -> Vec<Cause> {
        let mut blame = Blame { window: self, facts, found: Vec::new() };
        let thread = self.thread(tid);
        phases.iter().for_each(|phase| blame.phase(&thread, *phase));
        let mut causes: Vec<Cause> = Vec::new();
        for (cause, ns) in blame.found {
            match causes.iter_mut().find(|known| known.same(&cause)) {
                Some(known) => known.us += ns as f64 / 1e3,
                None => causes.push(Cause { us: ns as f64 / 1e3, ..cause }),
            }
        }
        causes.sort_by(|a, b| b.us.total_cmp(&a.us));
        causes
    }

    fn thread(&self, tid: i32) -> ThreadTimeline {
        ThreadTimeline::new(tid, &self.events, self.from_ns, self.to_ns)
    }
}

struct Blame<'a> {
    window: &'a Window,
    facts: Facts,
    found: Vec<(Cause, u64)>,
}

impl Blame<'_> {
    fn add(&mut self, cause: Cause, ns: u64) {
        if ns > 0 {
            self.found.push((cause, ns));
        }
    }

    fn add_kind(&mut self, kind: CauseKind, ns: u64) {
        self.add(Cause::new(kind, "", 0), ns);
    }

    fn phase(&mut self, thread: &ThreadTimeline, phase: Phase) {
        for (from_ns, to_ns, state) in thread.within(phase.from_ns, phase.to_ns) {
            match state {
                ThreadState::Running(core) => self.running(core, from_ns, to_ns, phase.duty, thread),
                ThreadState::Ready(core) => self.ready(core, from_ns, to_ns),
                ThreadState::Sleeping(core) => self.sleeping(core, from_ns, to_ns, phase.duty),
                ThreadState::Stopped => self.add_kind(CauseKind::Stopped, to_ns - from_ns),
                ThreadState::Uninterruptible if self.facts.major_faults => {
                    self.add_kind(CauseKind::PageFault, to_ns - from_ns);
                }
                ThreadState::Uninterruptible => {}
            }
        }
    }

    /// Blames interrupts on its core; of the rest, the gap of a spin on who took the core, and a computation on the thread.
    fn running(&mut self, core: usize, from_ns: u64, to_ns: u64, duty: Duty, thread: &ThreadTimeline) {
        let own: Vec<Span> = self.interrupts(core, from_ns, to_ns);
        let gap = match duty {
            Duty::Timer { gap } | Duty::Wake { gap, .. } => gap,
            Duty::Compute => (0, 0),
        };
        for Span { from_ns, to_ns, .. } in own {
            let (gap_from, gap_to) = (gap.0.max(from_ns), gap.1.min(to_ns));
            let taken_ns = gap_to.saturating_sub(gap_from);
            if taken_ns >= SILENCE_NS {
                self.add(Cause::new(CauseKind::CoreTaken, HYPERVISOR, 0), taken_ns);
            }
            // Before its first look at the clock a body completes its previous tick.
            let computes = duty == Duty::Compute || matches!(duty, Duty::Timer { gap } if gap.0 >= gap.1);
            if computes {
                let faults_ns = fault_time(&thread.page_faults, from_ns, to_ns);
                self.add_kind(CauseKind::PageFault, faults_ns);
                self.add_kind(CauseKind::Step, to_ns - from_ns - faults_ns);
            }
        }
    }

    /// Blames the interrupts of a core in a time, and returns the other spans.
    fn interrupts(&mut self, core: usize, from_ns: u64, to_ns: u64) -> Vec<Span> {
        let spans: Vec<Span> =
            self.window.cores.get(&core).map_or_else(Vec::new, |core| core.within(from_ns, to_ns).collect());
        let (interrupts, own): (Vec<Span>, Vec<Span>) =
            spans.into_iter().partition(|span| matches!(span.occupant, Occupant::Interrupt(_) | Occupant::Softirq(_)));
        for span in interrupts {
            self.occupant(&span);
        }
        own
    }

    /// Blames the occupant of a core for a span.
    fn occupant(&mut self, span: &Span) {
        let ns = span.to_ns - span.from_ns;
        match &span.occupant {
            Occupant::Task(Task { tid, name, priority }) => {
                let cause = Cause::new(CauseKind::Task, name, 0);
                self.add(Cause { tid: Some(*tid), priority: Some(*priority), ..cause }, ns);
            }
            Occupant::Interrupt(name) => self.add(Cause::new(CauseKind::Interrupt, name, 0), ns),
            Occupant::Softirq(name) => self.add(Cause::new(CauseKind::Softirq, name, 0), ns),
            Occupant::Idle => self.add_kind(CauseKind::IdleCore, ns),
            Occupant::Unknown => {}
        }
    }

    /// Blames who had the core for which a thread waited, unless the limit of a cgroup kept the thread from it.
    fn ready(&mut self, core: usize, from_ns: u64, to_ns: u64) {
        // The times do not cover each other exactly.
        if self.facts.throttled_ns > (to_ns - from_ns) / 2 {
            self.facts.throttled_ns = self.facts.throttled_ns.saturating_sub(to_ns - from_ns);
            return self.add_kind(CauseKind::Throttled, to_ns - from_ns);
        }
        let spans: Vec<Span> =
            self.window.cores.get(&core).map_or_else(Vec::new, |core| core.within(from_ns, to_ns).collect());
        let idle = spans.iter().filter(|span| span.occupant == Occupant::Idle);
        let idle_ns: u64 = idle.map(|span| span.to_ns - span.from_ns).sum();
        if self.facts.limited && idle_ns >= IDLE_NS {
            return self.add_kind(CauseKind::Throttled, to_ns - from_ns);
        }
        spans.iter().for_each(|span| self.occupant(span));
    }

    /// Blames a timer or a sender that should have woken the thread.
    fn sleeping(&mut self, core: usize, from_ns: u64, to_ns: u64, duty: Duty) {
        match duty {
            Duty::Timer { .. } | Duty::Wake { timed: true, .. } => self.overslept(core, from_ns, to_ns),
            Duty::Wake { sender, gap, .. } if sender > 0 => {
                let sender = self.window.thread(sender);
                // What keeps the sender from waking its reader keeps the reader waiting; its own work does not.
                self.phase(&sender, Phase { from_ns, to_ns, duty: Duty::Wake { sender: 0, timed: false, gap } });
            }
            Duty::Wake { .. } | Duty::Compute => {}
        }
    }

    /// Blames a timer that expired late, or the hypervisor if a task had the core meanwhile.
    fn overslept(&mut self, core: usize, from_ns: u64, to_ns: u64) {
        for span in self.interrupts(core, from_ns, to_ns) {
            let silent = self.window.cores.get(&core).is_some_and(|core| core.is_silent(span.from_ns, span.to_ns));
            let ns = span.to_ns - span.from_ns;
            match silent {
                true if span.occupant == Occupant::Idle => self.add(Cause::new(CauseKind::LateTimer, IDLE_CORE, 0), ns),
                true if ns >= SILENCE_NS => self.add(Cause::new(CauseKind::CoreTaken, HYPERVISOR, 0), ns),
                _ => {}
            }
        }
    }
}

/// Returns the time of a run of page faults within a time, ns.
fn fault_time(faults: &[u64], from_ns: u64, to_ns: u64) -> u64 {
    let within = faults.iter().filter(|ns| (from_ns..to_ns).contains(ns));
    let times: Vec<u64> = within.copied().chain([to_ns]).collect();
    times.windows(2).map(|pair| (pair[1] - pair[0]).min(FAULTS_NS)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::TaskState;

    const US: u64 = 1000;
    const ROLE: i32 = 100;
    const HOG: i32 = 666;

    fn task(tid: i32) -> Task {
        let (name, priority) = match tid {
            0 => ("swapper/0", 120),
            ROLE => ("corotate", 19),
            HOG => ("hog", 4),
            _ => ("other", 120),
        };
        Task { tid, name: name.to_owned(), priority }
    }

    fn event(us: u64, core: usize, kind: EventKind) -> Event {
        Event { ns: us * US, core, kind }
    }

    fn switch(us: u64, from: i32, state: TaskState, to: i32) -> Event {
        event(us, 0, EventKind::Switch { from: task(from), state, to: task(to) })
    }

    fn waking(us: u64, tid: i32) -> Event {
        event(us, 0, EventKind::Waking { by: 0, task: task(tid), target: 0 })
    }

    fn timer(us: u64) -> [Event; 2] {
        [event(us, 0, EventKind::VectorEntry { name: "local_timer" }), event(us + 3, 0, EventKind::VectorExit)]
    }

    fn blame(events: Vec<Event>, duty: Duty, from_us: u64, to_us: u64) -> Vec<(CauseKind, String, f64)> {
        let window = Window::new(events, 0, 10_000 * US);
        let phase = Phase { from_ns: from_us * US, to_ns: to_us * US, duty };
        let causes = window.blame(ROLE, Facts::default(), &[phase]);
        let sum: f64 = causes.iter().map(|cause| cause.us).sum();
        assert!(sum <= (to_us - from_us) as f64 + 1e-9, "{causes:?}");
        causes.into_iter().map(|cause| (cause.kind, cause.name, cause.us)).collect()
    }

    fn timer_duty() -> Duty {
        Duty::Timer { gap: (0, 0) }
    }

    #[test]
    fn a_task_that_preempts_a_role_is_named_with_its_time() {
        let events = vec![
            switch(10, 0, TaskState::Runnable, ROLE),
            switch(950, ROLE, TaskState::Runnable, HOG),
            switch(1700, HOG, TaskState::Sleeping, ROLE),
            switch(1800, ROLE, TaskState::Sleeping, 0),
        ];
        let causes = blame(events, Duty::Timer { gap: (949 * US, 1701 * US) }, 1000, 1703);
        assert_eq!(causes, [(CauseKind::Task, "hog".to_owned(), 700.0)]);
    }

    /// A hog that a shell starts is called like the shell, with its priority, until it runs its own program.
    #[test]
    fn a_task_has_the_name_with_which_it_leaves_the_core() {
        let early = Task { tid: HOG, name: "chrt".to_owned(), priority: 120 };
        let events = vec![
            switch(10, ROLE, TaskState::Sleeping, 0),
            event(900, 0, EventKind::Switch { from: task(0), state: TaskState::Runnable, to: early }),
            waking(1000, ROLE),
            event(1100, 0, EventKind::VectorEntry { name: "local_timer" }),
            event(1103, 0, EventKind::VectorExit),
            switch(1700, HOG, TaskState::Runnable, ROLE),
        ];
        let window = Window::new(events, 0, 10_000 * US);
        let phase = Phase { from_ns: 1000 * US, to_ns: 1700 * US, duty: timer_duty() };
        let causes = window.blame(ROLE, Facts::default(), &[phase]);
        let found: Vec<_> = causes.iter().map(|cause| (&*cause.name, cause.priority, cause.us)).collect();
        assert_eq!(found, [("hog", Some(4), 697.0), ("local_timer", None, 3.0)]);
    }

    #[test]
    fn interrupts_within_the_time_of_another_task_are_named_themselves() {
        let events = vec![
            switch(10, ROLE, TaskState::Sleeping, 7),
            waking(940, ROLE),
            event(950, 0, EventKind::SoftirqEntry { vector: 3 }),
            event(960, 0, EventKind::IrqEntry { irq: 9, name: "virtio0".to_owned() }),
            event(980, 0, EventKind::IrqExit),
            event(1200, 0, EventKind::SoftirqExit),
            switch(1250, 7, TaskState::Runnable, ROLE),
        ];
        let causes = blame(events, timer_duty(), 940, 1251);
        let expected = [
            (CauseKind::Softirq, "NET_RX".to_owned(), 230.0),
            (CauseKind::Task, "other".to_owned(), 60.0),
            (CauseKind::Interrupt, "virtio0".to_owned(), 20.0),
            (CauseKind::Step, String::new(), 1.0),
        ];
        assert_eq!(causes, expected);
    }

    #[test]
    fn a_silent_core_was_taken_and_a_long_computation_was_not() {
        let events = || vec![switch(10, 0, TaskState::Runnable, ROLE), switch(5000, ROLE, TaskState::Sleeping, 0)];
        let gap = (957 * US, 1908 * US);
        let taken = blame(events(), Duty::Timer { gap }, 1000, 1909);
        assert_eq!(taken, [(CauseKind::CoreTaken, "hypervisor".to_owned(), 908.0)]);
        assert_eq!(blame(events(), Duty::Compute, 1000, 1300), [(CauseKind::Step, String::new(), 300.0)]);
        let mut with_tick = events();
        with_tick.extend(timer(1400));
        let causes = blame(with_tick, Duty::Timer { gap }, 1000, 1909);
        let expected = [
            (CauseKind::CoreTaken, "hypervisor".to_owned(), 905.0),
            (CauseKind::Interrupt, "local_timer".to_owned(), 3.0),
        ];
        assert_eq!(
            causes, expected,
            "a spinning thread does not lose its core to an interrupt for longer than that lasts"
        );
    }

    #[test]
    fn a_timer_that_expires_late_on_an_idle_core_is_named() {
        let mut events = vec![switch(10, ROLE, TaskState::Sleeping, 0)];
        events.extend(timer(1857));
        events.extend([waking(1858, ROLE), switch(1862, 0, TaskState::Runnable, ROLE)]);
        let causes = blame(events, timer_duty(), 1000, 1863);
        assert_eq!(causes[0], (CauseKind::LateTimer, "idle core".to_owned(), 857.0));
    }

    /// Some virtual machines do not record the switches of a core away from its idle task.
    #[test]
    fn an_unrecorded_switch_from_the_idle_task_accuses_nothing() {
        let events = vec![
            switch(10, ROLE, TaskState::Sleeping, 0),
            waking(940, ROLE),
            switch(1990, ROLE, TaskState::Sleeping, 0),
        ];
        assert_eq!(blame(events.clone(), Duty::Timer { gap: (1, 2) }, 950, 1800), []);
        assert_eq!(blame(events[..2].to_vec(), Duty::Timer { gap: (1, 2) }, 950, 1800), []);
        let mut recorded = events;
        recorded.insert(2, switch(1400, 0, TaskState::Runnable, ROLE));
        let causes = blame(recorded, Duty::Timer { gap: (1, 2) }, 950, 1800);
        assert_eq!(causes, [(CauseKind::IdleCore, String::new(), 450.0)]);
    }

    /// The task that leaves a core was not the first one that was woken for it.
    #[test]
    fn the_task_that_an_idle_core_chose_is_seen_when_it_leaves() {
        let events = vec![
            switch(10, ROLE, TaskState::Sleeping, 0),
            waking(940, ROLE),
            waking(941, HOG),
            switch(1700, HOG, TaskState::Sleeping, ROLE),
        ];
        let causes = blame(events, timer_duty(), 1000, 1701);
        assert_eq!(causes[0], (CauseKind::Task, "hog".to_owned(), 700.0));
        let unknown = vec![switch(10, ROLE, TaskState::Runnable, 0), switch(1700, HOG, TaskState::Sleeping, ROLE)];
        assert_eq!(blame(unknown, timer_duty(), 1000, 1700), [], "the hog began at an unknown time");
    }

    #[test]
    fn stops_quotas_and_page_faults_are_told_apart() {
        let stopped = vec![
            switch(10, ROLE, TaskState::Stopped, 0),
            waking(1900, ROLE),
            switch(1910, 0, TaskState::Runnable, ROLE),
        ];
        assert_eq!(blame(stopped, timer_duty(), 1000, 1900), [(CauseKind::Stopped, String::new(), 900.0)]);
        let throttled = vec![switch(10, ROLE, TaskState::Runnable, 0), switch(1900, 0, TaskState::Runnable, ROLE)];
        let window = Window::new(throttled, 0, 10_000 * US);
        let phase = Phase { from_ns: 1000 * US, to_ns: 1900 * US, duty: timer_duty() };
        let causes = window.blame(ROLE, Facts { throttled_ns: 80_000 * US, ..Facts::default() }, &[phase]);
        assert_eq!((causes.len(), causes[0].kind, causes[0].us), (1, CauseKind::Throttled, 900.0));
        let limited = window.blame(ROLE, Facts { limited: true, ..Facts::default() }, &[phase]);
        assert_eq!((limited.len(), limited[0].kind), (1, CauseKind::Throttled), "its core was idle");
        let mut faults = vec![switch(10, 0, TaskState::Runnable, ROLE), switch(5000, ROLE, TaskState::Sleeping, 0)];
        faults.extend((1000..1200).map(|us| event(us, 0, EventKind::PageFault { tid: ROLE })));
        faults.sort_by_key(|event| event.ns);
        let causes = blame(faults, Duty::Compute, 1000, 1300);
        assert_eq!(causes[..2], [(CauseKind::PageFault, String::new(), 249.0), (CauseKind::Step, String::new(), 51.0)]);
    }

    #[test]
    fn a_reader_that_is_not_woken_blames_what_kept_its_sender() {
        let events = vec![
            switch(10, ROLE, TaskState::Sleeping, 7),
            switch(1000, 7, TaskState::Runnable, HOG),
            switch(1500, HOG, TaskState::Sleeping, 7),
            waking(1510, ROLE),
            switch(1511, 7, TaskState::Runnable, ROLE),
        ];
        let duty = Duty::Wake { sender: 7, timed: false, gap: (0, 0) };
        let causes = blame(events, duty, 990, 1512);
        assert_eq!(causes[0], (CauseKind::Task, "hog".to_owned(), 500.0));
    }

    #[test]
    fn a_thread_without_events_has_no_causes() {
        assert_eq!(blame(Vec::new(), timer_duty(), 0, 9000), []);
        assert_eq!(blame(vec![switch(10, 7, TaskState::Sleeping, 0)], timer_duty(), 0, 9000), []);
    }
}
