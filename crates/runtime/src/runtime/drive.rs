//! Decides when a node runs: on the time grid, or when its inputs arrive. One driver per clock.
//!
//! Must not know what a node computes. Real time: absolute deadlines, a bounded spin, then sleep on a notifier; late
//! ticks are skipped and counted, never executed in a burst. Lockstep: inputs and credit only, no time.

use super::error::NodeError;
use super::hooks::{self, Failpoint};
use super::late_watch::LateWatch;
use super::node::{Node, Poll, ReadyNode, RunCondition};
use super::role_id::RoleId;
use crate::bus::{Bus, BusError, Read, Write};
use crate::clock::{Grid, SpinGap, monotonic_ns, sleep_until, wait_until};
use crate::sample::{Health, Phase, RoleState, Schedule, Stamp};
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering};

/// Interval at which a role reads the schedule and publishes its heartbeat, ns.
const TURN_NS: u64 = 20_000_000;
/// Interval between checks that the run still exists, ns.
const GONE_NS: u64 = 1_000_000_000;
/// Sleep between two polls if no input can wake the role, ns.
const NAP_NS: u64 = 50_000;
/// Longest sleep on the notifier of a missing input, ns.
const SLEEP_NS: u64 = 20_000_000;
/// Time that a role still waits for inputs after its last tick, ns and periods.
const GRACE_NS: u64 = 1_000_000_000;
const GRACE_PERIODS: u64 = 5;
/// Lockstep ticks between two reads of the schedule and the time.
const TURN_TICKS: u64 = 256;

/// The end of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// The last tick is done.
    Finished,
    /// The launcher or a signal ended the run.
    Stopped,
}

/// Status of one role, published to the launcher.
pub struct Heartbeat<B: Bus> {
    /// The role.
    pub role: RoleId,
    /// The writing end of its health signal.
    pub health: B::Writer<Health>,
    /// The role's generation, from 1.
    pub generation: u64,
}

/// A process's link to the launcher, with the heartbeat of each of its roles.
pub struct LauncherLink<'a, B: Bus> {
    bus: &'a B,
    schedule: B::Reader<Schedule>,
    heartbeats: Vec<Heartbeat<B>>,
    denied: u64,
    terminated: &'a AtomicBool,
    /// Result of the last check that the run still exists, and time of the next check, ns.
    gone: bool,
    next_look_ns: u64,
}

impl<'a, B: Bus> LauncherLink<'a, B> {
    /// Creates the link over open signals. `denied` is the number of refused privileges; `terminated` is set by a
    /// signal that asks the process to end.
    pub fn new(
        bus: &'a B,
        schedule: B::Reader<Schedule>,
        heartbeats: Vec<Heartbeat<B>>,
        denied: u64,
        terminated: &'a AtomicBool,
    ) -> Self {
        Self { bus, schedule, heartbeats, denied, terminated, gone: false, next_look_ns: 0 }
    }

    /// Returns true if no role of this process had a predecessor.
    pub fn first(&self) -> bool {
        self.heartbeats.iter().all(|heartbeat| heartbeat.generation == 1)
    }

    /// Publishes the state and tick counters of each role.
    ///
    /// # Errors
    /// [`BusError::Send`].
    pub fn announce(&mut self, state: RoleState, node: &dyn Node) -> Result<(), BusError> {
        let denied = self.denied;
        for Heartbeat { role, health, generation } in &mut self.heartbeats {
            let ticks = node.member(*role).unwrap_or(node).ticks();
            health.send(|health| {
                let sent_ns = monotonic_ns();
                health.stamp = Stamp { tick: ticks.elapsed, generation: *generation, origin_ns: sent_ns, sent_ns };
                health.state = state as u64;
                health.executed = ticks.executed;
                health.missed = ticks.missed;
                health.denied = denied;
            })?;
            health.prepare()?;
        }
        Ok(())
    }

    /// Returns the newest schedule.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn schedule(&mut self) -> Result<Schedule, BusError> {
        while self.schedule.advance()? {}
        Ok(self.schedule.current().copied().unwrap_or_default())
    }

    /// Returns true if the run is over for this process.
    ///
    /// # Errors
    /// [`BusError::Receive`].
    pub fn stopped(&mut self) -> Result<bool, BusError> {
        let stop_requested =
            self.terminated.load(Ordering::Relaxed) || Phase::from_number(self.schedule()?.phase) == Phase::Stop;
        Ok(stop_requested || self.gone())
    }

    /// Returns true if the run no longer exists: a killed launcher sends no stop.
    fn gone(&mut self) -> bool {
        let now_ns = monotonic_ns();
        if now_ns >= self.next_look_ns {
            self.next_look_ns = now_ns + GONE_NS;
            self.gone = self.bus.is_gone();
        }
        self.gone
    }
}

