//! The domain of a run: its memory, and the files that a process needs to join it.

use super::super::supervision::Member;
use super::super::{Launch, LaunchError};
use crate::bus::domain::{Domain, OwnedDomain, require_files};
use crate::changes::ReceivedChanges;
use crate::clock::{self, RunClock};
use crate::config::ClockKind;
use crate::input::Change;
use crate::runtime::{PaceBoard, RoleId, shared_memory_bytes};
use crate::scenario::Scenario;
use crate::seat::{
    changes_path, describe_seat, listening_process, results_path, scenario_path, seat_path, write_whole,
};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::os::unix::ffi::OsStrExt;

/// Upper bounds on the number of open files of the launcher, which opens more than any other process.
const DESCRIPTORS: u64 = 32;
const DESCRIPTORS_PER_ROLE: u64 = 24;
/// Upper bounds on the number of files that a run creates in shared memory and beside it: signals, connections, process tags.
const FILES: u64 = 32;
const FILES_PER_ROLE: u64 = 32;

/// Makes the clock that a device may set, in a run in real time with an external body, and uses it in this process.
pub(super) fn open_pace(
    scenario: &Scenario,
    launch: &Launch<'_>,
    domain: &Domain,
) -> Result<Option<PaceBoard>, LaunchError> {
    let mut bodies = scenario.bodies.iter().filter(|body| body.driven && body.fleet.is_none());
    if scenario.clock != ClockKind::Realtime || !bodies.any(|body| is_external(scenario, launch, &body.name)) {
        return Ok(None);
    }
    let path = domain.shared(RunClock::PACE);
    let failed = |source| LaunchError::Write { path: path.clone(), source };
    let board = PaceBoard::open(domain).map_err(failed)?;
    clock::adopt(&path).map_err(failed)?;
    Ok(Some(board))
}

/// Makes this process use its own clock again when it is dropped.
pub(super) struct OwnClockAfter;

impl Drop for OwnClockAfter {
    fn drop(&mut self) {
        clock::release();
    }
}

/// Creates a domain with the shared memory that a run of a scenario needs.
pub fn new_domain(scenario: &Scenario) -> Result<OwnedDomain, LaunchError> {
    require_descriptors(scenario)?;
    require_files(FILES + FILES_PER_ROLE * RoleId::all(scenario).len() as u64)?;
    Ok(OwnedDomain::create(shared_memory_bytes(scenario))?)
}

/// Writes the files into a domain that a process needs to join the run.
pub fn prepare(scenario: &Scenario, launch: &Launch<'_>, domain: &Domain) -> Result<(), LaunchError> {
    if let Some(results) = &launch.results {
        let path = results_path(domain.root());
        write_whole(&path, results.as_os_str().as_bytes()).map_err(|source| LaunchError::Write { path, source })?;
    }
    share_changes(scenario, domain)?;
    describe_seats(scenario, launch, domain)?;
    // Last: a process that finds the scenario also finds the other files.
    let path = scenario_path(domain);
    write_whole(&path, scenario.to_file().as_bytes()).map_err(|source| LaunchError::Write { path, source })
}

/// Moves the list of received changes into a domain; that of a replay has those of the recorded run.
pub fn share_changes(scenario: &Scenario, domain: &Domain) -> Result<(), LaunchError> {
    let path = changes_path(domain);
    let list = ReceivedChanges::open(&path).map_err(|source| LaunchError::Write { path, source })?;
    let before = scenario.inputs.received();
    let before: Vec<Change> = (0..before.count()).filter_map(|number| before.get(number)).collect();
    list.append(&before, || true);
    scenario.inputs.receive_in(list);
    Ok(())
}

pub(super) fn is_external(scenario: &Scenario, launch: &Launch<'_>, role: &str) -> bool {
    launch.external.iter().chain(&scenario.external).any(|external| external == role)
}

/// Returns true if changes of inputs do not reach a role: the program that runs it does not read them.
pub(super) fn takes_no_inputs(
    scenario: &Scenario,
    launch: &Launch<'_>,
    domain: &Domain,
    members: &[Member],
    role: RoleId,
) -> bool {
    let name = role.name(scenario);
    let process = || members.iter().find(|member| member.books().any(|(own, _)| own == role))?.pid();
    is_external(scenario, launch, name)
        && listening_process(domain.root(), name).is_none_or(|listener| process().is_some_and(|pid| pid != listener))
}

/// Returns the other host that runs a role, if one does.
pub(super) fn elsewhere<'s>(scenario: &'s Scenario, launch: &Launch<'_>, role: &str) -> Option<&'s str> {
    let seat = launch.host.as_ref()?;
    scenario.hosts.host_of(role).filter(|host| *host != seat.host)
}

/// Writes the seat description of every external role into the domain.
fn describe_seats(scenario: &Scenario, launch: &Launch<'_>, domain: &Domain) -> Result<(), LaunchError> {
    let roles = RoleId::all(scenario).into_iter();
    for role in roles.filter(|role| is_external(scenario, launch, role.name(scenario))) {
        let path = seat_path(domain.root(), role.name(scenario));
        let seat = describe_seat(scenario, role, Some(domain)).to_json();
        write_whole(&path, seat.as_bytes()).map_err(|source| LaunchError::Write { path, source })?;
    }
    Ok(())
}

/// Raises the limit on open files as far as allowed, for this process and its children, and checks that it is enough.
fn require_descriptors(scenario: &Scenario) -> Result<(), LaunchError> {
    let limits = getrlimit(Resource::Nofile);
    // If it cannot be raised, the present limit is checked.
    let _ = setrlimit(Resource::Nofile, Rlimit { current: limits.maximum, ..limits });
    let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    let needed = DESCRIPTORS + DESCRIPTORS_PER_ROLE * RoleId::all(scenario).len() as u64;
    if limit < needed { Err(LaunchError::Descriptors { limit, needed }) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SHIPPED;
    use std::sync::atomic::AtomicUsize;

    /// Other processes take the scenario's file as the sign that a domain is whole.
    #[test]
    fn the_scenario_is_the_last_file_of_a_domain() {
        let external = "launch.external=[\"follower\"]".to_owned();
        let scenario = Scenario::parse(SHIPPED[0].1, "test", &[external]).unwrap();
        let owned = OwnedDomain::create(1 << 20).unwrap();
        let domain = owned.domain();
        // Its file cannot be written.
        std::fs::create_dir(scenario_path(domain)).unwrap();
        let signal = AtomicUsize::new(0);
        assert!(prepare(&scenario, &Launch::new(&signal, &mut |_| {}), domain).is_err());
        assert!(seat_path(domain.root(), "follower").is_file() && changes_path(domain).is_file());
    }
}
