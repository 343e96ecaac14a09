//! The host's end: the next frame to send, the answers that count, and the counters of the line.
//!
//! A request is repeated until it is answered or given up, and a device that is silent for long is greeted again. The
//! session must not do I/O, nor read a clock: bytes and times are passed in.

use super::frame::{Decoder, MAX_FRAME, MAX_PAYLOAD, encode};
use super::message::{
    Answer, Hello, MAX_CONTENT, MAX_SAMPLES, Message, ParseError, Reason, Refuse, Samples, Tick, Welcome, parse, write,
};
use serde::{Deserialize, Serialize};

/// The interval between two greetings, ns.
const GREET_NS: u64 = 100_000_000;
/// The number of consecutive unanswered requests after which the device is greeted again.
const SILENT_REQUESTS: u32 = 8;
/// The shortest interval before a request is repeated without a clock, and the longest, ns.
const SHORTEST_REPEAT_NS: u64 = 5_000_000;
const LONGEST_REPEAT_NS: u64 = 1_000_000_000;
/// The number of frames whose send time is stored; a power of two.
const REMEMBERED: usize = 32;
/// The number of round trips after which a request is repeated, and the smoothing of the round trip as a shift.
const PATIENT_ROUND_TRIPS: u64 = 2;
const SMOOTHING: u32 = 3;

/// The counters of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LineCounters {
    /// Frames sent, including repeated ones.
    pub frames_sent: u64,
    /// Bytes sent.
    pub bytes_sent: u64,
    /// Valid frames received.
    pub frames_received: u64,
    /// Bytes received, valid or not.
    pub bytes_received: u64,
    /// Frames received with a wrong CRC.
    pub crc_errors: u64,
    /// Malformed frames and malformed messages.
    pub malformed: u64,
    /// Bytes dropped with wrong CRC or as malformed.
    pub dropped_bytes: u64,
    /// Valid frames after dropped bytes.
    pub resyncs: u64,
    /// Frames of the device that were lost or damaged, by its sequence numbers.
    pub sequence_gaps: u64,
    /// Answers to a tick that was already answered.
    pub duplicates: u64,
    /// Answers to a tick that had been given up.
    pub late: u64,
    /// Own frames that came back, by an echo or a loop.
    pub echoes: u64,
    /// Requests sent again.
    pub repeats: u64,
    /// Ticks given up without an answer.
    pub unanswered: u64,
    /// Handshakes completed.
    pub handshakes: u64,
    /// Handshakes with a device that had lost the run, so that its body was at the initial state again.
    pub restarts: u64,
    /// Reopenings of the line.
    pub reopened: u64,
    /// Frames that the line did not accept because the previous one was still being sent.
    pub unsent: u64,
}

/// An event from the device that the host must handle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DeviceEvent<'a> {
    /// The device takes part.
    Welcome(Welcome<'a>),
    /// The device does not take part.
    Refused(Refuse<'a>),
    /// The device uses this version of the protocol.
    OtherVersion(u8),
    /// The answer to the current request.
    Answer(Answer<'a>),
}

/// The cycle of a device, by its own timer, in which it sent a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cycle {
    /// A cycle before the first tick, by the sequence number of its frame: the device counts its cycles by it.
    Idle(u32),
    /// The cycle of a tick.
    Tick(u64),
}

/// The terms of a run that the host needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Terms {
    /// [`Hello::run`].
    pub run: u64,
    /// The period if ticks follow the clock, ns.
    pub period_ns: Option<u64>,
    /// The size of each sample in an answer, bytes, in order; 0 after the last.
    pub outputs: [u16; MAX_SAMPLES],
    /// Bit i is set if every answer must have sample i.
    pub required: u32,
}

impl Terms {
    /// Returns true if an answer has the agreed samples.
    fn accepts(&self, samples: &Samples<'_>) -> bool {
        let lengths = self.outputs.iter().enumerate().filter(|(index, _)| samples.present >> index & 1 == 1);
        let (total, whole) =
            lengths.fold((0, true), |(total, whole), (_, length)| (total + usize::from(*length), whole && *length > 0));
        whole && total == samples.bytes.len() && samples.present & self.required == self.required
    }
}

