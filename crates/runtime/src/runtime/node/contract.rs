//! A node as its driver sees it: when it may run, and what came of it.

use crate::clock::Grid;
use crate::runtime::error::NodeError;
use crate::runtime::role_id::RoleId;
use crate::serial::LineCounters;
use crate::telemetry::{LedgerError, Outage, StageReport, Ticks};

/// When a node may execute its next tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunCondition {
    /// Lockstep: when every input of the tick is there and the tick is at most this one.
    Inputs {
        /// The farthest tick allowed.
        up_to: u64,
    },
    /// Real time, plants: now, whatever is there, skipping to the tick that is due.
    Now {
        /// The latest tick that is due.
        tick: u64,
        /// The time.
        now_ns: u64,
    },
    /// Real time, others: when the inputs are there.
    Arrived,
    /// Real time, others: with what is there, as long as the tick can be computed at all.
    Overdue,
}

/// Whether a node executed a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Poll {
    /// It did; [`Node::finish_tick`] is due.
    Executed,
    /// It waits for inputs, or has passed over a tick of which there are none.
    Waiting,
    /// It has given the tick up and counted it as missed.
    Missed,
}

/// A role with its links and counters.
pub trait Node {
    /// Whether the tick alone starts it, or its inputs do. What is started by its tick may still wait for something that
    /// the tick sets off: then it is polled until that has arrived, or is overdue.
    fn time_triggered(&self) -> bool;
    /// The next tick to execute.
    fn next_tick(&self) -> u64;
    /// Continues from where a predecessor committed its state, if there was one. Before [`start`](Self::start).
    ///
    /// # Errors
    /// [`LedgerError`].
    fn restore(&mut self) -> Result<(), LedgerError>;
    /// Hands over the time grid, once the epoch is known, and the first tick to execute. What a predecessor was committed to
    /// send is sent; what it left undone before that tick counts as missed.
    ///
    /// # Errors
    /// [`NodeError`].
    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), NodeError>;
    /// Lets scripted interruptions of this role act: before every tick, once.
    fn before_tick(&mut self) -> bool;
    /// Executes the next tick if the condition allows it: takes inputs, computes, commits, sends. The critical path.
    ///
    /// # Errors
    /// [`NodeError`].
    fn poll(&mut self, condition: RunCondition) -> Result<Poll, NodeError>;
    /// Whose sample the next tick lacks, as far as it is known.
    fn awaits(&self) -> Option<RoleId>;
    /// Sleeps until the input that the next tick lacks may be there, at most until `until_ns`; false if it lacks none.
    ///
    /// # Errors
    /// [`NodeError`].
    fn sleep(&mut self, until_ns: u64) -> Result<bool, NodeError>;
    /// Does what the executed tick left to be done: integrates, counts, prepares the next sample.
    ///
    /// # Errors
    /// [`NodeError`].
    fn finish_tick(&mut self) -> Result<(), NodeError>;
    /// Settles what is left of a tick that the end of the run has come upon, and commits the state for the last time.
    ///
    /// # Errors
    /// [`NodeError`].
    fn finish(&mut self) -> Result<(), NodeError>;
    /// Counts every tick before `tick` that was not executed as missed.
    fn skip_to(&mut self, tick: u64);
    /// Exercises all links with a sample that no role uses.
    ///
    /// # Errors
    /// [`NodeError`].
    fn warm_up(&mut self) -> Result<(), NodeError>;
    /// Lets readers that have come later know of this role's signals, and finds the writers that have. Off the critical
    /// path.
    ///
    /// # Errors
    /// [`NodeError`].
    fn refresh(&mut self) -> Result<(), NodeError>;
    /// The tick counters.
    fn ticks(&self) -> Ticks;
    /// The latencies.
    fn stages(&self) -> Vec<StageReport>;
    /// How many words its state takes.
    fn state_words(&mut self) -> usize;
    /// Of several roles that are driven as one, the node of this role.
    fn member(&self, _role: RoleId) -> Option<&dyn Node> {
        None
    }
    /// The counters of its device's serial line, if it has one.
    fn line(&self) -> Option<LineCounters> {
        None
    }
    /// When that device was absent.
    fn outages(&self) -> Vec<Outage> {
        Vec::new()
    }
}

/// A node that can be driven.
pub type ReadyNode = Box<dyn Node>;
