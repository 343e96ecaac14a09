//! The device's end: bytes in, frames out, and a [`DeviceRole`] that they drive tick by tick.
//!
//! What firmware has to add is what the seat needs (a [`Body`](crate::role::Body), an observer, a law), a byte stream and a
//! clock. Must not do I/O, nor look at a clock: both are handed in. Must not panic on anything that comes over the line.

use super::frame::{Decoder, FrameCounters, MAX_FRAME, MAX_PAYLOAD, encode};
use super::message::{Answer, Hello, Message, ParseError, Reason, Refuse, Tick, Welcome, parse, shorten, write};
use super::role::{DeviceRole, Inputs, Layout, Outputs, length};
use super::{MAX_CONTENT, MAX_SAMPLES};
use crate::role::CommandEvent;

/// A device: what `make` gives for a run, behind a byte stream.
///
/// `make` is asked once per run and gives the seat's occupant at its initial state, or nothing if this device has not that
/// role.
pub struct Device<S: DeviceRole, M> {
    name: &'static str,
    make: M,
    decoder: Decoder,
    mouth: Mouth,
    session: Option<Session<S>>,
}

/// The sending side.
struct Mouth {
    sequence: u32,
    frame: [u8; MAX_FRAME],
}

/// One run, seen from the device.
struct Session<S> {
    run: u64,
    seat: S,
    realtime: bool,
    period_ns: u64,
    last_tick: u64,
    /// The next tick that can be answered; none before the first.
    next: Option<u64>,
    /// The last tick executed, kept to be told again.
    last: Option<(u64, CommandEvent)>,
    outputs: Outputs,
    /// When the last tick was executed on the device's own clock, ns.
    heard_ns: u64,
}

impl<S: DeviceRole, M: FnMut(&Hello<'_>) -> Option<S>> Device<S, M> {
    /// A device that calls itself `name` (kind and version, for people; cut to 64 bytes).
    ///
    /// # Panics
    /// If its samples do not fit into a message: more than 32, or longer than 960 bytes together, either way.
    pub fn new(name: &'static str, make: M) -> Self {
        let fits = |layouts: &mut dyn Iterator<Item = Layout>| {
            let (count, bytes) = layouts.fold((0, 0), |(count, bytes), layout| (count + 1, bytes + layout.length));
            count <= MAX_SAMPLES && bytes <= MAX_CONTENT
        };
        assert!(
            fits(&mut S::reads()) && fits(&mut S::writes()),
            "the samples of this device do not fit into a message"
        );
        let mouth = Mouth { sequence: 0, frame: [0; MAX_FRAME] };
        Self { name, make, decoder: Decoder::default(), mouth, session: None }
    }

    /// Takes bytes that have arrived at `now_ns` on any monotonic clock, and hands every frame to be sent to `send`.
    pub fn receive(&mut self, bytes: &[u8], now_ns: u64, mut send: impl FnMut(&[u8])) {
        let Self { name, make, decoder, mouth, session } = self;
        decoder.feed(bytes, |payload| match parse(payload) {
            Ok((_, Message::Hello(hello))) => match greet::<S>(session, make, &hello, now_ns) {
                Ok(next_tick) => {
                    mouth
                        .say(Message::Welcome(Welcome { run: hello.run, next_tick, device: shorten(name) }), &mut send);
                }
                Err(refusal) => mouth.say(Message::Refuse(refusal), &mut send),
            },
            Ok((echo, Message::Tick(tick))) => match session {
                Some(session) => {
                    if session.execute(&tick, now_ns) {
                        session.tell(echo, mouth, &mut send);
                        session.seat.settle();
                    } else if session.last.is_some_and(|(last, _)| last == tick.tick) {
                        session.tell(echo, mouth, &mut send);
                    }
                }
                None => mouth.refuse(Reason::NotGreeted, "greet me first", &mut send),
            },
            Ok((_, Message::Stop)) => {
                if let Some(session) = session {
                    session.seat.expire();
                }
            }
            Err(ParseError::Version(_)) => mouth.refuse(Reason::Version, "another version of the protocol", &mut send),
            Ok((_, Message::Welcome(_) | Message::Refuse(_) | Message::Answer(_))) | Err(ParseError::Malformed) => {}
        });
    }

    /// Looks at the clock: where ticks stay away for too long, a body goes to its safe command by itself. To be called at
    /// least once per period, whether anything has arrived or not.
    pub fn elapse(&mut self, now_ns: u64) {
        if let Some(session) = &mut self.session {
            session.elapse(now_ns);
        }
    }

    /// Whether the safe command acts; so it does before the first run. Always, of what has no safe command.
    pub fn is_safe(&self) -> bool {
        self.session.as_ref().is_none_or(|session| session.seat.ticks_until_safe() == 0)
    }

    /// What has been met on the line.
    pub fn counters(&self) -> FrameCounters {
        self.decoder.counters()
    }
}

