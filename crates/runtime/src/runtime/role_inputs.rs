//! The inputs that one part of a loop uses: applies their changes at the ticks from which they act.
//!
//! A value is a function of the changes and of the tick, so a successor computes it again and needs no state. Must not
//! allocate after it was created.

use crate::changes::ReceivedChanges;
use crate::config::{InputInfo, InputUse, InputUser, Inputs, Variability};
use crate::input::{Change, Course};
use std::sync::Arc;

/// The inputs that a role, or the scorer, uses.
#[derive(Debug, Clone)]
pub struct RoleInputs {
    scripted: Arc<[Change]>,
    received: Arc<ReceivedChanges>,
    used: Vec<UsedInput>,
    /// The number of changes entered, of the scripted and of the received ones.
    entered: (usize, usize),
    /// The next tick at which something changes, as far as known.
    due: u64,
    /// The number of received changes that are known.
    known: usize,
    /// The first tick that was not executed yet.
    next: u64,
    /// The number of received changes that acted after their tick.
    late: u64,
}

#[derive(Debug, Clone)]
struct UsedInput {
    number: usize,
    components: usize,
    uses: Vec<InputUse>,
    course: Course,
    /// True if it has a change at this tick, or moves without one.
    changes: bool,
    moves: bool,
    /// True if a switch was set at this tick, also to the value that it has.
    is_switch: bool,
}

/// A value that acts from a tick on.
#[derive(Debug, Clone, Copy)]
pub struct NewValue<'a> {
    /// The user, and the number under which it knows the input.
    pub by: InputUse,
    /// The components.
    pub values: &'a [f64],
}

impl RoleInputs {
    /// Collects the inputs of the users for which `uses` returns true.
    pub fn new(inputs: &Inputs, uses: impl Fn(InputUser) -> bool) -> Self {
        let used = |(number, info): (usize, &InputInfo)| {
            let uses: Vec<InputUse> = info.uses.iter().filter(|by| uses(by.user)).copied().collect();
            let course = Course::new(InputInfo::values(&info.initial));
            let (components, is_switch) = (info.initial.len(), info.variability == Variability::Switch);
            // A switch that is on from the begin is set at the first tick.
            let changes = is_switch && info.initial != [0.0];
            let used = UsedInput { number, components, uses, course, changes, moves: false, is_switch };
            (!used.uses.is_empty()).then_some(used)
        };
        let used: Vec<UsedInput> = inputs.infos.iter().enumerate().filter_map(used).collect();
        let due = match used.iter().any(|used| used.changes) {
            true => 0,
            false => inputs.scripted.first().map_or(u64::MAX, |first| first.tick),
        };
        Self {
            scripted: inputs.scripted.clone(),
            received: inputs.received(),
            used,
            entered: (0, 0),
            due,
            known: 0,
            next: 0,
            late: 0,
        }
    }

    /// Returns true if [`advance`](Self::advance) has something to do at a tick.
    #[inline]
    pub fn is_due(&self, tick: u64) -> bool {
        !self.used.is_empty() && (tick >= self.due || self.received.count() != self.known)
    }

    /// Returns the number of received changes that acted after their tick, because they came too late.
    pub fn late(&self) -> u64 {
        self.late
    }

    /// Restores the values at the last tick before `next`, the first tick that this role executes. A switch is not set
    /// again: its effect is part of the role's state.
    pub fn resume(&mut self, next: u64, mut set: impl FnMut(NewValue<'_>)) {
        self.next = next;
        if let Some(last) = next.checked_sub(1) {
            self.enter_until(last);
            self.late = 0;
            self.apply(last, &mut |used, value| {
                if !used {
                    set(value);
                }
            });
        }
    }

    /// Passes the values that change at a tick to `set`, and the state of every switch that is set at it. Returns true if a change
    /// begins to act.
    #[cold]
    pub fn advance(&mut self, tick: u64, mut set: impl FnMut(NewValue<'_>)) -> bool {
        let before = self.entered;
        self.enter_until(tick);
        self.apply(tick, &mut |_, value| set(value));
        self.next = tick + 1;
        self.entered != before
    }

    /// Enters all changes up to a tick, the scripted ones of a tick first.
    fn enter_until(&mut self, tick: u64) {
        self.known = self.received.count();
        loop {
            let scripted = self.scripted.get(self.entered.0).copied();
            let received = self.received.get(self.entered.1);
            let is_received = match (&scripted, &received) {
                (Some(scripted), Some(received)) => received.tick < scripted.tick,
                (None, Some(_)) => true,
                _ => false,
            };
            let first = if is_received { received } else { scripted };
            self.due = first.map_or(u64::MAX, |first| first.tick);
            let Some(first) = first.filter(|first| first.tick <= tick) else { break };
            *(if is_received { &mut self.entered.1 } else { &mut self.entered.0 }) += 1;
            if let Some(used) = self.used.iter_mut().find(|used| used.number == first.input) {
                used.course.enter(&first);
                used.changes = true;
                self.late += u64::from(is_received && first.tick < self.next);
            }
        }
    }

    fn apply(&mut self, tick: u64, set: &mut dyn FnMut(bool, NewValue<'_>)) {
        for used in &mut self.used {
            if std::mem::take(&mut used.changes) | used.moves {
                let values = used.course.at(tick);
                let values = &values[..used.components];
                used.uses.iter().for_each(|by| set(used.is_switch, NewValue { by: *by, values }));
            }
            used.moves = used.course.moves(tick);
            if used.moves {
                self.due = tick + 1;
            }
        }
    }
}