/// The current request.
struct Request {
    tick: u64,
    present: u32,
    inputs: [u8; MAX_CONTENT],
    length: usize,
    /// The time at which it is due (again), ns, and the number of times it was sent.
    due_ns: u64,
    sent: u32,
}

/// The host's session with one device in one run.
pub struct HostSession {
    terms: Terms,
    decoder: Decoder,
    frame: [u8; MAX_FRAME],
    sequence: u32,
    /// The device's highest sequence number.
    newest_sequence: Option<u32>,
    greeted: bool,
    greet_due_ns: u64,
    request: Option<Request>,
    /// The last tick that was answered.
    answered: Option<u64>,
    /// The number of consecutive unanswered requests, and the start of the current wait, ns.
    silent: u32,
    silent_since_ns: Option<u64>,
    /// The latest requests without an answer: sequence number and send time, ns.
    sent: [Option<(u32, u64)>; REMEMBERED],
    /// The smoothed round-trip time, ns.
    round_trip_ns: u64,
    counters: LineCounters,
    /// True if the device sets the pace.
    follows: bool,
    /// The cycle of the last received frame, until it is taken.
    cycle: Option<Cycle>,
    slips: Slips,
}

/// The cycles that a device executed without the request that was sent for them.
#[derive(Debug, Default)]
struct Slips {
    count: u64,
    /// The last tick of which an answer came, and the last that slipped.
    newest_tick: Option<u64>,
    slipped_tick: Option<u64>,
}

impl Slips {
    /// Takes an answer, with the request that it answers, if that is the current one. `repeated` is true if its tick was
    /// answered before, `echoes` if it is the first answer to its frame.
    fn take(&mut self, answer: &Answer<'_>, request: Option<&Request>, repeated: bool, echoes: bool) {
        let news = self.newest_tick < Some(answer.tick);
        self.newest_tick = self.newest_tick.max(Some(answer.tick));
        let slipped = match request {
            // Its cycle began before the request was sent.
            Some(request) => answer.event.missed() && request.present > 0 && request.sent == 0,
            // The request came after its cycle.
            None if repeated => answer.event.missed() && echoes,
            // The request was not sent, or the frame came after the cutoff.
            None => news,
        };
        if slipped && self.slipped_tick < Some(answer.tick) {
            self.count += 1;
            self.slipped_tick = Some(answer.tick);
        }
    }
}

impl HostSession {
    /// Creates a session that has not greeted its device.
    pub fn new(terms: Terms) -> Self {
        Self {
            terms,
            decoder: Decoder::default(),
            frame: [0; MAX_FRAME],
            sequence: 0,
            newest_sequence: None,
            greeted: false,
            greet_due_ns: 0,
            request: None,
            answered: None,
            silent: 0,
            silent_since_ns: None,
            sent: [None; REMEMBERED],
            round_trip_ns: 0,
            counters: LineCounters::default(),
            follows: false,
            cycle: None,
            slips: Slips::default(),
        }
    }

    /// Declares that the device sets the pace: it answers at its own cycles, and requests never wait for an answer.
    pub fn follow(&mut self) {
        self.follows = true;
    }

    /// Returns the cycle of the last received frame, once.
    pub fn take_cycle(&mut self) -> Option<Cycle> {
        self.cycle.take()
    }

    /// Returns the number of cycles that the device executed without the request that the host had sent, or was about to
    /// send, for them. Lost requests do not count.
    pub fn slips(&self) -> u64 {
        self.slips.count
    }

    /// Returns true if the device takes part.
    pub fn greeted(&self) -> bool {
        self.greeted
    }

    /// Requests a tick from now on, with its samples, which have at most [`MAX_CONTENT`] bytes.
    pub fn request(&mut self, tick: u64, samples: Samples<'_>, now_ns: u64) {
        let (mut inputs, length) = ([0; MAX_CONTENT], samples.bytes.len().min(MAX_CONTENT));
        inputs[..length].copy_from_slice(&samples.bytes[..length]);
        let present = samples.present;
        self.request = Some(Request { tick, present, inputs, length, due_ns: now_ns, sent: 0 });
    }

    /// Gives up the current request.
    pub fn give_up(&mut self) {
        self.counters.unanswered += u64::from(self.request.take().is_some());
    }

