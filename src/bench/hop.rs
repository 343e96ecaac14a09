//! Measures one hop between two processes on two cores, with every mechanism in turn: paced, from the due time, and back to back.
//!
//! The sender is this process with the leader's privileges, the receiver a peer with the controller's. Must not favour a
//! mechanism: same cores, same privileges, same samples, same waits.

use super::board::Board;
use super::exchange::{Mechanism, Opening, Receiver, Sender, Station, Wake};
use super::peer::{LOST_NS, Peer, SPIN_NS, lead_ns};
use super::session::{Bench, BenchError};
use crate::bus::domain::{Domain, OwnedDomain};
use crate::clock::{Grid, SpinGap, monotonic_ns, wait_until};
use crate::telemetry::{Grant, Latency};

/// The pace of the open loop: 1 kHz.
const PERIOD_NS: u64 = 1_000_000;
/// The time until the first sample of a round is due, ns: both ends must be waiting by then.
const START_NS: u64 = 5_000_000;
/// Words of the samples: 64, 128, 256 bytes.
const SIZES: [usize; 3] = [8, 16, 32];

/// The compared mechanisms, for receivers that poll first and for those that sleep.
const POLLED: [Mechanism; 3] = [Mechanism::Ours, Mechanism::Iceoryx, Mechanism::SharedMemory];
const SLEEPERS: [Mechanism; 4] = [Mechanism::Ours, Mechanism::Iceoryx, Mechanism::SharedMemory, Mechanism::Udp];

/// Both ends of one exchange, with one mechanism, wait and sample size.
pub(super) struct Pair {
    name: String,
    floor: Option<String>,
    sender: Sender,
    back: Receiver,
    peer: Peer,
    number: u64,
    /// True if both ends yield their core between two polls.
    yields: bool,
    /// Samples that were overwritten by the next one before the late receiver read them.
    lost: u64,
}

/// Measures the row.
pub(super) fn measure(bench: &mut Bench<'_>, board: &mut Board) -> Result<(), BenchError> {
    let domain = OwnedDomain::create(0)?;
    let ways = [(Wake::Spin, &POLLED[..]), (Wake::Event, &SLEEPERS[..]), (Wake::Hybrid, &POLLED[..])];
    for (wake, mechanisms) in ways {
        for words in bench.size(&SIZES[..], &SIZES[..1]).iter().copied() {
            bench.next(&format!("hop: {}, {} bytes", wake.name(), 8 * words))?;
            let pairs: Result<Vec<_>, _> = mechanisms
                .iter()
                .map(|mechanism| Pair::open(domain.domain(), false, *mechanism, wake, words))
                .collect();
            let mut pairs = pairs?;
            for pair in &mut pairs {
                board.granted(pair.grants());
            }
            take_turns(bench, board, &mut pairs, wake)?;
        }
    }
    Ok(())
}

/// Measures the pairs in turn, round after round.
fn take_turns(bench: &mut Bench<'_>, board: &mut Board, pairs: &mut [Pair], wake: Wake) -> Result<(), BenchError> {
    let (rounds, paced) = (bench.size(8, 1), bench.size(250, 20));
    let exchanges = match wake {
        Wake::Spin => bench.size(5000, 200),
        Wake::Event | Wake::Hybrid => bench.size(500, 50),
    };
    for _ in 0..rounds {
        for pair in &mut *pairs {
            let (name, floor) = (pair.name.clone(), pair.floor.clone());
            bench.next(&format!("hop: {name}"))?;
            let measured = bench.in_the_leaders_place(board, |_| {
                let paced = pair.paced(paced)?;
                Ok((paced, pair.back_to_back(exchanges)?))
            });
            let (([due, sent], lost), one_way_us) = measured?;
            pair.lost += lost;
            board.record(&name, floor.as_deref(), &due);
            let suffixed =
                |suffix: &str| (format!("{name}, {suffix}"), floor.as_ref().map(|f| format!("{f}, {suffix}")));
            let (name_sent, floor_sent) = suffixed("from send");
            board.record(&name_sent, floor_sent.as_deref(), &sent);
            let (name_tight, floor_tight) = suffixed("back to back");
            board.add(&name_tight, "us", floor_tight.as_deref(), one_way_us);
        }
    }
    let lost: Vec<String> =
        pairs.iter().filter(|pair| pair.lost > 0).map(|pair| format!("{} {}", pair.name, pair.lost)).collect();
    if !lost.is_empty() {
        let total = rounds * paced;
        board.remark(format!("overtaken by the next before a late receiver looked, of {total}: {}", lost.join("; ")));
    }
    Ok(())
}

