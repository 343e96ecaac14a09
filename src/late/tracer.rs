//! The process that records the kernel's trace beside a run, and finds the causes of late ticks in it while they are fresh.
//!
//! It keeps the last seconds of the trace undecoded and decodes the time around a late tick only. Must not delay a role, nor end a run:
//! without a trace the roles' counters tell the kind of each cause.

use super::delay::Delay;
use super::explain::{causes, input_causes, slices};
use super::findings::{Finding, Findings, TRACER, announce_ready, ready_path};
use super::last::{Candidate, last_path};
use super::ring::{KEPT_NS, TraceRing};
use crate::bus::domain::Domain;
use crate::clock::{monotonic_ns, sleep_until};
use crate::runtime::{RoleId, cpu_quota, late_log};
use crate::scenario::Scenario;
use crate::seat::{RoleError, join_complete, open_ledger, report_path, write_whole};
use crate::system::name_thread;
use crate::telemetry::LateLog;
use corotate_trace::{Cause, TraceError};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Interval between two looks at the trace and at the records of late ticks, ns.
const POLL_NS: u64 = 20_000_000;
/// Least time between two publications of the last late tick, ns.
const PUBLISH_NS: u64 = 200_000_000;
/// The number of late ticks whose timelines are kept.
const TIMELINES: usize = 10;
/// The number of events that are decoded at each look, about: more would cost a core. At the end it is larger.
const DECODED: u64 = 50_000;
const DECODED_LAST: u64 = 5_000_000;

/// Traces a run until `terminated`, and writes what it found to the domain.
///
/// # Errors
/// [`RoleError`].
pub fn run_tracer(root: &Path, terminated: &AtomicBool) -> Result<(), RoleError> {
    let (domain, scenario) = join_complete(root)?;
    let failed = |path: PathBuf| move |source| RoleError::Report { path, source };
    name_thread(TRACER);
    let tracer = Tracer::start(&domain, &scenario);
    let _held = announce_ready(&domain).map_err(failed(ready_path(&domain)))?;
    let found = match tracer {
        Ok(tracer) => tracer.follow(&domain, terminated),
        Err(error) => Findings { note: Some(error.to_string()), ..Findings::default() },
    };
    let path = report_path(domain.root(), TRACER);
    let text = serde_json::to_vec(&found).expect("findings of plain values are JSON");
    write_whole(&path, &text).map_err(failed(path))?;
    domain.remove_if_over();
    Ok(())
}

struct Tracer<'a> {
    scenario: &'a Scenario,
    ring: TraceRing,
    roles: Vec<TracedRole>,
    /// True if a cgroup limits the processor time of the roles, which have the same group as this process.
    limited: bool,
    /// Late ticks that are not explained: role, index of the record, delay.
    pending: Vec<(usize, usize, Delay)>,
    findings: Vec<Finding>,
    /// The last explained late tick.
    last: Option<Candidate>,
    /// The tick that was published last, and the earliest time of the next one, ns.
    published: Option<(u64, u64)>,
}

struct TracedRole {
    role: RoleId,
    log: LateLog,
    /// The number of records that were seen.
    seen: usize,
    /// The threads, of all generations.
    threads: Vec<i32>,
}

impl<'a> Tracer<'a> {
    fn start(domain: &Domain, scenario: &'a Scenario) -> Result<Self, TraceError> {
        let id = domain.root().file_name().unwrap_or_default().to_string_lossy();
        let ring = TraceRing::start(&id)?;
        let roles = RoleId::all(scenario).into_iter().filter_map(|role| {
            let log = late_log(scenario, role, &open_ledger(domain, scenario, role).ok()?)?;
            Some(TracedRole { role, log, seen: 0, threads: Vec::new() })
        });
        let roles = roles.collect();
        let (pending, findings) = (Vec::new(), Vec::new());
        let limited = cpu_quota(Path::new("/")).is_some();
        Ok(Self { scenario, ring, roles, limited, pending, findings, last: None, published: None })
    }

    fn follow(mut self, domain: &Domain, terminated: &AtomicBool) -> Findings {
        while !terminated.load(Ordering::Relaxed) && domain.exists() {
            self.look();
            self.publish_last(domain);
            sleep_until(monotonic_ns() + POLL_NS);
        }
        // The events around the last late tick.
        self.look();
        self.explain_pending(DECODED_LAST);
        Findings { note: None, ticks: self.findings, cost: Some(self.ring.cost()) }
    }

