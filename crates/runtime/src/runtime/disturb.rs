//! Scripted faults where they act: on the samples of a writing end, and on a role before its tick.
//!
//! Must cost an undisturbed role no more than one check.

use crate::bus::{Carried, Signal};
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::{ClockKind, ScriptedFault, Settings};
use crate::fault::{Action, Change, Delivery, Fault, FaultSequence, Interruption, Transport};
use crate::state::{Persist, Words};
use crate::telemetry::TickCounters;
use std::borrow::{Borrow, BorrowMut};

/// The scripted faults on the samples of one signal.
#[derive(Debug)]
pub struct Disturbance<S: Carried + ?Sized> {
    faults: Vec<FaultSequence>,
    /// Delayed samples, each with the tick at which it is sent, in sending order. The capacity for the worst case is
    /// allocated at the start.
    late: Vec<(u64, S::Owned)>,
    room: usize,
    /// Number of bodies in a sample.
    bodies: usize,
}

impl<S: Carried + ?Sized> Disturbance<S> {
    /// Returns a scenario's faults on a role's signal about a body, or a fleet of `bodies`, from `next_tick` on; `None`
    /// without faults.
    pub fn for_signal(scenario: &Settings, role: &str, body: &str, bodies: usize, next_tick: u64) -> Option<Box<Self>> {
        Self::new(fault_sequences(scenario, role, Some(body), next_tick), bodies)
    }

    fn new(faults: Vec<FaultSequence>, bodies: usize) -> Option<Box<Self>> {
        let kept = |sequence: &FaultSequence| delay_bound(sequence.fault()).min(sequence.fault().ticks) as usize;
        // A sample is added before the due ones are removed.
        let room = faults.iter().map(kept).sum::<usize>() + 1;
        (!faults.is_empty()).then(|| Box::new(Self { faults, late: Vec::with_capacity(room), room, bodies }))
    }

    /// Changes the content of the sample of `tick`; returns true if a content fault acted. `last` is the sample sent
    /// before.
    pub fn alter_content(&mut self, tick: u64, sample: &mut S, last: &S) -> bool {
        let acting = self.faults.iter_mut().filter_map(|sequence| sequence.acts(tick).then_some(sequence.fault()));
        acting.filter(|fault| fault.alters_content()).map(|fault| fault.alter_content(tick, sample, last)).count() > 0
    }

    /// Returns the delivery fault of the sample of `tick`: of several faults, the first one's.
    pub fn delivery(&mut self, tick: u64) -> Option<Delivery> {
        delivery(&mut self.faults, tick)
    }

    /// Returns a zero sample.
    pub fn blank(&self) -> S::Owned {
        S::blank(self.bodies)
    }

    /// Holds a sample back until `tick`.
    pub fn keep(&mut self, tick: u64, sample: &S) {
        let mut kept = self.blank();
        kept.borrow_mut().assign(sample);
        let at = self.late.partition_point(|(due, _)| *due <= tick);
        self.late.insert(at, (tick, kept));
    }

    /// Returns the number of delayed samples that are due before the sample of `tick`.
    pub fn due(&self, tick: u64) -> u64 {
        self.late.partition_point(|(due, _)| *due <= tick) as u64
    }

    /// Returns a delayed sample by its position in sending order.
    pub fn late(&self, index: u64) -> Option<&S> {
        self.late.get(index as usize).map(|(_, sample)| sample.borrow())
    }

    /// Removes the first delayed samples.
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

/// Returns a scenario's faults on a role (`body` is `None`) or on its signal about a body. Ticks of a predecessor are
/// replayed here, not at the successor's first tick.
fn fault_sequences(scenario: &Settings, role: &str, body: Option<&str>, next_tick: u64) -> Vec<FaultSequence> {
    let here = |fault: &&ScriptedFault| fault.role == role && fault.body.as_deref() == body;
    let sequence = |scripted: &ScriptedFault| {
        let mut sequence = FaultSequence::new(scripted.fault.clone());
        if let Some(last) = next_tick.checked_sub(1) {
            sequence.acts(last);
        }
        sequence
    };
    scenario.faults.iter().filter(here).map(sequence).collect()
}

fn delivery(faults: &mut [FaultSequence], tick: u64) -> Option<Delivery> {
    faults.iter_mut().find_map(|sequence| sequence.fault().delivery(tick).filter(|_| sequence.acts(tick)))
}

/// The samples of a signal that a scripted fault delays. Without no-sample markers a reader uses this to reject a late
/// sample, however early it reads: lateness follows from the script, not from timing.
#[derive(Debug)]
pub struct LateSamples(Vec<FaultSequence>);

impl LateSamples {
    /// Returns the delays of a signal about a body; `None` if no reader could mistake a late sample for one in time.
    pub fn for_signal(scenario: &Settings, signal: Signal, body: &str) -> Option<Box<Self>> {
        let role = match signal {
            Signal::Measurement => body,
            Signal::Estimate => scenario.bodies.iter().find(|info| info.name == body)?.observer.as_deref()?,
            Signal::Command => "controller",
            _ => return None,
        };
        let faults = fault_sequences(scenario, role, Some(body), 0);
        let late =
            scenario.clock == ClockKind::Realtime && faults.iter().any(|sequence| delay_bound(sequence.fault()) > 0);
        late.then(|| Box::new(Self(faults)))
    }

