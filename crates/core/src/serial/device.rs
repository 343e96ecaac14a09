//! The device's end: bytes in, frames out, and a [`DeviceRole`] driven tick by tick.
//!
//! Firmware adds the inner parts of the role (a [`Body`](crate::role::Body), an observer, a law), a byte stream and a
//! clock. The device must not do I/O, nor read a clock: bytes and times are passed in. It must not panic on any
//! received bytes.

use super::frame::{Decoder, FrameCounters, MAX_FRAME, MAX_PAYLOAD, encode};
use super::message::{
    Answer, Hello, MAX_CONTENT, MAX_SAMPLES, Message, ParseError, Reason, Refuse, Tick, Welcome, parse, shorten, write,
};
use super::role::{DeviceRole, Inputs, Layout, Outputs, length};
use crate::role::CommandEvent;

/// A device behind a byte stream, with the role that `make` creates for a run.
///
/// `make` is called once per run. It returns the role at its initial state, or `None` if the device does not have the
/// role of that greeting.
pub struct Device<S: DeviceRole, M> {
    name: &'static str,
    make: M,
    decoder: Decoder,
    sender: Sender,
    session: Option<Session<S>>,
}

/// The sender of messages.
struct Sender {
    sequence: u32,
    frame: [u8; MAX_FRAME],
}

/// One run of the device.
struct Session<S> {
    run: u64,
    role: S,
    realtime: bool,
    period_ns: u64,
    last_tick: u64,
    /// The next tick that can be answered; `None` before the first.
    next: Option<u64>,
    /// The last tick executed and its outcome, for a repeated answer.
    last: Option<(u64, CommandEvent)>,
    outputs: Outputs,
    /// The device's time of the last tick, ns.
    executed_ns: u64,
}

impl<S: DeviceRole, M: FnMut(&Hello<'_>) -> Option<S>> Device<S, M> {
    /// Creates a device named `name` (kind and version, for display; shortened to 64 bytes).
    ///
    /// # Panics
    /// If the samples of one direction do not fit into a message: more than 32, or more than 960 bytes in total.
    pub fn new(name: &'static str, make: M) -> Self {
        let fits = |layouts: &mut dyn Iterator<Item = Layout>| {
            let (count, bytes) = layouts.fold((0, 0), |(count, bytes), layout| (count + 1, bytes + layout.length));
            count <= MAX_SAMPLES && bytes <= MAX_CONTENT
        };
        assert!(
            fits(&mut S::reads()) && fits(&mut S::writes()),
            "the samples of this device do not fit into a message"
        );
        let sender = Sender { sequence: 0, frame: [0; MAX_FRAME] };
        Self { name, make, decoder: Decoder::default(), sender, session: None }
    }

    /// Processes bytes received at `now_ns` on any monotonic clock, and passes every frame to be sent to `send`.
    pub fn receive(&mut self, bytes: &[u8], now_ns: u64, mut send: impl FnMut(&[u8])) {
        let Self { name, make, decoder, sender, session } = self;
        decoder.feed(bytes, |payload| match parse(payload) {
            Ok((_, Message::Hello(hello))) => match greet::<S>(session, make, &hello, now_ns) {
                Ok(next_tick) => {
                    sender.send(
                        Message::Welcome(Welcome { run: hello.run, next_tick, device: shorten(name) }),
                        &mut send,
                    );
                }
                Err(refusal) => sender.send(Message::Refuse(refusal), &mut send),
            },
            Ok((echo, Message::Tick(tick))) => match session {
                Some(session) => {
                    if session.execute(&tick, now_ns) {
                        session.answer(echo, sender, &mut send);
                        session.role.finish_tick();
                    } else if session.last.is_some_and(|(last, _)| last == tick.tick) {
                        session.answer(echo, sender, &mut send);
                    }
                }
                None => sender.refuse(Reason::NotGreeted, "greet me first", &mut send),
            },
            Ok((_, Message::Stop)) => {
                if let Some(session) = session {
                    session.role.expire();
                }
            }
            Err(ParseError::Version(_)) => sender.refuse(Reason::Version, "another version of the protocol", &mut send),
            Ok((_, Message::Welcome(_) | Message::Refuse(_) | Message::Answer(_))) | Err(ParseError::Malformed) => {}
        });
    }

    /// Checks the timeout: a body without ticks for too long applies its safe command. Call it at least once per
    /// period, even if no bytes have arrived.
    pub fn elapse(&mut self, now_ns: u64) {
        if let Some(session) = &mut self.session {
            session.elapse(now_ns);
        }
    }

    /// Returns true if the safe command acts, as before the first run, or if the role has no safe command.
    pub fn is_safe(&self) -> bool {
        self.session.as_ref().is_none_or(|session| session.role.ticks_until_safe() == 0)
    }

    /// Returns the counters of the receiving side.
    pub fn counters(&self) -> FrameCounters {
        self.decoder.counters()
    }
}

