//! The interface between a node and its driver.

use crate::clock::Grid;
use crate::runtime::error::NodeError;
use crate::runtime::role_id::RoleId;
use crate::serial::LineCounters;
use crate::telemetry::{LateTicks, LedgerError, Outage, PaceReport, StageReport, Ticks};

/// Condition under which a node executes its next tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunCondition {
    /// Lockstep: every input has arrived, and the tick is at most `up_to`.
    Inputs {
        /// The last allowed tick.
        up_to: u64,
    },
    /// Real time, plants: now, with the available inputs, skipping to the due tick.
    Now {
        /// The latest due tick.
        tick: u64,
        /// The current time, ns.
        now_ns: u64,
    },
    /// Real time, other roles: all inputs have arrived.
    Arrived,
    /// Real time, other roles: after the cutoff, with the available inputs, if these suffice.
    Overdue,
}

/// Result of a poll.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Poll {
    /// The tick was executed; [`Node::finish_tick`] must follow.
    Executed,
    /// Inputs are missing, or a tick without inputs was passed over.
    Waiting,
    /// The tick was given up and counted as missed.
    Missed,
}

/// A role with its links and counters.
pub trait Node {
    /// Returns true if the time grid starts its ticks, false if its inputs do. A tick that the grid starts may still
    /// wait for something that it triggers: the node is then polled until that arrives or is overdue.
    fn time_triggered(&self) -> bool;
    /// Returns the next tick to execute.
    fn next_tick(&self) -> u64;
    /// Restores the state that a predecessor committed, if any. Must precede [`start`](Self::start).
    ///
    /// # Errors
    /// [`LedgerError`].
    fn restore(&mut self) -> Result<(), LedgerError>;
    /// Sets the time grid and the first tick to execute. Sends what a predecessor committed and did not send; ticks
    /// before `first_tick` that it did not execute count as missed.
    ///
    /// # Errors
    /// [`NodeError`].
    fn start(&mut self, grid: Grid, first_tick: u64) -> Result<(), NodeError>;
    /// Applies scripted interruptions before a tick, once; returns true if the role was killed.
    fn before_tick(&mut self) -> bool;
    /// Executes the next tick if the condition holds: reads inputs, computes, commits, sends. The critical path.
    ///
    /// # Errors
    /// [`NodeError`].
    fn poll(&mut self, condition: RunCondition) -> Result<Poll, NodeError>;
    /// Returns the sender of a sample that the next tick lacks, if known.
    fn awaits(&self) -> Option<RoleId>;
    /// Sleeps until a missing input may have arrived, at most until `until_ns`; returns false if no input is missing.
    ///
    /// # Errors
    /// [`NodeError`].
    fn sleep(&mut self, until_ns: u64) -> Result<bool, NodeError>;
    /// Completes the executed tick: integrates, counts, prepares the next sample.
    ///
    /// # Errors
    /// [`NodeError`].
    fn finish_tick(&mut self) -> Result<(), NodeError>;
    /// Completes the last tick and commits the state for the last time.
    ///
    /// # Errors
    /// [`NodeError`].
    fn finish(&mut self) -> Result<(), NodeError>;
    /// Counts every unexecuted tick before `tick` as missed.
    fn skip_to(&mut self, tick: u64);
    /// Exercises all links with samples that no role uses.
    ///
    /// # Errors
    /// [`NodeError`].
    fn warm_up(&mut self) -> Result<(), NodeError>;
    /// Connects to readers and writers that came later. Off the critical path.
    ///
    /// # Errors
    /// [`NodeError`].
    fn refresh(&mut self) -> Result<(), NodeError>;
    /// Returns the tick counters.
    fn ticks(&self) -> Ticks;
    /// Returns the late ticks since this process started.
    fn late_ticks(&self) -> Option<&LateTicks>;
    /// Returns the latencies.
    fn stages(&self) -> Vec<StageReport>;
    /// Forgets the latencies so far.
    fn clear_stages(&mut self);
    /// Returns the length of the node's state, words.
    fn state_words(&mut self) -> usize;
    /// Passes every number of the role's own state, in an order that does not change: not the counters, nor the state of its links.
    fn numbers(&mut self, _visit: &mut dyn FnMut(&mut f64)) {}
    /// Returns the node of a role if several roles are driven as one.
    fn member(&self, _role: RoleId) -> Option<&dyn Node> {
        None
    }
    /// Returns the counters of its device's serial line, if it has one.
    fn line(&self) -> Option<LineCounters> {
        None
    }
    /// Returns the relation of the grid to its device, if that sets the pace.
    fn pace(&self) -> Option<PaceReport> {
        None
    }
    /// Returns the number of changes of inputs that acted after their tick.
    fn late_inputs(&self) -> u64 {
        0
    }
    /// Returns the outages of that device.
    fn outages(&self) -> Vec<Outage> {
        Vec::new()
    }
}

/// A node that can be driven.
pub type ReadyNode = Box<dyn Node>;

/// The methods of a [`Node`] that only look at its fields `counters` and `interruptions`, the same for every role.
macro_rules! counted {
    () => {
        fn next_tick(&self) -> u64 {
            self.counters.next()
        }

        #[inline]
        fn before_tick(&mut self) -> bool {
            self.interruptions.before_next(&mut self.counters)
        }

        fn ticks(&self) -> crate::telemetry::Ticks {
            self.counters.report()
        }

        #[inline]
        fn late_ticks(&self) -> Option<&crate::telemetry::LateTicks> {
            Some(self.counters.late_ticks())
        }

        fn state_words(&mut self) -> usize {
            super::persistent::length(self)
        }
    };
}
pub(super) use counted;