    /// Returns true if the sample of this tick is delayed.
    pub fn contains(&mut self, tick: u64) -> bool {
        matches!(delivery(&mut self.0, tick), Some(Delivery::Late(_)))
    }
}

/// Returns the largest delay of a fault, ticks.
fn delay_bound(fault: &Fault) -> u64 {
    if let Action::Transport(Transport::Delay(delay)) = fault.action { delay.bound() } else { 0 }
}

/// Returns the largest number of delayed samples that a signal may carry at once.
pub fn late_samples(scenario: &Settings) -> usize {
    scenario.faults.iter().map(|scripted| delay_bound(&scripted.fault) as usize).sum()
}

/// Returns the largest number of samples per tick that faults add to a signal.
pub fn extra_samples(scenario: &Settings) -> usize {
    let extra = |scripted: &&ScriptedFault| match scripted.fault.action {
        Action::Transport(transport) => transport != Transport::Drop,
        // A flipped bit may create a sample of an invalid tick beside the no-sample marker that replaces it.
        Action::Content(tamper) => matches!(tamper.change, Change::Flip(_)),
        Action::Role(_) => false,
    };
    scenario.faults.iter().filter(extra).count()
}

/// The number of skipped ticks whose faults still act: a role that was stopped for longer does not search through all of them.
const SKIPPED_TICKS_MAX: u64 = 10_000;

/// The faults that acted before a tick.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct InjectedFaults {
    /// Number of stalls.
    stalls: u64,
    /// True if a role without a process of its own was killed: its driver rebuilds it.
    killed: bool,
}

/// The scripted faults on a role before its ticks.
#[derive(Debug)]
pub struct Interruptions {
    faults: Vec<FaultSequence>,
    first_life: bool,
    /// True if the role is a process, which can be killed.
    process: bool,
    /// The first tick that has not been checked.
    next: u64,
}

impl Interruptions {
    /// Returns a scenario's faults on a role of this generation, from `next_tick` on.
    pub fn for_role(scenario: &Settings, role: &str, generation: u64, next_tick: u64) -> Self {
        let process = scenario.clock != ClockKind::InProcess;
        let faults = fault_sequences(scenario, role, None, next_tick);
        Self { faults, first_life: generation == 1, process, next: 0 }
    }

    /// Returns true if a scripted fault skips this tick.
    #[inline]
    pub fn misses(&mut self, tick: u64) -> bool {
        !self.faults.is_empty() && self.scripts_miss(tick)
    }

    #[cold]
    fn scripts_miss(&mut self, tick: u64) -> bool {
        let miss = Action::Role(Interruption::Miss);
        self.faults.iter_mut().any(|sequence| sequence.fault().action == miss && sequence.acts(tick))
    }

    /// Applies the faults before the role's next tick, once, and counts them; returns true if the role was killed.
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
        // In real time a late role skips ticks: their faults act before the next one.
        let first = if self.next == 0 { tick } else { self.next.max(tick.saturating_sub(SKIPPED_TICKS_MAX)) };
        self.next = tick + 1;
        let mut injected = InjectedFaults::default();
        for sequence in &mut self.faults {
            let acts = (first..=tick).any(|tick| sequence.acts(tick));
            match sequence.fault().action {
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

/// Sleeps for this time and ignores everything else.
fn stall(ns: u64) {
    let end_ns = monotonic_ns() + ns;
    while monotonic_ns() < end_ns {
        sleep_until(end_ns);
    }
}

/// Kills this process with SIGKILL, without any cleanup.
fn kill() {
    // If the kernel refuses, the role continues and the fault has no effect.
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
    fn delayed_samples_arrive_in_order_without_allocation() {
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

    /// Random delays never exceed the allocated capacity.
    #[test]
    fn randomly_delayed_samples_arrive_once_without_allocation() {
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
    fn the_first_of_several_faults_decides_the_delivery() {
        let [drop, twice] = [Transport::Drop, Transport::Duplicate].map(Action::Transport);
        let mut disturbance = Disturbance::<RateCommand>::new(vec![fault(5, 2, twice), fault(6, 2, drop)], 1).unwrap();
        let ways = [4, 5, 6, 7, 8].map(|tick| disturbance.delivery(tick));
        let (drop, twice) = (Some(Delivery::Dropped), Some(Delivery::Twice));
        assert_eq!(ways, [None, twice, twice, drop, None]);
        assert!(Disturbance::<RateCommand>::new(Vec::new(), 1).is_none());
    }

    #[test]
    fn a_stall_delays_the_role_once_per_tick() {
        let faults = vec![fault(3, 2, Action::Role(Interruption::Stall { ns: 2_000_000 }))];
        let mut interruptions = Interruptions { faults, first_life: false, process: true, next: 0 };
        let begun = monotonic_ns();
        let stalls = [0, 1, 3, 3, 4, 5].map(|tick| interruptions.before(tick).stalls);
        assert_eq!(stalls, [0, 0, 1, 0, 1, 0]);
        assert!(monotonic_ns() - begun >= 4_000_000);
    }

    #[test]
    fn a_kill_without_a_process_is_returned_once_and_spares_the_successor() {
        let kill = || vec![fault(3, 1, Action::Role(Interruption::Kill))];
        let mut first = Interruptions { faults: kill(), first_life: true, process: false, next: 0 };
        assert_eq!([2, 3].map(|tick| first.before(tick).killed), [false, true]);
        let mut late = Interruptions { faults: kill(), first_life: true, process: false, next: 0 };
        assert_eq!([2, 7, 8].map(|tick| late.before(tick).killed), [false, true, false], "tick 3 was skipped");
        let mut second = Interruptions { faults: kill(), first_life: false, process: true, next: 0 };
        assert!(!second.before(3).killed, "the successor is not killed");
    }
}