/// Waiting behaviour of a role in real time.
#[derive(Debug, Clone, Copy)]
pub struct WaitPolicy<'a> {
    /// The role wakes this long before the tick and spins the rest, ns.
    pub lead_ns: u64,
    /// Longest spin for a due sample, ns. At 0 the role sleeps at once and no timer wakes it.
    pub spin_ns: u64,
    /// For samples of these roles it yields instead of spinning: they need its core.
    pub yields_to: &'a [RoleId],
    /// Instant in the period, as a fraction, after which the role continues without missing samples.
    pub cutoff: f64,
}

/// Drives the nodes of one process.
pub struct Driver<'a, 'b, B: Bus> {
    launcher: &'a mut LauncherLink<'b, B>,
    last_tick: u64,
    window_ticks: u64,
    next_turn_ns: u64,
    late: Option<LateWatch>,
    /// The longest gap of the current tick's spin.
    gap: SpinGap,
    /// True if the process slept until a time before the current tick, and was not seen awake before its inputs.
    slept: bool,
    /// The tick before which latencies are not judged, until it has come.
    grace_ticks: u64,
}

impl<'a, 'b, B: Bus> Driver<'a, 'b, B> {
    /// Creates a driver up to `last_tick`; in lockstep at most `window_ticks` ahead of the slowest consumer.
    pub fn new(launcher: &'a mut LauncherLink<'b, B>, last_tick: u64, window_ticks: u64) -> Self {
        Self {
            launcher,
            last_tick,
            window_ticks,
            next_turn_ns: 0,
            late: None,
            gap: SpinGap::default(),
            slept: false,
            grace_ticks: 0,
        }
    }

    /// Adds the records of late ticks.
    #[must_use]
    pub fn with_late(self, late: Option<LateWatch>) -> Self {
        Self { late, ..self }
    }

    /// Forgets the latencies of the ticks before `grace_ticks`.
    #[must_use]
    pub fn with_grace(self, grace_ticks: u64) -> Self {
        Self { grace_ticks, ..self }
    }

    /// Drives a node on the time grid.
    ///
    /// # Errors
    /// [`NodeError`] if a link failed.
    pub fn realtime(&mut self, node: &mut dyn Node, grid: Grid, policy: &WaitPolicy<'_>) -> Result<Ended, NodeError> {
        while node.next_tick() <= self.last_tick {
            let due_ns = grid.due_ns(node.next_tick());
            self.slept = false;
            let timed = node.time_triggered() || policy.spin_ns > 0;
            if timed && self.idle_until(due_ns.saturating_sub(policy.lead_ns), node)? {
                return Ok(Ended::Stopped);
            }
            node.before_tick();
            self.gap = SpinGap::default();
            let begun = if node.time_triggered() { self.on_time(node, grid, policy.lead_ns)? } else { Poll::Waiting };
            let waits = begun == Poll::Waiting && node.next_tick() <= self.last_tick;
            let executed = if waits { self.on_arrival(node, grid, policy)? } else { Some(begun) };
            match executed {
                Some(Poll::Executed) => {
                    if begun == Poll::Executed && !policy.yields_to.is_empty() {
                        // Other roles wait for the sent sample, and for this core.
                        std::thread::yield_now();
                    }
                    node.finish_tick()?;
                }
                Some(Poll::Waiting | Poll::Missed) => {}
                None => return Ok(Ended::Stopped),
            }
            if self.grace_ticks > 0 && node.next_tick() >= self.grace_ticks {
                node.clear_stages();
                self.grace_ticks = 0;
            }
            if let Some(late) = &mut self.late {
                late.look(node, grid, &self.gap, self.slept);
            }
            if self.turn(node)? {
                return Ok(Ended::Stopped);
            }
        }
        Ok(Ended::Finished)
    }

    /// Executes a plant's tick when it is due, or the latest due one if this process was delayed.
    fn on_time(&mut self, node: &mut dyn Node, grid: Grid, lead_ns: u64) -> Result<Poll, NodeError> {
        let now_ns = wait_until(grid.due_ns(node.next_tick()), lead_ns, &mut self.gap);
        node.poll(RunCondition::Now { tick: grid.tick_at(now_ns), now_ns })
    }

