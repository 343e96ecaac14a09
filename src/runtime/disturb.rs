//! Scripted faults at the places where they act: a writing end's samples, and a role before its tick.
//!
//! Must cost an undisturbed role nothing but one look whether there is anything to do.

use crate::bus::Carried;
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::{ClockKind, Scenario, ScriptedFault};
use crate::fault::{Action, Change, Fault, Interruption, Transport};
use crate::state::{Persist, Words};
use crate::telemetry::TickCounters;
use std::borrow::{Borrow, BorrowMut};

/// What happens to the samples of one signal.
#[derive(Debug)]
pub struct Disturbance<S: Carried + ?Sized> {
    faults: Vec<Fault>,
    /// Samples that are held back, each with the tick at which it is sent, in the order in which they are sent. As much room
    /// as can ever be needed is taken at the start.
    late: Vec<(u64, S::Owned)>,
    room: usize,
    /// How many bodies the signal tells of.
    bodies: usize,
}

impl<S: Carried + ?Sized> Disturbance<S> {
    /// What a scenario does to a role's signal about a body, or a fleet of so many; nothing if there is nothing.
    pub fn of(scenario: &Scenario, role: &str, body: &str, bodies: usize) -> Option<Box<Self>> {
        let here = |fault: &&ScriptedFault| fault.role == role && fault.body.as_deref() == Some(body);
        Self::new(scenario.faults.iter().filter(here).map(|scripted| scripted.fault.clone()).collect(), bodies)
    }

    fn new(faults: Vec<Fault>, bodies: usize) -> Option<Box<Self>> {
        let kept = |fault: &Fault| match fault.action {
            Action::Transport(Transport::Delay { ticks }) => ticks.min(fault.ticks) as usize,
            _ => 0,
        };
        // One is added before those that are due are let go.
        let room = faults.iter().map(kept).sum::<usize>() + 1;
        (!faults.is_empty()).then(|| Box::new(Self { faults, late: Vec::with_capacity(room), room, bodies }))
    }

    /// Changes the content of the sample of `tick` and tells whether anything was changed. `last` was sent before.
    pub fn tamper(&self, tick: u64, sample: &mut S, last: &S) -> bool {
        let acting = self.faults.iter().filter(|fault| fault.tampers() && fault.acts(tick));
        acting.map(|fault| fault.tamper(tick, sample, last)).count() > 0
    }

    /// What happens to the sample of `tick` on its way: of several faults, what the first says.
    pub fn way(&self, tick: u64) -> Option<Transport> {
        self.faults.iter().find_map(|fault| match fault.action {
            Action::Transport(transport) if fault.acts(tick) => Some(transport),
            _ => None,
        })
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

/// How many samples per tick a signal of a scenario may carry beyond the one that is its own.
pub fn extra_samples(scenario: &Scenario) -> usize {
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
    faults: Vec<Fault>,
    first_life: bool,
    /// Whether the role is a process, which can be killed.
    process: bool,
    /// Ticks before this one have been looked at.
    next: u64,
}

impl Interruptions {
    /// What a scenario does to a role in this generation of it.
    pub fn of(scenario: &Scenario, role: &str, generation: u64) -> Self {
        let here = |fault: &&ScriptedFault| fault.role == role && fault.body.is_none();
        let faults = scenario.faults.iter().filter(here).map(|scripted| scripted.fault.clone()).collect();
        let process = scenario.clock != ClockKind::InProcess;
        Self { faults, first_life: generation == 1, process, next: 0 }
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
        for fault in self.faults.iter().filter(|fault| fault.acts(tick)) {
            match fault.action {
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
    use crate::sample::RateCommand;

    fn fault(from_tick: u64, ticks: u64, action: Action) -> Fault {
        Fault { from_tick, ticks, probability: 1.0, seed: 1, action }
    }

    #[test]
    fn what_is_kept_comes_in_order_when_it_is_due_and_takes_no_memory_on_the_way() {
        let delay = Action::Transport(Transport::Delay { ticks: 3 });
        let mut disturbance = Disturbance::<RateCommand>::new(vec![fault(5, 100, delay)], 1).unwrap();
        let room = disturbance.late.capacity();
        assert_eq!(room, 3 + 1);
        for tick in 5..105_u64 {
            let due = disturbance.due(tick);
            let sent = (0..due).map(|index| disturbance.late(index).unwrap().stamp.tick).collect::<Vec<_>>();
            disturbance.forget(due);
            assert_eq!(sent, if tick < 8 { vec![] } else { vec![tick - 3] });
            assert_eq!(disturbance.way(tick), Some(Transport::Delay { ticks: 3 }));
            let mut sample = RateCommand::default();
            sample.stamp.tick = tick;
            disturbance.keep(tick + 3, &sample);
        }
        assert_eq!((disturbance.way(105), disturbance.late.capacity()), (None, room));
    }

    #[test]
    fn of_several_faults_the_first_decides_the_way() {
        let [drop, twice] = [Transport::Drop, Transport::Duplicate].map(Action::Transport);
        let disturbance = Disturbance::<RateCommand>::new(vec![fault(5, 2, twice), fault(6, 2, drop)], 1).unwrap();
        let ways = [4, 5, 6, 7, 8].map(|tick| disturbance.way(tick));
        let (drop, twice) = (Some(Transport::Drop), Some(Transport::Duplicate));
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
