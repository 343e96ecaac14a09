//! The hunt: a probe on each core, and the causes of its late wakes from the kernel's trace, or from counters without one.
//!
//! Changes nothing of the machine but a trace instance of its own, which it removes, and its request for fast wake-ups.

use super::hunt_report::{CoreLateness, HuntOptions, HuntReport, Measured};
use super::probe::{LateWake, Probe, Schedule, Wakes};
use crate::clock::{Grid, monotonic_ns, sleep_until};
use crate::config::Realtime;
use crate::late::{Cause, Delay, LateKind, LateTick, Steal, TraceRing, causes_by_counters};
use crate::runtime::{RoleId, hold_low_latency_idle, usable_cores};
use crate::system::name_thread;
use crate::telemetry::{Grant, LateRecord};
use corotate_trace::{Duty, Facts, Phase, Window};
use std::io;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::{Builder, Scope, ScopedJoinHandle, scope};

/// Interval between two looks of a thread that waits for the start, ns.
const WAIT_NS: u64 = 1_000_000;
/// Time from the start to the first tick, ns.
const LEAD_NS: u64 = 20_000_000;
/// Interval between two looks at the late wakes and at the trace, ns.
const POLL_NS: u64 = 20_000_000;
/// The number of late wakes of a core that fit between two looks: all at the highest rate, even if one look is late.
const ROOM: usize = 4096;
/// The number of late wakes of a core that are examined, as of a role. Further ones are only counted.
const EXAMINED: usize = 2048;
/// Longest time from the first due time to the last wake for which late wakes share their events, ns.
const SHARED_NS: u64 = 100_000_000;

/// Measures the lateness of the wakes on each core of this process, and finds the causes of late ones, until `ended` or for the
/// given duration. `progress` is called with the number of ticks so far.
///
/// # Errors
/// The system's reason, if it refuses a thread.
pub fn hunt(options: &HuntOptions, ended: &AtomicBool, progress: &mut dyn FnMut(u64)) -> io::Result<HuntReport> {
    let realtime = Realtime::default();
    let (_held, mut grants) = hold_low_latency_idle(&realtime);
    // The name under which a trace shows this thread.
    name_thread("corotate-hunt");
    let (ring, note) = match TraceRing::start("hunt") {
        Ok(ring) => (Some(ring), None),
        Err(error) => (None, Some(error.to_string())),
    };
    let late_ns = realtime.late_ns(options.period_ns());
    let steal = Steal::read();
    let mut hunter =
        Hunter { ring, period_ns: options.period_ns(), epoch_ns: 0, cores: Vec::new(), ticks: Vec::new(), traced: 0 };
    let start = Start::default();
    let probes: Vec<(Wakes, Vec<Grant>)> = scope(|threads| {
        let probes: io::Result<Vec<_>> =
            usable_cores().into_iter().map(|core| hunter.spawn(threads, core, &start, ended)).collect();
        // After an error the probes that wait have nothing to do, but must end.
        let (count, ticks) = probes.as_ref().map_or((0, 0), |probes| (probes.len(), options.ticks()));
        let schedule = start.once_ready(count, options.period_ns(), ticks, late_ns);
        Ok::<_, io::Error>(hunter.follow(probes?, schedule, progress))
    })?;
    let mut cores = Vec::new();
    for (core, (wakes, asked)) in hunter.cores.iter().zip(probes) {
        cores.push(CoreLateness::new(core.number, &wakes));
        let news: Vec<Grant> = asked.into_iter().filter(|grant| !grants.contains(grant)).collect();
        grants.extend(news);
    }
    let cost = hunter.ring.as_ref().map(TraceRing::cost);
    let Hunter { epoch_ns, ticks, traced, .. } = hunter;
    let measured = Measured { epoch_ns, late_ns, cores, grants, ticks, traced, cost, note };
    let mut report = HuntReport::new(options, measured);
    report.late.steal_ms = Steal::read().since_ms(&steal);
    Ok(report)
}

/// The common start of all probes, so that none waits for one that does not come.
#[derive(Debug, Default)]
struct Start {
    /// The number of probes that are ready.
    ready: AtomicUsize,
    schedule: OnceLock<Schedule>,
}

impl Start {
    /// Announces a ready probe, and waits for the schedule.
    fn wait(&self) -> &Schedule {
        self.ready.fetch_add(1, Ordering::Relaxed);
        loop {
            if let Some(schedule) = self.schedule.get() {
                return schedule;
            }
            sleep_until(monotonic_ns() + WAIT_NS);
        }
    }

