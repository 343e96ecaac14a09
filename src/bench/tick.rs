//! Measures the lateness of a tick in a run, in a bare loop and in cyclictest, in turn, with the same priority, period and core.

use super::board::Board;
use super::chain::{APART, run_live, stages};
use super::session::{Bench, BenchError};
use super::watch::Watch;
use crate::clock::{Grid, SpinGap, monotonic_ns, sleep_until, wait_until};
use crate::runtime::RoleId;
use crate::telemetry::{Grant, Latency};
use std::process::{Command, Stdio};

const PERIOD_NS: u64 = 1_000_000;
/// The time before a tick at which a role wakes to spin, ns.
const LEAD_NS: u64 = 60_000;
/// The longest latency in cyclictest's histogram, ns: its own limit.
const LONGEST_NS: u64 = 1_000_000;

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let (rounds, ticks) = (bench.size(5, 1), bench.size(2000, 100));
    let scenario = bench.scenario(&[])?;
    let leader = RoleId::Plant(0).name(&scenario).to_owned();
    for round in 1..=rounds {
        bench.next(&format!("tick: round {round} of {rounds}"))?;
        let outcome = run_live(bench, 1000, ticks as f64 / 1e3, APART)?;
        for latency in stages(&outcome, &leader, "lateness") {
            board.record("ours, in a run", Some("cyclictest"), &latency);
        }
        match cyclictest(bench, board, ticks)? {
            Ok(latency) => board.record("cyclictest", None, &latency),
            Err(reason) => board.remark(format!("cyclictest is missing: {reason}")),
        }
        let (spun, spun_error) = bare(bench, board, ticks, LEAD_NS)?;
        board.record("bare sleep and spin", Some("cyclictest"), &spun);
        board.add("rate error of a bare sleep and spin", "%", None, spun_error);
        let (slept, slept_error) = bare(bench, board, ticks, 0)?;
        board.record("bare sleep", Some("cyclictest"), &slept);
        board.add("rate error of a bare sleep", "%", None, slept_error);
        let duration = format!("duration_s={:?}", ticks as f64 / 1e3);
        let mut watch =
            Watch { overrides: &[&duration, "clock=realtime"], environment: Vec::new(), midway: &mut |_, _| {} };
        if let Some(error) = watch.run(bench)?.rate_error_percent {
            board.add("rate error of a run", "%", None, error);
        }
    }
    Ok(())
}

/// Runs bare ticks with the leader's privileges, each with this lead. Returns their lateness, and the error of their rate, %.
fn bare(bench: &Bench<'_>, board: &mut Board, ticks: u64, lead_ns: u64) -> Result<(Latency, f64), BenchError> {
    bench.in_the_leaders_place(board, |_| {
        let mut latency = Latency::default();
        let grid = Grid { epoch_ns: monotonic_ns() + PERIOD_NS, period_ns: PERIOD_NS };
        let (mut first_ns, mut last_ns) = (0, 0);
        for tick in 0..ticks {
            let due_ns = grid.due_ns(tick);
            last_ns = match lead_ns {
                0 => {
                    sleep_until(due_ns);
                    monotonic_ns()
                }
                lead_ns => wait_until(due_ns, lead_ns, &mut SpinGap::default()),
            };
            first_ns = if tick == 0 { last_ns } else { first_ns };
            latency.record(due_ns, last_ns);
        }
        let expected_ns = (ticks - 1) * PERIOD_NS;
        Ok((latency, ((last_ns - first_ns) as f64 / expected_ns as f64 - 1.0).abs() * 100.0))
    })
}

/// Measures the lateness with cyclictest, or returns the reason why it cannot.
fn cyclictest(bench: &Bench<'_>, board: &mut Board, ticks: u64) -> Result<Result<Latency, String>, BenchError> {
    let grants = bench.in_the_leaders_place(board, |place| Ok(place.grants.clone()))?;
    let granted = |name: &str| grants.iter().find(|grant: &&Grant| grant.granted && grant.privilege == name);
    let mut command = Command::new("cyclictest");
    command.args(["--quiet", "--nsecs", "--threads=1", "--json=/dev/stdout"]);
    command.arg(format!("--interval={}", PERIOD_NS / 1000)).arg(format!("--loops={ticks}"));
    command.arg(format!("--histogram={LONGEST_NS}")).arg("--histfile=/dev/null");
    if granted("locked memory").is_some() {
        command.arg("--mlockall");
    }
    for (privilege, option) in [("SCHED_FIFO", "--priority"), ("core", "--affinity")] {
        if let Some(grant) = granted(privilege) {
            command.arg(format!("{option}={}", grant.asked));
        }
    }
    let done = match command.stdin(Stdio::null()).output() {
        Ok(done) => done,
        Err(error) => return Ok(Err(format!("{error}; install it (Debian: apt install rt-tests)"))),
    };
    if !done.status.success() {
        return Ok(Err(format!("it failed: {}", String::from_utf8_lossy(&done.stderr).trim())));
    }
    Ok(parse(&String::from_utf8_lossy(&done.stdout)))
}

/// Reads the histogram from cyclictest's JSON, which begins with the first brace.
fn parse(text: &str) -> Result<Latency, String> {
    let json = text.find('{').map_or("", |begin| &text[begin..]);
    // Text after the object is ignored.
    let mut values = serde_json::Deserializer::from_str(json).into_iter::<serde_json::Value>();
    let value = values.next().and_then(Result::ok).ok_or("its JSON cannot be read")?;
    let thread = &value["thread"]["0"];
    let histogram = thread["histogram"].as_object().ok_or("its JSON has no histogram")?;
    let mut latency = Latency::default();
    let mut counted = 0;
    for (ns, count) in histogram {
        let (ns, count) = (ns.parse::<u64>().map_err(|error| error.to_string())?, count.as_u64().unwrap_or(0));
        (0..count).for_each(|_| latency.record(0, ns));
        counted += count;
    }
    // Latencies beyond the histogram count as the maximum.
    let (cycles, longest) = (thread["cycles"].as_u64().unwrap_or(counted), thread["max"].as_u64().unwrap_or(0));
    (counted..cycles).for_each(|_| latency.record(0, longest));
    Ok(latency)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latencies_beyond_cyclictests_histogram_count_as_the_maximum() {
        let text = r#"# /dev/cpu_dma_latency set to 0us
{"thread": {"0": {"histogram": {"1000": 2, "30000": 1}, "cycles": 4, "min": 1000, "max": 2000000}}}
# Total: 4"#;
        let figures = parse(text).unwrap().percentiles();
        assert_eq!((figures.count, figures.min_us), (4, 1.0));
        assert!((figures.max_us - 2000.0).abs() < 2.0, "{figures:?}");
        assert!(parse("nothing").is_err() && parse("{}").is_err());
    }
}