impl Mouth {
    /// Every message whose texts and samples are within their limits fits into a frame.
    fn say(&mut self, message: Message<'_>, send: &mut impl FnMut(&[u8])) {
        let mut payload = [0; MAX_PAYLOAD];
        let framed = write(self.sequence, message, &mut payload).and_then(|payload| encode(payload, &mut self.frame));
        self.sequence = self.sequence.wrapping_add(1);
        if let Ok(frame) = framed {
            send(frame);
        }
    }

    fn refuse(&mut self, reason: Reason, detail: &str, send: &mut impl FnMut(&[u8])) {
        self.say(Message::Refuse(Refuse { reason, detail }), send);
    }
}

/// The first of a device's own layouts that is not the one asked for.
fn unlike(asked: &str, own: impl Iterator<Item = Layout>) -> Option<&'static str> {
    let mut asked = asked.split(' ').filter(|name| !name.is_empty());
    for layout in own {
        if asked.next() != Some(layout.name) {
            return Some(layout.name);
        }
    }
    asked.next().map(|_| "fewer samples")
}

/// Begins a run, or goes on with one. Returns the next tick.
fn greet<S: DeviceRole>(
    session: &mut Option<Session<S>>,
    make: &mut impl FnMut(&Hello<'_>) -> Option<S>,
    hello: &Hello<'_>,
    now_ns: u64,
) -> Result<u64, Refuse<'static>> {
    if let Some(own) = unlike(hello.reads, S::reads()).or_else(|| unlike(hello.writes, S::writes())) {
        return Err(Refuse { reason: Reason::Samples, detail: shorten(own) });
    }
    if hello.period_ns == 0 || hello.timeout_ticks == 0 {
        return Err(Refuse { reason: Reason::Role, detail: "a period or a command timeout of 0 is none" });
    }
    let known = session.take().filter(|session| session.run == hello.run);
    let begun = match known {
        Some(session) => session,
        None => {
            let seat = make(hello).ok_or(Refuse { reason: Reason::Role, detail: "this device has another role" })?;
            Session::new(seat, hello, now_ns)
        }
    };
    Ok(session.insert(begun).next.unwrap_or(0))
}

impl<S: DeviceRole> Session<S> {
    fn new(seat: S, hello: &Hello<'_>, now_ns: u64) -> Self {
        Self {
            run: hello.run,
            seat,
            realtime: hello.realtime,
            period_ns: hello.period_ns,
            // The one after it must be a number too.
            last_tick: hello.last_tick.min(u64::MAX - 1),
            next: None,
            last: None,
            outputs: Outputs::default(),
            heard_ns: now_ns,
        }
    }

    /// Executes a tick. False if it is none that can be executed (any more), or not what was agreed upon.
    fn execute(&mut self, asked: &Tick<'_>, now_ns: u64) -> bool {
        let tick = asked.tick;
        // The device's time begins with the first tick that it hears.
        let next = self.next.unwrap_or(tick);
        if tick < next || tick > self.last_tick {
            return false;
        }
        let Some(mut inputs) = Inputs::new(asked.inputs, S::reads()) else { return false };
        self.seat.miss(next, tick - next);
        self.outputs.clear();
        let event = self.seat.execute(tick, &mut inputs, &mut self.outputs);
        debug_assert_eq!(length(S::writes(), self.outputs.samples().present), Some(self.outputs.samples().bytes.len()));
        self.last = Some((tick, event));
        self.next = Some(tick + 1);
        self.heard_ns = now_ns;
        true
    }

    fn tell(&self, echo: u32, mouth: &mut Mouth, send: &mut impl FnMut(&[u8])) {
        if let Some((tick, event)) = self.last {
            mouth.say(Message::Answer(Answer { echo, tick, event, outputs: self.outputs.samples() }), send);
        }
    }

    /// Half a period of grace keeps a tick that is merely late from being counted as missing.
    fn elapse(&mut self, now_ns: u64) {
        let (left, Some(next)) = (self.seat.ticks_until_safe(), self.next) else { return };
        let grace_ns = left.saturating_mul(self.period_ns).saturating_add(self.period_ns / 2);
        if self.realtime && left > 0 && now_ns.saturating_sub(self.heard_ns) >= grace_ns {
            self.seat.miss(next, left);
            self.next = Some(next.saturating_add(left));
        }
    }
}