    /// Starts the probes once `count` of them are ready.
    fn once_ready(&self, count: usize, period_ns: u64, ticks: u64, late_ns: u64) -> &Schedule {
        while self.ready.load(Ordering::Relaxed) < count {
            sleep_until(monotonic_ns() + WAIT_NS);
        }
        self.schedule.get_or_init(|| {
            let grid = Grid { epoch_ns: monotonic_ns() + LEAD_NS, period_ns };
            Schedule { grid, ticks, late_ns }
        })
    }
}

/// A core with a probe.
struct Core {
    number: usize,
    late: Receiver<LateWake>,
    examined: usize,
}

/// The thread that finds the causes while the trace is fresh.
struct Hunter {
    /// The kernel's trace, if this user may read it.
    ring: Option<TraceRing>,
    period_ns: u64,
    epoch_ns: u64,
    cores: Vec<Core>,
    ticks: Vec<LateTick>,
    traced: u64,
}

impl Hunter {
    /// Starts the probe of a core.
    fn spawn<'scope>(
        &mut self,
        threads: &'scope Scope<'scope, '_>,
        core: usize,
        start: &'scope Start,
        ended: &'scope AtomicBool,
    ) -> io::Result<ScopedJoinHandle<'scope, (Wakes, Vec<Grant>)>> {
        let (sender, receiver) = sync_channel(ROOM);
        let body = move || {
            let (probe, grants) = Probe::open(core, sender);
            (probe.run(start.wait(), ended), grants)
        };
        let probe = Builder::new().name(format!("probe {core}")).spawn_scoped(threads, body)?;
        self.cores.push(Core { number: core, late: receiver, examined: 0 });
        Ok(probe)
    }

    /// Explains late wakes until all probes have ended, and returns their results.
    fn follow<T>(
        &mut self,
        probes: Vec<ScopedJoinHandle<'_, T>>,
        schedule: &Schedule,
        progress: &mut dyn FnMut(u64),
    ) -> Vec<T> {
        self.epoch_ns = schedule.grid.epoch_ns;
        while !probes.iter().all(|probe| probe.is_finished()) {
            sleep_until(monotonic_ns() + POLL_NS);
            self.look();
            progress(schedule.grid.tick_at(monotonic_ns()).min(schedule.ticks));
        }
        // The events around the last late wake.
        self.look();
        probes.into_iter().map(|probe| probe.join().expect("a probe does not panic")).collect()
    }

    fn look(&mut self) {
        let mut late: Vec<(usize, LateWake)> = Vec::new();
        for core in &mut self.cores {
            for wake in core.late.try_iter() {
                if core.examined < EXAMINED {
                    core.examined += 1;
                    late.push((core.number, wake));
                }
            }
        }
        // After the late wakes: the trace then reaches beyond them.
        self.ring.iter_mut().for_each(TraceRing::read);
        late.sort_by_key(|(_, wake)| wake.record.due_ns);
        let mut rest = &late[..];
        while !rest.is_empty() {
            let (due_ns, done_ns, count) = first_group(rest);
            let (group, later) = rest.split_at(count);
            rest = later;
            let window = self.ring.as_mut().map(|ring| ring.around(due_ns, done_ns, self.period_ns));
            let window = window.filter(|window| !window.has_losses());
            self.traced += window.as_ref().map_or(0, |_| group.iter().map(|(_, wake)| wake.ticks).sum());
            for (core, wake) in group {
                let delay = Delay { role: RoleId::Plant(*core), record: wake.record, period_ns: self.period_ns };
                let counted = || causes_by_counters(&delay);
                let causes = window.as_ref().map_or_else(counted, |window| causes_by_trace(window, &wake.record));
                self.ticks.push(late_tick(*core, wake, causes, self.epoch_ns));
            }
        }
    }
}

/// Returns the first due time, the last wake and the number of those first late wakes that share their events. They are in the
/// order of their due times, and there is one at least.
fn first_group(late: &[(usize, LateWake)]) -> (u64, u64, usize) {
    let (due_ns, mut done_ns) = (late[0].1.record.due_ns, late[0].1.record.done_ns);
    let mut count = 1;
    for (_, wake) in &late[1..] {
        let end_ns = done_ns.max(wake.record.done_ns);
        if end_ns - due_ns > SHARED_NS {
            break;
        }
        (done_ns, count) = (end_ns, count + 1);
    }
    (due_ns, done_ns, count)
}