    /// Returns the next frame that is due, if any. Call it until it returns `None`.
    pub fn due(&mut self, now_ns: u64, hello: &Hello<'_>) -> Option<&[u8]> {
        if self.silent >= SILENT_REQUESTS {
            self.greet_again(now_ns);
        }
        if !self.greeted {
            if now_ns < self.greet_due_ns {
                return None;
            }
            self.greet_due_ns = now_ns + GREET_NS;
            self.silent_since_ns.get_or_insert(now_ns);
            return Some(self.send(Message::Hello(*hello)));
        }
        let (repeat_ns, free_ns) = (self.repeat_ns(), self.free_ns());
        let due = |request: &&mut Request| now_ns >= request.due_ns && (request.sent > 0 || now_ns >= free_ns);
        let request = self.request.as_mut().filter(due)?;
        // The interval doubles after each repetition, so that a slow line is not overloaded.
        request.due_ns = now_ns + (repeat_ns << request.sent.min(8)).min(LONGEST_REPEAT_NS.max(repeat_ns));
        request.sent += 1;
        self.counters.repeats += u64::from(request.sent > 1);
        self.silent += 1;
        self.silent_since_ns.get_or_insert(now_ns);
        self.sent[self.sequence as usize % REMEMBERED] = Some((self.sequence, now_ns));
        let (tick, present, inputs, length) = (request.tick, request.present, request.inputs, request.length);
        Some(self.send(Message::Tick(Tick { tick, inputs: Samples { present, bytes: &inputs[..length] } })))
    }

    /// Returns the frame that ends the run for the device.
    pub fn stop(&mut self) -> &[u8] {
        self.send(Message::Stop)
    }

