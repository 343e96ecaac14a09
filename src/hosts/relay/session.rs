//! The session of a joined host with the launching one: its first answers set the clock, and a silent session is replaced.

use super::super::clock::HostClock;
use super::super::net::{Arrival, Network, Outbox};
use super::super::offset::Exchange;
use super::super::plan::Plan;
use super::super::wire::{Message, Payload};
use super::error::RelayError;
use crate::bus::domain::Domain;
use crate::clock::{RunClock, raw_ns};
use crate::scenario::Scenario;
use crate::seat::clock_path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

/// Time for which the first session requests the launching host's time without an answer, ns, before a new session replaces it; the
/// time doubles with every second session, up to the maximum. The network may have lost a declaration of the session.
const TRY_NS: u64 = 500_000_000;
const TRY_MAX_NS: u64 = 4_000_000_000;
/// Timeout of the measurement of the time after the first answer, ns.
const SYNC_NS: u64 = 15_000_000_000;
/// Time without an answer to the 20 time requests per second after which a joined host replaces its session, ns.
const UNANSWERED_NS: u64 = 1_500_000_000;
/// Timeout of one attempt to replace a session.
const REOPEN: Duration = Duration::from_secs(3);
/// Pause of an idle relay, except in lockstep for its first idle rounds.
pub(super) const PAUSE: Duration = Duration::from_millis(1);

/// Requests the launching host's time until the clock can be set. Replaces the session while no answer arrives.
pub(super) fn synchronise(
    (domain, scenario): (&Domain, &Scenario),
    plan: &Plan,
    (network, timeout): (&Network, Duration),
    inbox: &mpsc::Receiver<Arrival>,
    terminated: &AtomicBool,
) -> Result<HostClock, RelayError> {
    let path = clock_path(domain);
    let run_clock = RunClock::open(&path).map_err(|source| RelayError::Write { path, source })?;
    let (mut clock, outbox) = (HostClock::new(scenario, plan.name(plan.own), run_clock), network.outbox());
    let (begun_ns, limit_ns) = (raw_ns(), timeout.as_nanos() as u64);
    let (mut sessions, mut try_ns, mut opened_ns, mut answered_ns) = (1, TRY_NS, raw_ns(), None);
    while !clock.try_set(raw_ns())? {
        let now_ns = raw_ns();
        let late = match answered_ns {
            Some(answered_ns) => now_ns - answered_ns > SYNC_NS,
            None => now_ns - begun_ns > limit_ns,
        };
        if late || terminated.load(Ordering::Relaxed) {
            return Err(RelayError::NoTime((now_ns - begun_ns) / 1_000_000_000));
        }
        if answered_ns.is_none() && now_ns - opened_ns > try_ns {
            // If this fails, the previous session may still work.
            let _ = network.reopen(REOPEN);
            (sessions, opened_ns) = (sessions + 1, raw_ns());
            try_ns = if sessions % 2 == 1 { (2 * try_ns).min(TRY_MAX_NS) } else { try_ns };
        }
        request_time(&mut clock, plan, &outbox);
        let Ok(Arrival { at_ns, bytes }) = inbox.recv_timeout(PAUSE) else { continue };
        if let Some(Message { from, payload: payload @ Payload::Pong { .. } }) = Message::decode(&bytes)
            && from == plan.hub
        {
            answered_ns.get_or_insert(at_ns);
            take_time(&mut clock, &payload, at_ns);
        }
    }
    Ok(clock)
}

/// Requests the time, if a request is due.
pub(super) fn request_time(clock: &mut HostClock, plan: &Plan, outbox: &Outbox) {
    if clock.is_request_due(raw_ns()) {
        // A lost request is repeated.
        let _ = outbox.send(plan.hub, true, &Message { from: plan.own, payload: Payload::Ping { sent_ns: raw_ns() } });
    }
}

/// Takes the answer to a time request; ignores any other payload.
pub(super) fn take_time(clock: &mut HostClock, payload: &Payload<'_>, returned_ns: u64) {
    if let Payload::Pong { sent_ns, received_ns, answered_ns, tai_offset_ns } = *payload {
        clock.take(Exchange { sent_ns, received_ns, answered_ns, returned_ns }, tai_offset_ns as i64);
    }
}

/// Replaces a joined host's session if the launching host does not answer; in a thread, because zenoh blocks.
pub(super) struct SessionMonitor {
    /// Time of the launching host's last answer, ns.
    pub answered_ns: u64,
    replacement: Option<std::thread::JoinHandle<()>>,
}

impl SessionMonitor {
    pub fn start() -> Self {
        Self { answered_ns: raw_ns(), replacement: None }
    }

    pub fn check(&mut self, network: &Arc<Network>, now_ns: u64) {
        if self.replacement.as_ref().is_some_and(std::thread::JoinHandle::is_finished) {
            // The new session has the same time to answer.
            (self.replacement, self.answered_ns) = (None, now_ns);
        }
        if self.replacement.is_none() && now_ns.saturating_sub(self.answered_ns) > UNANSWERED_NS {
            let network = network.clone();
            // A failed attempt is repeated.
            let replace = move || drop(network.reopen(REOPEN));
            self.replacement = std::thread::Builder::new().name("reopen".to_owned()).spawn(replace).ok();
        }
    }
}