impl Sender {
    /// Sends a message. Every message whose texts and samples are within their limits fits into a frame.
    fn send(&mut self, message: Message<'_>, send: &mut impl FnMut(&[u8])) {
        let mut payload = [0; MAX_PAYLOAD];
        let framed = write(self.sequence, message, &mut payload).and_then(|payload| encode(payload, &mut self.frame));
        self.sequence = self.sequence.wrapping_add(1);
        if let Ok(frame) = framed {
            send(frame);
        }
    }

    fn refuse(&mut self, reason: Reason, detail: &str, send: &mut impl FnMut(&[u8])) {
        self.send(Message::Refuse(Refuse { reason, detail }), send);
    }
}

/// Returns the first of the device's layouts that differs from the requested one.
fn first_mismatch(requested: &str, own: impl Iterator<Item = Layout>) -> Option<&'static str> {
    let mut requested = requested.split(' ').filter(|name| !name.is_empty());
    for layout in own {
        if requested.next() != Some(layout.name) {
            return Some(layout.name);
        }
    }
    requested.next().map(|_| "fewer samples")
}

/// Begins or continues a run. Returns the next tick.
fn greet<S: DeviceRole>(
    session: &mut Option<Session<S>>,
    make: &mut impl FnMut(&Hello<'_>) -> Option<S>,
    hello: &Hello<'_>,
    now_ns: u64,
) -> Result<u64, Refuse<'static>> {
    if let Some(own) = first_mismatch(hello.reads, S::reads()).or_else(|| first_mismatch(hello.writes, S::writes())) {
        return Err(Refuse { reason: Reason::Samples, detail: shorten(own) });
    }
    if hello.period_ns == 0 || hello.timeout_ticks == 0 {
        return Err(Refuse { reason: Reason::Role, detail: "the period and the command timeout must not be 0" });
    }
    let known = session.take().filter(|session| session.run == hello.run);
    let current = match known {
        Some(session) => session,
        None => {
            let role = make(hello).ok_or(Refuse { reason: Reason::Role, detail: "this device has another role" })?;
            Session::new(role, hello, now_ns)
        }
    };
    Ok(session.insert(current).next.unwrap_or(0))
}

impl<S: DeviceRole> Session<S> {
    fn new(role: S, hello: &Hello<'_>, now_ns: u64) -> Self {
        Self {
            run: hello.run,
            role,
            realtime: hello.realtime,
            period_ns: hello.period_ns,
            // Leaves room for the tick after the last one.
            last_tick: hello.last_tick.min(u64::MAX - 1),
            next: None,
            last: None,
            outputs: Outputs::default(),
            executed_ns: now_ns,
        }
    }

    /// Executes a tick. Returns false if the tick is not in the run, is already executed, or has other samples than
    /// agreed.
    fn execute(&mut self, requested: &Tick<'_>, now_ns: u64) -> bool {
        let tick = requested.tick;
        // The device's time begins with the first tick that it receives.
        let next = self.next.unwrap_or(tick);
        if tick < next || tick > self.last_tick {
            return false;
        }
        let Some(mut inputs) = Inputs::new(requested.inputs, S::reads()) else { return false };
        self.role.miss(next, tick - next);
        self.outputs.clear();
        let event = self.role.execute(tick, &mut inputs, &mut self.outputs);
        debug_assert_eq!(length(S::writes(), self.outputs.samples().present), Some(self.outputs.samples().bytes.len()));
        self.last = Some((tick, event));
        self.next = Some(tick + 1);
        self.executed_ns = now_ns;
        true
    }

    fn answer(&self, echo: u32, sender: &mut Sender, send: &mut impl FnMut(&[u8])) {
        if let Some((tick, event)) = self.last {
            sender.send(Message::Answer(Answer { echo, tick, event, outputs: self.outputs.samples() }), send);
        }
    }

    /// Half a period of grace keeps a late tick from counting as missing.
    fn elapse(&mut self, now_ns: u64) {
        let (left, Some(next)) = (self.role.ticks_until_safe(), self.next) else { return };
        let grace_ns = left.saturating_mul(self.period_ns).saturating_add(self.period_ns / 2);
        if self.realtime && left > 0 && now_ns.saturating_sub(self.executed_ns) >= grace_ns {
            self.role.miss(next, left);
            self.next = Some(next.saturating_add(left));
        }
    }
}
