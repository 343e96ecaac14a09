//! The host's end: what to send when, which answers count, and the counters of the line.
//!
//! A request is repeated until it is answered or given up, and a device that is silent for long is greeted anew. Must not
//! do I/O, nor look at a clock: both are handed in.

use super::frame::{Decoder, MAX_FRAME, MAX_PAYLOAD, encode};
use super::message::{
    Answer, Hello, MAX_CONTENT, MAX_SAMPLES, Message, ParseError, Reason, Refuse, Samples, Tick, Welcome, parse, write,
};
use serde::{Deserialize, Serialize};

/// Between two greetings, ns.
const GREET_NS: u64 = 100_000_000;
/// After so many requests in a row without any answer the device is greeted anew.
const SILENT_REQUESTS: u32 = 8;
/// The shortest time after which a request is repeated where no clock drives the ticks, and the longest, ns.
const SHORTEST_REPEAT_NS: u64 = 5_000_000;
const LONGEST_REPEAT_NS: u64 = 1_000_000_000;
/// Of so many frames it is known when they were sent; a power of two.
const REMEMBERED: usize = 32;
/// A request is repeated after so many round trips; the smoothing of that figure, as a shift.
const PATIENT_ROUND_TRIPS: u64 = 2;
const SMOOTHING: u32 = 3;

/// The counters of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LineCounters {
    /// Frames sent, repeated ones too.
    pub frames_sent: u64,
    /// Their bytes.
    pub bytes_sent: u64,
    /// Frames received whole.
    pub frames_received: u64,
    /// Bytes received, good or bad.
    pub bytes_received: u64,
    /// Frames received with a wrong CRC.
    pub crc_errors: u64,
    /// Blocks that were no frame, and frames that were no message.
    pub malformed: u64,
    /// Bytes of both that were dropped.
    pub dropped_bytes: u64,
    /// How often a good frame followed something dropped.
    pub resyncs: u64,
    /// Frames that the device sent and that did not come whole in their turn, by its sequence numbers.
    pub sequence_gaps: u64,
    /// Answers to a tick that was answered already.
    pub duplicates: u64,
    /// Answers to a tick that had been given up.
    pub late: u64,
    /// The host's own frames coming back: an echo, or a loop.
    pub echoes: u64,
    /// Requests sent again.
    pub repeats: u64,
    /// Ticks given up without an answer.
    pub unanswered: u64,
    /// Handshakes completed.
    pub handshakes: u64,
    /// Handshakes with a device that had lost the run: its body was at its initial state again, in the midst of it.
    pub restarts: u64,
    /// How often the line was opened again.
    pub reopened: u64,
    /// Frames that the line did not take, for the one before was still on its way.
    pub unsent: u64,
}

