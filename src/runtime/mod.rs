//! Drives roles: a node is one role on a bus with its books; a driver decides when it runs.
//!
//! Between ready and drain a node allocates nothing of its own, logs nothing, locks nothing and panics on nothing that can
//! arrive from outside. Must not decide what a run is for, nor start processes.

mod bridge;
mod disturb;
mod drive;
mod hooks;
mod line;
mod link;
mod node;
mod privileges;
mod process;
mod seat;

pub use bridge::{DeviceError, DeviceLink, DeviceSeat, run_bridge};
pub use disturb::{Disturbance, Interruptions, Suffered};
pub use drive::{Backoff, Control, Drive, Ended, in_turn};
pub use line::{Line, LineError};
pub use link::{Horizon, Input, Output, Seek};
pub use node::{
    Gate, Node, Occupant, Poll, Port, Ports, ReadyNode, RoleId, Visit, build, ports, private_ledger, report, topic,
    visit_reads, visit_writes,
};
pub(crate) use node::{horizon, next_tick, shared_memory_bytes};
pub use privileges::{Privileges, hold_low_latency_idle};
pub use process::{RoleError, RoleSeat, run_role, serve};
pub(crate) use process::{join, open_ledger, report_path, scenario_path, write_whole};
pub use seat::{SeatDescription, describe_seat, join_run, seat_path};

use crate::bus::Depths;
use crate::config::{ClockKind, Scenario};

/// How far the fastest plant may run ahead of the slowest consumer in lockstep, ticks.
pub const WINDOW_TICKS: u64 = 64;

/// How deep the links of a scenario are.
pub fn depths(scenario: &Scenario) -> Depths {
    // The scorer looks about every 20 ms; a quarter of a second is slack for a loaded machine.
    let quarter_second = (250_000_000 / scenario.period_ns).next_power_of_two() as usize;
    match scenario.clock {
        ClockKind::Realtime => Depths { role: 1, scorer: quarter_second.clamp(64, 8192), history: 0 },
        // Nobody is more than the window ahead of anybody: twice that never overflows, nor as much again for whatever
        // scripted faults add.
        ClockKind::Lockstep | ClockKind::InProcess => {
            let deep = (2 + disturb::extra_samples(scenario)) * WINDOW_TICKS as usize;
            Depths { role: deep, scorer: deep, history: deep }
        }
    }
}
