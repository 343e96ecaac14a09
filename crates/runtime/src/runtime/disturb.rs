//! Scripted faults at the places where they act: a writing end's samples, and a role before its tick.
//!
//! Must cost an undisturbed role nothing but one look whether there is anything to do.

use crate::bus::{Carried, Signal};
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::{ClockKind, ScriptedFault, Settings};
use crate::fault::{Action, Change, Delivery, Fault, FaultSequence, Interruption, Transport};
use crate::state::{Persist, Words};
use crate::telemetry::TickCounters;
use std::borrow::{Borrow, BorrowMut};

/// What happens to the samples of one signal.
#[derive(Debug)]
pub struct Disturbance<S: Carried + ?Sized> {
    faults: Vec<FaultSequence>,
    /// Samples that are held back, each with the tick at which it is sent, in the order in which they are sent. As much room
    /// as can ever be needed is taken at the start.
    late: Vec<(u64, S::Owned)>,
    room: usize,
    /// How many bodies the signal tells of.
    bodies: usize,
}

impl<S: Carried + ?Sized> Disturbance<S> {
    /// What a scenario does to a role's signal about a body, or a fleet of so many, from a tick on; nothing if there is
    /// nothing.
    pub fn for_signal(scenario: &Settings, role: &str, body: &str, bodies: usize, next_tick: u64) -> Option<Box<Self>> {
        Self::new(courses(scenario, role, Some(body), next_tick), bodies)
    }

    fn new(faults: Vec<FaultSequence>, bodies: usize) -> Option<Box<Self>> {
        let kept = |course: &FaultSequence| delay_bound(course.fault()).min(course.fault().ticks) as usize;
        // One is added before those that are due are let go.
        let room = faults.iter().map(kept).sum::<usize>() + 1;
        (!faults.is_empty()).then(|| Box::new(Self { faults, late: Vec::with_capacity(room), room, bodies }))
    }

    /// Changes the content of the sample of `tick` and tells whether anything was changed. `last` was sent before.
    pub fn alter_content(&mut self, tick: u64, sample: &mut S, last: &S) -> bool {
        let acting = self.faults.iter_mut().filter_map(|course| course.acts(tick).then_some(course.fault()));
        acting.filter(|fault| fault.alters_content()).map(|fault| fault.alter_content(tick, sample, last)).count() > 0
    }

    /// What happens to the sample of `tick` on its way: of several faults, what the first says.
    pub fn delivery(&mut self, tick: u64) -> Option<Delivery> {
        delivery(&mut self.faults, tick)
    }

    /// A sample to be disturbed.
    pub fn blank(&self) -> S::Owned {
        S::blank(self.bodies)
    }

    /// Keeps a sample until `tick`.
    pub fn keep(&mut self, tick: u64, sample: &S) {
        let mut kept = self.blank();
        kept.borrow_mut().assign(sample);
        let at = self.late.partition_point(|(due, _)| *due <= tick);
        self.late.insert(at, (tick, kept));
    }

    /// How many of the samples that are kept are to be sent before that of `tick`.
    pub fn due(&self, tick: u64) -> u64 {
        self.late.partition_point(|(due, _)| *due <= tick) as u64
    }

    /// One of the samples that are kept, in the order in which they are sent.
    pub fn late(&self, index: u64) -> Option<&S> {
        self.late.get(index as usize).map(|(_, sample)| sample.borrow())
    }

    /// Lets the first samples that are kept go.
    pub fn forget(&mut self, samples: u64) {
        self.late.drain(..self.late.len().min(samples as usize));
    }
}

impl<S: Carried + ?Sized> Persist for Disturbance<S> {
    fn persist<W: Words>(&mut self, words: &mut W) {
        let mut count = self.late.len() as u64;
        count.persist(words);
        self.late.resize_with(self.room, || (0, S::blank(self.bodies)));
        for (due, sample) in &mut self.late {
            due.persist(words);
            sample.borrow_mut().words_mut().persist(words);
        }
        self.late.truncate(count as usize);
    }
}

/// What a scenario does to a role (`body` none) or to its signal about a body. What a predecessor has passed is decided here,
/// and not at its successor's first tick.
fn courses(scenario: &Settings, role: &str, body: Option<&str>, next_tick: u64) -> Vec<FaultSequence> {
    let here = |fault: &&ScriptedFault| fault.role == role && fault.body.as_deref() == body;
    let course = |scripted: &ScriptedFault| {
        let mut course = FaultSequence::new(scripted.fault.clone());
        if let Some(last) = next_tick.checked_sub(1) {
            course.acts(last);
        }
        course
    };
    scenario.faults.iter().filter(here).map(course).collect()
}

fn delivery(faults: &mut [FaultSequence], tick: u64) -> Option<Delivery> {
    faults.iter_mut().find_map(|course| course.fault().delivery(tick).filter(|_| course.acts(tick)))
}

