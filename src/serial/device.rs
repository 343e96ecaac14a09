//! The device's end: bytes in, frames out, and a [`Plant`] that is measured, commanded and moved by them.
//!
//! What firmware has to add is a [`Body`](crate::role::Body), a byte stream and a clock. Must not do I/O, nor look at a
//! clock: both are handed in.

use super::frame::{Decoder, FrameBook, MAX_FRAME, MAX_PAYLOAD, encode};
use super::message::{
    Answer, Hello, MAX_CONTENT, Message, ParseError, Reason, Refuse, Tick, Welcome, parse, shorten, write,
};
use crate::role::{Actuation, CommandEvent, Plant, Rearm, SingleBody};
use crate::sample::{Message as _, Sample, Stamp, content_length};

/// A body lives through at most so many ticks that it missed; after a longer absence its clock jumps.
const CATCH_UP_TICKS: u64 = 100_000;

/// A device: the body that `make` gives for a run, behind a byte stream.
///
/// `make` is asked once per run and gives a body at its initial state, or nothing if this device is not that body.
pub struct Device<B: SingleBody, M> {
    name: &'static str,
    make: M,
    tells_truth: bool,
    decoder: Decoder,
    mouth: Mouth,
    session: Option<Session<B>>,
}

/// The sending side.
struct Mouth {
    sequence: u32,
    frame: [u8; MAX_FRAME],
}

/// One run, seen from the device.
struct Session<B: SingleBody> {
    run: u64,
    plant: Plant<B>,
    realtime: bool,
    period_ns: u64,
    last_tick: u64,
    /// The next tick that can be answered; none before the first.
    next: Option<u64>,
    last: Option<Executed<B>>,
    /// When the last tick was executed on the device's own clock, ns.
    heard_ns: u64,
}

/// The last tick executed, kept to be told again.
struct Executed<B: SingleBody> {
    tick: u64,
    event: CommandEvent,
    measurement: B::Measurement,
    truth: B::Truth,
}

impl<B: SingleBody, M: FnMut(&Hello<'_>) -> Option<B>> Device<B, M> {
    const FITS: () = assert!(
        content_length::<B::Command>() <= MAX_CONTENT
            && content_length::<B::Measurement>() <= MAX_CONTENT
            && content_length::<B::Truth>() <= MAX_CONTENT
    );

    /// A device that calls itself `name` (kind and version, for people; cut to 64 bytes).
    pub fn new(name: &'static str, make: M) -> Self {
        let () = Self::FITS;
        let mouth = Mouth { sequence: 0, frame: [0; MAX_FRAME] };
        Self { name, make, tells_truth: true, decoder: Decoder::default(), mouth, session: None }
    }

    /// A device that tells its measurements only: a real one, which knows no more than its sensors do.
    #[must_use]
    pub fn without_truth(mut self) -> Self {
        self.tells_truth = false;
        self
    }

    /// Takes bytes that have arrived at `now_ns` on any monotonic clock, and hands every frame to be sent to `send`.
    pub fn receive(&mut self, bytes: &[u8], now_ns: u64, mut send: impl FnMut(&[u8])) {
        let Self { name, make, tells_truth, decoder, mouth, session } = self;
        decoder.feed(bytes, |payload| match parse(payload) {
            Ok((_, Message::Hello(hello))) => match greet::<B>(session, make, &hello, now_ns) {
                Ok(next_tick) => {
                    mouth
                        .say(Message::Welcome(Welcome { run: hello.run, next_tick, device: shorten(name) }), &mut send);
                }
                Err(refusal) => mouth.say(Message::Refuse(refusal), &mut send),
            },
            Ok((echo, Message::Tick(tick))) => match session {
                Some(session) => {
                    if session.execute(&tick, now_ns) {
                        session.tell(echo, *tells_truth, mouth, &mut send);
                        session.settle();
                    } else if session.again(&tick) {
                        session.tell(echo, *tells_truth, mouth, &mut send);
                    }
                }
                None => mouth.refuse(Reason::NotGreeted, "greet me first", &mut send),
            },
            Ok((_, Message::Stop)) => {
                if let Some(session) = session {
                    session.plant.expire();
                }
            }
            Err(ParseError::Version(_)) => mouth.refuse(Reason::Version, "another version of the protocol", &mut send),
            Ok((_, Message::Welcome(_) | Message::Refuse(_) | Message::Answer(_))) | Err(ParseError::Malformed) => {}
        });
    }

    /// Looks at the clock: where ticks stay away for too long, the device goes to its safe command by itself. To be called
    /// at least once per period, whether anything has arrived or not.
    pub fn elapse(&mut self, now_ns: u64) {
        if let Some(session) = &mut self.session {
            session.elapse(now_ns);
        }
    }

    /// Whether the safe command acts; so it does before the first run.
    pub fn is_safe(&self) -> bool {
        self.session.as_ref().is_none_or(|session| session.plant.ticks_until_safe() == 0)
    }

    /// What has been met on the line.
    pub fn counters(&self) -> FrameBook {
        self.decoder.counters()
    }
}