    /// Processes one received byte. Returns the event that it completes, if any.
    pub fn push(&mut self, byte: u8, now_ns: u64) -> Option<DeviceEvent<'_>> {
        let Self { terms, decoder, newest_sequence, counters, slips, .. } = self;
        let payload = decoder.push(byte)?;
        let (sequence, message) = match parse(payload) {
            Ok(parsed) => parsed,
            Err(ParseError::Version(theirs)) => return Some(DeviceEvent::OtherVersion(theirs)),
            Err(ParseError::Malformed) => {
                counters.malformed += 1;
                return None;
            }
        };
        match message {
            Message::Hello(_) | Message::Tick(_) | Message::Stop => counters.echoes += 1,
            Message::Welcome(welcome) if welcome.run == terms.run => {
                self.cycle = (welcome.next_tick == 0).then_some(Cycle::Idle(sequence));
                // A greeted device that sends another Welcome has received two greetings.
                let restarted = !self.greeted && self.answered.is_some_and(|answered| welcome.next_tick <= answered);
                if restarted {
                    counters.restarts += 1;
                    // The device counts from 0 again: its next frame is the first comparable one.
                    *newest_sequence = None;
                } else {
                    count_gap(newest_sequence, counters, sequence);
                }
                if !self.greeted {
                    counters.handshakes += 1;
                    self.greeted = true;
                    self.silent = 0;
                    self.sent = [None; REMEMBERED];
                    if let Some(request) = &mut self.request {
                        (request.due_ns, request.sent) = (now_ns, 0);
                    }
                    return Some(DeviceEvent::Welcome(welcome));
                }
            }
            // A late Welcome of another run.
            Message::Welcome(_) => counters.late += 1,
            Message::Refuse(Refuse { reason: Reason::NotGreeted, .. }) => {
                count_gap(newest_sequence, counters, sequence);
                self.greeted = false;
            }
            Message::Refuse(refusal) => return Some(DeviceEvent::Refused(refusal)),
            Message::Answer(answer) => {
                count_gap(newest_sequence, counters, sequence);
                if !terms.accepts(&answer.outputs) {
                    counters.malformed += 1;
                    return None;
                }
                self.silent = 0;
                self.silent_since_ns = None;
                // Late answers count too: a device that has fallen behind and is asked twice would stay behind.
                let sent = self.sent[answer.echo as usize % REMEMBERED].take_if(|(frame, _)| *frame == answer.echo);
                if let Some((_, sent_ns)) = sent {
                    smooth(&mut self.round_trip_ns, now_ns.saturating_sub(sent_ns));
                }
                self.cycle = Some(Cycle::Tick(answer.tick));
                let request = self.request.take_if(|request| request.tick == answer.tick);
                let repeated = self.answered == Some(answer.tick);
                if self.follows {
                    slips.take(&answer, request.as_ref(), repeated, sent.is_some());
                }
                match request {
                    Some(_) => {
                        self.answered = Some(answer.tick);
                        return Some(DeviceEvent::Answer(answer));
                    }
                    None if repeated => counters.duplicates += 1,
                    None => counters.late += 1,
                }
            }
        }
        None
    }

    /// Handles an interruption of the line: frames in transit are lost, and another device may answer afterwards.
    pub fn cut(&mut self, now_ns: u64) {
        self.decoder.cut();
        self.greet_again(now_ns);
    }

    /// Counts a reopening of the line.
    pub fn reopened(&mut self) {
        self.counters.reopened += 1;
    }

    /// Counts a frame that the line did not accept.
    pub fn unsent(&mut self) {
        self.counters.unsent += 1;
    }

    /// Returns the time for which the device has not answered, ns; 0 if no answer is expected.
    pub fn silent_ns(&self, now_ns: u64) -> u64 {
        self.silent_since_ns.map_or(0, |since_ns| now_ns.saturating_sub(since_ns))
    }

    /// Starts waiting for an answer, unless already waiting.
    pub fn wait_since(&mut self, now_ns: u64) {
        self.silent_since_ns.get_or_insert(now_ns);
    }

    /// Restarts the wait with the next request.
    pub fn restart_wait(&mut self) {
        self.silent_since_ns = None;
    }

    /// Returns the number of handshakes with a device that had lost the run.
    pub fn restarts(&self) -> u64 {
        self.counters.restarts
    }

    /// Returns the terms of the run.
    pub fn terms(&self) -> &Terms {
        &self.terms
    }

    /// Returns the counters.
    pub fn counters(&self) -> LineCounters {
        let frames = self.decoder.counters();
        LineCounters {
            frames_received: frames.frames,
            bytes_received: frames.bytes,
            crc_errors: frames.crc_errors,
            malformed: self.counters.malformed + frames.malformed,
            dropped_bytes: frames.dropped_bytes,
            resyncs: frames.resyncs,
            ..self.counters
        }
    }

    fn greet_again(&mut self, now_ns: u64) {
        self.greeted = false;
        self.silent = 0;
        self.greet_due_ns = now_ns;
    }

    /// Returns the time from which the device may be asked for another tick of the clock, ns. A device that still
    /// works on an earlier tick would be late for this one, and for each after it. After a period it is asked
    /// nevertheless: the earlier request may be lost.
    fn free_ns(&self) -> u64 {
        let Some(period_ns) = self.terms.period_ns.filter(|_| !self.follows) else { return 0 };
        let wait_ns = self.repeat_ns().min(period_ns);
        self.sent.iter().flatten().map(|(_, sent_ns)| sent_ns + wait_ns).max().unwrap_or(0)
    }

    fn repeat_ns(&self) -> u64 {
        let shortest_ns = self.terms.period_ns.map_or(SHORTEST_REPEAT_NS, |period_ns| period_ns / 4);
        shortest_ns.max(PATIENT_ROUND_TRIPS * self.round_trip_ns)
    }

    fn send(&mut self, message: Message<'_>) -> &[u8] {
        let mut payload = [0; MAX_PAYLOAD];
        let frame = write(self.sequence, message, &mut payload)
            .and_then(|payload| encode(payload, &mut self.frame))
            .expect("a message within its limits fits into a frame");
        self.sequence = self.sequence.wrapping_add(1);
        self.counters.frames_sent += 1;
        self.counters.bytes_sent += frame.len() as u64;
        frame
    }
}

/// Counts the frames missing between the highest sequence number and this one. A repeated frame is not newer: it is
/// no gap, and does not change the highest number.
fn count_gap(newest_sequence: &mut Option<u32>, counters: &mut LineCounters, sequence: u32) {
    let ahead = newest_sequence.map_or(1, |newest| sequence.wrapping_sub(newest));
    if (1..=u32::MAX / 2).contains(&ahead) {
        counters.sequence_gaps += u64::from(ahead - 1);
        *newest_sequence = Some(sequence);
    }
}

