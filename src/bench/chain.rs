//! Measures the whole chain at several rates, beside the same chain of bare iceoryx2 hops with the same cores, priorities and
//! waits.
//!
//! The latency is from the time at which the leader's tick was due until the controller has sent its command. The follower
//! applies the command when the next tick is due, so no role waits for that hop.

use super::board::Board;
use super::exchange::{Mechanism, Opening, Sender, Station, Wake};
use super::hop::send_paced;
use super::peer::Peer;
use super::session::{Bench, BenchError};
use crate::bus::domain::OwnedDomain;
use crate::clock::{Grid, monotonic_ns};
use crate::launch::Outcome;
use crate::runtime::RoleId;

const RATES_HZ: [u64; 4] = [1000, 5000, 10_000, 20_000];
/// Words of the bare samples: 128 bytes, the size of a measurement and nearly that of an estimate.
const WORDS: usize = 16;
/// Values of `launch.processes`: each role in its own process; observer and controller, the critical path, in one.
pub(super) const APART: &str = "[]";
const ESTIMATE_AND_CONTROL: &str = "[['observer', 'controller']]";
/// The time until the first sample of a round is due, ns.
const START_NS: u64 = 20_000_000;

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let (rounds, seconds) = (bench.size(4, 1), bench.size(2.0, 0.1));
    let scenario = bench.scenario(&[])?;
    if !RoleId::all(&scenario).contains(&RoleId::Controller) {
        board.remark("chain is not measured: no body of this scenario is driven, so there is no command".to_owned());
        return Ok(());
    }
    let all = format!("[{:?}]", scenario.roles());
    let domain = OwnedDomain::create(0)?;
    let mut raw = RawChain::open(board, &domain)?;
    for round in 1..=rounds {
        for hz in bench.size(&RATES_HZ[..], &RATES_HZ[..1]) {
            bench.next(&format!("chain: {hz} Hz, round {round} of {rounds}"))?;
            let (ours, floor) = (format!("ours, {hz} Hz"), format!("raw hops, {hz} Hz"));
            let apart = match run_live(bench, *hz, seconds, APART) {
                Err(BenchError::Scenario(reason)) => {
                    board.remark(format!("chain is not measured at {hz} Hz: {reason}"));
                    continue;
                }
                apart => apart?,
            };
            for (name, processes) in [("observer with controller", ESTIMATE_AND_CONTROL), ("all in one process", &all)]
            {
                let together = run_live(bench, *hz, seconds, processes)?;
                stages(&together, "controller", "age")
                    .for_each(|latency| board.record(&format!("{name}, {hz} Hz"), Some(&ours), &latency));
            }
            for (name, role, stage, beside) in [
                (ours.clone(), "controller", "age", Some(floor.as_str())),
                (format!("ours until the estimate is sent, {hz} Hz"), "observer", "age", None),
                (format!("step of the observer, {hz} Hz"), "observer", "step", None),
                (format!("step of the controller, {hz} Hz"), "controller", "step", None),
            ] {
                stages(&apart, role, stage).for_each(|latency| board.record(&name, beside, &latency));
            }
            let (missed, elapsed) = apart.reports.iter().fold((0, 0), |(missed, elapsed), report| {
                (missed + report.ticks.missed + report.ticks.starved, elapsed + report.ticks.elapsed)
            });
            let share = 100.0 * missed as f64 / elapsed as f64;
            board.add(&format!("missed or starved, {hz} Hz"), "%", None, share);
            raw.measure(bench, board, *hz, (seconds * *hz as f64) as u64)?;
        }
    }
    Ok(())
}

/// Returns the latencies of a role's stage.
pub(super) fn stages<'a>(
    outcome: &'a Outcome,
    role: &'a str,
    stage: &'a str,
) -> impl Iterator<Item = crate::telemetry::Latency> + 'a {
    let of_role = outcome.reports.iter().filter(move |report| report.role == role);
    of_role.flat_map(|report| &report.stages).filter(move |found| found.stage == stage).map(|found| found.latency())
}

/// Runs the scenario in real time with this value of `launch.processes`.
pub(super) fn run_live(bench: &Bench<'_>, hz: u64, seconds: f64, processes: &str) -> Result<Outcome, BenchError> {
    let (hz, seconds) = (format!("tick_hz={hz}.0"), format!("duration_s={seconds:?}"));
    let scenario = bench.scenario(&[&hz, &seconds, "clock=realtime", &format!("launch.processes={processes}")])?;
    bench.launch(&scenario, bench.signal, &mut |_| {})
}

/// Two bare hops in sequence. This process has the leader's privileges, one peer the observer's, the other the controller's.
struct RawChain {
    sender: Sender,
    relay: Peer,
    last: Peer,
    number: u64,
}

impl RawChain {
    fn open(board: &mut Board, domain: &OwnedDomain) -> Result<Self, BenchError> {
        let link = |name: &str| Opening {
            mechanism: Mechanism::Iceoryx,
            wake: Wake::Spin,
            words: WORDS,
            name: name.to_owned(),
            direction: 0,
        };
        let mut relay = Peer::start(domain.domain(), true)?;
        let mut last = Peer::start(domain.domain(), false)?;
        // Each receiver is open before its sender.
        last.open(link("second"), None)?;
        relay.open(link("first"), Some(link("second")))?;
        let sender = Station { domain: domain.domain(), process: "bench" }.sender(&link("first"))?;
        for peer in [&mut relay, &mut last] {
            board.granted(std::mem::take(&mut peer.grants));
        }
        Ok(Self { sender, relay, last, number: 0 })
    }

    fn measure(&mut self, bench: &Bench<'_>, board: &mut Board, hz: u64, count: u64) -> Result<(), BenchError> {
        let name = format!("raw hops, {hz} Hz");
        let grid = Grid { epoch_ns: monotonic_ns() + START_NS, period_ns: 1_000_000_000 / hz };
        self.relay.receive(grid, self.number + 1, count, true)?;
        self.last.receive(grid, self.number + 1, count, false)?;
        bench.in_the_leaders_place(board, |place| {
            let co_located = place.co_located.contains(&RoleId::Observer(0));
            send_paced(&mut self.sender, grid, count, &mut self.number, co_located)
        })?;
        let (_, lost_first) = self.relay.received()?;
        let ([due, _], lost) = self.last.received()?;
        board.record(&name, None, &due);
        let share = 100.0 * (lost + lost_first) as f64 / (2 * count) as f64;
        board.add(&format!("overtaken in {name}"), "%", None, share);
        Ok(())
    }
}
