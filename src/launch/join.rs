//! The part of a host that joined a run: starts its roles, supervises them, and ends them when the run ends or its heartbeats
//! stop.
//!
//! Phases, epoch and credit come from the host that launched. Must not score, nor record.

use super::children::END_LIMIT;
use super::error::LaunchError;
use super::incident::Incident;
use super::options::Launch;
use super::processes::{Supervisor, prepare};
use super::relay::{FarEnd, RelayWatch};
use crate::bus::domain::{Domain, OwnedDomain};
use crate::bus::iox::IoxBus;
use crate::bus::{Bus, BusError, Read, Reader, Signal};
use crate::clock::{self, RunClock, monotonic_ns, raw_ns};
use crate::config::ClockKind;
use crate::hosts::{HostEndpoint, RELAY, far_end_path};
use crate::runtime::{depths, hold_low_latency_idle, request_short_slices, topic};
use crate::sample::{Phase, RoleState, Schedule};
use crate::scenario::Scenario;
use crate::seat::{clock_path, report_path, write_whole};
use crate::system::tell;
use std::cmp::Reverse;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// The number of late ticks, the longest delays first, in the report of a role.
const REPORTED_LATE_TICKS: usize = 20;
/// Interval between two looks at the roles, ns.
const LOOK_NS: u64 = 10_000_000;
/// Interval between two looks at the schedule while none comes, ns: in real time, and in lockstep.
const LULL_NS: u64 = 1_000_000;
const LOCKSTEP_LULL_NS: u64 = 50_000;
/// Time that the relay may take to report the host's end, ns: longer than it tries.
const TELL_NS: u64 = 25_000_000_000;

/// The end of a host's part in a run.
#[derive(Debug)]
pub struct FarOutcome {
    /// The reason for which the host gave up, if it did.
    pub failed: Option<String>,
    /// Roles that failed there.
    pub incidents: Vec<Incident>,
    /// Ticks that its roles executed, and missed.
    pub ticks: (u64, u64),
}

/// Takes a host's part in a run that `hub` launched. The scenario is that run's; `owned` is a domain for it.
///
/// # Errors
/// [`LaunchError`] if it could not begin.
pub fn join(
    scenario: &Scenario,
    owned: OwnedDomain,
    seat: &HostEndpoint,
    hub: &str,
    launch: &mut Launch<'_>,
) -> Result<FarOutcome, LaunchError> {
    request_short_slices();
    let domain = owned.domain();
    prepare(scenario, launch, domain)?;
    let path = clock_path(domain);
    let failed = |source| LaunchError::Write { path: path.clone(), source };
    // Created here, so that it exists before any process of this host publishes.
    RunClock::open(&path).map_err(failed)?;
    let startup_limit = Duration::from_secs_f64(scenario.startup_timeout_s);
    let mut janitor = super::janitor::Janitor::start(domain, startup_limit)?;
    let (_low_latency, _) = match scenario.clock {
        ClockKind::Realtime => hold_low_latency_idle(&scenario.realtime),
        _ => (None, Vec::new()),
    };
    let bus = IoxBus::enter(domain, "launcher", depths(scenario))?.with_opening_limit(startup_limit);
    let mut relay = RelayWatch::start(Some(seat), hub, scenario, domain)?;
    while !relay.ready()? {
        if launch.signal.load(Ordering::Relaxed) != 0 {
            return Ok(FarOutcome {
                failed: Some("a signal ended it".to_owned()),
                incidents: Vec::new(),
                ticks: (0, 0),
            });
        }
        clock::sleep_until(monotonic_ns() + LULL_NS);
    }
    clock::adopt(&path).map_err(failed)?;
    let word = bus.reader(&topic(scenario, RELAY, Signal::Schedule), Reader::Role)?;
    let mut supervisor = Supervisor::of_host(scenario, &seat.host, domain, &bus, &mut janitor, relay)?;
    let failed = Follower { scenario, hub, word, heard_ns: raw_ns() }.follow(&mut supervisor, launch)?;
    failed.iter().for_each(|reason| tell(format_args!("corotate: {reason}; the roles here end")));
    let (far_end, ticks) = end(supervisor, failed, domain, &seat.host)?;
    Ok(FarOutcome { failed: far_end.failed, incidents: far_end.incidents, ticks })
}

