//! Measures the processor time per tick of each role in whole runs, for each wait mode, beside a thread that only sleeps until
//! each tick.
//!
//! The values come from the kernel's accounting of each process. Must not query the processes of the run.

use super::board::Board;
use super::session::{Bench, BenchError};
use super::watch::{Process, Watch};
use crate::clock::{Grid, SpinGap, monotonic_ns, wait_until};
use rustix::time::{ClockId, clock_gettime};
use std::fs;
use std::time::{Duration, Instant};

/// The wait modes of roles, as in `realtime.wake`.
const WAKES: [&str; 3] = ["event", "spin", "auto"];
const PERIOD_NS: u64 = 1_000_000;
/// The time before a tick at which a plant wakes to spin, ns.
const LEAD_NS: u64 = 60_000;

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let (rounds, window) = (bench.size(3, 1), bench.size(Duration::from_secs(2), Duration::from_millis(300)));
    for round in 1..=rounds {
        for wake in WAKES {
            bench.next(&format!("processor: {wake}, round {round} of {rounds}"))?;
            for (process, us) in per_tick(bench, wake, window)? {
                board.add(&format!("{process}, {wake}"), "us/tick", Some("bare sleep"), us);
            }
        }
        let ticks = window.as_nanos() as u64 / PERIOD_NS;
        for (name, lead_ns) in [("bare sleep", 0), ("bare sleep and spin", LEAD_NS)] {
            let us = bare(bench, board, ticks, lead_ns)?;
            board.add(name, "us/tick", None, us);
        }
    }
    Ok(())
}

/// Measures the processor time of each process of a run per tick, µs.
fn per_tick(bench: &mut Bench<'_>, wake: &str, window: Duration) -> Result<Vec<(String, f64)>, BenchError> {
    let duration = format!("duration_s={:?}", window.as_secs_f64() + bench.size(2.0, 1.0));
    let wake = format!("realtime.wake={wake}");
    let mut used = Vec::new();
    let mut midway = |processes: &[Process], period_ns: u64| {
        let began = Instant::now();
        let before: Vec<_> = processes.iter().map(|process| processor_ns(process.pid)).collect();
        std::thread::sleep(window);
        let ticks = began.elapsed().as_nanos() as f64 / period_ns as f64;
        let after = processes.iter().zip(before).filter_map(|(process, before)| {
            let ns = processor_ns(process.pid)?.checked_sub(before?)?;
            Some((process.name.clone(), ns as f64 / 1e3 / ticks))
        });
        used = after.collect();
    };
    Watch { overrides: &[&duration, "clock=realtime", &wake], environment: Vec::new(), midway: &mut midway }
        .run(bench)?;
    Ok(used)
}

/// Returns the processor time of all threads of a process so far, ns; `None` without such a process or kernel accounting.
fn processor_ns(pid: i32) -> Option<u64> {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).ok()?.flatten();
    let thread_ns = |task: fs::DirEntry| {
        let schedstat = fs::read_to_string(task.path().join("schedstat")).ok()?;
        schedstat.split_whitespace().next()?.parse::<u64>().ok()
    };
    tasks.map(thread_ns).sum()
}

/// Measures the processor time of a thread that only waits for each tick, with the leader's privileges and this lead, µs per tick.
fn bare(bench: &Bench<'_>, board: &mut Board, ticks: u64, lead_ns: u64) -> Result<f64, BenchError> {
    bench.in_the_leaders_place(board, |_| {
        let grid = Grid { epoch_ns: monotonic_ns() + PERIOD_NS, period_ns: PERIOD_NS };
        let before = clock_gettime(ClockId::ThreadCPUTime);
        for tick in 0..ticks {
            wait_until(grid.due_ns(tick), lead_ns, &mut SpinGap::default());
        }
        let after = clock_gettime(ClockId::ThreadCPUTime);
        let ns = (after.tv_sec - before.tv_sec) * 1_000_000_000 + after.tv_nsec - before.tv_nsec;
        Ok(ns as f64 / 1e3 / ticks as f64)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_busy_process_has_processor_time_and_a_missing_one_has_none() {
        // A separate process, because the time of this process falls when one of its threads ends.
        let mut busy = std::process::Command::new("sh").args(["-c", "while :; do :; done"]).spawn().unwrap();
        let pid = busy.id() as i32;
        while processor_ns(pid).unwrap() < 10_000_000 {
            std::thread::yield_now();
        }
        busy.kill().unwrap();
        busy.wait().unwrap();
        assert_eq!(processor_ns(-1), None);
    }
}
