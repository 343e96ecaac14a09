//! Real-time privileges: requested, taken where granted, and reported in both cases.
//!
//! Must not end a run: `--require-rt` decides whether a missing privilege matters.

use super::budget::{empty_budgets, grant_budgets};
use super::role_id::RoleId;
use crate::config::{Cores, NamedCores, Realtime, Settings};
use crate::telemetry::Grant;
use rustix::io::Errno;
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, getrlimit, nice};
use rustix::thread::{
    CapabilitySet, CpuSet, capabilities, sched_getaffinity, sched_setaffinity, set_current_timer_slack,
};
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::num::NonZero;
use std::path::Path;

const FIFO: &str = "SCHED_FIFO";
/// Lower bound on the memlock limit, bytes. A role needs far less.
const ENOUGH_LOCKED: u64 = 256 << 20;

/// Locks the present and future memory of this process. Must precede the opening of links.
///
/// Refuses under a limit that the process could reach: the next allocation or stack growth would kill it.
fn lock_memory() -> io::Result<()> {
    let unlimited = capabilities(None).is_ok_and(|sets| sets.effective.contains(CapabilitySet::IPC_LOCK));
    match getrlimit(Resource::Memlock).current {
        Some(limit) if !unlimited && limit < ENOUGH_LOCKED => {
            let (limit, enough) = (limit >> 10, ENOUGH_LOCKED >> 10);
            Err(io::Error::other(format!("the memlock limit is {limit} KiB, and less than {enough} is not safe")))
        }
        // Touched pages stay; untouched ones, as most of the program, take no memory. The warm-up touches what is
        // needed.
        _ => Ok(mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT)?),
    }
}

/// The privileges of a role.
#[derive(Debug, Default)]
pub struct Privileges {
    /// All requested privileges, granted or not.
    pub grants: Vec<Grant>,
    /// True if the role runs before all ordinary processes.
    pub has_realtime: bool,
    /// The other roles on the role's core, all of equal priority. A role that waits for a sample of one of these yields
    /// to it: a switch between equals costs a fraction of a sleep and a wake.
    pub co_located: Vec<RoleId>,
}

/// Takes the privileges that a scenario requests for a role, for the calling thread.
pub fn take_privileges(scenario: &Settings, role: RoleId) -> Privileges {
    let settings = &scenario.realtime;
    // Not a privilege. Without SCHED_FIFO the kernel would delay timers by 50 us to save power.
    let _ = set_current_timer_slack(NonZero::new(1));
    let mut grants = Vec::new();
    if settings.lock_memory {
        let remedy = "raise the memlock limit (ulimit -l) or grant CAP_IPC_LOCK";
        grants.push(grant("locked memory", "all".to_owned(), lock_memory(), remedy));
    }
    if settings.priority > 0 {
        grants.push(take_fifo(settings.priority));
    }
    let has_realtime = grants.iter().any(|grant| grant.privilege == FIFO && grant.granted);
    // Without priority, a pinned role on a busy core is worse off than a free one: "auto" pins with a real-time
    // priority only.
    let cores = cores(settings, has_realtime);
    let mut co_located = Vec::new();
    if let Some(core) = core_of(&cores, role, scenario) {
        let pinned = bind_to(core);
        if pinned.granted && has_realtime {
            co_located = RoleId::all(scenario);
            co_located
                .retain(|peer| peer.process_role(scenario) != role && core_of(&cores, *peer, scenario) == Some(core));
        }
        grants.push(pinned);
    }
    Privileges { grants, has_realtime, co_located }
}

/// Takes the privileges of a probe of a core for the calling thread: the core and the default priority of roles. Without that
/// priority it requests short time slices, as roles do.
pub fn take_probe_privileges(core: usize) -> Vec<Grant> {
    let _ = set_current_timer_slack(NonZero::new(1));
    let priority = take_fifo(Realtime::default().priority);
    if !priority.granted {
        request_short_slices();
    }
    vec![priority, bind_to(core)]
}

/// Requests SCHED_FIFO for the calling thread.
fn take_fifo(priority: i32) -> Grant {
    let result = set_fifo(priority);
    let remedy = if result.is_ok() { String::new() } else { priority_remedy(Path::new("/")) };
    grant(FIFO, priority.to_string(), result, &remedy)
}

/// Binds the calling thread to a core.
fn bind_to(core: usize) -> Grant {
    let mut set = CpuSet::new();
    set.set(core);
    let result = sched_setaffinity(None, &set).map_err(io::Error::from);
    grant("core", core.to_string(), result, "name cores of this machine in realtime.cores")
}

/// Returns the cores that the calling thread may use.
pub fn usable_cores() -> Vec<usize> {
    let allowed = sched_getaffinity(None).unwrap_or_default();
    (0..CpuSet::MAX_CPU).filter(|core| allowed.is_set(*core)).collect()
}