/// Which samples of a signal are late because a scripted fault says so. Where there are no voids, a reader knows by it that
/// they are, however soon after their tick it looks: what is late is so by the script, not by who was faster.
#[derive(Debug)]
pub struct LateSamples(Vec<FaultSequence>);

impl LateSamples {
    /// Those of a signal about a body; nothing if there are none that a reader could take for samples in time.
    pub fn for_signal(scenario: &Settings, signal: Signal, body: &str) -> Option<Box<Self>> {
        let role = match signal {
            Signal::Measurement => body,
            Signal::Estimate => "observer",
            Signal::Command => "controller",
            _ => return None,
        };
        let faults = courses(scenario, role, Some(body), 0);
        let late = scenario.clock == ClockKind::Realtime && faults.iter().any(|course| delay_bound(course.fault()) > 0);
        late.then(|| Box::new(Self(faults)))
    }

    /// Whether that of a tick is.
    pub fn contains(&mut self, tick: u64) -> bool {
        matches!(delivery(&mut self.0, tick), Some(Delivery::Late(_)))
    }
}

/// By how many ticks a fault sends a sample late, at the most.
fn delay_bound(fault: &Fault) -> u64 {
    if let Action::Transport(Transport::Delay(delay)) = fault.action { delay.bound() } else { 0 }
}

/// How many late samples may come at once on a signal of a scenario, at the most.
pub fn late_samples(scenario: &Settings) -> usize {
    scenario.faults.iter().map(|scripted| delay_bound(&scripted.fault) as usize).sum()
}

/// How many samples per tick a signal of a scenario may carry beyond the one that is its own.
pub fn extra_samples(scenario: &Settings) -> usize {
    let extra = |scripted: &&ScriptedFault| match scripted.fault.action {
        Action::Transport(transport) => transport != Transport::Drop,
        // A flip of a bit may make a sample that belongs to no tick, beside the void in its place.
        Action::Content(tamper) => matches!(tamper.change, Change::Flip(_)),
        Action::Role(_) => false,
    };
    scenario.faults.iter().filter(extra).count()
}

/// The scripted faults that a role has met before a tick.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct InjectedFaults {
    /// So many stalls.
    stalls: u64,
    /// Its life is over, where it has no process that could be killed: whoever drives it builds it anew.
    killed: bool,
}

/// What happens to a role before its ticks.
#[derive(Debug)]
pub struct Interruptions {
    faults: Vec<FaultSequence>,
    first_life: bool,
    /// Whether the role is a process, which can be killed.
    process: bool,
    /// Ticks before this one have been looked at.
    next: u64,
}

impl Interruptions {
    /// What a scenario does to a role in this generation of it, from a tick on.
    pub fn for_role(scenario: &Settings, role: &str, generation: u64, next_tick: u64) -> Self {
        let process = scenario.clock != ClockKind::InProcess;
        let faults = courses(scenario, role, None, next_tick);
        Self { faults, first_life: generation == 1, process, next: 0 }
    }

    /// Whether the role is not to execute this tick, whatever is there for it.
    #[inline]
    pub fn misses(&mut self, tick: u64) -> bool {
        !self.faults.is_empty() && self.scripts_miss(tick)
    }

    #[cold]
    fn scripts_miss(&mut self, tick: u64) -> bool {
        let miss = Action::Role(Interruption::Miss);
        self.faults.iter_mut().any(|course| course.fault().action == miss && course.acts(tick))
    }

    /// Acts before the next tick of a role, once, and enters it into the role's counters; true if the role's life is over.
    #[inline]
    pub fn before_next(&mut self, counters: &mut TickCounters) -> bool {
        let injected = self.before(counters.next());
        counters.stalled(injected.stalls);
        injected.killed
    }

    #[inline]
    fn before(&mut self, tick: u64) -> InjectedFaults {
        if self.faults.is_empty() || tick < self.next { InjectedFaults::default() } else { self.act(tick) }
    }

    #[cold]
    fn act(&mut self, tick: u64) -> InjectedFaults {
        self.next = tick + 1;
        let mut injected = InjectedFaults::default();
        for course in &mut self.faults {
            let acts = course.acts(tick);
            match course.fault().action {
                _ if !acts => {}
                Action::Role(Interruption::Stall { ns }) => {
                    stall(ns);
                    injected.stalls += 1;
                }
                Action::Role(Interruption::Kill) if self.first_life => {
                    if self.process {
                        kill();
                    }
                    injected.killed = true;
                }
                _ => {}
            }
        }
        injected
    }
}

/// Does nothing for so long, deaf to everything.
fn stall(ns: u64) {
    let end_ns = monotonic_ns() + ns;
    while monotonic_ns() < end_ns {
        sleep_until(end_ns);
    }
}