    fn look(&mut self) {
        self.follow_threads();
        for (role, traced) in self.roles.iter_mut().enumerate() {
            for record in traced.log.records(traced.seen) {
                let delay = Delay { role: traced.role, record, period_ns: self.scenario.period_ns };
                self.pending.push((role, traced.seen, delay));
                traced.seen += 1;
            }
        }
        // After the records: the trace then reaches beyond them.
        self.ring.read();
        self.explain_pending(DECODED);
    }

    /// Explains late ticks, the longest delays first, until about `events` events are decoded. The others wait as long as their pages are
    /// kept.
    fn explain_pending(&mut self, events: u64) {
        let begun = self.ring.decoded();
        self.pending.sort_by_key(|(.., delay)| delay.ns());
        while self.ring.decoded() - begun < events
            && let Some((role, index, delay)) = self.pending.pop()
        {
            self.explain(role, index, &delay);
        }
        let kept_ns = monotonic_ns().saturating_sub(KEPT_NS);
        self.pending.retain(|(.., delay)| delay.record.due_ns > kept_ns);
    }

    /// Writes the last explained late tick for watchers, if it is a new one: at most five times per second.
    fn publish_last(&mut self, domain: &Domain) {
        let Some(Candidate { last, .. }) = &self.last else { return };
        let now_ns = monotonic_ns();
        if self.published.is_none_or(|(tick, next_ns)| tick != last.tick && now_ns >= next_ns) {
            self.published = Some((last.tick, now_ns + PUBLISH_NS));
            // Only a screen lacks it.
            let _ = serde_json::to_vec(last).map(|text| write_whole(&last_path(domain), &text));
        }
    }

    /// Watches the page faults of the roles' threads.
    fn follow_threads(&mut self) {
        let mut news = false;
        for role in &mut self.roles {
            let thread = role.log.thread() as i32;
            if thread > 0 && !role.threads.contains(&thread) {
                role.threads.push(thread);
                news = true;
            }
        }
        if news {
            let threads: Vec<i32> = self.roles.iter().filter_map(|role| role.threads.last().copied()).collect();
            self.ring.set_page_fault_threads(&threads);
        }
    }

    fn explain(&mut self, role: usize, index: usize, delay: &Delay) {
        let (role, record) = (self.roles[role].role.number(), &delay.record);
        let window = self.ring.around(record.due_ns, record.done_ns, self.scenario.period_ns);
        let thread_of = |role: RoleId| self.roles.iter().find(|traced| traced.role == role)?.threads.last().copied();
        let sender = delay.sender().and_then(thread_of).unwrap_or(0);
        let roles = &self.roles;
        let name = |tid: i32| {
            let traced = roles.iter().find(|traced| traced.threads.contains(&tid))?;
            Some(traced.role.name(self.scenario).to_owned())
        };
        let named = |cause: Cause| match cause.tid.and_then(name) {
            Some(name) => Cause { name, ..cause },
            None => cause,
        };
        let named = |causes: Vec<Cause>| causes.into_iter().map(named).collect();
        let Some(causes) = causes(delay, sender, self.limited, &window).map(named) else { return };
        let input_causes = named(input_causes(delay, sender, &window));
        let delay_ns = delay.ns();
        let slices = if self.is_shown(delay_ns) { slices(delay, &window, name) } else { Vec::new() };
        if !slices.is_empty() {
            self.make_room();
        }
        let finding = Finding { role, index, delay_ns, causes, input_causes, slices };
        let candidate = Candidate::new(self.scenario, delay, Some(&finding));
        if candidate.supersedes(self.last.as_ref()) {
            self.last = Some(candidate);
        }
        self.findings.push(finding);
    }

    /// Returns true if a delay is one of the worst, whose timelines are kept.
    fn is_shown(&self, delay_ns: u64) -> bool {
        let shown = || self.findings.iter().filter(|known| !known.slices.is_empty());
        shown().count() < TIMELINES || shown().any(|known| known.delay_ns < delay_ns)
    }

    /// Drops the timeline of the shortest delay if there is no room for another one.
    fn make_room(&mut self) {
        let mut shown: Vec<&mut Finding> = self.findings.iter_mut().filter(|known| !known.slices.is_empty()).collect();
        if shown.len() >= TIMELINES
            && let Some(least) = shown.iter_mut().min_by_key(|known| known.delay_ns)
        {
            least.slices.clear();
        }
    }
}