    /// Waits for the inputs of a tick and executes it. Spins for a while, then sleeps on the notifier of the missing
    /// input. `None` if the run was stopped.
    fn on_arrival(
        &mut self,
        node: &mut dyn Node,
        grid: Grid,
        policy: &WaitPolicy<'_>,
    ) -> Result<Option<Poll>, NodeError> {
        let tick = node.next_tick();
        let overdue_ns = grid.due_ns(tick) + (grid.period_ns as f64 * policy.cutoff) as u64;
        let end_ns = grid.due_ns(self.last_tick) + GRACE_NS + GRACE_PERIODS * grid.period_ns;
        let spin_end_ns = monotonic_ns().max(grid.due_ns(tick)) + policy.spin_ns;
        loop {
            let now_ns = monotonic_ns();
            self.gap.look(now_ns);
            let condition = if now_ns >= overdue_ns { RunCondition::Overdue } else { RunCondition::Arrived };
            match node.poll(condition)? {
                // It is awake before its inputs are there.
                Poll::Waiting => self.slept = false,
                done => return Ok(Some(done)),
            }
            hooks::at(Failpoint::Waiting);
            if policy.spin_ns > 0 && now_ns < spin_end_ns {
                spin(node, policy.yields_to, &mut self.gap);
            } else if now_ns > end_ns {
                node.skip_to(self.last_tick + 1);
                return Ok(Some(Poll::Waiting));
            } else {
                if !node.sleep(overdue_ns.min(now_ns + SLEEP_NS).max(now_ns + NAP_NS))? {
                    sleep_until(now_ns + NAP_NS);
                }
                self.gap.pause();
                if self.turn_while_waiting(node)? {
                    return Ok(None);
                }
            }
        }
    }