/// Returns the remedy for a refused real-time priority; `root` is the root of the machine's files.
pub fn priority_remedy(root: &Path) -> String {
    let empty = empty_budgets(root);
    if let Some(file) = empty.last() {
        return format!("{} is 0: `{}`, or start it in another cgroup", file.display(), grant_budgets(&empty));
    }
    if capabilities(None).is_ok_and(|sets| sets.effective.contains(CapabilitySet::SYS_NICE)) {
        return "a sandbox, or a cgroup without real-time budget, may forbid it: start it outside of that".to_owned();
    }
    "raise the rtprio limit (ulimit -r) or grant CAP_SYS_NICE".to_owned()
}

/// Requests a real-time priority in a short-lived thread; returns the error if it is refused.
pub fn refused_priority(priority: i32) -> Option<io::Error> {
    std::thread::spawn(move || set_fifo(priority).err()).join().ok().flatten()
}

/// Returns the cores that the scenario names and this process cannot use: offline, or not in its cpuset.
pub fn unavailable_cores(settings: &Realtime) -> Vec<usize> {
    let Cores::List(cores) = &settings.cores else { return Vec::new() };
    let mut cores = cores.clone();
    // A short-lived thread takes its affinity with it. The roles report other errors.
    let bind = move || {
        cores.retain(|core| {
            let mut set = CpuSet::new();
            set.set(*core);
            sched_setaffinity(None, &set) == Err(Errno::INVAL)
        });
        cores
    };
    std::thread::spawn(bind).join().unwrap_or_default()
}

/// Opens `/dev/cpu_dma_latency` and requests 0 µs. The request lasts as long as the file is open.
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

/// Returns the cores for roles; empty if roles are not pinned.
fn cores(settings: &Realtime, has_realtime: bool) -> Vec<usize> {
    match &settings.cores {
        Cores::List(cores) => cores.clone(),
        Cores::Named(NamedCores::Auto) if has_realtime => usable_cores(),
        Cores::Named(_) => Vec::new(),
    }
}

/// Returns the core of a role's process. Plants take turns over the cores, because all of them act at the due instant.
/// Observer and controller get cores of their own if possible, else those of the leader and of the first follower,
/// whose measurements they wait for; then the other observers, else on the core of their body. The first role decides for a process of several roles.
fn core_of(cores: &[usize], role: RoleId, scenario: &Settings) -> Option<usize> {
    let bodies = scenario.bodies.len();
    let own_or = |own: usize, beside: usize| if own < cores.len() { own } else { beside };
    let observers_until = |last: usize| {
        let bodies = scenario.bodies.get(1..=last).unwrap_or_default();
        bodies.iter().filter(|body| body.observer.is_some()).count()
    };
    let place = match role.process_role(scenario).process_members(scenario).first()? {
        RoleId::Plant(index) => *index,
        RoleId::Observer(0) => own_or(bodies, 0),
        RoleId::Controller => own_or(bodies + 1, 1),
        RoleId::Observer(index) => own_or(bodies + 1 + observers_until(*index), *index),
    };
    cores.get(place % cores.len().max(1)).copied()
}

fn set_fifo(priority: i32) -> io::Result<()> {
    set_scheduler(libc::SCHED_FIFO, priority)
}

/// Opens links to a running loop for a process that no role waits for. From then on the process runs at this niceness
/// and off the cores of the roles.
pub fn join_at_low_priority<T>(scenario: &Settings, niceness: i32, open: impl FnOnce() -> T) -> T {
    let opened = with_realtime_priority(open);
    yield_cores(scenario, niceness);
    opened
}

/// Opens or closes links at the lowest real-time priority, if granted.
///
/// A role that finds a half-made link waits for its completion, so the process that makes it must not be preempted by
/// ordinary ones.
pub fn with_realtime_priority<T>(act: impl FnOnce() -> T) -> T {
    take_lowest_realtime_priority();
    let done = act();
    release_priority();
    done
}

/// Takes the lowest real-time priority: before all ordinary processes, after the roles. Without permission nothing
/// changes.
pub fn take_lowest_realtime_priority() {
    let _ = set_fifo(1);
}

/// Takes a priority above all roles, for the calling thread and threads started from now on: the process that carries
/// samples between hosts does little, and a spinning role would delay it. Without permission nothing changes.
#[cfg(feature = "hosts")]
pub fn take_priority_above_roles(scenario: &Settings) {
    let _ = set_current_timer_slack(NonZero::new(1));
    if (1..99).contains(&scenario.realtime.priority) {
        let _ = set_fifo(scenario.realtime.priority + 1);
    }
}

/// Sets the niceness and leaves the cores that the scenario names for roles. Failures are ignored.
fn yield_cores(scenario: &Settings, niceness: i32) {
    let _ = nice(niceness);
    if let (Cores::List(critical), Ok(mut allowed)) = (&scenario.realtime.cores, sched_getaffinity(None)) {
        critical.iter().for_each(|core| allowed.unset(*core));
        if allowed.count() > 0 {
            let _ = sched_setaffinity(None, &allowed);
        }
    }
}

/// Returns the calling thread to ordinary priority: work after the last tick must not delay another role.
pub fn release_priority() {
    // A failure affects only the time after the last tick.
    let _ = set_scheduler(libc::SCHED_OTHER, 0);
}