/// What the device said that its host must know.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DeviceEvent<'a> {
    /// It takes part.
    Welcome(Welcome<'a>),
    /// It does not.
    Refused(Refuse<'a>),
    /// It speaks this version of the protocol.
    OtherVersion(u8),
    /// The answer to the request at hand.
    Answer(Answer<'a>),
}

/// What a host must know of its run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Terms {
    /// [`Hello::run`].
    pub run: u64,
    /// The period where ticks follow the clock, ns.
    pub period_ns: Option<u64>,
    /// Bytes of each sample in an answer, in order; 0 beyond the last.
    pub outputs: [u16; MAX_SAMPLES],
    /// Bit i: sample i is in every answer.
    pub required: u32,
}

impl Terms {
    /// Whether an answer has what was agreed upon.
    fn hold(&self, samples: &Samples<'_>) -> bool {
        let lengths = self.outputs.iter().enumerate().filter(|(index, _)| samples.present >> index & 1 == 1);
        let (total, whole) =
            lengths.fold((0, true), |(total, whole), (_, length)| (total + usize::from(*length), whole && *length > 0));
        whole && total == samples.bytes.len() && samples.present & self.required == self.required
    }
}

/// The request at hand.
struct Request {
    tick: u64,
    present: u32,
    inputs: [u8; MAX_CONTENT],
    length: usize,
    /// When it is to be sent (again), ns, and how often it was.
    due_ns: u64,
    sent: u32,
}

/// The host of one device in one run.
pub struct HostSession {
    terms: Terms,
    decoder: Decoder,
    frame: [u8; MAX_FRAME],
    sequence: u32,
    /// The device's highest sequence number.
    heard: Option<u32>,
    greeted: bool,
    greet_due_ns: u64,
    request: Option<Request>,
    /// The last tick that was answered.
    answered: Option<u64>,
    /// Requests in a row without an answer, and since when something has been waited for, ns.
    silent: u32,
    silent_since_ns: Option<u64>,
    /// The latest requests that no answer is known to: frame and when it was sent, ns.
    sent: [Option<(u32, u64)>; REMEMBERED],
    /// Smoothed, ns.
    round_trip_ns: u64,
    counters: LineCounters,
}

impl HostSession {
    /// A host that has not greeted its device yet.
    pub fn new(terms: Terms) -> Self {
        Self {
            terms,
            decoder: Decoder::default(),
            frame: [0; MAX_FRAME],
            sequence: 0,
            heard: None,
            greeted: false,
            greet_due_ns: 0,
            request: None,
            answered: None,
            silent: 0,
            silent_since_ns: None,
            sent: [None; REMEMBERED],
            round_trip_ns: 0,
            counters: LineCounters::default(),
        }
    }

    /// Whether the device takes part.
    pub fn greeted(&self) -> bool {
        self.greeted
    }

    /// Asks for a tick from now on, with its samples, which take at most [`MAX_CONTENT`] bytes.
    pub fn request(&mut self, tick: u64, samples: Samples<'_>, now_ns: u64) {
        let (mut inputs, length) = ([0; MAX_CONTENT], samples.bytes.len().min(MAX_CONTENT));
        inputs[..length].copy_from_slice(&samples.bytes[..length]);
        let present = samples.present;
        self.request = Some(Request { tick, present, inputs, length, due_ns: now_ns, sent: 0 });
    }

    /// Asks no more for the tick at hand.
    pub fn give_up(&mut self) {
        self.counters.unanswered += u64::from(self.request.take().is_some());
    }

    /// The frame to be sent now, if there is one. To be asked again until there is none.
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
            return Some(self.say(Message::Hello(*hello)));
        }
        let (repeat_ns, free_ns) = (self.repeat_ns(), self.free_ns());
        let due = |request: &&mut Request| now_ns >= request.due_ns && (request.sent > 0 || now_ns >= free_ns);
        let request = self.request.as_mut().filter(due)?;
        // Twice as long after each time: a line that is too slow for what is asked of it must not be asked more.
        request.due_ns = now_ns + (repeat_ns << request.sent.min(8)).min(LONGEST_REPEAT_NS.max(repeat_ns));
        request.sent += 1;
        self.counters.repeats += u64::from(request.sent > 1);
        self.silent += 1;
        self.silent_since_ns.get_or_insert(now_ns);
        self.sent[self.sequence as usize % REMEMBERED] = Some((self.sequence, now_ns));
        let (tick, present, inputs, length) = (request.tick, request.present, request.inputs, request.length);
        Some(self.say(Message::Tick(Tick { tick, inputs: Samples { present, bytes: &inputs[..length] } })))
    }

    /// The frame that ends the run for the device.
    pub fn stop(&mut self) -> &[u8] {
        self.say(Message::Stop)
    }

    /// Takes a byte that has arrived, and tells what it completes.
    pub fn push(&mut self, byte: u8, now_ns: u64) -> Option<DeviceEvent<'_>> {
        let Self { terms, decoder, heard, counters, .. } = self;
        let payload = decoder.push(byte)?;
        let (sequence, message) = match parse(payload) {
            Ok(said) => said,
            Err(ParseError::Version(theirs)) => return Some(DeviceEvent::OtherVersion(theirs)),
            Err(ParseError::Malformed) => {
                counters.malformed += 1;
                return None;
            }
        };
        match message {
            Message::Hello(_) | Message::Tick(_) | Message::Stop => counters.echoes += 1,
            Message::Welcome(welcome) if welcome.run == terms.run => {
                // A greeted device that welcomes again has heard two greetings.
                let restarted = !self.greeted && self.answered.is_some_and(|answered| welcome.next_tick <= answered);
                if restarted {
                    counters.restarts += 1;
                    // It counts from 0: the next frame is the first that is comparable.
                    *heard = None;
                } else {
                    note(heard, counters, sequence);
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
            // Of another run: it was on its way for long.
            Message::Welcome(_) => counters.late += 1,
            Message::Refuse(Refuse { reason: Reason::NotGreeted, .. }) => {
                note(heard, counters, sequence);
                self.greeted = false;
            }
            Message::Refuse(refusal) => return Some(DeviceEvent::Refused(refusal)),
            Message::Answer(answer) => {
                note(heard, counters, sequence);
                if !terms.hold(&answer.outputs) {
                    counters.malformed += 1;
                    return None;
                }
                self.silent = 0;
                self.silent_since_ns = None;
                // Late answers tell it too: a device that has fallen behind and is asked twice stays behind.
                let sent = self.sent[answer.echo as usize % REMEMBERED].take_if(|(frame, _)| *frame == answer.echo);
                if let Some((_, sent_ns)) = sent {
                    smooth(&mut self.round_trip_ns, now_ns.saturating_sub(sent_ns));
                }
                match self.request.take_if(|request| request.tick == answer.tick) {
                    Some(_) => {
                        self.answered = Some(answer.tick);
                        return Some(DeviceEvent::Answer(answer));
                    }
                    None if self.answered.is_some_and(|tick| answer.tick == tick) => counters.duplicates += 1,
                    None => counters.late += 1,
                }
            }
        }
        None
    }

    /// The line was cut: what was on its way is lost, and nobody knows who is there when it is whole again.
    pub fn cut(&mut self, now_ns: u64) {
        self.decoder.cut();
        self.greet_again(now_ns);
    }

    /// The line was opened again.
    pub fn reopened(&mut self) {
        self.counters.reopened += 1;
    }

    /// The line did not take a frame.
    pub fn unsent(&mut self) {
        self.counters.unsent += 1;
    }

    /// For how long the device has not answered, ns; 0 if nothing is waited for.
    pub fn silent_ns(&self, now_ns: u64) -> u64 {
        self.silent_since_ns.map_or(0, |since_ns| now_ns.saturating_sub(since_ns))
    }

    /// Something is waited for, at the latest since now.
    pub fn wait_since(&mut self, now_ns: u64) {
        self.silent_since_ns.get_or_insert(now_ns);
    }

    /// Begins to wait anew.
    pub fn restart_wait(&mut self) {
        self.silent_since_ns = None;
    }

    /// What was agreed upon.
    pub fn terms(&self) -> &Terms {
        &self.terms
    }

    /// The counters.
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

    /// When the device can be asked for another tick of the clock, ns: who is still at an earlier one would be late for this one
    /// too, and for each after it. After a period it is asked all the same: the earlier request may have been lost.
    fn free_ns(&self) -> u64 {
        let Some(period_ns) = self.terms.period_ns else { return 0 };
        let wait_ns = self.repeat_ns().min(period_ns);
        self.sent.iter().flatten().map(|(_, sent_ns)| sent_ns + wait_ns).max().unwrap_or(0)
    }

    fn repeat_ns(&self) -> u64 {
        let shortest_ns = self.terms.period_ns.map_or(SHORTEST_REPEAT_NS, |period_ns| period_ns / 4);
        shortest_ns.max(PATIENT_ROUND_TRIPS * self.round_trip_ns)
    }

    fn say(&mut self, message: Message<'_>) -> &[u8] {
        let mut payload = [0; MAX_PAYLOAD];
        let frame = write(self.sequence, message, &mut payload)
            .and_then(|payload| encode(payload, &mut self.frame))
            .expect("every message whose texts and contents are within their limits fits into a frame");
        self.sequence = self.sequence.wrapping_add(1);
        self.counters.frames_sent += 1;
        self.counters.bytes_sent += frame.len() as u64;
        frame
    }
}

/// Counts the frames between the newest one heard and this one. One that is not newer came again: it is no gap, and nothing
/// is counted from it.
fn note(heard: &mut Option<u32>, counters: &mut LineCounters, sequence: u32) {
    let ahead = heard.map_or(1, |newest| sequence.wrapping_sub(newest));
    if (1..=u32::MAX / 2).contains(&ahead) {
        counters.sequence_gaps += u64::from(ahead - 1);
        *heard = Some(sequence);
    }
}

fn smooth(mean_ns: &mut u64, value_ns: u64) {
    *mean_ns = if *mean_ns == 0 { value_ns } else { *mean_ns - (*mean_ns >> SMOOTHING) + (value_ns >> SMOOTHING) };
}