/// Ends this process as the kernel or an operator would: without a word, without cleaning up.
fn kill() {
    // Nothing is left to do if the kernel should refuse; then the role lives on, and the fault was none.
    let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault::{Delay, Occurrence};
    use crate::sample::RateCommand;

    fn fault(from_tick: u64, ticks: u64, action: Action) -> FaultSequence {
        FaultSequence::new(Fault { from_tick, ticks, occurrence: Occurrence::Independent(1.0), seed: 1, action })
    }

    #[test]
    fn what_is_kept_comes_in_order_when_it_is_due_and_takes_no_memory_on_the_way() {
        let delay = Action::Transport(Transport::Delay(Delay::constant(3)));
        let mut disturbance = Disturbance::<RateCommand>::new(vec![fault(5, 100, delay)], 1).unwrap();
        let room = disturbance.late.capacity();
        assert_eq!(room, 3 + 1);
        for tick in 5..105_u64 {
            let due = disturbance.due(tick);
            let sent = (0..due).map(|index| disturbance.late(index).unwrap().stamp.tick).collect::<Vec<_>>();
            disturbance.forget(due);
            assert_eq!(sent, if tick < 8 { vec![] } else { vec![tick - 3] });
            assert_eq!(disturbance.delivery(tick), Some(Delivery::Late(3)));
            let mut sample = RateCommand::default();
            sample.stamp.tick = tick;
            disturbance.keep(tick + 3, &sample);
        }
        assert_eq!((disturbance.delivery(105), disturbance.late.capacity()), (None, room));
    }

    /// Whatever is drawn, what is late finds room, and comes when it is due.
    #[test]
    fn samples_that_overtake_one_another_take_no_memory_on_the_way() {
        let delay = Delay { jitter_ticks: 7, ..Delay::constant(0) };
        let delay = Action::Transport(Transport::Delay(delay));
        let mut disturbance = Disturbance::<RateCommand>::new(vec![fault(5, 500, delay)], 1).unwrap();
        let (room, mut overtaken, mut at_once, mut come) = (disturbance.late.capacity(), 0, 0, Vec::new());
        for tick in 5..520_u64 {
            let due = disturbance.due(tick);
            at_once = at_once.max(due);
            for index in 0..due {
                let sent = disturbance.late(index).unwrap().stamp.tick;
                overtaken += u64::from(come.last().is_some_and(|last| *last > sent));
                come.push(sent);
            }
            disturbance.forget(due);
            match disturbance.delivery(tick) {
                Some(Delivery::Late(ticks)) => {
                    let mut sample = RateCommand::default();
                    sample.stamp.tick = tick;
                    disturbance.keep(tick + ticks, &sample);
                }
                way => {
                    assert_eq!(way, None);
                    come.push(tick);
                }
            }
        }
        assert!(overtaken > 50 && at_once > 2, "{overtaken} {at_once}");
        assert_eq!((disturbance.late.len(), disturbance.late.capacity()), (0, room));
        come.sort_unstable();
        assert_eq!(come, (5..520).collect::<Vec<_>>(), "each once");
    }

    #[test]
    fn of_several_faults_the_first_decides_the_way() {
        let [drop, twice] = [Transport::Drop, Transport::Duplicate].map(Action::Transport);
        let mut disturbance = Disturbance::<RateCommand>::new(vec![fault(5, 2, twice), fault(6, 2, drop)], 1).unwrap();
        let ways = [4, 5, 6, 7, 8].map(|tick| disturbance.delivery(tick));
        let (drop, twice) = (Some(Delivery::Dropped), Some(Delivery::Twice));
        assert_eq!(ways, [None, twice, twice, drop, None]);
        assert!(Disturbance::<RateCommand>::new(Vec::new(), 1).is_none());
    }

    #[test]
    fn a_stall_holds_the_role_up_once_per_tick() {
        let faults = vec![fault(3, 2, Action::Role(Interruption::Stall { ns: 2_000_000 }))];
        let mut interruptions = Interruptions { faults, first_life: false, process: true, next: 0 };
        let begun = monotonic_ns();
        let stalls = [0, 1, 3, 3, 4, 5].map(|tick| interruptions.before(tick).stalls);
        assert_eq!(stalls, [0, 0, 1, 0, 1, 0]);
        assert!(monotonic_ns() - begun >= 4_000_000);
    }

    #[test]
    fn whoever_has_no_process_is_told_of_its_end_and_its_successor_is_spared() {
        let kill = || vec![fault(3, 1, Action::Role(Interruption::Kill))];
        let mut first = Interruptions { faults: kill(), first_life: true, process: false, next: 0 };
        assert_eq!([2, 3].map(|tick| first.before(tick).killed), [false, true]);
        let mut second = Interruptions { faults: kill(), first_life: false, process: true, next: 0 };
        assert!(!second.before(3).killed, "and lives to say so");
    }
}
