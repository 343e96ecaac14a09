//! Real-time privileges: asked for, taken where granted, and reported either way.
//!
//! Must not fail a run: whether a missing privilege matters is decided by `--require-rt`.

use super::node::RoleId;
use crate::config::{Cores, NamedCores, Realtime};
use crate::telemetry::Grant;
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, getrlimit};
use rustix::thread::{
    CapabilitySet, CpuSet, capabilities, sched_getaffinity, sched_setaffinity, set_current_timer_slack,
};
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::num::NonZero;

const FIFO: &str = "SCHED_FIFO";
/// What a limit on locked memory must allow a role, bytes. Its own need is far below.
const ENOUGH_LOCKED: u64 = 256 << 20;

/// Locks this process's memory, present and future. To be done before links are opened.
///
/// Not under a limit that the process could reach: there the next allocation, or the stack's growth, would kill it.
fn lock_memory() -> io::Result<()> {
    let unlimited = capabilities(None).is_ok_and(|sets| sets.effective.contains(CapabilitySet::IPC_LOCK));
    match getrlimit(Resource::Memlock).current {
        Some(limit) if !unlimited && limit < ENOUGH_LOCKED => {
            let (limit, enough) = (limit >> 10, ENOUGH_LOCKED >> 10);
            Err(io::Error::other(format!("the memlock limit is {limit} KiB, and less than {enough} is not safe")))
        }
        _ => Ok(mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE)?),
    }
}

/// Whether a role with these grants runs before all ordinary processes.
pub fn first_served(grants: &[Grant]) -> bool {
    grants.iter().any(|grant| grant.privilege == FIFO && grant.granted)
}

/// Takes what a role asks for, for the calling thread.
pub fn take(settings: &Realtime, role: RoleId) -> Vec<Grant> {
    // No privilege: without SCHED_FIFO the kernel would let timers run late by 50 us to save power.
    let _ = set_current_timer_slack(NonZero::new(1));
    let mut grants = Vec::new();
    if settings.lock_memory {
        let remedy = "raise the memlock limit (ulimit -l) or grant CAP_IPC_LOCK";
        grants.push(grant("locked memory", "all".to_owned(), lock_memory(), remedy));
    }
    if settings.priority > 0 {
        let priority = settings.priority - behind_leader(role);
        let remedy = "raise the rtprio limit (ulimit -r) or grant CAP_SYS_NICE";
        grants.push(grant(FIFO, priority.to_string(), set_fifo(priority), remedy));
    }
    // Among equals, being bound to a busy core is worse than being free: "auto" binds with a real-time priority only.
    if let Some(core) = core_of(settings, role, first_served(&grants)) {
        let mut set = CpuSet::new();
        set.set(core);
        let pinned = sched_setaffinity(None, &set).map_err(io::Error::from);
        grants.push(grant("core", core.to_string(), pinned, "name cores of this machine in realtime.cores"));
    }
    grants
}

/// Opens `/dev/cpu_dma_latency` and asks for 0 µs. The request lasts as long as the file is open.
pub fn hold_low_latency_idle(settings: &Realtime) -> (Option<File>, Vec<Grant>) {
    if !settings.low_latency_idle {
        return (None, Vec::new());
    }
    let opened = OpenOptions::new().write(true).open("/dev/cpu_dma_latency").and_then(|mut file| {
        file.write_all(&0_i32.to_ne_bytes())?;
        Ok(file)
    });
    let (file, result) = match opened {
        Ok(file) => (Some(file), Ok(())),
        Err(error) => (None, Err(error)),
    };
    let remedy = "allow this user to write /dev/cpu_dma_latency";
    (file, vec![grant("low-latency idle", "0 us".to_owned(), result, remedy)])
}

fn grant(privilege: &str, asked: String, result: io::Result<()>, remedy: &str) -> Grant {
    let reason = result.as_ref().err().map_or(String::new(), |error| format!("{error}; {remedy}"));
    Grant { privilege: privilege.to_owned(), asked, granted: result.is_ok(), reason }
}

/// How far below the leader a role's priority lies: the order in which one tick passes through the roles, so that on a
/// shared core none that waits by spinning keeps the one it waits for from running.
fn behind_leader(role: RoleId) -> i32 {
    match role {
        RoleId::Plant(0) => 0,
        RoleId::Plant(_) => 1,
        RoleId::Observer => 2,
        RoleId::Controller => 3,
    }
}

/// The core of a role: plants in turn from the first core on, observer and controller together on the last.
fn core_of(settings: &Realtime, role: RoleId, first_served: bool) -> Option<usize> {
    let cores = match &settings.cores {
        Cores::List(cores) => cores.clone(),
        Cores::Named(NamedCores::Auto) if first_served => {
            let allowed = sched_getaffinity(None).ok()?;
            (0..CpuSet::MAX_CPU).filter(|core| allowed.is_set(*core)).collect()
        }
        Cores::Named(_) => return None,
    };
    let (last, plants) = cores.split_last()?;
    match role {
        RoleId::Plant(index) if !plants.is_empty() => Some(plants[index % plants.len()]),
        _ => Some(*last),
    }
}

fn set_fifo(priority: i32) -> io::Result<()> {
    set_scheduler(libc::SCHED_FIFO, priority)
}

/// Gives the real-time priority of the calling thread back: what follows the last tick must not delay another role's.
pub fn release() {
    // Failing to give up what one has harms nobody but the last tick.
    let _ = set_scheduler(libc::SCHED_OTHER, 0);
}

#[allow(unsafe_code)]
fn set_scheduler(policy: i32, priority: i32) -> io::Result<()> {
    let parameters = libc::sched_param { sched_priority: priority };
    // SAFETY: pid 0 is the calling thread, and the pointer is to a live, fully initialised sched_param.
    match unsafe { libc::sched_setscheduler(0, policy, &raw const parameters) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(cores: &[usize]) -> Realtime {
        Realtime { cores: Cores::List(cores.to_vec()), ..Realtime::default() }
    }

    #[test]
    fn plants_share_the_first_cores_and_the_others_the_last() {
        let core = |cores: &[usize], role| core_of(&settings(cores), role, false);
        assert_eq!(core(&[4, 5], RoleId::Plant(0)), Some(4));
        assert_eq!(core(&[4, 5], RoleId::Plant(1)), Some(4));
        assert_eq!(core(&[4, 5], RoleId::Observer), Some(5));
        assert_eq!(core(&[4, 5, 6], RoleId::Plant(1)), Some(5));
        assert_eq!(core(&[4, 5, 6], RoleId::Plant(2)), Some(4));
        assert_eq!(core(&[7], RoleId::Plant(0)), Some(7));
        assert_eq!(core(&[7], RoleId::Controller), Some(7));
    }

    #[test]
    fn nobody_is_bound_to_a_core_without_being_served_first_there() {
        assert_eq!(core_of(&Realtime::default(), RoleId::Observer, false), None);
        assert!(core_of(&Realtime::default(), RoleId::Observer, true).is_some());
    }

    #[test]
    fn what_is_not_granted_is_reported_with_a_remedy() {
        let grants = take(
            &Realtime { lock_memory: false, priority: 0, cores: Cores::List(vec![1023]), ..Realtime::default() },
            RoleId::Observer,
        );
        assert_eq!(grants.len(), 1);
        assert!(!grants[0].granted && grants[0].reason.contains("realtime.cores"), "{grants:?}");
    }
}