/// Ends the roles, and writes their final reports and that of this process for the relay.
fn end(
    mut supervisor: Supervisor<'_>,
    failed: Option<String>,
    domain: &Domain,
    host: &str,
) -> Result<(FarEnd, (u64, u64)), LaunchError> {
    let mut shutdown = supervisor.shut_down(END_LIMIT);
    for report in &mut shutdown.reports {
        // The connection is made for short reports.
        report.late_ticks.sort_by_key(|late| Reverse(late.done_ns.saturating_sub(late.due_ns)));
        report.late_ticks.truncate(REPORTED_LATE_TICKS);
        let path = report_path(domain.root(), &report.role);
        let text = serde_json::to_vec(report).expect("a report of plain values is JSON");
        write_whole(&path, &text).map_err(|source| LaunchError::Write { path, source })?;
    }
    let ticks = shutdown.reports.iter().map(|report| report.ticks);
    let ticks = ticks.fold((0, 0), |(executed, missed), ticks| (executed + ticks.executed, missed + ticks.missed));
    let problems =
        shutdown.problems.into_iter().chain(shutdown.unbooked.into_iter().map(|role| format!("{role} left no report")));
    let (incidents, mut relay) = supervisor.dismiss();
    let far_end = FarEnd { failed, incidents, problems: problems.collect() };
    let path = far_end_path(domain.root(), host);
    let text = serde_json::to_vec(&far_end).expect("a report of plain values is JSON");
    write_whole(&path, &text).map_err(|source| LaunchError::Write { path, source })?;
    let limit_ns = raw_ns() + TELL_NS;
    while relay.companion.lingers() && raw_ns() < limit_ns {
        clock::sleep_until(monotonic_ns() + LULL_NS);
    }
    Ok((far_end, ticks))
}

/// Follows the schedule of the host that launched.
struct Follower<'a> {
    scenario: &'a Scenario,
    hub: &'a str,
    word: <IoxBus as Bus>::Reader<Schedule>,
    heard_ns: u64,
}

impl Follower<'_> {
    /// Reads the schedule, if there is a new one.
    fn hear(&mut self, supervisor: &mut Supervisor<'_>) -> Result<bool, BusError> {
        let mut news = false;
        while self.word.advance()? {
            news = true;
        }
        if let Some(word) = self.word.current().filter(|_| news) {
            self.heard_ns = raw_ns();
            news = supervisor.adopt(word);
        }
        Ok(news)
    }

    /// Supervises until the run ends; returns the reason if this host gave up.
    fn follow(
        mut self,
        supervisor: &mut Supervisor<'_>,
        launch: &mut Launch<'_>,
    ) -> Result<Option<String>, LaunchError> {
        let lull_ns = if self.scenario.clock == ClockKind::Realtime { LULL_NS } else { LOCKSTEP_LULL_NS };
        let (mut next_look_ns, mut told_ns) = (0, raw_ns());
        loop {
            let news = self.hear(supervisor)?;
            let now_ns = monotonic_ns();
            if news || now_ns >= next_look_ns {
                supervisor.announce()?;
            }
            if now_ns >= next_look_ns {
                next_look_ns = now_ns + LOOK_NS;
                supervisor.listen()?;
                let signal = launch.signal.load(Ordering::Relaxed);
                if signal != 0 {
                    return Ok(Some(format!("signal {signal} ended it")));
                }
                // A pause of this process does not count as silence of the other host.
                let looked_ns = raw_ns();
                if looked_ns - std::mem::replace(&mut told_ns, looked_ns) > 20 * LOOK_NS {
                    self.heard_ns = looked_ns;
                }
                let limit_s = self.scenario.host_silence_s(supervisor.phase() >= Phase::Run);
                if (looked_ns.saturating_sub(self.heard_ns)) as f64 > limit_s * 1e9 {
                    return Ok(Some(format!("no heartbeat from the host {} for {limit_s} s", self.hub)));
                }
                if supervisor.phase() == Phase::Stop {
                    return Ok(None);
                }
                let go_on = supervisor.supervise(&mut |_, _| {}, 0, now_ns)?;
                if !go_on {
                    return Ok(Some("a role failed".to_owned()));
                }
                let behind = supervisor.behind();
                (launch.progress)(&match behind {
                    Some(tick) => {
                        super::Progress::Running { tick, last_tick: self.scenario.last_tick, metric: f64::NAN }
                    }
                    None => supervisor.waiting(RoleState::Running),
                });
            }
            supervisor.pause(now_ns + lull_ns);
        }
    }
}