fn smooth(mean_ns: &mut u64, value_ns: u64) {
    *mean_ns = if *mean_ns == 0 { value_ns } else { *mean_ns - (*mean_ns >> SMOOTHING) + (value_ns >> SMOOTHING) };
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::role::CommandEvent;

    const HELLO: Hello<'_> = Hello {
        run: 7,
        realtime: true,
        period_ns: 2_000_000,
        last_tick: 1000,
        timeout_ticks: 20,
        manual_rearm: false,
        role: "body",
        reads: "",
        writes: "",
    };

    /// The host's end, with a device that counts its cycles.
    struct Line {
        host: HostSession,
        sequence: u32,
        now_ns: u64,
    }

    impl Line {
        fn greeted() -> Self {
            let terms = Terms { run: 7, period_ns: Some(HELLO.period_ns), outputs: [0; MAX_SAMPLES], required: 0 };
            let mut line = Self { host: HostSession::new(terms), sequence: 0, now_ns: 0 };
            line.host.follow();
            assert!(line.host.due(0, &HELLO).is_some());
            line.arrive(Message::Welcome(Welcome { run: 7, next_tick: 0, device: "test" }));
            assert_eq!((line.host.take_cycle(), line.host.take_cycle()), (Some(Cycle::Idle(0)), None));
            line
        }

        fn arrive(&mut self, message: Message<'_>) {
            let (mut payload, mut frame) = ([0; MAX_PAYLOAD], [0; MAX_FRAME]);
            let frame = encode(write(self.sequence, message, &mut payload).unwrap(), &mut frame).unwrap();
            self.sequence += 1;
            frame.iter().for_each(|byte| _ = self.host.push(*byte, self.now_ns));
        }

        /// Lets the request of a tick fall due. Returns its sequence, if it was `sent`.
        fn request(&mut self, tick: u64, sent: bool) -> u32 {
            self.now_ns += HELLO.period_ns;
            self.host.request(tick, Samples { present: 1, bytes: &[1; 8] }, self.now_ns);
            let sequence = self.host.sequence;
            assert!(!sent || self.host.due(self.now_ns, &HELLO).is_some());
            sequence
        }

        fn answer(&mut self, echo: u32, tick: u64, event: CommandEvent) {
            self.arrive(Message::Answer(Answer { echo, tick, event, outputs: Samples::default() }));
            assert_eq!(self.host.take_cycle(), Some(Cycle::Tick(tick)));
        }
    }

    #[test]
    fn a_cycle_slips_if_its_request_came_too_late() {
        let mut line = Line::greeted();
        let first = line.request(0, true);
        line.answer(first, 0, CommandEvent::NotDue);
        // The request is lost.
        line.request(1, true);
        line.answer(first, 1, CommandEvent::Held);
        assert_eq!(line.host.slips(), 0);
        // The request comes after its cycle: the device answers it again, and the network doubles that answer.
        let late = line.request(2, true);
        line.answer(first, 2, CommandEvent::Held);
        assert_eq!(line.host.slips(), 0);
        line.answer(late, 2, CommandEvent::Held);
        line.answer(late, 2, CommandEvent::Held);
        assert_eq!(line.host.slips(), 1);
        // This host wakes after the cycle.
        line.request(3, false);
        line.answer(late, 3, CommandEvent::Held);
        assert_eq!(line.host.slips(), 2);
        // It sleeps for two cycles, and gives up a third.
        line.answer(late, 4, CommandEvent::Held);
        line.answer(late, 5, CommandEvent::Held);
        let sent = line.request(6, true);
        line.host.give_up();
        line.answer(sent, 6, CommandEvent::Applied);
        assert_eq!(line.host.slips(), 5);
        // An overtaken frame is not news.
        line.answer(late, 4, CommandEvent::Held);
        let sent = line.request(7, true);
        line.answer(sent, 7, CommandEvent::Applied);
        assert_eq!(line.host.slips(), 5);
    }
}