impl Pair {
    /// Opens both ends; the peer takes the privileges of the observer, or of the controller.
    pub fn open(
        domain: &Domain,
        observer: bool,
        mechanism: Mechanism,
        wake: Wake,
        words: usize,
    ) -> Result<Self, BenchError> {
        let title = |mechanism: Mechanism| format!("{}, {}, {} B", mechanism.name(wake), wake.name(), 8 * words);
        let floor = (mechanism == Mechanism::Ours).then(|| title(Mechanism::Iceoryx));
        let mut name: String = title(mechanism).chars().filter(|letter| letter.is_ascii_alphanumeric()).collect();
        name += if observer { "observer" } else { "controller" };
        let opening = |direction| Opening { mechanism, wake, words, name: name.clone(), direction };
        let mut peer = Peer::start(domain, observer)?;
        let station = Station { domain, process: "bench" };
        // Each receiver opens before its sender, which looks for it only once.
        let back = station.receiver(&opening(1))?;
        peer.open(opening(0), Some(opening(1)))?;
        let sender = station.sender(&opening(0))?;
        Ok(Self { name: title(mechanism), floor, sender, back, peer, number: 0, yields: false, lost: 0 })
    }

    /// Makes both ends yield their core between two polls.
    pub fn enable_yield(&mut self) {
        self.yields = true;
        self.back.enable_yield();
    }

    /// Takes the peer's privileges, granted or not.
    pub fn grants(&mut self) -> Vec<Grant> {
        std::mem::take(&mut self.peer.grants)
    }

    /// Sends `count` samples, each when it is due. Returns the receiver's latencies from due and from sent, and the lost samples.
    fn paced(&mut self, count: u64) -> Result<([Latency; 2], u64), BenchError> {
        let grid = Grid { epoch_ns: monotonic_ns() + START_NS, period_ns: PERIOD_NS };
        self.peer.receive(grid, self.number + 1, count, false)?;
        send_paced(&mut self.sender, grid, count, &mut self.number, false)?;
        self.peer.received()
    }

    /// Sends `count` samples there and back without a pause. Returns half of the mean round trip, µs.
    pub fn back_to_back(&mut self, count: u64) -> Result<f64, BenchError> {
        self.peer.echo(count, self.yields)?;
        self.back.refresh();
        let began_ns = monotonic_ns();
        for _ in 0..count {
            self.number += 1;
            self.sender.send(self.number, 0)?;
            self.sender.prepare()?;
            if self.back.receive(monotonic_ns() + SPIN_NS, monotonic_ns() + LOST_NS)?.is_none() {
                return Err(BenchError::Peer(format!("{}: it did not echo", self.name)));
            }
        }
        let one_way_us = (monotonic_ns() - began_ns) as f64 / 2e3 / count as f64;
        self.peer.echoed()?;
        Ok(one_way_us)
    }
}

/// Sends the samples of a grid from tick 1 to `count`, each when it is due. If `yields`, yields the core after each.
pub(super) fn send_paced(
    sender: &mut Sender,
    grid: Grid,
    count: u64,
    number: &mut u64,
    yields: bool,
) -> Result<(), BenchError> {
    let (before, mut tick) = (*number, 1);
    while tick <= count {
        let now_ns = wait_until(grid.due_ns(tick), lead_ns(grid), &mut SpinGap::default());
        // As in a role, late ticks are skipped, never sent in a burst. The receiver counts the missing numbers.
        tick = grid.tick_at(now_ns).clamp(tick, count);
        sender.send(before + tick, grid.due_ns(tick))?;
        if yields {
            // The receiver waits for this core too.
            std::thread::yield_now();
        }
        sender.prepare()?;
        tick += 1;
    }
    *number = before + count;
    Ok(())
}