/// Requested time slice of a process without priority, ns: the shortest that the kernel grants.
const TURN_NS: u64 = 100_000;

/// Requests short time slices for the calling thread and threads started from now on. A sleeping process then wakes at
/// once instead of after the slices of busy processes; its share of the processor stays the same. Needs no privilege.
/// Effective from Linux 6.12 on, ignored by older kernels.
pub fn request_short_slices() {
    let mut attributes = libc::sched_attr {
        size: size_of::<libc::sched_attr>() as u32,
        sched_policy: 0,
        sched_flags: 0,
        sched_nice: 0,
        sched_priority: 0,
        sched_runtime: 0,
        sched_deadline: 0,
        sched_period: 0,
    };
    let size = attributes.size;
    #[allow(unsafe_code)]
    // SAFETY: thread 0 is the calling one, and the pointer is to a live structure of the given size.
    let result = unsafe { libc::syscall(libc::SYS_sched_getattr, 0, &raw mut attributes, size, 0) };
    if result == 0 && attributes.sched_policy == libc::SCHED_OTHER as u32 {
        attributes.sched_runtime = TURN_NS;
        #[allow(unsafe_code)]
        // SAFETY: as above; the kernel only reads it. An older kernel changes nothing.
        let _ = unsafe { libc::syscall(libc::SYS_sched_setattr, 0, &raw const attributes, 0) };
    }
}

/// Calls the kernel: the function of the C library musl only fails.
#[allow(unsafe_code)]
fn set_scheduler(policy: libc::c_int, priority: libc::c_int) -> io::Result<()> {
    // SAFETY: thread 0 is the calling one, and the pointer is to a live integer, which is all that the kernel's sched_param has.
    match unsafe { libc::syscall(libc::SYS_sched_setscheduler, 0, policy, &raw const priority) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use crate::scenario::Scenario;

    fn shipped(name: &str, overrides: &[&str]) -> Scenario {
        let (_, text) = SHIPPED.iter().find(|(known, _)| *known == name).unwrap();
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        Scenario::parse(text, name, &overrides).unwrap()
    }

    #[test]
    fn roles_share_cores_with_the_bodies_they_wait_for_unless_cores_suffice() {
        let roles = [RoleId::Plant(0), RoleId::Plant(1), RoleId::Observer(0), RoleId::Controller];
        let places = |cores: &[usize], processes: &str| {
            let scenario = shipped("rigid-pair", &[processes]);
            roles.map(|role| core_of(cores, role, &scenario).unwrap())
        };
        let apart = |cores: &[usize]| places(cores, "launch.processes=[]");
        assert_eq!(apart(&[7]), [7, 7, 7, 7]);
        assert_eq!(apart(&[4, 5]), [4, 5, 4, 5]);
        assert_eq!(apart(&[4, 5, 6]), [4, 5, 6, 5]);
        assert_eq!(apart(&[4, 5, 6, 7, 8]), [4, 5, 6, 7]);
        let together = |cores: &[usize]| places(cores, "launch.processes=[['observer','controller']]");
        assert_eq!(together(&[7]), [7, 7, 7, 7]);
        assert_eq!(together(&[4, 5]), [4, 5, 4, 4]);
        assert_eq!(together(&[4, 5, 6, 7]), [4, 5, 6, 6]);
        let trio = shipped("rigid-trio", &[]);
        assert_eq!(core_of(&[4, 5], RoleId::Plant(2), &trio), Some(4));
        assert_eq!(core_of(&[], RoleId::Plant(2), &trio), None);
    }

    #[test]
    fn no_role_is_pinned_without_a_realtime_priority() {
        assert!(cores(&Realtime::default(), false).is_empty());
        assert!(!cores(&Realtime::default(), true).is_empty());
    }

    #[test]
    fn an_unavailable_core_is_found_before_a_run() {
        let cores =
            |list: &str| unavailable_cores(&shipped("rigid-pair", &[&format!("realtime.cores={list}")]).realtime);
        let allowed = sched_getaffinity(None).unwrap();
        let first = (0..CpuSet::MAX_CPU).find(|core| allowed.is_set(*core)).unwrap();
        assert_eq!(cores(&format!("[{first},1023]")), [1023]);
        assert!(cores("\"auto\"").is_empty());
        assert_eq!(sched_getaffinity(None).unwrap(), allowed, "this thread keeps its affinity");
    }

    #[test]
    fn a_refused_privilege_is_reported_with_a_remedy() {
        let overrides = ["realtime.lock_memory=false", "realtime.priority=0", "realtime.cores=[1023]"];
        let scenario = shipped("rigid-pair", &overrides);
        let Privileges { grants, has_realtime, co_located } = take_privileges(&scenario, RoleId::Observer(0));
        assert_eq!((grants.len(), has_realtime, co_located), (1, false, Vec::new()));
        assert!(!grants[0].granted && grants[0].reason.contains("realtime.cores"), "{grants:?}");
    }
}
