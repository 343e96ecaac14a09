//! Runs roles: a node is one role on a bus with its counters; a driver decides when the node runs.
//!
//! Between the phases ready and drain a node does not allocate, log or lock, and no input from outside makes it panic.
//! Must not decide what a run is for, nor start processes.

mod absence;
mod budget;
mod device;
mod disturb;
pub(crate) mod drive;
mod error;
pub(crate) mod hooks;
mod ignored;
mod late_watch;
mod line;
mod link;
mod node;
mod pace;
mod privileges;
mod role_function;
mod role_id;
mod role_impl;
mod role_inputs;
mod role_values;
mod sample_source;
mod usage;

pub use budget::{CpuQuota, CpuSetLimit, cpu_quota, cpu_set, empty_budgets, grant_budgets};
pub use device::{DeviceConfig, DeviceLink};
pub use disturb::{Disturbance, Interruptions, LateSamples};
pub use drive::{Backoff, Driver, Ended, LauncherLink, drive_in_turn, drive_in_turn_tracked, run_in_turn};
pub use error::{DeviceError, NodeError};
pub use ignored::{ignored_changes, ignoring_role};
pub use late_watch::LateWatch;
pub use line::{Line, LineAddress, LineError};
#[cfg(feature = "hosts")]
pub use link::RetainedSamples;
pub use link::{AcceptedTicks, Input, Output, Seek};
#[cfg(feature = "hosts")]
pub use node::retained_samples;
pub use node::{
    Node, Poll, Ports, ReadyNode, RunCondition, build_rig, ports, private_ledger, report, shared_ledger, topic,
};
pub use node::{accepted_ticks, committed_ticks, late_log, ledger_file, ledger_words, next_tick, shared_memory_bytes};
pub use pace::{OnLost, Pace, PaceBoard, PaceOptions, PaceState, PaceStatus};
#[cfg(feature = "hosts")]
pub use privileges::take_priority_above_roles;
pub use privileges::{Privileges, hold_low_latency_idle, priority_remedy, refused_priority, unavailable_cores};
pub use privileges::{
    join_at_low_priority, release_priority, request_short_slices, take_lowest_realtime_priority, take_privileges,
    take_probe_privileges, usable_cores, with_realtime_priority,
};
pub use role_function::{RoleFunction, TickSamples};
pub use role_id::RoleId;
pub use role_impl::RoleImpl;
pub use role_inputs::{NewValue, RoleInputs};
pub use role_values::{CurrentValues, RoleValue, role_values};
pub use usage::{ThreadUsage, page_fault_ns, watch_continued};

use crate::bus::Depths;
use crate::config::{ClockKind, Settings};
use crate::sample::FleetTruth;

/// Range of the lockstep window, ticks. The smallest value applies to the largest samples.
const WINDOW_TICKS: std::ops::RangeInclusive<u64> = 2..=64;
/// Upper bound on the fleet samples that wait for one reader, bytes, unless the window's minimum needs more.
const WAITING_BYTES: usize = 1 << 20;
/// Upper bound on the samples of one signal, over all bodies, that wait for one reader in lockstep. A larger backlog does
/// not fit into the caches of a core.
const WAITING_SAMPLES: u64 = 512;
/// Upper bound on the fleet samples that wait for the scorer in real time, bytes: the scorer reads rarely.
const SCORED_BYTES: usize = 1 << 22;

/// Returns the length of the longest fleet sample, bytes; `None` without a fleet.
fn longest_sample(scenario: &Settings) -> Option<usize> {
    let fleets = scenario.bodies.iter().filter_map(|body| body.fleet);
    fleets.max().map(|bodies| FleetTruth::length(bodies) * size_of::<u64>())
}

/// Returns the number of ticks that the fastest plant may run ahead of the slowest consumer in lockstep.
pub fn window_ticks(scenario: &Settings) -> u64 {
    let fits = longest_sample(scenario).map_or(u64::MAX, |bytes| (WAITING_BYTES / 2 / bytes) as u64);
    fits.min(WAITING_SAMPLES / scenario.bodies.len() as u64).clamp(*WINDOW_TICKS.start(), *WINDOW_TICKS.end())
}

/// Returns the queue depths of a scenario's links.
pub fn depths(scenario: &Settings) -> Depths {
    // The scorer reads about every 20 ms, the recorder every 5 ms. Neither has priority: beside 18 ready tasks on two
    // cores the recorder did not run for 0.4 s.
    let second = (1_000_000_000 / scenario.period_ns).next_power_of_two() as usize;
    match scenario.clock {
        ClockKind::Realtime => {
            let fits = longest_sample(scenario).map_or(usize::MAX, |bytes| (SCORED_BYTES / bytes).max(8));
            let late = disturb::late_samples(scenario);
            // All commands in flight must fit.
            let fits = fits.max(scenario.actuation_delay_ticks as usize);
            Depths { role: 1, scorer: second.clamp(64, 8192).min(fits) + late, history: 0 }
        }
        // No role runs further ahead of another than the window: twice the window never overflows, plus the same for
        // each sample that scripted faults add.
        ClockKind::Lockstep | ClockKind::InProcess => {
            let extra = disturb::extra_samples(scenario);
            let deep = (2 + extra) * window_ticks(scenario) as usize + disturb::late_samples(scenario);
            Depths { role: deep, scorer: deep, history: deep }
        }
    }
}
