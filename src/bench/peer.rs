//! The other end of a hop: a separate process of this program that receives, echoes or forwards samples.
//!
//! It requests the privileges of the role that it stands for. It reads orders as lines of JSON from standard input and answers
//! on standard output, never during a measurement. It ends with its parent.

use super::exchange::{Opening, Receiver, Sender, Station, Wake, system};
use super::session::BenchError;
use crate::bus::domain::Domain;
use crate::clock::{Grid, monotonic_ns, sleep_until};
use crate::runtime::{Privileges, RoleId, take_privileges};
use crate::scenario::Scenario;
use crate::system::this_program;
use crate::telemetry::{Grant, Latency, StageReport};
use serde::{Deserialize, Serialize};
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, Stdio};
use std::sync::mpsc::{Receiver as Lines, channel};
use std::time::Duration;

/// The time before a sample is due at which both ends wake, as in roles, ns.
const LEAD_NS: u64 = 60_000;
/// The spin time after a sample was due, before a receiver sleeps, ns.
pub(super) const SPIN_NS: u64 = 50_000;
/// The time after which a missing sample counts as lost, ns.
pub(super) const LOST_NS: u64 = 1_000_000_000;
/// The time without an answer after which a peer counts as hung.
const WATCHDOG: Duration = Duration::from_secs(60);

/// An order to a peer.
#[derive(Debug, Serialize, Deserialize)]
enum Order {
    /// Open these ends: one to read from, one to write to.
    Open { inlet: Opening, outlet: Option<Opening> },
    /// Receive `count` samples that are due on a grid, beginning with number `first`; if `pass_on`, forward them.
    Receive { epoch_ns: u64, period_ns: u64, first: u64, count: u64, pass_on: bool },
    /// Send each of `count` samples back at once; if `give_way`, yield the core between two polls.
    Echo { count: u64, give_way: bool },
}

/// An answer of a peer.
#[derive(Debug, Serialize, Deserialize)]
enum Answer {
    /// The peer has started, with these privileges.
    Here(Vec<Grant>),
    /// The ends are open.
    Open,
    /// The samples are received: latencies from due and from sent, and the number of lost samples.
    Received { due: StageReport, sent: StageReport, lost: u64 },
    /// All samples are echoed.
    Echoed,
}

/// Serves as a peer of the benchmark in this domain until standard input ends. It takes the privileges of the scenario's observer,
/// which shares the leader's core if cores are few, or else of the controller.
///
/// # Errors
/// The reason as text.
pub fn serve_peer(domain: &Path, scenario: &Scenario, observer: bool) -> Result<(), String> {
    let domain = Domain::join(domain).map_err(|error| error.to_string())?;
    let (role, waits_for) = match observer {
        true => (RoleId::Observer(0), RoleId::Plant(0)),
        false => (RoleId::Controller, RoleId::Observer(0)),
    };
    let Privileges { grants, co_located, .. } = take_privileges(scenario, role);
    send_answer(&Answer::Here(grants))?;
    let mut ends = None;
    for line in std::io::stdin().lock().lines() {
        let line = line.map_err(|error| error.to_string())?;
        let order: Order = serde_json::from_str(&line).map_err(|error| error.to_string())?;
        ends.iter_mut().for_each(|(receiver, _): &mut (Receiver, _)| receiver.refresh());
        let answer = execute(&order, &domain, &mut ends).map_err(|error| error.to_string())?;
        if let (Some((receiver, _)), true) = (&mut ends, co_located.contains(&waits_for)) {
            receiver.enable_yield();
        }
        send_answer(&answer)?;
    }
    Ok(())
}

fn send_answer(answer: &Answer) -> Result<(), String> {
    let line = serde_json::to_string(answer).map_err(|error| error.to_string())?;
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{line}").and_then(|()| stdout.flush()).map_err(|error| error.to_string())
}

fn execute(
    order: &Order,
    domain: &Domain,
    ends: &mut Option<(Receiver, Option<Sender>)>,
) -> Result<Answer, BenchError> {
    match (order, ends) {
        (Order::Open { inlet, outlet }, ends) => {
            let station = Station { domain, process: "peer" };
            let receiver = station.receiver(inlet)?;
            let sender = outlet.as_ref().map(|outlet| station.sender(outlet)).transpose()?;
            *ends = Some((receiver, sender));
            Ok(Answer::Open)
        }
        (Order::Receive { epoch_ns, period_ns, first, count, pass_on }, Some((receiver, sender))) => {
            let grid = Grid { epoch_ns: *epoch_ns, period_ns: *period_ns };
            receive(grid, *first, *count, receiver, sender.as_mut().filter(|_| *pass_on))
        }
        (Order::Echo { count, give_way }, Some((receiver, Some(sender)))) => {
            if *give_way {
                receiver.enable_yield();
            }
            for _ in 0..*count {
                let Some(content) = receiver.receive(monotonic_ns() + SPIN_NS, monotonic_ns() + LOST_NS)? else {
                    return Err(system("relay a sample", "one is lost that nothing could overtake"));
                };
                sender.send(content.number, content.due_ns)?;
                sender.prepare()?;
            }
            Ok(Answer::Echoed)
        }
        _ => Err(system("obey", "nothing is open")),
    }
}

/// Returns the time before a sample is due at which both ends wake; a short period must leave time to sleep.
pub(super) fn lead_ns(grid: Grid) -> u64 {
    LEAD_NS.min(grid.period_ns / 4)
}

