//! The last seconds of the kernel's trace on the cores that this process may use, undecoded.
//!
//! Decodes the time around a late tick only. Must not wait for the kernel.

use super::model::TracerCost;
use crate::clock::{correction_ns, raw_ns};
use crate::runtime::usable_cores;
use corotate_trace::{Event, Instance, Page, TraceError, Window, remove_instances};
use rustix::time::{ClockId, clock_gettime};
use std::collections::VecDeque;
use std::path::Path;

/// The beginning of the names of all trace instances of this program.
const PREFIX: &str = "corotate-";
/// Time before a late tick that is decoded: it must include a switch on each core, ns.
const BEFORE_NS: u64 = 20_000_000;
/// The same in periods of the loop.
const BEFORE_PERIODS: u64 = 3;
/// Time after a late tick that is decoded, ns.
const AFTER_NS: u64 = 1_000_000;
/// Age at which pages are dropped, ns.
pub const KEPT_NS: u64 = 3_000_000_000;
/// The largest number of pages that are kept of each core.
const PAGES: usize = 8192;
/// Longest delay whose whole time is decoded, ns; of a longer one its end.
const WINDOW_NS: u64 = 1_000_000_000;

/// A running trace, and the pages that were read from it. Ends when it is dropped.
#[derive(Debug)]
pub struct TraceRing {
    instance: Instance,
    cores: Vec<(usize, VecDeque<Page>)>,
    events: u64,
    overruns: u64,
}

impl TraceRing {
    /// Starts a trace after removing those of dead processes. `name` distinguishes it from other traces of this process.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn start(name: &str) -> Result<Self, TraceError> {
        remove_dead_traces();
        let cores = usable_cores();
        let instance = Instance::create(&format!("{PREFIX}{}-{name}", std::process::id()), &cores, &[])?;
        let cores = cores.into_iter().map(|core| (core, VecDeque::new())).collect();
        Ok(Self { instance, cores, events: 0, overruns: 0 })
    }

    /// Records the page faults of these threads only.
    pub fn set_page_fault_threads(&mut self, threads: &[i32]) {
        // Without these events page faults count as computation.
        let _ = self.instance.set_page_fault_threads(threads);
    }

    /// Reads the pages that the kernel holds, and drops old ones.
    pub fn read(&mut self) {
        let now_ns = raw_ns();
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

    /// Decodes the events around a delay from `due_ns` to `done_ns` in a loop of this period.
    pub fn around(&mut self, due_ns: u64, done_ns: u64, period_ns: u64) -> Window {
        let to_ns = done_ns + AFTER_NS;
        let before_ns = BEFORE_NS.max(BEFORE_PERIODS * period_ns);
        let from_ns = due_ns.saturating_sub(before_ns).max(to_ns.saturating_sub(WINDOW_NS));
        Window::new(self.decode(from_ns, to_ns), from_ns, to_ns)
    }

    /// Decodes the events of a time on all cores. The kernel's time is this host's own, all others are the run's.
    fn decode(&mut self, from_ns: u64, to_ns: u64) -> Vec<Event> {
        let correction_ns = correction_ns();
        let [from_ns, to_ns] = [from_ns, to_ns].map(|ns| ns.saturating_add_signed(-correction_ns));
        let mut events = Vec::new();
        for (core, pages) in &self.cores {
            let first = pages.partition_point(|page| page.start_ns <= from_ns).saturating_sub(1);
            for page in pages.iter().skip(first).take_while(|page| page.start_ns < to_ns) {
                self.instance.formats().decode(page, *core, &mut events);
            }
        }
        events.iter_mut().for_each(|event| event.ns = event.ns.saturating_add_signed(correction_ns));
        self.events += events.len() as u64;
        events
    }

    /// Returns the number of events that were decoded so far.
    pub fn decoded(&self) -> u64 {
        self.events
    }

    /// Returns the costs so far; the processor time is that of the calling thread.
    pub fn cost(&self) -> TracerCost {
        let used = clock_gettime(ClockId::ThreadCPUTime);
        let cpu_s = used.tv_sec as f64 + used.tv_nsec as f64 / 1e9;
        TracerCost { cpu_s, events: self.events, overruns: self.overruns }
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
