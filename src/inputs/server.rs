//! The launcher's end: a thread accepts requests, and the launcher's own loop serves them between its other duties.
//!
//! Must not block the launcher, whatever a client sends.

use super::protocol::{Answer, LINE_MAX, Request, WantedChange};
use crate::bus::domain::Domain;
use crate::changes::ReceivedChanges;
use crate::config::{InputInfo, Settings};
use crate::input::{Change, Shape};
use crate::runtime::{RoleId, ignoring_role};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// The time that a client has to send its request, and that it waits for the launcher's answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// The most requests that wait for the launcher.
const WAITING_MAX: usize = 64;

/// Returns the path of the socket in a domain's directory.
pub(super) fn socket_path(root: &Path) -> PathBuf {
    root.join("inputs")
}

/// The time at which a request is served.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Timing {
    /// The earliest tick at which a change can act in every role.
    pub earliest: u64,
    /// The earliest tick for which a change may still be published.
    pub safe: u64,
    /// The last tick for which a change may be appended now: later ones wait.
    pub horizon: u64,
    /// In real time, the time until a tick of the given number: `(due of tick 0, period, now)`, ns.
    pub clock: Option<(u64, u64, u64)>,
}

type Waiting = (Request, Sender<Answer>);

/// Receives changes of inputs for a run.
pub(crate) struct InputServer {
    requests: Receiver<Waiting>,
    /// Changes that act later than the horizon, in the order of their ticks.
    pending: Vec<Change>,
    path: PathBuf,
    stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl InputServer {
    /// Opens the socket in a domain.
    ///
    /// # Errors
    /// The system's reason.
    pub fn start(domain: &Domain) -> io::Result<Self> {
        let path = socket_path(domain.root());
        let listener = UnixListener::bind(&path)?;
        let (sender, requests) = sync_channel(WAITING_MAX);
        let stopped = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&stopped);
        let accept = move || {
            for stream in listener.incoming() {
                if seen.load(Ordering::Relaxed) {
                    return;
                }
                let sender = sender.clone();
                // A client that sends nothing holds up no other.
                let serve = move || stream.and_then(|stream| answer(&stream, &sender)).unwrap_or_default();
                let _ = std::thread::Builder::new().name("input".to_owned()).spawn(serve);
            }
        };
        let thread = std::thread::Builder::new().name("inputs".to_owned()).spawn(accept)?;
        Ok(Self { requests, pending: Vec::new(), path, stopped, thread: Some(thread) })
    }

    /// Serves the waiting requests, and appends the pending changes that are due. `ignores` returns true for a role that takes no
    /// inputs: one that another program runs, without this library.
    pub fn poll(
        &mut self,
        scenario: &Settings,
        list: &ReceivedChanges,
        timing: &dyn Fn() -> Timing,
        ignores: &dyn Fn(RoleId) -> bool,
    ) {
        self.append_pending(list, timing().horizon);
        while let Ok((request, reply)) = self.requests.try_recv() {
            let answer = match &request {
                Request::Get => values(scenario, timing().earliest),
                Request::Set { changes, at_tick } => {
                    self.set(scenario, list, timing, ignores, changes, *at_tick).unwrap_or_else(|refusal| refusal)
                }
            };
            // A client that has gone has its change all the same.
            let _ = reply.send(answer);
        }
    }

    /// Applies the safe command of every driven body as soon as possible. Returns the tick from which it acts.
    ///
    /// # Errors
    /// The reason.
    pub fn go_safe(
        &mut self,
        scenario: &Settings,
        list: &ReceivedChanges,
        timing: &dyn Fn() -> Timing,
        ignores: &dyn Fn(RoleId) -> bool,
    ) -> Result<u64, String> {
        let safe = WantedChange { key: "actuator.safe".to_owned(), value: toml::Value::Boolean(true), ramp_s: 0.0 };
        match self.set(scenario, list, timing, ignores, &[safe], None) {
            Ok(Answer::Accepted { tick, .. }) => Ok(tick),
            Ok(_) => Err("the launcher did not accept it".to_owned()),
            Err(Answer::Refused { reason, .. }) => Err(reason),
            Err(_) => Err("the launcher refused it".to_owned()),
        }
    }

    /// Appends the pending changes up to a tick, before any role can come there.
    pub fn append_pending(&mut self, list: &ReceivedChanges, last_tick: u64) {
        if self.pending.is_empty() {
            return;
        }
        let due = self.pending.partition_point(|change| change.tick <= last_tick);
        for change in self.pending.drain(..due) {
            // Nothing else fills the list: its length is checked when a request is accepted.
            let _ = list.append(&[change], || true);
        }
    }

