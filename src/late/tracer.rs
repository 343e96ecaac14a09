//! The process that records the kernel's trace beside a run, and finds the causes of late ticks in it while they are fresh.
//!
//! It keeps the last seconds of the trace undecoded and decodes the time around a late tick only. Must not delay a role, nor end a run:
//! without a trace the roles' counters tell the kind of each cause.

use super::delay::Delay;
use super::explain::{causes, input_causes, slices};
use super::last::{Candidate, last_path};
use super::{Cause, Slice, TracerCost};
use crate::bus::domain::Domain;
use crate::clock::{monotonic_ns, sleep_until};
use crate::config::{ClockKind, Trace};
use crate::runtime::{RoleId, late_log};
use crate::scenario::Scenario;
use crate::seat::{RoleError, join_complete, open_ledger, report_path, write_whole};
use crate::system::name_thread;
use crate::telemetry::LateLog;
use corotate_trace::{Event, Instance, Page, TraceError, Window, remove_instances, require_tracefs};
use rustix::thread::sched_getaffinity;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// The name of the process.
pub const TRACER: &str = "tracer";
/// The beginning of the names of all trace instances of this program.
const PREFIX: &str = "corotate-";
/// The longest wait of another process for the findings, ns.
const FINDINGS_NS: u64 = 2_000_000_000;
/// Interval between two looks at the trace and at the records of late ticks, ns.
const POLL_NS: u64 = 20_000_000;
/// Least time between two publications of the last late tick, ns.
const PUBLISH_NS: u64 = 200_000_000;
/// Time before a late tick that is decoded: it must include a switch on each core, ns.
const BEFORE_NS: u64 = 20_000_000;
/// The same in periods of the loop.
const BEFORE_PERIODS: u64 = 3;
/// Time after a late tick that is decoded, ns.
const AFTER_NS: u64 = 1_000_000;
/// Age at which pages are dropped, ns.
const KEPT_NS: u64 = 3_000_000_000;
/// The largest number of pages that are kept of each core.
const PAGES: usize = 8192;
/// Longest delay whose whole time is decoded, ns; of a longer one its end.
const WINDOW_NS: u64 = 1_000_000_000;
/// The number of late ticks whose timelines are kept.
const TIMELINES: usize = 10;
/// The number of late ticks, the longest delays first, that are explained at each look: beside more the trace would cost a core.
const EXPLAINED: usize = 100;

/// Findings of the process.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Findings {
    /// The reason for which there is no trace, with the remedy.
    pub note: Option<String>,
    /// The explained late ticks.
    pub ticks: Vec<Finding>,
    /// The costs of the process.
    pub cost: Option<TracerCost>,
}

/// The causes of one late tick.
#[derive(Debug, Serialize, Deserialize)]
pub struct Finding {
    /// The role, as [`RoleId::number`].
    pub role: u64,
    /// The index of its record.
    pub index: usize,
    /// The length of the delay, ns.
    pub delay_ns: u64,
    /// The causes.
    pub causes: Vec<Cause>,
    /// Causes that kept the sender of its last input from sending it, for a sender without a late tick of its own.
    pub input_causes: Vec<Cause>,
    /// The cores around it, if it is one of the worst ticks.
    pub slices: Vec<Slice>,
}

/// Returns the file that the process writes once the trace runs, or cannot run.
pub fn ready_path(domain: &Domain) -> PathBuf {
    domain.root().join("tracer.ready")
}

/// Returns the findings of the process in a domain.
pub fn findings(domain: &Domain) -> Option<Findings> {
    serde_json::from_slice(&std::fs::read(report_path(domain.root(), TRACER)).ok()?).ok()
}

/// Returns true if a scenario asks for the kernel's trace.
pub fn wants_trace(scenario: &Scenario) -> bool {
    scenario.clock == ClockKind::Realtime && matches!(scenario.realtime.trace, Trace::Auto | Trace::Kernel)
}

/// Returns the reason for which this process could not trace a run of a scenario that asks for it; `None` if it could.
pub fn trace_refusal(scenario: &Scenario) -> Option<String> {
    require_tracefs().err().filter(|_| wants_trace(scenario)).map(|error| error.to_string())
}

/// Waits until the process of a stopped run has written its findings. Returns them, or the reason why there are none. Does not wait if
/// the run has no such process.
pub fn await_findings(
    domain: &Domain,
    scenario: &Scenario,
    may_wait: impl Fn() -> bool,
) -> Result<Findings, Option<String>> {
    if !ready_path(domain).exists() {
        return Err(trace_refusal(scenario));
    }
    let end_ns = monotonic_ns() + FINDINGS_NS;
    loop {
        match findings(domain) {
            Some(findings) => return Ok(findings),
            None if monotonic_ns() < end_ns && may_wait() => sleep_until(monotonic_ns() + POLL_NS / 4),
            None => return Err(Some("the tracing process left no findings in time".to_owned())),
        }
    }
}

/// Removes the trace instances of dead processes of this program.
pub fn remove_dead_traces() {
    // The kernel keeps an instance that a process reads, even if this one cannot see the process.
    remove_instances(PREFIX, |name| {
        let pid = name.strip_prefix(PREFIX).and_then(|rest| rest.split('-').next()?.parse::<u32>().ok());
        pid.is_none_or(|pid| Path::new(&format!("/proc/{pid}")).exists())
    });
}