impl Mouth {
    fn say(&mut self, message: Message<'_>, send: &mut impl FnMut(&[u8])) {
        let mut payload = [0; MAX_PAYLOAD];
        let framed = write(self.sequence, message, &mut payload).and_then(|payload| encode(payload, &mut self.frame));
        self.sequence = self.sequence.wrapping_add(1);
        send(framed.expect("every message whose texts and contents are within their limits fits into a frame"));
    }

    fn refuse(&mut self, reason: Reason, detail: &str, send: &mut impl FnMut(&[u8])) {
        self.say(Message::Refuse(Refuse { reason, detail }), send);
    }
}

/// Begins a run, or goes on with one. Returns the next tick.
fn greet<B: SingleBody>(
    session: &mut Option<Session<B>>,
    make: &mut impl FnMut(&Hello<'_>) -> Option<B>,
    hello: &Hello<'_>,
    now_ns: u64,
) -> Result<u64, Refuse<'static>> {
    for (asked, own) in [
        (hello.command, B::Command::TYPE_NAME),
        (hello.measurement, B::Measurement::TYPE_NAME),
        (hello.truth, B::Truth::TYPE_NAME),
    ] {
        if asked != own {
            return Err(Refuse { reason: Reason::Samples, detail: own });
        }
    }
    if hello.period_ns == 0 || hello.timeout_ticks == 0 {
        return Err(Refuse { reason: Reason::Body, detail: "a period or a command timeout of 0 is none" });
    }
    let known = session.take().filter(|session| session.run == hello.run);
    let begun = match known {
        Some(session) => session,
        None => {
            let body = make(hello).ok_or(Refuse { reason: Reason::Body, detail: "this device is not that body" })?;
            Session::new(body, hello, now_ns)
        }
    };
    Ok(session.insert(begun).next.unwrap_or(0))
}

impl<B: SingleBody> Session<B> {
    fn new(body: B, hello: &Hello<'_>, now_ns: u64) -> Self {
        let rearm = if hello.manual_rearm { Rearm::Manual } else { Rearm::Auto };
        let actuation = Actuation { driven: true, delay_ticks: 1, timeout_ticks: hello.timeout_ticks, rearm };
        Self {
            run: hello.run,
            plant: Plant::new(body, actuation, hello.period_ns as f64 / 1e9),
            realtime: hello.realtime,
            period_ns: hello.period_ns,
            // The one after it must be a number too.
            last_tick: hello.last_tick.min(u64::MAX - 1),
            next: None,
            last: None,
            heard_ns: now_ns,
        }
    }

    /// Executes a tick: applies its command, measures. False if it is none that can be executed (any more).
    fn execute(&mut self, asked: &Tick<'_>, now_ns: u64) -> bool {
        let tick = asked.tick;
        // The device's time begins with the first tick that it hears.
        let next = self.next.unwrap_or(tick);
        if tick < next || tick > self.last_tick {
            return false;
        }
        self.miss(next, tick - next);
        let mut command = B::Command::default();
        let taken = asked.command.is_some_and(|content| command.set_content(content));
        command.stamp_mut().tick = tick.saturating_sub(1);
        let event = self.plant.command(tick, taken.then_some(&command));
        let stamp = Stamp { tick, ..Stamp::default() };
        let (mut measurement, mut truth) = (B::Measurement::default(), B::Truth::default());
        self.plant.measure(&stamp, &mut measurement);
        self.plant.truth(&stamp, &mut truth);
        self.last = Some(Executed { tick, event, measurement, truth });
        self.next = Some(tick + 1);
        self.heard_ns = now_ns;
        true
    }

    /// Whether the last executed tick is asked for again.
    fn again(&self, asked: &Tick<'_>) -> bool {
        self.last.as_ref().is_some_and(|last| last.tick == asked.tick)
    }

    fn tell(&self, echo: u32, truth: bool, mouth: &mut Mouth, send: &mut impl FnMut(&[u8])) {
        if let Some(last) = &self.last {
            let Executed { tick, event, measurement, .. } = last;
            let truth: &[u8] = if truth { last.truth.content() } else { &[] };
            let measurement = measurement.content();
            mouth.say(Message::Answer(Answer { echo, tick: *tick, event: *event, measurement, truth }), send);
        }
    }

    /// Moves the body over the tick just executed. After the answer: it does not wait for this.
    fn settle(&mut self) {
        self.plant.advance(1);
    }

    /// Lives through ticks that never came, as the actuators do: they hold, and then go safe.
    fn miss(&mut self, from: u64, count: u64) {
        for tick in from..from + count.min(CATCH_UP_TICKS) {
            self.plant.command(tick, None);
            self.plant.advance(1);
        }
    }

    /// Half a period of grace keeps a tick that is merely late from being counted as missing.
    fn elapse(&mut self, now_ns: u64) {
        let (left, Some(next)) = (self.plant.ticks_until_safe(), self.next) else { return };
        let grace_ns = left.saturating_mul(self.period_ns).saturating_add(self.period_ns / 2);
        if self.realtime && left > 0 && now_ns.saturating_sub(self.heard_ns) >= grace_ns {
            self.miss(next, left);
            self.next = Some(next.saturating_add(left));
        }
    }
}