/// Receives the samples that are due on a grid. A link that holds only the newest sample loses some if the receiver is late.
fn receive(
    grid: Grid,
    first: u64,
    count: u64,
    receiver: &mut Receiver,
    mut sender: Option<&mut Sender>,
) -> Result<Answer, BenchError> {
    let (mut due, mut sent, mut lost, mut tick) = (Latency::default(), Latency::default(), 0, 0);
    while tick < count {
        let due_ns = grid.due_ns(tick + 1);
        if receiver.wake() != Wake::Event {
            sleep_until(due_ns - lead_ns(grid));
        }
        let Some(content) = receiver.receive(due_ns + SPIN_NS, grid.due_ns(count) + LOST_NS)? else {
            lost += count - tick;
            break;
        };
        let now_ns = monotonic_ns();
        if content.number < first {
            continue;
        }
        if let Some(sender) = &mut sender {
            sender.send(content.number, content.due_ns)?;
            sender.prepare()?;
        }
        due.record(content.due_ns, now_ns);
        sent.record(content.sent_ns, now_ns);
        lost += content.number - first - tick;
        tick = content.number - first + 1;
    }
    Ok(Answer::Received { due: StageReport::new("due", &due), sent: StageReport::new("sent", &sent), lost })
}

/// The parent's handle of a peer.
pub(super) struct Peer {
    child: Child,
    orders: Option<ChildStdin>,
    answers: Lines<String>,
    /// The privileges that it requested.
    pub grants: Vec<Grant>,
}

impl Peer {
    /// Starts a peer.
    pub fn start(domain: &Domain, observer: bool) -> Result<Self, BenchError> {
        let mut command = this_program().map_err(BenchError::system("find this program"))?;
        command.arg("bench-peer").arg("--domain").arg(domain.root());
        command.arg("--parent").arg(std::process::id().to_string());
        if observer {
            command.arg("--observer");
        }
        let mut child = command
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(BenchError::system("start a measuring peer"))?;
        let (orders, stdout) = (child.stdin.take(), child.stdout.take());
        let (lines, answers) = channel();
        // The thread ends with the peer's output.
        let read_answers = move || {
            for line in stdout.into_iter().flat_map(|stdout| BufReader::new(stdout).lines()).map_while(Result::ok) {
                if lines.send(line).is_err() {
                    break;
                }
            }
        };
        let mut peer = Self { child, orders, answers, grants: Vec::new() };
        std::thread::Builder::new().spawn(read_answers).map_err(BenchError::system("start a thread"))?;
        match peer.answer()? {
            Answer::Here(grants) => peer.grants = grants,
            answer => return Err(unexpected(&answer)),
        }
        Ok(peer)
    }

    /// Opens the peer's ends.
    pub fn open(&mut self, inlet: Opening, outlet: Option<Opening>) -> Result<(), BenchError> {
        self.send_order(&Order::Open { inlet, outlet })?;
        match self.answer()? {
            Answer::Open => Ok(()),
            answer => Err(unexpected(&answer)),
        }
    }

    /// Orders it to receive the samples due on a grid from tick 1 to `count`, beginning with number `first`, and to forward them if
    /// `pass_on`; [`Self::received`] returns the result.
    pub fn receive(&mut self, grid: Grid, first: u64, count: u64, pass_on: bool) -> Result<(), BenchError> {
        self.send_order(&Order::Receive { epoch_ns: grid.epoch_ns, period_ns: grid.period_ns, first, count, pass_on })
    }

    /// Waits for the result of a receive: latencies from due and from sent, and the number of lost samples.
    pub fn received(&mut self) -> Result<([Latency; 2], u64), BenchError> {
        match self.answer()? {
            Answer::Received { due, sent, lost } => Ok(([due.latency(), sent.latency()], lost)),
            answer => Err(unexpected(&answer)),
        }
    }

    /// Orders it to echo.
    pub fn echo(&mut self, count: u64, give_way: bool) -> Result<(), BenchError> {
        self.send_order(&Order::Echo { count, give_way })
    }

    /// Waits until all samples are echoed.
    pub fn echoed(&mut self) -> Result<(), BenchError> {
        match self.answer()? {
            Answer::Echoed => Ok(()),
            answer => Err(unexpected(&answer)),
        }
    }

    fn send_order(&mut self, order: &Order) -> Result<(), BenchError> {
        let line = serde_json::to_string(order).map_err(|error| BenchError::Peer(error.to_string()))?;
        let orders = self.orders.as_mut().ok_or_else(|| BenchError::Peer("it takes no orders".to_owned()))?;
        writeln!(orders, "{line}").map_err(|error| BenchError::Peer(error.to_string()))
    }

    fn answer(&mut self) -> Result<Answer, BenchError> {
        let line = self.answers.recv_timeout(WATCHDOG).map_err(|_| BenchError::Peer("no answer".to_owned()))?;
        serde_json::from_str(&line).map_err(|error| BenchError::Peer(error.to_string()))
    }
}

fn unexpected(answer: &Answer) -> BenchError {
    BenchError::Peer(format!("it answered {answer:?}"))
}

impl Drop for Peer {
    fn drop(&mut self) {
        // A peer that waits for orders ends with them; one that hangs in a receive must be killed.
        self.orders.take();
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