    fn set(
        &mut self,
        scenario: &Settings,
        list: &ReceivedChanges,
        timing: &dyn Fn() -> Timing,
        ignores: &dyn Fn(RoleId) -> bool,
        wanted: &[WantedChange],
        at_tick: Option<u64>,
    ) -> Result<Answer, Answer> {
        let changes = wanted.iter().map(|wanted| resolve(scenario, wanted, ignores)).collect::<Result<Vec<_>, _>>()?;
        if changes.is_empty() {
            return Err(Answer::refused("no-change", "the request changes nothing; name a key and its value"));
        }
        if list.count() + self.pending.len() + changes.len() > crate::changes::CHANGES_MAX {
            let limit = crate::changes::CHANGES_MAX;
            return Err(Answer::refused("too-many", format!("a run takes at most {limit} changes; start another run")));
        }
        loop {
            let now = timing();
            let last = list.count().checked_sub(1).and_then(|last| list.get(last)).map_or(0, |change| change.tick);
            let tick = at_tick.unwrap_or(now.earliest.max(last));
            if tick > scenario.last_tick {
                let end = scenario.last_tick;
                return Err(Answer::refused(
                    "after-end",
                    format!("tick {tick} is after the last tick {end} of the run"),
                ));
            }
            if tick < now.earliest.max(last) {
                let earliest = now.earliest.max(last);
                let reason = format!("tick {tick} is too early; the earliest is now {earliest}, later every tick");
                return Err(Answer::refused("too-early", reason));
            }
            let at = |change: &Change| Change { tick, ..*change };
            let changes: Vec<Change> = changes.iter().map(at).collect();
            if tick > now.horizon {
                let place = self.pending.partition_point(|change| change.tick <= tick);
                self.pending.splice(place..place, changes);
            } else if !list.append(&changes, || timing().safe <= tick) {
                // This process was held up: the next tick that all roles reach is later now.
                if at_tick.is_none() {
                    continue;
                }
                return Err(Answer::refused("too-early", format!("tick {tick} has come meanwhile; give a later one")));
            }
            let delay_ms = now
                .clock
                .map(|(epoch_ns, period_ns, now_ns)| (epoch_ns + tick * period_ns).saturating_sub(now_ns) as f64 / 1e6);
            return Ok(Answer::Accepted { tick, time_s: scenario.time_s(tick), delay_ms });
        }
    }
}

impl Drop for InputServer {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        // Wakes the thread.
        let _ = UnixStream::connect(&self.path);
        let _ = std::fs::remove_file(&self.path);
        self.thread.take().map(JoinHandle::join);
    }
}

/// Reads a request, passes it to the launcher, and sends its answer.
fn answer(stream: &UnixStream, requests: &SyncSender<Waiting>) -> io::Result<()> {
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let mut line = String::new();
    BufReader::new(stream.take(LINE_MAX)).read_line(&mut line)?;
    let answer = match serde_json::from_str(&line) {
        Err(error) => Answer::refused("malformed", format!("the request is malformed: {error}")),
        Ok(request) => {
            let (reply, replied) = channel();
            let sent = requests.try_send((request, reply)).is_ok();
            let replied = sent.then(|| replied.recv_timeout(PATIENCE).ok()).flatten();
            replied.unwrap_or_else(|| Answer::refused("busy", "the launcher does not answer; try again"))
        }
    };
    let mut stream = stream;
    writeln!(stream, "{}", serde_json::to_string(&answer)?)
}

/// Returns the values of all inputs at a tick.
fn values(scenario: &Settings, tick: u64) -> Answer {
    let inputs = &scenario.inputs;
    let values = inputs.lists().values_at(&inputs.infos, tick);
    let values = inputs.infos.iter().zip(values).map(|(info, values)| (info.key.clone(), info.to_toml(&values)));
    Answer::Values { tick, values: values.collect() }
}

/// Returns a wanted change, with tick 0.
///
/// # Errors
/// A refusal. `ignores` returns true for a role that takes no inputs.
pub(crate) fn resolve(
    scenario: &Settings,
    wanted: &WantedChange,
    ignores: &dyn Fn(RoleId) -> bool,
) -> Result<Change, Answer> {
    let (input, info) = scenario.inputs.find(&wanted.key).map_err(|reason| Answer::refused("not-tunable", reason))?;
    let InputInfo { key, .. } = info;
    let values =
        info.from_toml(&wanted.value).map_err(|reason| Answer::refused("wrong-type", format!("{key} {reason}")))?;
    if !info.allows(&values) {
        let (least, largest) = info.range;
        return Err(Answer::refused("out-of-range", format!("{key} is out of range; give {least} to {largest}")));
    }
    if let Some(reason) = ignoring_role(scenario, info, ignores) {
        return Err(Answer::refused("external-role", reason));
    }
    let ticks = (wanted.ramp_s / scenario.tick_s()).round();
    let shape = match ticks {
        0.0 => Shape::Step,
        _ if info.variability == crate::config::Variability::Switch => {
            return Err(Answer::refused("wrong-shape", format!("{key} is a switch and has no ramp")));
        }
        ticks if (0.0..1e15).contains(&ticks) => Shape::Ramp { ticks: ticks as u64 },
        _ => return Err(Answer::refused("out-of-range", "the length of a ramp is out of range; give 0 s or more")),
    };
    Ok(Change { tick: 0, input, shape, values })
}