    /// Sleeps until `until_ns` while serving the launcher; returns true if the run was stopped.
    fn idle_until(&mut self, until_ns: u64, node: &mut dyn Node) -> Result<bool, NodeError> {
        while monotonic_ns() < until_ns {
            hooks::at(Failpoint::Waiting);
            self.slept = true;
            sleep_until(until_ns.min(monotonic_ns() + TURN_NS));
            if until_ns > monotonic_ns() && self.turn(node)? {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Publishes the heartbeat if it is due; returns true if the run is over. Not while a tick waits for its input.
    fn turn(&mut self, node: &mut dyn Node) -> Result<bool, NodeError> {
        if self.turn_is_due() {
            self.late.iter_mut().for_each(LateWatch::rebase);
            return self.serve(node);
        }
        Ok(false)
    }

    /// Publishes the heartbeat if it is due, while a tick waits for its input; returns true if the run is over.
    fn turn_while_waiting(&mut self, node: &mut dyn Node) -> Result<bool, NodeError> {
        if self.turn_is_due() { self.serve(node) } else { Ok(false) }
    }

    /// Publishes the heartbeat, and returns true if the run is over.
    fn serve(&mut self, node: &mut dyn Node) -> Result<bool, NodeError> {
        self.launcher.announce(RoleState::Running, node)?;
        node.refresh()?;
        Ok(self.launcher.stopped()?)
    }

    fn turn_is_due(&mut self) -> bool {
        let now_ns = monotonic_ns();
        let due = now_ns >= self.next_turn_ns;
        if due {
            self.next_turn_ns = now_ns + TURN_NS;
        }
        due
    }

    /// Waits for the missing input, or for credit.
    fn rest(&mut self, node: &mut dyn Node, up_to: u64, backoff: &mut Backoff) -> Result<(), NodeError> {
        // No role waits for one that is this far ahead, and another may need its core.
        let ahead = node.next_tick() > up_to;
        if !ahead && backoff.brief() {
            return Ok(());
        }
        let until_ns = monotonic_ns() + SLEEP_NS;
        if ahead || !node.sleep(until_ns)? {
            self.launcher.schedule.sleep(until_ns)?;
        }
        Ok(())
    }

    /// Drives a node by its inputs alone, at most the window ahead of the slowest consumer.
    ///
    /// # Errors
    /// [`NodeError`] if a link failed.
    pub fn lockstep(&mut self, node: &mut dyn Node) -> Result<Ended, NodeError> {
        let mut up_to = self.window_ticks.min(self.last_tick);
        let mut backoff = Backoff::default();
        while node.next_tick() <= self.last_tick {
            node.before_tick();
            let polled = node.poll(RunCondition::Inputs { up_to })?;
            if polled == Poll::Executed {
                node.finish_tick()?;
            }
            if polled != Poll::Waiting {
                backoff = Backoff::default();
                if !node.next_tick().is_multiple_of(TURN_TICKS) {
                    continue;
                }
            } else {
                hooks::at(Failpoint::Waiting);
                self.rest(node, up_to, &mut backoff)?;
            }
            if self.turn_is_due() {
                self.launcher.announce(RoleState::Running, node)?;
                node.refresh()?;
            }
            if self.launcher.stopped()? {
                return Ok(Ended::Stopped);
            }
            up_to = (self.launcher.schedule()?.credit_tick + self.window_ticks).min(self.last_tick);
        }
        Ok(Ended::Finished)
    }
}

/// Spins once for a due sample, or yields if its sender needs this core.
fn spin(node: &dyn Node, yields_to: &[RoleId], gap: &mut SpinGap) {
    if node.awaits().is_some_and(|role| yields_to.contains(&role)) {
        std::thread::yield_now();
        gap.pause();
    } else {
        std::hint::spin_loop();
    }
}

/// Number of polls before the first sleep.
const SPIN_ROUNDS: u32 = 50;

/// Spins a limited number of rounds, then asks for a sleep.
///
/// It does not yield: Linux 6.18 takes a whole time slice from a process that yields, and thousands of yields per
/// second advance the queue's clock so far that a process that wakes beside busy ones, even a kernel thread, waits for
/// seconds.
#[derive(Default)]
pub struct Backoff {
    rounds: u32,
}

impl Backoff {
    /// Spins one round; returns false once the caller should sleep.
    pub fn brief(&mut self) -> bool {
        let brief = self.rounds < SPIN_ROUNDS;
        if brief {
            self.rounds += 1;
            std::hint::spin_loop();
        }
        brief
    }
}

/// Drives all nodes in one thread, each tick through all of them in the given order. `revive` returns the successor of
/// a killed role (by index), or `None` to end the run.
///
/// # Errors
/// [`NodeError`] if a link failed, or if the roles wait for each other in a cycle.
pub fn drive_in_turn(
    nodes: &mut Vec<ReadyNode>,
    last_tick: u64,
    revive: impl FnMut(usize) -> Result<Option<ReadyNode>, NodeError>,
    after_tick: impl FnMut(u64) -> bool,
) -> Result<Ended, NodeError> {
    drive_in_turn_tracked(nodes, last_tick, &Cell::new(None), revive, after_tick)
}

/// Drives all nodes in one thread; `turn` holds the index of the running node, `None` between ticks.
pub fn drive_in_turn_tracked(
    nodes: &mut Vec<ReadyNode>,
    last_tick: u64,
    turn: &Cell<Option<usize>>,
    mut revive: impl FnMut(usize) -> Result<Option<ReadyNode>, NodeError>,
    mut after_tick: impl FnMut(u64) -> bool,
) -> Result<Ended, NodeError> {
    for tick in 0..=last_tick {
        for index in 0..nodes.len() {
            turn.set(Some(index));
            if nodes[index].before_tick() {
                // The old node is dropped before its successor opens the links, as between processes.
                let mut left = nodes.remove(index);
                left.finish()?;
                drop(left);
                let Some(successor) = revive(index)? else { return leave(nodes, Ended::Stopped) };
                nodes.insert(index, successor);
            }
            run_in_turn(&mut nodes[index], tick)?;
        }
        turn.set(None);
        if !after_tick(tick) {
            return leave(nodes, Ended::Stopped);
        }
    }
    leave(nodes, Ended::Finished)
}

/// Lets a node execute a tick in its turn, if its inputs are there.
///
/// # Errors
/// [`NodeError`] if a link failed.
pub fn run_in_turn(node: &mut ReadyNode, tick: u64) -> Result<(), NodeError> {
    if node.poll(RunCondition::Inputs { up_to: tick })? == Poll::Executed {
        node.finish_tick()?;
    }
    Ok(())
}

fn leave(nodes: &mut [ReadyNode], ended: Ended) -> Result<Ended, NodeError> {
    nodes.iter_mut().try_for_each(|node| node.finish())?;
    Ok(ended)
}