/// Returns the causes of a late wake by name.
fn causes_by_trace(window: &Window, record: &LateRecord) -> Vec<Cause> {
    let LateRecord { due_ns, done_ns, usage, .. } = *record;
    let facts = Facts { throttled_ns: usage.throttled_ns, major_faults: usage.major_faults > 0, limited: false };
    // From its due time to its look at the clock a probe has nothing to compute: time on the core is time without it.
    let duty = Duty::Timer { gap: (due_ns, done_ns) };
    window.blame(record.tid as i32, facts, &[Phase { from_ns: due_ns, to_ns: done_ns, duty }])
}

fn late_tick(core: usize, wake: &LateWake, causes: Vec<Cause>, epoch_ns: u64) -> LateTick {
    let LateRecord { tick, due_ns, done_ns, .. } = wake.record;
    let mut late = LateTick {
        role: format!("core {core}"),
        tick,
        ticks: wake.ticks,
        kind: LateKind::Late,
        time_s: due_ns.saturating_sub(epoch_ns) as f64 / 1e9,
        late_us: (done_ns - due_ns) as f64 / 1e3,
        causes,
        caused_by: None,
        slices: Vec::new(),
    };
    late.complete_causes();
    late
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::late::CauseKind;
    use crate::telemetry::Usage;

    const MS: u64 = 1_000_000;

    fn wake(tick: u64, late_ns: u64, usage: Usage) -> LateWake {
        let due_ns = 1000 * MS + tick * MS;
        let (done_ns, began_ns) = (due_ns + late_ns, due_ns + late_ns);
        let record =
            LateRecord { tick, tid: 7, due_ns, began_ns, done_ns, slept: true, usage, ..LateRecord::default() };
        LateWake { record, ticks: 1 }
    }

    #[test]
    fn without_a_trace_counters_tell_the_kinds_of_the_causes() {
        let (sender, late) = sync_channel(ROOM);
        let core = Core { number: 3, late, examined: EXAMINED - 2 };
        let mut hunter =
            Hunter { ring: None, period_ns: MS, epoch_ns: 1000 * MS, cores: vec![core], ticks: Vec::new(), traced: 0 };
        let waited = |run_delay_ns| Usage { run_delay_ns, ..Usage::default() };
        sender.send(wake(5, 200_000, waited(150_000))).unwrap();
        sender.send(wake(9, 400_000, waited(1000))).unwrap();
        sender.send(wake(11, 900_000, waited(0))).unwrap();
        hunter.look();
        let found = |late: &LateTick| {
            let causes: Vec<(CauseKind, f64)> = late.causes.iter().map(|cause| (cause.kind, cause.us)).collect();
            (late.role.clone(), late.tick, late.time_s, late.late_us, causes)
        };
        let core = || "core 3".to_owned();
        // The third one is beyond the number that is examined.
        assert_eq!(
            hunter.ticks.iter().map(found).collect::<Vec<_>>(),
            [
                (core(), 5, 0.005, 200.0, vec![(CauseKind::Task, 150.0), (CauseKind::LateTimer, 50.0)]),
                (core(), 9, 0.009, 400.0, vec![(CauseKind::LateTimer, 399.0)]),
            ]
        );
    }

    #[test]
    fn late_wakes_close_to_each_other_share_their_events() {
        let late = |tick: u64, late_ms: u64| (0, wake(tick, late_ms * MS, Usage::default()));
        let group = |wakes: &[(usize, LateWake)]| {
            let (due_ns, done_ns, count) = first_group(wakes);
            (due_ns / MS, done_ns / MS, count)
        };
        assert_eq!(group(&[late(0, 1)]), (1000, 1001, 1));
        assert_eq!(group(&[late(0, 50), late(1, 2), late(90, 10), late(90, 11)]), (1000, 1100, 3));
        assert_eq!(group(&[late(0, 900), late(1, 1)]), (1000, 1900, 1), "a long delay has its own");
        assert_eq!(group(&[late(0, 1), late(1, 900), late(2, 1)]), (1000, 1001, 1));
    }

    #[test]
    fn a_hunt_has_a_row_for_each_core_and_ends_early() {
        let options = HuntOptions { seconds: 1, rate_hz: 50 };
        let (ended, mut last) = (AtomicBool::new(false), 0);
        let report = hunt(&options, &ended, &mut |tick| last = tick).unwrap();
        assert!((40..=50).contains(&last), "{last}");
        assert_eq!(report.cores.len(), usable_cores().len());
        assert!(report.cores.iter().all(|core| core.wakes + core.missed == 50), "{report}");
        ended.store(true, Ordering::Relaxed);
        let report = hunt(&HuntOptions { seconds: 3600, ..options }, &ended, &mut |_| {}).unwrap();
        assert!(report.cores.iter().all(|core| core.wakes == 0) && report.late.counted == 0, "{report}");
    }
}
