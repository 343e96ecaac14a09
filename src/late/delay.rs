//! The delay of a late tick, as its role recorded it: how long, and which part an input accounts for.

use super::model::LateKind;
use crate::runtime::RoleId;
use crate::telemetry::LateRecord;

/// The delay of a late tick.
#[derive(Debug, Clone, Copy)]
pub struct Delay {
    /// The role.
    pub role: RoleId,
    /// The record.
    pub record: LateRecord,
    /// The period, ns.
    pub period_ns: u64,
}

impl Delay {
    /// Returns the kind.
    pub fn kind(&self) -> LateKind {
        match (self.record.missed, self.record.starved) {
            (1.., _) => LateKind::Missed,
            (0, true) => LateKind::Starved,
            (0, false) => LateKind::Late,
        }
    }

    /// Returns its length, ns. An input that is absent at its due time is at least one period late.
    pub fn ns(&self) -> u64 {
        match self.kind() {
            LateKind::Starved => self.period_ns,
            LateKind::Late | LateKind::Missed => self.record.done_ns.saturating_sub(self.record.due_ns),
        }
    }

    /// Returns the sender of the last or absent input.
    pub fn sender(&self) -> Option<RoleId> {
        RoleId::from_number(self.record.sender)
    }

    /// Returns the part that passed before that input was sent, ns. For missed ticks the record does not tell it.
    pub fn input_ns(&self) -> u64 {
        match self.kind() {
            LateKind::Starved => self.ns(),
            LateKind::Missed => 0,
            LateKind::Late => self.record.input_ns.saturating_sub(self.record.due_ns).min(self.ns()),
        }
    }

    /// Returns the time from which the role itself is to blame: its due time, or the sending of its last input, ns.
    pub fn own_from_ns(&self) -> u64 {
        self.record.due_ns + self.input_ns()
    }

    /// Returns the time at which the role began to compute, ns.
    pub fn began_ns(&self) -> u64 {
        self.record.began_ns.clamp(self.own_from_ns(), self.record.done_ns.max(self.own_from_ns()))
    }
}