/// Traces a run until `terminated`, and writes what it found to the domain.
///
/// # Errors
/// [`RoleError`].
pub fn run_tracer(root: &Path, terminated: &AtomicBool) -> Result<(), RoleError> {
    let (domain, scenario) = join_complete(root)?;
    let failed = |path: PathBuf| move |source| RoleError::Report { path, source };
    name_thread(TRACER);
    let tracer = Tracer::start(&domain, &scenario);
    let ready = ready_path(&domain);
    write_whole(&ready, b"").map_err(failed(ready))?;
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
    instance: Instance,
    cores: Vec<(usize, VecDeque<Page>)>,
    roles: Vec<TracedRole>,
    findings: Vec<Finding>,
    /// The last explained late tick.
    last: Option<Candidate>,
    /// The tick that was published last, and the earliest time of the next one, ns.
    published: Option<(u64, u64)>,
    events: u64,
    overruns: u64,
}

struct TracedRole {
    role: RoleId,
    log: LateLog,
    /// The number of records that are explained.
    explained: usize,
    /// The threads, of all generations.
    threads: Vec<i32>,
}

impl<'a> Tracer<'a> {
    fn start(domain: &Domain, scenario: &'a Scenario) -> Result<Self, TraceError> {
        remove_dead_traces();
        let set = sched_getaffinity(None).unwrap_or_default();
        let numbers: Vec<usize> = (0..rustix::thread::CpuSet::MAX_CPU).filter(|core| set.is_set(*core)).collect();
        let (pid, id) = (std::process::id(), domain.root().file_name().unwrap_or_default().to_string_lossy());
        let instance = Instance::create(&format!("{PREFIX}{pid}-{id}"), &numbers, &[])?;
        let roles = RoleId::all(scenario).into_iter().filter_map(|role| {
            let log = late_log(scenario, role, &open_ledger(domain, scenario, role).ok()?)?;
            Some(TracedRole { role, log, explained: 0, threads: Vec::new() })
        });
        let cores = numbers.into_iter().map(|core| (core, VecDeque::new())).collect();
        let roles = roles.collect();
        Ok(Self {
            scenario,
            instance,
            cores,
            roles,
            findings: Vec::new(),
            last: None,
            published: None,
            events: 0,
            overruns: 0,
        })
    }

    fn follow(mut self, domain: &Domain, terminated: &AtomicBool) -> Findings {
        while !terminated.load(Ordering::Relaxed) && domain.exists() {
            self.look();
            self.publish_last(domain);
            sleep_until(monotonic_ns() + POLL_NS);
        }
        // The events around the last late tick.
        self.look();
        let used = clock_gettime(ClockId::ProcessCPUTime);
        let cpu_s = used.tv_sec as f64 + used.tv_nsec as f64 / 1e9;
        let cost = TracerCost { cpu_s, events: self.events, overruns: self.overruns };
        Findings { note: None, ticks: self.findings, cost: Some(cost) }
    }

    fn look(&mut self) {
        self.follow_threads();
        let mut late = Vec::new();
        for (role, traced) in self.roles.iter_mut().enumerate() {
            for record in traced.log.records(traced.explained) {
                let delay = Delay { role: traced.role, record, period_ns: self.scenario.period_ns };
                late.push((role, traced.explained, delay));
                traced.explained += 1;
            }
        }
        // After the records: the trace then reaches beyond them.
        self.read_pages();
        late.sort_by_key(|(.., delay)| std::cmp::Reverse(delay.ns()));
        late.into_iter().take(EXPLAINED).for_each(|(role, index, delay)| self.explain(role, index, &delay));
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
            // Without these events page faults count as computation.
            let _ = self.instance.set_page_fault_threads(&threads);
        }
    }

    fn read_pages(&mut self) {
        let now_ns = monotonic_ns();
        for (core, pages) in &mut self.cores {
            let overruns = &mut self.overruns;
            self.instance.read(*core, &mut |page| {
                *overruns += u64::from(page.lost);
                pages.push_back(page);
            });
            // A page begins before its last event: the next one must be old too.
            while pages.len() > PAGES || pages.get(1).is_some_and(|next| next.start_ns + KEPT_NS < now_ns) {
                pages.pop_front();
            }
        }
    }

    fn explain(&mut self, role: usize, index: usize, delay: &Delay) {
        let (role, record) = (self.roles[role].role.number(), &delay.record);
        let to_ns = record.done_ns + AFTER_NS;
        let before_ns = BEFORE_NS.max(BEFORE_PERIODS * self.scenario.period_ns);
        let from_ns = record.due_ns.saturating_sub(before_ns).max(to_ns.saturating_sub(WINDOW_NS));
        let window = Window::new(self.decode(from_ns, to_ns), from_ns, to_ns);
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
        let Some(causes) = causes(delay, sender, &window).map(named) else { return };
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

    /// Decodes the events of a time on all cores.
    fn decode(&mut self, from_ns: u64, to_ns: u64) -> Vec<Event> {
        let mut events = Vec::new();
        for (core, pages) in &self.cores {
            let first = pages.partition_point(|page| page.start_ns <= from_ns).saturating_sub(1);
            for page in pages.iter().skip(first).take_while(|page| page.start_ns < to_ns) {
                self.instance.formats().decode(page, *core, &mut events);
            }
        }
        self.events += events.len() as u64;
        events
    }
}
